// A map in Web Mercator: layers of tiles, drawings over them, moved and zoomed by mouse, fingers and keys.

import * as api from "./api";
import { el, svg } from "./dom";
import * as units from "./units";

const SIDE = 256;
const MAX_ZOOM = 24;
const FADE_MS = 4000; // after which a tile that does not load gives way
const EQUATOR_M = 2 * Math.PI * 6378137;
const CLICK_PX = 5; // a pointer that moved farther moved the map

/** A place in the square of Web Mercator: 0 to 1 from west and from north. */
export interface Place {
  x: number;
  y: number;
}

/** West, south, east, north in degrees. */
export type Bounds = [number, number, number, number];

export interface TileJson {
  bounds?: Bounds;
  version?: string;
  /** Of contours, by zoom. */
  intervals_m?: number[];
  /** What colours are multiplied with. */
  exposure?: number;
}

export function placeOf(lat_deg: number, lon_deg: number): Place {
  return { x: lon_deg / 360 + 0.5, y: 0.5 - Math.asinh(Math.tan((lat_deg * Math.PI) / 180)) / (2 * Math.PI) };
}

/** Latitude and longitude. */
export function degreesOf({ x, y }: Place): [number, number] {
  return [(Math.atan(Math.sinh(Math.PI * (1 - 2 * y))) * 180) / Math.PI, 360 * (x - 0.5)];
}

/** None where there is no such layer; throws when the ground station does not answer. */
export const tileJson = (address: string): Promise<TileJson | null> =>
  api.ask<TileJson>(address).catch((error: unknown) => {
    if (error instanceof api.Refused) return null;
    throw error;
  });

/** The tiles of one layer in a box of their own. */
export class Layer {
  readonly element = el("div", { className: "layer" });
  shown = true;
  version = "";
  intervals_m: number[] = [];
  protected readonly tiles = new Map<string, HTMLImageElement | HTMLCanvasElement>();

  /** `about` is the address of its TileJSON, whose version changes with the tiles. */
  constructor(
    protected readonly address: (z: number, x: number, y: number) => string,
    readonly about?: string,
  ) {}

  /** Whether it is switched on. */
  get seen(): boolean {
    return this.shown;
  }

  set seen(on: boolean) {
    this.shown = on;
  }

  async refresh(): Promise<void> {
    if (!this.about || !this.shown) return;
    const { version = "", intervals_m = [], exposure = 1 } = (await tileJson(this.about)) ?? {};
    Object.assign(this, { version, intervals_m });
    this.element.style.filter = exposure === 1 ? "" : `brightness(${exposure})`;
  }

  opacity(share: number): void {
    this.element.style.opacity = String(share);
  }

  static zoomOf = (zoom: number): number => Math.max(0, Math.min(MAX_ZOOM, Math.round(zoom)));

  /** Places the tiles that a view needs; older ones stay below until theirs have come. */
  draw(middle: Place, zoom: number, w: number, h: number): void {
    this.element.hidden = !this.shown;
    if (!this.shown) return;
    const z = Layer.zoomOf(zoom);
    const n = 2 ** z;
    const scale = SIDE * 2 ** zoom;
    const wanted = new Set<string>();
    const range = (at: number, half: number): [number, number] => [
      Math.max(0, Math.floor((at - half / scale) * n)),
      Math.min(n - 1, Math.floor((at + half / scale) * n)),
    ];
    const [west, east] = range(middle.x, w / 2);
    const [north, south] = range(middle.y, h / 2);
    for (let x = west; x <= east; x++)
      for (let y = north; y <= south; y++) {
        const name = `${z}/${x}/${y}/${this.version}`;
        wanted.add(name);
        if (!this.tiles.has(name)) this.tiles.set(name, this.load(z, x, y));
      }
    const missing = [...wanted].map((name) => this.tiles.get(name)!).some((tile) => isLoading(tile) || tile.hidden);
    for (const [name, tile] of this.tiles) {
      if (!wanted.has(name) && (!missing || isLoading(tile) || Number(tile.dataset["at"]) < performance.now() - FADE_MS)) {
        tile.remove();
        this.tiles.delete(name);
        continue;
      }
      const [tz, tx, ty] = name.split("/").map(Number) as [number, number, number];
      // Whole pixels, so that neighbours leave no seam.
      const edge = (n: number, at: number, half: number): number => Math.round((n / 2 ** tz - at) * scale + half);
      const [left, top] = [edge(tx, middle.x, w / 2), edge(ty, middle.y, h / 2)];
      tile.style.transform = `translate(${left}px, ${top}px)`;
      tile.style.width = `${edge(tx + 1, middle.x, w / 2) - left}px`;
      tile.style.height = `${edge(ty + 1, middle.y, h / 2) - top}px`;
      if (wanted.has(name)) tile.dataset["at"] = String(performance.now());
    }
  }

