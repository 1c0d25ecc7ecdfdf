// Control points of a scan: choose one, and click it in the images that show it; the residual follows at once.

import * as api from "./api";
import { el, notify, svg, toScans } from "./dom";
import { jobsOf } from "./jobs";
import { nameOf } from "./names";
import * as units from "./units";

const ZOOMS = [1, 2, 4, 8, 16];
const ARROWS: Record<string, api.Px> = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const COLUMNS = "name, lat, lon, alt_amsl_m; or EPSG:n and rows of name, x, y, z; gcp_list.txt; Metashape; Pix4D";

/** Shows the control points of a scan; gives what closes it. */
export async function showControl(root: HTMLElement, drone: string, name: string): Promise<() => void> {
  const scan = await api.scan(drone, name);
  const id = { drone: scan.drone, scan: scan.scan };
  let known = await api.controlPoints(id);
  let chosen = "";
  let zoom = 4;
  let views: View[] = [];
  let left = false;
  let last = { name: "", seq: -1 }; // marked
  let marking: Promise<void> = Promise.resolve();

  const list = el("ul", {});
  const about = el("p", { className: "quiet" });
  const chosenFile = el("input", { type: "file", multiple: true, hidden: true });
  chosenFile.setAttribute("aria-label", "file of control points");
  const load = el("button", { textContent: "Load points…", title: COLUMNS, onclick: () => chosenFile.click() });
  const refine = el("button", { textContent: "Refine", title: "adjust the scan to the marked points", onclick: () => void marking.then(() => api.make(id, "refine")).then(follow).catch(notify) });
  const nearer = el("button", { textContent: "+", onclick: () => zoomBy(1) });
  const wider = el("button", { textContent: "−", onclick: () => zoomBy(-1) });
  nearer.setAttribute("aria-label", "zoom in");
  wider.setAttribute("aria-label", "zoom out");
  const head = el("header", {}, toScans(), el("h1", { textContent: nameOf(scan), title: nameOf(scan) }), wider, nearer, load, refine, el("a", { href: api.viewAddress(id), textContent: "3D" }), chosenFile);
  const images = el("main", { className: "sights", tabIndex: 0 });
  images.setAttribute("aria-label", "images of the point");
  const side = el("aside", { className: "side points" }, about, list, jobsOf(() => scan));
  side.setAttribute("aria-label", "control points");
  root.replaceChildren(el("div", { className: "view control" }, head, side, images));

  const follow = (): Promise<void> => api.finished(scan, "refine").then(() => api.controlPoints(id)).then((now) => learn(now, true));
  const mark = (seq: number, at: api.Px | null): void => {
    const mine = { name: chosen, seq };
    last = mine;
    const send = async (): Promise<void> => {
      if (mine !== last && mine.seq === last.seq && mine.name === last.name) return; // moved on
      known = await api.mark(id, mine.name, seq, at);
      if (mine === last) learn(known); // else what is drawn is newer
    };
    marking = marking.then(send).catch((error: unknown) => (notify(error), draw())); // one after the other, or an older one may win
  };
  const choose = (name: string): void => {
    chosen = name;
    const point = known.points.find((p) => p.name === name);
    views = (point?.images ?? []).map((image) => new View(id, known.size_px, image, mark));
    images.replaceChildren(...views.map((v) => v.element), ...(views.length ? [] : [blank(point ? "No image shows this point." : "Load the surveyed points: their names and places.")]));
    draw();
  };
  const draw = (): void => {
    if (left) return;
    const point = known.points.find((p) => p.name === chosen);
    for (const view of views) view.show(point?.images.find((i) => i.keyframe_seq === view.seq), zoom);
    list.replaceChildren(...known.points.map((p) => row(p, p.name === chosen, () => choose(p.name))));
    about.textContent = known.points.length ? "Click the centre of the target in two images or more. The dashed ring is where the map expects it; arrow keys move a mark." : "";
    const marked = known.points.filter((p) => p.marks).length;
    refine.disabled = !marked || !scan.finished;
    document.body.dataset["control"] = `${chosen} ${marked}`;
  };
  const learn = (now: api.ControlPoints, afresh = false): void => {
    known = now;
    if (afresh || !known.points.some((p) => p.name === chosen)) choose(known.points.find((p) => p.name === chosen)?.name ?? known.points[0]?.name ?? "");
    else draw();
  };
  const zoomBy = (step: number): void => {
    zoom = ZOOMS[Math.min(Math.max(ZOOMS.indexOf(zoom) + step, 0), ZOOMS.length - 1)]!;
    draw();
  };
  chosenFile.onchange = () => {
    const [first, second] = [...(chosenFile.files ?? [])];
    if (!first) return;
    void Promise.all([first.text(), second?.text()])
      .then(([text, marks]) => api.setControlPoints(id, text, marks))
      .then((now) => learn(now, true), notify)
      .finally(() => (chosenFile.value = ""));
  };
  learn(known, true);
  return () => {
    left = true;
    delete document.body.dataset["control"];
  };
}

const blank = (textContent: string): HTMLElement => el("p", { className: "blank", textContent });

