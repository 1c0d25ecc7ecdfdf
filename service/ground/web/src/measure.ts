// The ruler: clicked places with labels over the scene, their figures, and the way out as GeoJSON.

import { Vector3 } from "three";
import type { Origin } from "./api";
import { copy, el, save, svg, notify } from "./dom";
import { along, area, lastStep, profile, type Points, type Volume, volume } from "./figures";
import { coordinates, placeOf } from "./globe";
import * as units from "./units";

const CLICK_PX = 5; // a pointer that moved farther turned the view
const LETTER_PX = 8;
const LABEL_PX = 18; // height of a label with its outline
const HOVER_MS = 120;

/** What is measured in: the 3D view, or the map. */
export interface Scene {
  canvas: HTMLElement;
  origin: Origin | null;
  /** The place at a place of the page; null where nothing is measured. A quick look may miss some. */
  pick: (x: number, y: number, quick?: boolean) => Vector3 | null;
  /** Where the canvas shows a place, in CSS pixels; null where it is out of sight. */
  seen: (place: Vector3) => { x: number; y: number } | null;
  /** All points, for volumes and profiles. */
  points: Points;
  /** Relative sigma of the scan's scale; none where nothing states it. */
  scaleSigma: () => number | null | undefined;
}

let down = { x: 0, y: 0 };
addEventListener("pointerdown", (e) => (down = { x: e.clientX, y: e.clientY }), { capture: true });

/** Whether the pointer has not moved since it went down: it turned no view. */
export const wasClick = (e: MouseEvent): boolean => Math.hypot(e.clientX - down.x, e.clientY - down.y) <= CLICK_PX;

/** The middle of a label's base line and half its width, CSS pixels. */
interface Label {
  x: number;
  y: number;
  half: number;
}

/** The label as near to its place as it is seen whole and covers none of the others. */
function free(wanted: Label, others: Label[], width: number, height: number): Label {
  const { half } = wanted;
  const x = Math.max(half, Math.min(width - half, wanted.x));
  const covers = (y: number): boolean =>
    others.some((o) => Math.abs(o.x - x) < o.half + half && Math.abs(o.y - y) < LABEL_PX);
  const fits = (y: number): boolean => y >= LABEL_PX && y <= height && !covers(y);
  const inside = Math.max(LABEL_PX, Math.min(height, wanted.y));
  const heights = [inside, ...others.flatMap((o) => [o.y - LABEL_PX, o.y + LABEL_PX])].filter(fits);
  const near = (y: number): number => Math.abs(y - inside);
  const y = heights.reduce((a, b) => (near(b) < near(a) ? b : a), heights[0] ?? inside);
  return { x, y, half };
}

export class Ruler {
  active = false;
  readonly panel = el("section", { className: "panel measure", hidden: true });
  readonly overlay = svg("svg", { class: "overlay" });
  readonly cursor = el("output", { className: "cursor" });
  /** Called when the ruler is switched on or off. */
  changed: () => void = () => undefined;
  /** What the panel offers with the places. */
  offer: (places: Vector3[]) => HTMLElement | null = () => null;
  private readonly places: Vector3[] = [];
  private volume: Volume | null = null;
  private heights: Float64Array | null = null;
  private hovered = 0;

  constructor(private readonly scene: Scene) {
    this.panel.setAttribute("aria-label", "measurement");
    this.overlay.setAttribute("aria-hidden", "true");
    const { canvas } = scene;
    canvas.addEventListener("click", (e) => this.click(e));
    canvas.addEventListener("pointermove", (e) => this.hover(e));
    canvas.addEventListener("pointerleave", () => (this.cursor.value = ""));
    addEventListener("keydown", this.press);
  }

  close(): void {
    removeEventListener("keydown", this.press);
  }

  toggle(): void {
    this.active = !this.active;
    this.panel.hidden = !this.active && !this.places.length; // what is measured stays until it is cleared
    this.rewrite();
    this.changed();
  }

