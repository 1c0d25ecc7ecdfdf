// All scans and sites on one map: their outlines, what was measured in them, and which lie under a place.

import * as api from "./api";
import { el, short, svg } from "./dom";
import { type Bounds, degreesOf, FlatMap, Layer, type Place, placeOf, tileJson } from "./flatmap";
import { nameOf } from "./names";

const MIN_PX = 14; // a smaller outline is drawn as a dot
const NEAR_PX = 12;
const LETTER_PX = 8;
const ZOOM_PX = 60; // the buttons at the right border
const MIN_DEG = 0.0005; // of what is shown, about 50 m
const GRID_PX = 140; // at least, between lines of the grid
const STEPS_DEG = [45, 30, 10, 5, 2, 1, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001, 0.0005, 0.0002, 0.0001];

interface Outline {
  scan: api.Scan;
  corners: Place[]; // none: only its origin is known
  middle: Place;
}

export const keyOf = ({ drone, scan }: { drone: string; scan: string }): string => `${drone}/${scan}`;

export class Overview {
  readonly element = el("section", { className: "overview", hidden: true });
  /** Called with the scans under a place that was clicked; none: all. */
  onChoose: (scans: api.Scan[]) => void = () => undefined;
  private readonly host = el("div", { className: "map", tabIndex: 0 });
  private readonly grid = svg("svg", { class: "overlay grid" });
  private readonly images = el("div", { className: "layer" });
  private readonly marks = svg("svg", { class: "overlay outlines" });
  private readonly map = new FlatMap(this.host);
  private outlines: Outline[] = [];
  private marked = "";
  private shown = "";

  constructor() {
    this.element.setAttribute("aria-label", "map of all scans");
    this.host.setAttribute("role", "application");
    this.host.setAttribute("aria-label", "map of all scans: drag to move, plus and minus to zoom, Enter to list what is at the middle");
    this.element.append(this.host);
    this.host.prepend(this.grid, this.images);
    this.host.append(this.marks);
    this.map.over.push(() => this.draw());
    this.map.onClick = (place) => this.choose(place);
    this.host.addEventListener("keydown", (e) => e.target === this.host && e.key === "Enter" && this.choose(this.map.middle));
    this.map.onHover = (place) => {
      const names = this.at(place).map(nameOf);
      this.host.title = names.join("\n");
      this.host.classList.toggle("points", names.length > 0);
    };
    void tileJson("/tiles/basemap.json").then((found) => {
      if (!found) return;
      this.grid.remove();
      this.map.add(new Layer((z, x, y) => `/tiles/basemap/${z}/${x}/${y}`));
      this.host.append(this.images, this.marks);
      this.map.draw();
    }, () => undefined);
  }

  close(): void {
    this.map.close();
  }

  /** Draws these scans; the view moves when they are others, until somebody moves it. */
  show(scans: api.Scan[]): void {
    const placed = scans.filter((s) => s.origin);
    this.element.hidden = !placed.length;
    this.outlines = placed.map((scan) => {
      const corners = (scan.corners_lat_lon ?? []).map(([lat, lon]) => placeOf(lat, lon));
      const at = scan.origin!;
      const middle = corners.length ? { x: mean(corners.map((c) => c.x)), y: mean(corners.map((c) => c.y)) } : placeOf(at.lat_deg, at.lon_deg);
      return { scan, corners, middle };
    });
    const ids = placed.map(keyOf).join();
    if (ids && ids !== this.shown && this.map.isFree) this.map.frame(boundsOf(this.outlines));
    this.shown = ids;
    this.map.draw();
  }

  /** Marks the outline of a scan; null: none. */
  mark(scan: api.Scan | null): void {
    this.marked = scan ? keyOf(scan) : "";
    this.draw();
  }

  /** Shows all again. */
  whole(): void {
    this.map.isFree = true;
    this.shown = "";
  }

  /** Goes to the scans under a place, and gives them to `onChoose`. */
  private choose(place: Place): void {
    const found = this.at(place);
    if (found.length) {
      this.map.frame(boundsOf(this.outlines.filter(({ scan }) => found.includes(scan))));
      this.map.isFree = false;
      this.map.draw();
    }
    this.onChoose(found);
  }

  /** The scans under a place. */
  private at(place: Place): api.Scan[] {
    const [x, y] = this.map.seen(place);
    const hit = this.outlines.filter(({ corners, middle }) => {
      const spots = corners.map((c) => this.map.seen(c));
      const [west, east] = [Math.min(...spots.map((s) => s[0])), Math.max(...spots.map((s) => s[0]))];
      const [north, south] = [Math.min(...spots.map((s) => s[1])), Math.max(...spots.map((s) => s[1]))];
      if (spots.length && x >= west && x <= east && y >= north && y <= south) return true;
      const [u, v] = this.map.seen(middle);
      return Math.hypot(u - x, v - y) <= NEAR_PX;
    });
    return hit.map(({ scan }) => scan);
  }

