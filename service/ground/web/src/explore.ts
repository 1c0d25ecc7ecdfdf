// Looking around in a scan: its growth over time, a clip box, images of keyframes, links to a view.

import * as THREE from "three";
import * as api from "./api";
import type { Cameras } from "./cameras";
import { copy, el, notify } from "./dom";
import { wasClick } from "./measure";
import type { Cloud } from "./points";
import type { Stage } from "./stage";
import * as units from "./units";

const IMAGE_EVERY_MS = 1500;
const NEAR_PX = 14;
const DAY_S = 86400;
const SPEEDS = [1, 2, 5, 10, 20];
const LONGEST_WAIT_S = 5; // between two keyframes, or the dates of a site

export interface Site {
  stage: Stage;
  cloud: Cloud;
  cameras: Cameras;
  id: { drone: string; scan: string };
}

/** A slider over the keyframes: all as it was when each was taken, played if one likes; at its end it follows. `moved` is
 * called with each of its moves, but not while it follows a flight. */
export function timeSlider({ stage, cloud, cameras }: Site, moved: () => void): { element: HTMLElement; refresh: () => void; toEnd: () => void } {
  const input = el("input", { type: "range", min: "1", value: "1", max: "1" });
  input.setAttribute("aria-label", "time of the flight");
  const shown = el("output", {});
  const day = el("span", { className: "day" });
  const play = el("button", { textContent: "▶", title: "play the flight" });
  const speed = el("select", {}, ...SPEEDS.map((x) => el("option", { value: String(x), textContent: `${x}×`, selected: x === 5 })));
  speed.setAttribute("aria-label", "speed of playing");
  const element = el("div", { className: "time", hidden: true }, play, speed, input, shown, day);
  let timer = 0;
  const show = (): void => {
    const moments = cloud.moments();
    const k = Number(input.value) - 1;
    const last = k >= moments.length - 1;
    cloud.until(last ? Infinity : moments[k]!);
    shown.value = moment(moments[k]!, moments[0]!, moments.at(-1)!);
    day.textContent = new Date(1000 * moments[k]!).toLocaleString("en-GB", { dateStyle: "medium", timeStyle: "medium" });
    cameras.stand(last ? null : cloud.own.newest);
    stage.touch();
  };
  const move = (): void => (show(), moved());
  const stop = (): void => {
    clearTimeout(timer);
    timer = 0;
    [play.textContent, play.title] = ["▶", "play the flight"];
  };
  const step = (): void => {
    const moments = cloud.moments();
    const k = Number(input.value);
    if (k >= moments.length || !element.isConnected) return stop();
    timer = setTimeout(
      () => {
        input.value = String(k + 1);
        move();
        step();
      },
      (1000 * Math.min(moments[k]! - moments[k - 1]!, LONGEST_WAIT_S)) / Number(speed.value),
    );
  };
  play.onclick = () => {
    if (timer) return stop();
    if (input.value === input.max) input.value = "1";
    move();
    [play.textContent, play.title] = ["❚❚", "pause"];
    step();
  };
  input.oninput = () => (stop(), move());
  const refresh = (): void => {
    const n = cloud.moments().length;
    element.hidden = n < 2;
    if (n < 2 || Number(input.max) === n) return;
    const followed = input.value === input.max;
    input.max = String(n);
    if (followed) input.value = input.max;
    show();
  };
  const toEnd = (): void => {
    if (input.value === input.max) return;
    input.value = input.max;
    stop();
    move();
  };
  return { element, refresh, toEnd };
}

/** A time: seconds of a flight, the date of a site. */
function moment(time: number, first: number, last: number): string {
  if (last - first < DAY_S) return `${(time - first).toFixed(0)} s`;
  return new Date(1000 * time).toISOString().slice(0, 16).replace("T", " ");
}

/** Six sliders that cut the scene to a box, as shares of the cloud's extent, with the lengths they stand for. */
export function clipBox({ stage, cloud }: Site): HTMLElement {
  const panel = el("div", { className: "settings clip" });
  const axes: [string, "x" | "y" | "z"][] = [["East", "x"], ["North", "y"], ["Height", "z"]];
  const fields: { axis: "x" | "y" | "z"; low: HTMLInputElement; high: HTMLInputElement; shown: HTMLOutputElement }[] = [];
  const cut = (): void => {
    if (!cloud.total) return;
    const box = new THREE.Box3().setFromObject(cloud.group);
    const size = box.getSize(new THREE.Vector3());
    const planes: THREE.Plane[] = [];
    for (const { axis, low, high, shown } of fields) {
      const at = (field: HTMLInputElement): number => box.min[axis] + (size[axis] * Number(field.value)) / 100;
      const zero_m = axis === "z" ? cloud.datum_m : 0;
      shown.value = [low, high].map((field) => units.length(at(field) + zero_m, 1)).join(" to ");
      const along = new THREE.Vector3();
      along[axis] = 1;
      if (low.value !== low.min) planes.push(new THREE.Plane(along.clone(), -at(low)));
      if (high.value !== high.max) planes.push(new THREE.Plane(along.clone().negate(), at(high)));
    }
    stage.renderer.clippingPlanes = planes;
    stage.touch();
  };
  const text = (textContent: string): HTMLElement => el("span", { textContent });
  panel.append(el("div", { className: "axis" }, text(""), text("from"), text("to")));
  for (const [name, axis] of axes) {
    const slide = (which: string, value: string): HTMLInputElement => {
      const input = el("input", { type: "range", min: "0", max: "100", value, oninput: cut });
      input.setAttribute("aria-label", `${name}, ${which}`);
      return input;
    };
    const field = { axis, low: slide("from", "0"), high: slide("to", "100"), shown: el("output", {}) };
    fields.push(field);
    panel.append(el("div", { className: "axis" }, text(name), field.low, field.high, field.shown));
  }
  const whole = (): void => {
    for (const { low, high } of fields) [low.value, high.value] = ["0", "100"];
    cut();
  };
  panel.append(el("button", { textContent: "Whole", onclick: whole }));
  return el("details", { className: "group", ontoggle: cut }, el("summary", { textContent: "Clip" }), panel);
}