  /** Draws lines and labels where the places are seen now. */
  readonly draw = (): void => {
    const seen = this.places.map((place) => this.scene.seen(place));
    const inFront = seen.filter((p) => p !== null);
    const parts: SVGElement[] = [];
    const n = seen.length;
    const { clientWidth, clientHeight } = this.scene.canvas;
    const labels: Label[] = [];
    const text = (x: number, y: number, words: string): void => {
      labels.push(free({ x, y: y - 7, half: (words.length * LETTER_PX) / 2 }, labels, clientWidth, clientHeight));
      const at = labels.at(-1)!;
      parts.push(svg("text", { x: at.x.toFixed(1), y: at.y.toFixed(1) }, words));
    };
    seen.forEach((b, i) => {
      const a = seen[(i || n) - 1];
      if (!a || !b || n < 2 || (i === 0 && n < 3)) return;
      const [x1, y1, x2, y2] = [a.x, a.y, b.x, b.y].map((v) => v.toFixed(1));
      parts.push(svg("line", { x1: x1!, y1: y1!, x2: x2!, y2: y2!, class: i ? "" : "closing" }));
      const step = this.places[i]!.distanceTo(this.places[(i || n) - 1]!);
      if (i) text((a.x + b.x) / 2, (a.y + b.y) / 2, units.length(step));
    });
    const mean = (values: number[]): number => values.reduce((a, b) => a + b, 0) / n;
    if (n > 2 && inFront.length === n)
      text(mean(inFront.map((p) => p.x)), mean(inFront.map((p) => p.y)), units.area(area(this.places)));
    const circles = inFront.map((p) => svg("circle", { cx: p.x.toFixed(1), cy: p.y.toFixed(1), r: "4" }));
    this.overlay.replaceChildren(...circles, ...parts);
  };

  private clear(): void {
    this.places.length = 0;
    this.panel.hidden = !this.active;
    this.measure();
  }

  private click(event: MouseEvent): void {
    if (!wasClick(event) || (event.target as HTMLElement).closest("button, input")) return;
    const place = this.scene.pick(event.clientX, event.clientY);
    this.cursor.value = place ? coordinates(this.scene.origin, place) : "";
    if (!this.active) return;
    if (!place) return notify("nothing was measured there");
    this.places.push(place);
    this.measure();
  }

  private hover(event: PointerEvent): void {
    if (event.buttons || event.pointerType === "touch" || event.timeStamp - this.hovered < HOVER_MS) return;
    this.hovered = event.timeStamp;
    const place = this.scene.pick(event.clientX, event.clientY, true);
    this.cursor.value = place ? coordinates(this.scene.origin, place) : "";
  }

  private readonly press = (event: KeyboardEvent): void => {
    if (!this.active || (event.target as HTMLElement).matches("input, select, textarea")) return;
    if (event.key === "Backspace") this.back();
    else if (event.key === "Escape" && this.places.length) this.clear();
    else if (event.key === "Escape") this.toggle();
    else return;
    event.preventDefault();
  };

  /** Writes the figures again, in the units of now. */
  rewrite(): void {
    const offer = this.offer(this.places);
    this.panel.replaceChildren(...this.rows(), ...(offer ? [offer] : []));
    this.draw();
  }

  private back(): void {
    this.places.pop();
    this.measure();
  }

  private measure(): void {
    const { places } = this;
    const { points } = this.scene;
    this.volume = places.length > 2 ? volume(places, points) : null;
    this.heights = places.length > 1 ? profile(places, points) : null;
    this.rewrite();
  }

  private rows(): HTMLElement[] {
    const n = this.places.length;
    const button = (text: string, title: string, off: boolean, onclick: () => void): HTMLElement =>
      el("button", { textContent: text, title, disabled: off, onclick });
    const homeless = this.scene.origin === null;
    const out = homeless ? "this scan is not georeferenced" : "the places as GeoJSON";
    const acts = el(
      "p",
      { className: "acts" },
      button("Undo", "remove the last point (Backspace)", !n, () => this.back()),
      button("Clear", "remove all points (Esc)", !n, () => this.clear()),
      button("Copy", out, !n || homeless, () => void copy(this.geojson()).then(() => notify("copied"), notify)),
      button("GeoJSON", out, !n || homeless, () => save("measurement.geojson", this.geojson())),
    );
    if (n < 2) {
      const hint = n ? "Click the next point." : "Click a point. Backspace removes the last one, Esc all.";
      return [el("p", { textContent: hint }), acts];
    }
    const facts = Object.entries(this.words()).flatMap(([k, v]) => [
      el("dt", { textContent: k }),
      el("dd", { textContent: v }),
    ]);
    return [el("dl", {}, ...facts), ...(this.heights ? [chart(this.heights, this.scene.origin, along(this.places))] : []), acts];
  }

