// Heights of a map: tiles in the Terrarium encoding, painted by height, and read under a pointer.

import { Layer, type Place } from "./flatmap";

const SIDE = 256;
const SHARE = 0.02; // of heights left out of the ramp at either end
const LIGHT = [-0.5, -0.5, 0.7] as const; // from the north-west
const LABEL_GAP_PX = 110;
const LABEL_EDGE_PX = 26;
const LABEL_SMOOTH_PX = 2;

/** Viridis, as in the legend of the 3D view. */
const RAMP = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]] as const;

interface Tile {
  z: number;
  x: number;
  y: number;
  canvas: HTMLCanvasElement;
  heights: Float32Array | null; // NaN where unknown
}

/** A height of a contour, where it is written and how it lies. */
export interface Label {
  place: Place;
  height_m: number;
  turn_deg: number;
}

/** Its tiles are always there, for the cursor; they are seen only when the layer is switched on. */
export class Terrain extends Layer {
  /** Lowest and highest height of the ramp; null without heights. */
  range: [number, number] | null = null;
  /** Called when the range has changed. */
  ranged: () => void = () => undefined;
  private readonly known = new Map<string, Tile>();

  override get seen(): boolean {
    return !this.element.classList.contains("unseen");
  }

  override set seen(on: boolean) {
    const shows = on && !this.seen;
    this.element.classList.toggle("unseen", !on);
    if (shows) this.paintAll();
  }

  /** Height above mean sea level at a place; null where unknown. */
  heightAt({ x, y }: Place): number | null {
    let best: Tile | null = null;
    for (const tile of this.known.values()) {
      if (!tile.heights || !tile.canvas.isConnected) continue;
      const n = 2 ** tile.z;
      if (Math.floor(x * n) === tile.x && Math.floor(y * n) === tile.y && (!best || tile.z > best.z)) best = tile;
    }
    if (!best) return null;
    const n = 2 ** best.z;
    const [col, row] = [Math.floor((x * n - best.x) * SIDE), Math.floor((y * n - best.y) * SIDE)];
    const height = best.heights![row * SIDE + col]!;
    return Number.isNaN(height) ? null : height;
  }

  /** Calls `use` with the middle and the height of each known pixel of the present zoom. */
  eachHeight(use: (place: Place, height_m: number) => void): void {
    const tiles = this.finest();
    for (const { z, x, y, heights } of tiles)
      heights!.forEach((height, i) => {
        if (Number.isNaN(height)) return;
        use({ x: (x + ((i % SIDE) + 0.5) / SIDE) / 2 ** z, y: (y + (Math.floor(i / SIDE) + 0.5) / SIDE) / 2 ** z }, height);
      });
  }

  /** Heights written along the contours of this interval. */
  labels(interval_m: number): Label[] {
    return this.finest().flatMap((tile) => labelsOf(tile, interval_m));
  }

  /** Tiles that are loaded, of the largest zoom that is shown. */
  private finest(): Tile[] {
    const loaded = [...this.known.values()].filter((t) => t.heights && t.canvas.isConnected);
    const z = Math.max(...loaded.map((t) => t.z));
    return loaded.filter((t) => t.z === z);
  }

  protected override load(z: number, x: number, y: number): HTMLCanvasElement {
    const canvas = document.createElement("canvas");
    canvas.width = canvas.height = SIDE;
    canvas.dataset["state"] = "loading";
    const tile: Tile = { z, x, y, canvas, heights: null };
    this.known.set(`${z}/${x}/${y}/${this.version}`, tile);
    for (const [name, { canvas: old }] of this.known) if (old !== canvas && !old.isConnected) this.known.delete(name);
    const image = new Image();
    image.onload = () => {
      tile.heights = decode(image);
      canvas.dataset["state"] = "shown";
      this.ramp();
      this.paint(tile);
      this.came();
    };
    image.onerror = () => {
      canvas.dataset["state"] = "missing";
      canvas.hidden = true;
      this.came();
    };
    image.src = `${this.address(z, x, y)}?v=${this.version}`;
    this.element.append(canvas);
    return canvas;
  }

  /** Fits the ramp to the tiles that are shown; paints all again when it has moved. */
  private ramp(): void {
    const values: number[] = [];
    for (const { heights } of this.finest()) for (let i = 0; i < heights!.length; i += 37) if (!Number.isNaN(heights![i]!)) values.push(heights![i]!);
    if (!values.length) return;
    values.sort((a, b) => a - b);
    const at = (share: number): number => values[Math.round(share * (values.length - 1))]!;
    const [low, high] = [at(SHARE), Math.max(at(1 - SHARE), at(SHARE) + 0.5)];
    const moved = !this.range || Math.abs(low - this.range[0]) + Math.abs(high - this.range[1]) > 0.02 * (high - low);
    if (!moved) return;
    this.range = [low, high];
    this.paintAll();
    this.ranged();
  }