/** A point in the list: its marks, and how far the map is off. */
function row(point: api.ControlPoint, on: boolean, choose: () => void): HTMLElement {
  const words = [point.role === "check" ? "check" : "", point.marks ? `${point.marks} ${point.marks > 1 ? "marks" : "mark"}` : "not marked"];
  const button = el("button", { className: on ? "on" : "", onclick: choose }, el("strong", { textContent: point.name }), el("span", { textContent: words.filter(Boolean).join(", ") }));
  button.setAttribute("aria-pressed", String(on));
  if (point.off_m) button.append(el("output", { textContent: offset(point.off_m, point.place[2] !== null) }));
  if (point.why_not) button.append(el("em", { textContent: point.why_not }));
  return el("li", {}, button);
}

/** Map less survey, in words. */
function offset([east, north, up]: api.Triple, height: boolean): string {
  const signed = (m: number): string => `${m < 0 ? "−" : "+"}${units.length(Math.abs(m), 2)}`;
  return [`${signed(east)} east`, `${signed(north)} north`, ...(height ? [`${signed(up)} up`] : [])].join(", ");
}

/** One image around the place where it should show the point. Lengths are pixels of the camera. */
class View {
  readonly seq: number;
  readonly element = el("figure", {});
  private readonly drawing = svg("svg", { preserveAspectRatio: "xMidYMid slice", tabindex: "0", role: "button" });
  private readonly marks = svg("g", {});
  private readonly remove = el("button", { textContent: "Remove", hidden: true, onclick: () => this.mark(this.seq, null) });
  private readonly centre: api.Px;
  private at: api.Px | null = null;
  private image: api.Sight | undefined;
  private zoom = 1;

  constructor(
    id: { drone: string; scan: string },
    private readonly size: api.Px,
    image: api.Sight,
    private readonly mark: (seq: number, at: api.Px | null) => void,
  ) {
    this.seq = image.keyframe_seq;
    const [w, h] = size;
    this.centre = image.marked_px ?? image.expected_px ?? [(w - 1) / 2, (h - 1) / 2];
    const href = api.controlImage(id, this.seq);
    this.drawing.append(svg("image", { href, x: "-0.5", y: "-0.5", width: String(w), height: String(h), preserveAspectRatio: "none" }), this.marks);
    this.drawing.setAttribute("aria-label", `keyframe ${this.seq}: click the point`);
    this.drawing.onclick = (event) => {
      const m = this.drawing.getScreenCTM();
      if (!m) return;
      const { x, y } = new DOMPoint(event.clientX, event.clientY).matrixTransform(m.inverse());
      this.set([x, y]);
    };
    this.drawing.onkeydown = (event) => {
      const step = ARROWS[event.key];
      if (!step && event.key !== "Enter") return;
      event.preventDefault();
      const [x, y] = this.at ?? this.centre;
      const px = event.shiftKey ? 0.1 : 0.5;
      this.set(step ? [x + px * step[0], y + px * step[1]] : [x, y]);
    };
    this.remove.setAttribute("aria-label", `Remove the mark in keyframe ${this.seq}`);
    this.element.append(this.drawing, el("figcaption", {}, el("span", { textContent: `keyframe ${this.seq}` }), el("output", {}), this.remove));
  }

  /** Draws what is known of the point in this image. */
  show(image: api.Sight | undefined, zoom: number): void {
    [this.image, this.zoom] = [image, zoom];
    const [w, h] = this.size;
    const [width, height] = [w / zoom, h / zoom];
    const corner = (middle: number, shown: number, all: number): number => Math.min(Math.max(middle - shown / 2, -0.5), all - shown - 0.5);
    this.drawing.setAttribute("viewBox", [corner(this.centre[0], width, w), corner(this.centre[1], height, h), width, height].join(" "));
    this.at = image?.marked_px ?? null;
    const expected = image?.expected_px ?? null;
    const r = width / 40;
    const parts: SVGElement[] = [];
    if (expected) parts.push(svg("circle", { class: "expected", cx: String(expected[0]), cy: String(expected[1]), r: String(r) }));
    if (this.at) {
      const [x, y] = this.at;
      const cross = `M${x - r} ${y}H${x - r / 4}M${x + r / 4} ${y}H${x + r}M${x} ${y - r}V${y - r / 4}M${x} ${y + r / 4}V${y + r}`;
      parts.push(svg("path", { class: "under", d: cross }), svg("path", { class: "mark", d: cross }));
    }
    this.marks.replaceChildren(...parts);
    this.element.classList.toggle("marked", this.at !== null);
    this.remove.hidden = this.at === null;
    const off = this.at && expected ? Math.hypot(this.at[0] - expected[0], this.at[1] - expected[1]) : null;
    this.element.querySelector("output")!.textContent = off === null ? "" : `${off.toFixed(1)} px off`;
  }

  private set([x, y]: api.Px): void {
    const [w, h] = this.size;
    const at: api.Px = [Math.min(Math.max(x, -0.5), w - 0.5), Math.min(Math.max(y, -0.5), h - 0.5)];
    if (this.image) this.show({ ...this.image, marked_px: at }, this.zoom); // the next step counts from here
    this.mark(this.seq, at);
  }
}