  /** What the places measure, as a list of names and texts. */
  private words(): Record<string, string> {
    const step = lastStep(this.places);
    const words: Record<string, string> = {
      Distance: units.length(step.distance_m),
      Level: units.length(step.level_m),
      Height: `${step.height_m >= 0 ? "+" : ""}${units.length(step.height_m)}`,
      Slope: `${step.slope_deg.toFixed(1)}° (${((100 * step.height_m) / step.level_m).toFixed(0)} %)`,
    };
    if (this.places.length > 2) {
      words["Along"] = units.length(along(this.places));
      words["Area"] = units.area(area(this.places));
    }
    if (this.volume) {
      words["Volume above"] = units.volume(this.volume.above_m3);
      words["Volume below"] = units.volume(this.volume.below_m3);
      words["Base"] = "plane of the points";
      words["Not seen"] = `${(100 * this.volume.unseen).toFixed(1)} % of the area`;
    }
    const sigma = this.scene.scaleSigma();
    if (sigma) {
      words["Accuracy"] = `±${units.share(sigma)} by the scale${this.volume ? `, ±${units.share(3 * sigma)} of volumes` : ""}`;
    }
    return words;
  }

  /** The places as GeoJSON: longitude, latitude and metres above mean sea level. */
  private geojson(): string {
    const origin = this.scene.origin!;
    const spots = this.places.map((p) => {
      const { lon_deg, lat_deg, alt_m } = placeOf(origin, p);
      return [Number(lon_deg.toFixed(9)), Number(lat_deg.toFixed(9)), Number(alt_m.toFixed(3))];
    });
    const properties: Record<string, number> = {};
    const put = (name: string, value: number): number => (properties[name] = Number(value.toFixed(3)));
    if (spots.length > 1) {
      for (const [name, value] of Object.entries(lastStep(this.places))) put(`last_${name}`, value);
      put("length_m", along(this.places));
    }
    if (spots.length > 2) put("area_m2", area(this.places));
    if (this.volume) {
      put("volume_above_m3", this.volume.above_m3);
      put("volume_below_m3", this.volume.below_m3);
      put("volume_unseen_share", this.volume.unseen);
    }
    const geometry =
      spots.length === 1
        ? { type: "Point", coordinates: spots[0] }
        : spots.length === 2
          ? { type: "LineString", coordinates: spots }
          : { type: "Polygon", coordinates: [[...spots, spots[0]]] };
    const feature = { type: "Feature", properties, geometry };
    return JSON.stringify({ type: "FeatureCollection", features: [feature] }, null, 1);
  }
}

/** The heights along the way as a line, with the lowest and highest value at its side. */
function chart(heights: Float64Array, origin: Origin | null, length_m: number): HTMLElement {
  const known = heights.filter((z) => !Number.isNaN(z));
  if (!known.length) return el("p", { textContent: "No points along the line." });
  const [low, high] = [known.reduce((a, b) => Math.min(a, b)), known.reduce((a, b) => Math.max(a, b))];
  const span = Math.max(high - low, 0.1);
  let path = "";
  let pen = "M";
  heights.forEach((z, i) => {
    if (Number.isNaN(z)) return void (pen = "M");
    path += `${pen}${((i + 0.5) * 240) / heights.length} ${(4 + (62 * (high - z)) / span).toFixed(1)}`;
    pen = "L";
  });
  const datum = origin?.alt_amsl_m ?? 0;
  const words = `${units.length(low + datum)} to ${units.length(high + datum)} over ${units.length(length_m, 1)}`;
  const drawing = svg("svg", { viewBox: "0 0 240 70", role: "img", "aria-label": `height profile: ${words}` });
  drawing.append(svg("path", { d: path }));
  const figure = el("figure", { className: "profile" }, el("figcaption", { textContent: `Profile ${words}` }));
  figure.prepend(drawing);
  return figure;
}