/** The address of this view of this scan. */
function linkOf({ stage, id }: Site): string {
  const numbers = [...stage.camera.position.toArray(), ...stage.controls.target.toArray()];
  const view = numbers.map((v) => v.toFixed(2)).join(",");
  return `${api.viewAddress(id)}/${view}`;
}

/** Takes the view of an address; false when it holds none. */
export function takeView(stage: Stage, text: string | undefined): boolean {
  const numbers = (text ?? "").split(",").map(Number);
  if (numbers.length !== 6 || !numbers.every(Number.isFinite)) return false;
  stage.camera.position.fromArray(numbers);
  stage.controls.target.fromArray(numbers, 3);
  stage.follow = false;
  return true;
}

export function linkButton(site: Site): HTMLElement {
  const act = (): void => {
    history.replaceState(null, "", linkOf(site));
    void copy(location.href).then(() => notify("The link to this view is copied."), notify);
  };
  return el("button", { textContent: "Link", title: "copy a link to this view", onclick: act });
}

/** Shows an image as large as the page, until a click or Esc. */
function enlarge(image: HTMLImageElement, text: string): void {
  const large = el("img", { src: image.src, alt: image.alt });
  const dialog = el("dialog", { className: "large" }, el("button", { textContent: "Close", autofocus: true }), large, el("p", { textContent: text }));
  dialog.onclick = () => dialog.close();
  dialog.onclose = () => dialog.remove();
  document.body.append(dialog);
  dialog.showModal();
}

/** The image of the newest keyframe in the corner and in its frustum; a click on a frustum shows its own. */
export class Images {
  readonly element = el("figure", { className: "panel latest", hidden: true });
  /** Ends it. */
  readonly close = api.every(IMAGE_EVERY_MS, async () => this.refresh());
  private loading = false; // one at a time: a flight may play faster than they come
  private chosen: number | null = null;
  private shown = -1;
  private version = 0;

  constructor(private readonly site: Site, free: () => boolean) {
    site.stage.renderer.domElement.addEventListener("click", (e) => free() && wasClick(e) && this.click(e));
  }

  /** A keyframe came, or a finer layer of one: its image is fetched again. */
  arrived(seq: number): void {
    this.version += 1;
    if (seq === this.shown) this.shown = -1;
  }

  private click(event: MouseEvent): void {
    const { stage, cameras } = this.site;
    const box = stage.renderer.domElement.getBoundingClientRect();
    const place = new THREE.Vector2(event.clientX - box.left, event.clientY - box.top);
    const seq = cameras.at(place, stage.camera, new THREE.Vector2(box.width, box.height), NEAR_PX);
    if (seq === null) return;
    this.chosen = seq;
    this.refresh();
  }

  /** Shows the image of what is chosen, or of the newest keyframe by now. */
  refresh(): void {
    const seq = this.chosen ?? this.site.cloud.own.newest;
    if (seq < 0 || seq === this.shown || this.loading) return;
    this.shown = seq;
    this.loading = true;
    const image = new Image();
    image.alt = `keyframe ${seq}, seen from the aircraft`;
    image.onload = () => {
      this.loading = false;
      this.show(seq, image);
      this.refresh();
    };
    image.onerror = () => (this.loading = false);
    image.src = `${api.keyframe(this.site.id, seq)}?v=${this.version}`;
  }

  private show(seq: number, image: HTMLImageElement): void {
    if (seq !== this.shown) return; // another one was chosen meanwhile
    const { cameras, cloud, stage } = this.site;
    cameras.show(seq, image);
    stage.touch();
    const text = this.chosen === null && cloud.isWhole ? `latest keyframe, ${seq}` : `keyframe ${seq}`;
    const back = el("button", { textContent: "Latest", title: "back to the newest keyframe" });
    back.onclick = () => ((this.chosen = null), this.refresh());
    this.element.hidden = false;
    const open = el("button", { className: "image", title: "show it large", onclick: () => enlarge(image, text) }, image);
    this.element.replaceChildren(open, el("figcaption", {}, text, this.chosen !== null && back));
    document.body.dataset["image"] = String(seq);
  }
}