  private paintAll(): void {
    for (const tile of this.known.values()) this.paint(tile);
  }

  private paint({ canvas, heights, z }: Tile): void {
    if (!this.range || !heights || !this.seen) return;
    const context = canvas.getContext("2d")!;
    const image = context.createImageData(SIDE, SIDE);
    const [low, high] = this.range;
    const pixel_m = 156543 / 2 ** z; // at the equator: shading needs no more
    heights.forEach((height, i) => {
      if (Number.isNaN(height)) return;
      const share = Math.max(0, Math.min(1, (height - low) / (high - low))) * (RAMP.length - 1);
      const k = Math.min(RAMP.length - 2, Math.floor(share));
      const light = shade(heights, i, pixel_m);
      for (let c = 0; c < 3; c++) image.data[4 * i + c] = light * (RAMP[k]![c]! + (share - k) * (RAMP[k + 1]![c]! - RAMP[k]![c]!));
      image.data[4 * i + 3] = 255;
    });
    context.putImageData(image, 0, 0);
  }
}

/** How bright the ground is at a pixel, about 1 where it is level. */
function shade(heights: Float32Array, i: number, pixel_m: number): number {
  const [col, row] = [i % SIDE, Math.floor(i / SIDE)];
  const rise = (a: number, b: number): number => (Number.isNaN(heights[a]!) || Number.isNaN(heights[b]!) ? 0 : (heights[b]! - heights[a]!) / (2 * pixel_m));
  const [dx, dy] = [col > 0 && col < SIDE - 1 ? rise(i - 1, i + 1) : 0, row > 0 && row < SIDE - 1 ? rise(i - SIDE, i + SIDE) : 0];
  const cos = (-dx * LIGHT[0] - dy * LIGHT[1] + LIGHT[2]) / Math.hypot(dx, dy, 1) / LIGHT[2];
  return Math.max(0.35, Math.min(1.2, 0.4 + 0.6 * cos));
}

function decode(image: HTMLImageElement): Float32Array {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = SIDE;
  const context = canvas.getContext("2d", { willReadFrequently: true })!;
  context.drawImage(image, 0, 0);
  const { data } = context.getImageData(0, 0, SIDE, SIDE);
  return Float32Array.from({ length: SIDE * SIDE }, (_, i) =>
    data[4 * i + 3] ? 256 * data[4 * i]! + data[4 * i + 1]! + data[4 * i + 2]! / 256 - 32768 : NaN,
  );
}

const found = new WeakMap<Float32Array, { interval_m: number; labels: Label[] }>();

/** Places on the contours of a tile, apart from each other and from its edge. */
function labelsOf({ z, x, y, heights }: Tile, interval_m: number): Label[] {
  const before = found.get(heights!);
  if (before?.interval_m === interval_m) return before.labels;
  const smooth = (col: number, row: number): number => {
    let [sum, n] = [0, 0];
    for (let r = row - LABEL_SMOOTH_PX; r <= row + LABEL_SMOOTH_PX; r++)
      for (let c = col - LABEL_SMOOTH_PX; c <= col + LABEL_SMOOTH_PX; c++) {
        const height = heights![r * SIDE + c]!;
        if (!Number.isNaN(height)) [sum, n] = [sum + height, n + 1];
      }
    return n > 12 ? sum / n : NaN;
  };
  const spots: [number, number][] = [];
  const labels: Label[] = [];
  for (let row = LABEL_EDGE_PX; row < SIDE - LABEL_EDGE_PX; row += 3)
    for (let col = LABEL_EDGE_PX; col < SIDE - LABEL_EDGE_PX; col++) {
      if (Number.isNaN(heights![row * SIDE + col]!) || spots.some(([c, r]) => Math.hypot(c - col, r - row) < LABEL_GAP_PX)) continue;
      const [here, next] = [smooth(col, row), smooth(col + 1, row)];
      const level = Math.max(Math.floor(here / interval_m), Math.floor(next / interval_m));
      if (!(Math.floor(here / interval_m) !== Math.floor(next / interval_m))) continue;
      const [dx, dy] = [smooth(col + 4, row) - smooth(col - 4, row), smooth(col, row + 4) - smooth(col, row - 4)];
      if (!(Math.hypot(dx, dy) < 4 * interval_m)) continue; // a wall: its lines lie on each other
      let turn_deg = (Math.atan2(dx, -dy) * 180) / Math.PI; // along the line
      if (turn_deg > 90) turn_deg -= 180;
      if (turn_deg < -90) turn_deg += 180;
      spots.push([col, row]);
      labels.push({ place: { x: (x + (col + 1) / SIDE) / 2 ** z, y: (y + (row + 0.5) / SIDE) / 2 ** z }, height_m: level * interval_m, turn_deg });
    }
  found.set(heights!, { interval_m, labels });
  return labels;
}
