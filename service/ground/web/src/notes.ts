// Annotations: places with a text, as labels over the scene and as a list; kept with the scan.

import * as THREE from "three";
import * as api from "./api";
import { el, notify, short, svg } from "./dom";
import { pointOf, placeOf } from "./globe";
import { type Scene, wasClick } from "./measure";

export class Notes {
  active = false;
  readonly panel = el("section", { className: "panel measure notes", hidden: true });
  readonly overlay = svg("svg", { class: "overlay notes" });
  /** Without a georeference a note has no place. */
  get isPossible(): boolean {
    return this.scene.origin !== null;
  }
  /** Called when notes are switched on or off. */
  changed: () => void = () => undefined;
  private readonly text = el("input", { type: "text", maxLength: 500, placeholder: "text of a new note" });
  private readonly list = el("ul", {});
  private notes: { feature: api.Annotation; at: THREE.Vector3 }[] = [];

  constructor(
    private readonly scene: Scene,
    private readonly id: { drone: string; scan: string },
    private readonly lookAt: (point: THREE.Vector3) => void,
  ) {
    this.panel.setAttribute("aria-label", "notes");
    this.overlay.setAttribute("aria-hidden", "true");
    this.text.setAttribute("aria-label", "text of a new note");
    const middle = el("button", {
      textContent: "Place at the middle",
      title: "where the middle of the view meets the scene",
      onclick: () => this.place(scene.pick(...middleOf(scene))),
    });
    const hint = el("p", { textContent: "Write a note, then click its place." });
    this.panel.append(hint, this.text, el("p", { className: "acts" }, middle), this.list);
    scene.canvas.addEventListener("click", (e) => this.active && wasClick(e) && this.place(scene.pick(e.clientX, e.clientY)));
    addEventListener("keydown", this.press);
    if (scene.origin) void this.refresh();
  }

  close(): void {
    removeEventListener("keydown", this.press);
  }

  toggle(): void {
    this.active = !this.active;
    this.panel.hidden = !this.active;
    this.changed();
    if (!this.active) return;
    this.text.focus();
    void this.refresh();
  }

  /** Draws the notes where their places are seen now. */
  readonly draw = (): void => {
    const parts: SVGElement[] = [];
    for (const { feature, at } of this.notes) {
      const spot = this.scene.seen(at);
      if (!spot) continue;
      const [x, y] = [spot.x.toFixed(1), spot.y.toFixed(1)];
      parts.push(svg("circle", { cx: x, cy: y, r: "5" }), svg("text", { x, y: (spot.y - 10).toFixed(1) }, short(feature.properties.text)));
    }
    this.overlay.replaceChildren(...parts);
  };

  private readonly press = (event: KeyboardEvent): void => {
    if (!this.active || event.key !== "Escape") return;
    this.toggle();
    event.preventDefault();
  };

  private place(point: THREE.Vector3 | null): void {
    const text = this.text.value.trim();
    if (!text) return void (notify("write the note first"), this.text.focus());
    if (!point) return notify("no point there");
    const { lon_deg, lat_deg, alt_m } = placeOf(this.scene.origin!, point);
    void api
      .annotate(this.id, [lon_deg, lat_deg, alt_m], text)
      .then(() => ((this.text.value = ""), this.refresh()))
      .catch(notify);
  }

  private async refresh(): Promise<void> {
    const found = await api.annotations(this.id).catch((error: unknown) => (notify(error), null));
    if (!found) return;
    this.notes = found.features.flatMap((feature) =>
      feature.geometry.type === "Point" ? [{ feature, at: pointOf(this.scene.origin!, feature.geometry.coordinates) }] : [],
    );
    this.list.replaceChildren(...this.notes.map(({ feature, at }) => this.row(feature, at)));
    this.draw();
  }

  private row(feature: api.Annotation, at: THREE.Vector3): HTMLElement {
    const { text, by, made_unix_s } = feature.properties;
    const title = `by ${by}, ${new Date(made_unix_s * 1000).toLocaleString()}; look at it`;
    const go = el("button", { className: "note-text", textContent: text, title, onclick: () => this.lookAt(at) });
    const remove = el("button", {
      textContent: "Delete",
      onclick: () => void api.eraseAnnotation(this.id, feature.id).then(() => this.refresh(), notify),
    });
    remove.setAttribute("aria-label", `Delete the note ${short(text)}`);
    return el("li", {}, go, remove);
  }
}

function middleOf({ canvas }: Scene): [number, number] {
  const box = canvas.getBoundingClientRect();
  return [box.left + box.width / 2, box.top + box.height / 2];
}