  protected load(z: number, x: number, y: number): HTMLImageElement | HTMLCanvasElement {
    const image = new Image();
    image.alt = "";
    image.draggable = false;
    image.onload = () => this.came();
    image.onerror = () => {
      image.hidden = true;
      this.came();
    };
    image.src = `${this.address(z, x, y)}?v=${this.version}`;
    this.element.append(image);
    return image;
  }

  /** A tile came, or did not: the map is drawn again. */
  protected came(): void {
    this.element.dispatchEvent(new Event("tile", { bubbles: true }));
  }

  /** The tiles that did not come are asked for at the next drawing. */
  retry(): void {
    for (const [name, tile] of this.tiles)
      if (tile.hidden) {
        tile.remove();
        this.tiles.delete(name);
      }
  }

  get loading(): boolean {
    return this.shown && [...this.tiles.values()].some(isLoading);
  }
}

/** A tile that is drawn here says by `data-state` that it waits for its content. */
const isLoading = (tile: HTMLImageElement | HTMLCanvasElement): boolean =>
  tile instanceof HTMLImageElement ? !tile.complete : tile.dataset["state"] === "loading";

/** Layers in a box, and what is drawn over them. */
export class FlatMap {
  readonly layers: Layer[] = [];
  /** Called at each drawing. */
  readonly over: (() => void)[] = [];
  /** Called with a place that is pointed at, and with one that is clicked. */
  onHover: (place: Place) => void = () => undefined;
  onClick: (place: Place) => void = () => undefined;
  middle: Place = { x: 0.5, y: 0.5 };
  zoom = 18;
  isFree = true; // until somebody moves it, it shows what `frame` gave it
  private readonly bar = svg("svg", { class: "scale", width: "200", height: "30" });
  private framed: Bounds | null = null;
  private readonly resized = new ResizeObserver(() => {
    if (this.isFree && this.framed) this.frame(this.framed);
    this.draw();
  });

  constructor(readonly host: HTMLElement) {
    const nearer = el("button", { textContent: "+", title: "nearer", onclick: () => this.zoomTo(this.zoom + 1) });
    const farther = el("button", { textContent: "−", title: "farther", onclick: () => this.zoomTo(this.zoom - 1) });
    host.append(this.bar, el("span", { className: "zoom" }, nearer, farther));
    host.addEventListener("tile", () => this.draw());
    this.listen();
    this.resized.observe(host);
  }

  close(): void {
    this.resized.disconnect();
    this.over.length = 0; // a tile that comes late draws nothing more
  }

  /** A new layer above the others, below what is drawn over them. */
  add(layer: Layer): void {
    this.host.insertBefore(layer.element, this.layers.at(-1)?.element.nextSibling ?? this.host.firstChild);
    this.layers.push(layer);
  }

  remove(layer: Layer): void {
    layer.element.remove();
    this.layers.splice(this.layers.indexOf(layer), 1);
  }

  draw(): void {
    const { clientWidth: w, clientHeight: h } = this.host;
    for (const layer of this.layers) layer.draw(this.middle, this.zoom, w, h);
    for (const write of this.over) write();
    this.scaleBar();
  }

  get loading(): boolean {
    return this.layers.some((layer) => layer.loading);
  }

  /** Where a place is seen, CSS pixels from the box's corner. */
  seen({ x, y }: Place): [number, number] {
    const scale = SIDE * 2 ** this.zoom;
    return [(x - this.middle.x) * scale + this.host.clientWidth / 2, (y - this.middle.y) * scale + this.host.clientHeight / 2];
  }

  /** Places as the points of an SVG line. */
  path = (places: Place[]): string => places.map((p) => this.seen(p).map((v) => v.toFixed(1)).join(",")).join(" ");

  under(x: number, y: number): Place {
    const scale = SIDE * 2 ** this.zoom;
    return { x: this.middle.x + (x - this.host.clientWidth / 2) / scale, y: this.middle.y + (y - this.host.clientHeight / 2) / scale };
  }

