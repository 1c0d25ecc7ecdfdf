// The ruler: clicked places with labels over the scene, their figures, and the measurements kept with the scan.

import { Vector3 } from "three";
import * as api from "./api";
import { copy, el, notify, save, short, svg, unbroken } from "./dom";
import { along, area, type Points } from "./figures";
import { coordinates, pointOf } from "./globe";
import { chart, csvOf, geojsonOf, type Measured, measured, type Named, print, spotsOf, wordsOf } from "./measured";
import * as units from "./units";

const CLICK_PX = 5; // a pointer that moved farther turned the view
const LETTER_PX = 8;
const LABEL_PX = 18; // height of a label with its outline
const HOVER_MS = 120;

/** What is measured in: the 3D view, or the map. */
export interface Scene {
  canvas: HTMLElement;
  origin: api.Origin | null;
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
  private now: Measured = { places: this.places, volume: null, heights: null };
  private saved: api.Annotation[] = [];
  private readonly name = el("input", { type: "text", maxLength: 100, placeholder: "name of this measurement" });
  private hovered = 0;
  private asked = 0;

  /** Measurements are kept with the scan `id`, which people call `title`. */
  constructor(
    private readonly scene: Scene,
    private readonly id: { drone: string; scan: string },
    private readonly title: string,
  ) {
    this.name.setAttribute("aria-label", "name of this measurement");
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
    if (this.active) void this.refresh();
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
    this.panel.replaceChildren(...this.rows(), ...(offer ? [offer] : []), ...this.kept());
    this.draw();
  }

  private back(): void {
    this.places.pop();
    this.measure();
  }

  private measure(): void {
    this.now = measured(this.places, this.scene.points);
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
    const { heights } = this.now;
    const facts = Object.entries(wordsOf(this.now, this.scene.scaleSigma())).flatMap(([k, v]) => [
      el("dt", { textContent: k }),
      el("dd", {}, ...unbroken(v)),
    ]);
    const keep = button("Save", "keep this measurement with the scan", homeless, () => this.save());
    return [
      el("dl", {}, ...facts),
      ...(heights ? [chart(heights, this.scene.origin, along(this.places))] : []),
      acts,
      ...(homeless ? [] : [el("p", { className: "acts name" }, this.name, keep)]),
    ];
  }

  /** The measurements that are kept with the scan, and their ways out. */
  private kept(): HTMLElement[] {
    if (!this.active || !this.saved.length) return [];
    const rows = this.saved.map((one) => {
      const { text, by, made_unix_s } = one.properties;
      const title = `by ${by}, ${new Date(made_unix_s * 1000).toLocaleString()}; show it`;
      const show = el("button", { className: "note-text", textContent: text, title, onclick: () => this.show(one) });
      const erase = el("button", { textContent: "Delete", onclick: () => void api.eraseAnnotation(this.id, one.id).then(() => this.refresh(), notify) });
      erase.setAttribute("aria-label", `Delete the measurement ${short(text)}`);
      return el("li", {}, show, erase);
    });
    const origin = this.scene.origin!;
    const out = (text: string, act: (all: Named[]) => void): HTMLElement => {
      const all = (): Named[] => this.saved.map((one) => ({ name: one.properties.text, ...measured(this.placesOf(one), this.scene.points) }));
      return el("button", { textContent: text, title: "all saved measurements", onclick: () => act(all()) });
    };
    return [
      el("h2", { textContent: "Saved" }),
      el("ul", {}, ...rows),
      el(
        "p",
        { className: "acts" },
        out("All as CSV", (all) => save("measurements.csv", csvOf(origin, all), "text/csv")),
        out("All as GeoJSON", (all) => save("measurements.geojson", geojsonOf(origin, all))),
        out("Print or PDF", (all) => print(this.title, origin, this.scene.scaleSigma(), this.scene.canvas, all)),
      ),
    ];
  }

  private placesOf(one: api.Annotation): Vector3[] {
    const { coordinates } = one.geometry as { coordinates: api.Triple[] };
    return coordinates.map((spot) => pointOf(this.scene.origin!, spot));
  }

  private show(one: api.Annotation): void {
    this.places.splice(0, this.places.length, ...this.placesOf(one));
    this.measure();
  }

  private save(): void {
    const name = this.name.value.trim();
    if (!name) return void (notify("name it first"), this.name.focus());
    void api
      .saveMeasurement(this.id, spotsOf(this.scene.origin!, this.places), name)
      .then(() => ((this.name.value = ""), this.refresh()))
      .catch(notify);
  }

  private async refresh(): Promise<void> {
    if (!this.scene.origin) return;
    const mine = ++this.asked;
    const found = await api.annotations(this.id).catch((error: unknown) => (notify(error), null));
    if (!found || mine !== this.asked) return; // an older answer may come last
    this.saved = found.features.filter(({ geometry }) => geometry.type === "LineString");
    this.rewrite();
  }

  private geojson(): string {
    return geojsonOf(this.scene.origin!, [{ name: "", ...this.now }]);
  }
}