  /** Outlines as they are seen; those too small to see are dots, one for all that lie together. */
  private draw(): void {
    if (this.grid.isConnected) this.drawGrid();
    const shown: HTMLElement[] = [];
    const parts: SVGElement[] = [];
    const dots: { x: number; y: number; kind: string; scans: api.Scan[] }[] = [];
    for (const { scan, corners, middle } of this.outlines) {
      const spots = corners.map((c) => this.map.seen(c));
      const [w, h] = [0, 1].map((k) => Math.max(...spots.map((s) => s[k]!)) - Math.min(...spots.map((s) => s[k]!))) as [number, number];
      const kind = keyOf(scan) === this.marked ? "marked" : scan.growing ? "growing" : "";
      if (Math.max(w, h) >= MIN_PX) {
        parts.push(svg("polygon", { points: this.map.path(corners), class: kind }));
        if (scan.thumbnail) shown.push(this.imageOf(scan, spots[0]!, w, h));
        continue;
      }
      const [x, y] = this.map.seen(middle);
      const near = dots.find((dot) => Math.hypot(dot.x - x, dot.y - y) < NEAR_PX);
      near?.scans.push(scan);
      if (near) near.kind ||= kind;
      else dots.push({ x, y, kind, scans: [scan] });
    }
    for (const { x, y, kind, scans } of dots) {
      const words = scans.length > 1 ? `${scans.length} scans` : short(nameOf(scans[0]!));
      parts.push(svg("circle", { cx: x.toFixed(1), cy: y.toFixed(1), r: "7", class: kind }));
      const half = (LETTER_PX * words.length) / 2;
      const at = Math.max(half, Math.min(this.host.clientWidth - ZOOM_PX - half, x));
      parts.push(svg("text", { x: at.toFixed(1), y: (y - 12).toFixed(1) }, words));
    }
    const last = parts.findIndex((p) => p.classList.contains("marked"));
    if (last >= 0) parts.push(...parts.splice(last, 1)); // above the others
    this.marks.replaceChildren(...parts);
    this.images.replaceChildren(...shown);
  }

  private readonly loaded = new Map<string, HTMLImageElement>();

  private imageOf(scan: api.Scan, [left, top]: [number, number], w: number, h: number): HTMLImageElement {
    const src = api.file(scan, "thumbnail.webp");
    const image = this.loaded.get(src) ?? el("img", { src, alt: "", draggable: false });
    this.loaded.set(src, image);
    Object.assign(image.style, { transform: `translate(${left}px, ${top}px)`, width: `${w}px`, height: `${h}px` });
    return image;
  }

  /** Lines of latitude and longitude, where there is no basemap. */
  private drawGrid(): void {
    const { clientWidth: w, clientHeight: h } = this.host;
    const [north, west] = degreesOf(this.map.under(0, 0));
    const [south, east] = degreesOf(this.map.under(w, h));
    const step = STEPS_DEG.filter((s) => ((east - west) / s) * GRID_PX <= Math.max(w, GRID_PX)).at(-1) ?? 90;
    const digits = Math.max(0, Math.ceil(-Math.log10(step)));
    const parts: SVGElement[] = [];
    for (let lon = Math.ceil(Math.max(-180, west) / step) * step; lon <= Math.min(180, east); lon += step) {
      const [x] = this.map.seen(placeOf(0, lon));
      parts.push(svg("path", { d: `M${x.toFixed(1)} 0V${h}` }), svg("text", { x: (x + 4).toFixed(1), y: String(h - 6) }, `${lon.toFixed(digits)}°`));
    }
    for (let lat = Math.ceil(Math.max(-85, south) / step) * step; lat <= Math.min(85, north); lat += step) {
      const [, y] = this.map.seen(placeOf(lat, 0));
      parts.push(svg("path", { d: `M0 ${y.toFixed(1)}H${w}` }), svg("text", { x: "4", y: (y - 4).toFixed(1) }, `${lat.toFixed(digits)}°`));
    }
    this.grid.replaceChildren(...parts);
  }
}

const mean = (values: number[]): number => values.reduce((a, b) => a + b, 0) / values.length;

function boundsOf(outlines: Outline[]): Bounds {
  const places = outlines.flatMap(({ corners, middle }) => [...corners, middle]).map(degreesOf);
  const [lats, lons] = [places.map((p) => p[0]), places.map((p) => p[1])];
  const spread = (values: number[], share: number): [number, number] => {
    const [low, high] = [Math.min(...values), Math.max(...values)];
    const pad = Math.max(share * (high - low), (MIN_DEG - (high - low)) / 2, 0);
    return [low - pad, high + pad];
  };
  const [[south, north], [west, east]] = [spread(lats, 0.15), spread(lons, 0.3)];
  return [west, south, east, north];
}