  /** Length on the ground of a CSS pixel at the middle. */
  get pixel_m(): number {
    const [lat] = degreesOf(this.middle);
    return (EQUATOR_M * Math.cos((lat * Math.PI) / 180)) / (SIDE * 2 ** this.zoom);
  }

  frame(bounds: Bounds): void {
    const [west, south, east, north] = (this.framed = bounds);
    const [a, b] = [placeOf(north, west), placeOf(south, east)];
    this.middle = { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2 };
    const fit = Math.min(this.host.clientWidth / (b.x - a.x), this.host.clientHeight / (b.y - a.y)) / SIDE;
    this.zoom = Math.max(1, Math.min(MAX_ZOOM, Math.log2(fit * 0.9)));
  }

  private zoomTo(next: number, x = this.host.clientWidth / 2, y = this.host.clientHeight / 2): void {
    const before = this.under(x, y);
    this.zoom = Math.max(1, Math.min(MAX_ZOOM, next));
    const after = this.under(x, y);
    this.middle = { x: this.middle.x + before.x - after.x, y: this.middle.y + before.y - after.y };
    this.isFree = false;
    this.draw();
  }

  private move(dx: number, dy: number): void {
    const scale = SIDE * 2 ** this.zoom;
    this.middle = { x: this.middle.x - dx / scale, y: this.middle.y - dy / scale };
    this.isFree = false;
    this.draw();
  }

  /** Mouse, fingers and keys. */
  private listen(): void {
    const { host } = this;
    const fingers = new Map<number, Place>();
    let down: Place | null = null; // while what began there may be a click
    const local = (e: MouseEvent): [number, number] => {
      const box = host.getBoundingClientRect();
      return [e.clientX - box.left, e.clientY - box.top];
    };
    const apart = (): number => {
      const [a, b] = [...fingers.values()];
      return a && b ? Math.hypot(a.x - b.x, a.y - b.y) : 0;
    };
    host.addEventListener("pointerdown", (e) => {
      if ((e.target as HTMLElement).closest("button, input, a")) return;
      host.setPointerCapture(e.pointerId);
      fingers.set(e.pointerId, { x: e.clientX, y: e.clientY });
      down = fingers.size === 1 ? { x: e.clientX, y: e.clientY } : null;
    });
    host.addEventListener("pointermove", (e) => {
      this.onHover(this.under(...local(e)));
      const before = fingers.get(e.pointerId);
      if (!before) return;
      if (down && Math.hypot(e.clientX - down.x, e.clientY - down.y) > CLICK_PX) down = null;
      const was = apart();
      fingers.set(e.pointerId, { x: e.clientX, y: e.clientY });
      this.move((e.clientX - before.x) / fingers.size, (e.clientY - before.y) / fingers.size);
      if (was && apart()) this.zoomTo(this.zoom + Math.log2(apart() / was), ...local(e));
    });
    host.addEventListener("pointerup", (e) => {
      if (down && fingers.has(e.pointerId)) this.onClick(this.under(...local(e)));
      down = null;
    });
    for (const name of ["pointerup", "pointercancel"] as const) host.addEventListener(name, (e) => fingers.delete(e.pointerId));
    host.addEventListener("wheel", (e) => (e.preventDefault(), this.zoomTo(this.zoom - e.deltaY / 300, ...local(e))), { passive: false });
    host.addEventListener("keydown", (e) => {
      if ((e.target as HTMLElement).matches("input, select")) return;
      const step: Record<string, [number, number]> = { ArrowLeft: [80, 0], ArrowRight: [-80, 0], ArrowUp: [0, 80], ArrowDown: [0, -80] };
      if (step[e.key]) this.move(...step[e.key]!);
      else if (e.key === "+") this.zoomTo(this.zoom + 1);
      else if (e.key === "-") this.zoomTo(this.zoom - 1);
      else return;
      e.preventDefault();
    });
  }

  /** A round length on the ground at the middle of the map. */
  private scaleBar(): void {
    const [length_m, words] = units.round(150 * this.pixel_m);
    this.bar.replaceChildren(
      svg("path", { d: `M1 12 V20 H${length_m / this.pixel_m + 1} V12` }),
      svg("text", { x: "6", y: "14" }, words),
    );
  }
}
