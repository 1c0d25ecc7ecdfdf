// A scan on a flat map: layers as XYZ tiles over the operator's own basemap; grows while it flies.

import * as api from "./api";
import { el, notify, short, svg, toScans } from "./dom";
import { coverageKeys } from "./keys";
import * as units from "./units";

const SIDE = 256;
const MAX_ZOOM = 24;
const REFRESH_MS = 2000;
const FADE_MS = 4000; // after which a tile that does not load gives way
const EQUATOR_M = 2 * Math.PI * 6378137;
const COVERAGE = "Coverage";
const LAYERS: [string, string, boolean][] = [
  ["ortho", "Orthophoto", true],
  ["dsm", "Surface (shaded)", false],
  ["coverage", COVERAGE, false],
  ["contours", "Contours", false],
];

/** A place in the square of Web Mercator: 0 to 1 from west and from north. */
interface Place {
  x: number;
  y: number;
}

interface TileJson {
  bounds?: [number, number, number, number];
  version?: string;
  /** Of contours, by zoom. */
  intervals_m?: number[];
}

function placeOf(lat_deg: number, lon_deg: number): Place {
  return { x: lon_deg / 360 + 0.5, y: 0.5 - Math.asinh(Math.tan((lat_deg * Math.PI) / 180)) / (2 * Math.PI) };
}

function degreesOf({ x, y }: Place): [number, number] {
  return [(Math.atan(Math.sinh(Math.PI * (1 - 2 * y))) * 180) / Math.PI, 360 * (x - 0.5)];
}

/** None where there is no such layer; throws when the ground station does not answer. */
const tileJson = (address: string): Promise<TileJson | null> =>
  api.ask<TileJson>(address).catch((error: unknown) => {
    if (error instanceof api.Refused) return null;
    throw error;
  });

/** The tiles of one layer in a box of their own. */
class Layer {
  readonly element = el("div", { className: "layer" });
  shown = true;
  version = "";
  intervals_m: number[] = [];
  private readonly tiles = new Map<string, HTMLImageElement>();

  /** `about` is the address of its TileJSON, whose version changes with the tiles. */
  constructor(
    private readonly address: (z: number, x: number, y: number) => string,
    private readonly about?: string,
  ) {}

  async refresh(): Promise<void> {
    if (!this.about || !this.shown) return;
    const { version = "", intervals_m = [] } = (await tileJson(this.about)) ?? {};
    Object.assign(this, { version, intervals_m });
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
    const missing = [...wanted].map((name) => this.tiles.get(name)!).some((image) => !image.complete || image.hidden);
    for (const [name, image] of this.tiles) {
      if (!wanted.has(name) && (!missing || !image.complete || Number(image.dataset["at"]) < performance.now() - FADE_MS)) {
        image.remove();
        this.tiles.delete(name);
        continue;
      }
      const [tz, tx, ty] = name.split("/").map(Number) as [number, number, number];
      // Whole pixels, so that neighbours leave no seam.
      const edge = (n: number, at: number, half: number): number => Math.round((n / 2 ** tz - at) * scale + half);
      const [left, top] = [edge(tx, middle.x, w / 2), edge(ty, middle.y, h / 2)];
      image.style.transform = `translate(${left}px, ${top}px)`;
      image.style.width = `${edge(tx + 1, middle.x, w / 2) - left}px`;
      image.style.height = `${edge(ty + 1, middle.y, h / 2) - top}px`;
      if (wanted.has(name)) image.dataset["at"] = String(performance.now());
    }
  }

  private load(z: number, x: number, y: number): HTMLImageElement {
    const image = new Image();
    image.alt = "";
    image.draggable = false;
    image.onload = () => this.element.dispatchEvent(new Event("tile", { bubbles: true }));
    image.onerror = () => {
      image.hidden = true;
      image.onload!(new Event("load"));
    };
    image.src = `${this.address(z, x, y)}?v=${this.version}`;
    this.element.append(image);
    return image;
  }

  /** The tiles that did not come are asked for at the next drawing. */
  retry(): void {
    for (const [name, image] of this.tiles)
      if (image.hidden) {
        image.remove();
        this.tiles.delete(name);
      }
  }

  get loading(): boolean {
    return this.shown && [...this.tiles.values()].some((image) => !image.complete);
  }
}

/** Shows the map of a scan; gives what closes it. */
export async function showMap(root: HTMLElement, drone: string, name: string): Promise<() => void> {
  const scan = await api.scan(drone, name);
  const id = { drone: scan.drone, scan: scan.scan };
  const at = `/tiles/${encodeURIComponent(id.drone)}/${encodeURIComponent(id.scan)}`;
  const host = el("main", { className: "map", tabIndex: 0 });
  host.setAttribute("aria-label", "map: drag to move, plus and minus to zoom");
  const cursor = el("output", { className: "cursor" });
  const bar = svg("svg", { class: "scale", width: "200", height: "30" });
  const none = el("p", { className: "blank", textContent: scan.finished ? "This scan has no surface." : "No surface yet." });
  const panel = el("fieldset", { className: "panel layers" }, el("legend", { textContent: "Layers" }));
  const open = api.viewAddress(id);
  const state = el("span", { className: "state" });
  state.setAttribute("role", "status");
  const head = el(
    "header",
    {},
    toScans(),
    el("h1", { textContent: scan.title, title: scan.title }),
    state,
    el("a", { href: open, textContent: "3D" }),
    el("a", { href: `${at}/ortho.kml`, textContent: "KML" }),
  );
  const marks = svg("svg", { class: "overlay notes" });
  const again = svg("svg", { class: "overlay refly" });
  const plan = `${api.scanAddress(id)}/refly`;
  let flight: { polygon: boolean; places: Place[] }[] = [];
  let isPlanned = false; // whether the flight over weak places is shown
  let notes: { place: Place; text: string }[] = [];
  const layers: Layer[] = [];
  const captions: (() => void)[] = []; // write what the panel states about layers
  let middle = scan.origin ? placeOf(scan.origin.lat_deg, scan.origin.lon_deg) : { x: 0.5, y: 0.5 };
  let zoom = 18;
  let isFree = true; // until somebody moves it the map shows the whole scan

  const draw = (): void => {
    const { clientWidth: w, clientHeight: h } = host;
    for (const layer of layers) layer.draw(middle, zoom, w, h);
    for (const write of captions) write();
    scaleBar(bar, middle, zoom);
    const scale = SIDE * 2 ** zoom;
    marks.replaceChildren(
      ...notes.flatMap(({ place, text }) => {
        const [x, y] = [(place.x - middle.x) * scale + w / 2, (place.y - middle.y) * scale + h / 2];
        const at = { cx: x.toFixed(1), cy: y.toFixed(1), r: "5" };
        return [svg("circle", at), svg("text", { x: at.cx, y: (y - 10).toFixed(1) }, text)];
      }),
    );
    const path = (places: Place[]): string =>
      places.map(({ x, y }) => `${((x - middle.x) * scale + w / 2).toFixed(1)},${((y - middle.y) * scale + h / 2).toFixed(1)}`).join(" ");
    again.replaceChildren(
      ...(isPlanned ? flight : []).map(({ polygon, places }) => svg(polygon ? "polygon" : "polyline", { points: path(places) })),
    );
    document.body.dataset["map"] = layers.some((layer) => layer.loading) ? "loading" : "shown";
  };
  const zoomTo = (next: number, x = host.clientWidth / 2, y = host.clientHeight / 2): void => {
    const before = under(x, y);
    zoom = Math.max(1, Math.min(MAX_ZOOM, next));
    const after = under(x, y);
    middle = { x: middle.x + before.x - after.x, y: middle.y + before.y - after.y };
    isFree = false;
    draw();
  };
  const under = (x: number, y: number): Place => {
    const scale = SIDE * 2 ** zoom;
    return { x: middle.x + (x - host.clientWidth / 2) / scale, y: middle.y + (y - host.clientHeight / 2) / scale };
  };
  const move = (dx: number, dy: number): void => {
    const scale = SIDE * 2 ** zoom;
    middle = { x: middle.x - dx / scale, y: middle.y - dy / scale };
    isFree = false;
    draw();
  };
  const frame = ([west, south, east, north]: [number, number, number, number]): void => {
    const [a, b] = [placeOf(north, west), placeOf(south, east)];
    middle = { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2 };
    const fit = Math.min(host.clientWidth / (b.x - a.x), host.clientHeight / (b.y - a.y)) / SIDE;
    zoom = Math.max(1, Math.min(MAX_ZOOM, Math.log2(fit * 0.9)));
  };
  const add = (layer: Layer, title: string, on: boolean): void => {
    layer.shown = on;
    layers.push(layer);
    host.append(layer.element);
    const box = el("input", { type: "checkbox", checked: on });
    box.onchange = () => {
      layer.shown = box.checked;
      document.body.dataset["map"] = "loading"; // until it is drawn
      void layer.refresh().then(draw, notify);
    };
    const share = el("input", { type: "range", min: "0", max: "1", step: "0.05", value: "1" });
    share.setAttribute("aria-label", `${title}, opacity`);
    share.oninput = () => layer.opacity(Number(share.value));
    const words = el("span", { textContent: ` ${title}` });
    panel.append(el("div", {}, el("label", {}, box, words), share));
    captions.push(() => {
      const step_m = layer.shown ? layer.intervals_m[Layer.zoomOf(zoom)] : undefined;
      words.textContent = step_m ? ` ${title}, ${units.length(step_m, step_m < 1 ? 1 : 0)}` : ` ${title}`;
    });
    if (title !== COVERAGE) return;
    const keys = coverageKeys();
    panel.append(keys);
    captions.push(() => (keys.hidden = !layer.shown));
  };
  const plans = async (): Promise<void> => {
    if (!isPlanned) return;
    flight = (await api.refly(id)).features.map(({ geometry: g }) => {
      const places = (g.type === "Polygon" ? g.coordinates[0]! : g.coordinates).map(([lon, lat]) => placeOf(lat, lon));
      return { polygon: g.type === "Polygon", places };
    });
    lines.textContent = flight.length ? `${flight.length / 2} ${flight.length > 2 ? "lines" : "line"}` : "nothing large enough";
    files.hidden = !flight.length;
  };
  const load = async (): Promise<void> => {
    const [now, found, { features }] = await Promise.all([
      api.scan(drone, name),
      tileJson(`${at}/ortho.json`).then((json) => ((none.hidden = json !== null), json)),
      api.annotations(id).catch(() => ({ features: [] })),
      plans().catch((error) => (lines.textContent = String(error.message ?? error))),
      ...layers.map((layer) => layer.refresh()),
    ]);
    if (now.finished) say("finished", "finished");
    else if (now.growing) say("receiving", "receiving");
    else say("silent", "silent");
    notes = features.map(({ geometry: { coordinates }, properties }) => ({
      place: placeOf(coordinates[1], coordinates[0]),
      text: short(properties.text),
    }));
    if (found?.bounds && isFree) frame(found.bounds);
    layers.forEach((layer) => layer.retry());
    draw();
  };

  const say = (kind: string, text: string): void => {
    state.className = `state ${kind}`;
    state.textContent = text;
  };
  const refresh = (): Promise<void> => load().catch((error: Error) => say("silent", error.message));

  const basemap = await tileJson("/tiles/basemap.json");
  const side = el("aside", {}, panel);
  side.setAttribute("aria-label", "layers");
  root.replaceChildren(el("div", { className: "view flat" }, head, host, side));
  if (basemap) add(new Layer((z, x, y) => `/tiles/basemap/${z}/${x}/${y}`), "Basemap", true);
  for (const [layer, title, on] of LAYERS)
    add(new Layer((z, x, y) => `${at}/${layer}/${z}/${x}/${y}.png`, `${at}/${layer}.json`), title, on);
  const box = el("input", { type: "checkbox" });
  const lines = el("output", {});
  const files = el(
    "span",
    { hidden: true },
    el("a", { href: `${plan}.plan`, textContent: ".plan", title: "mission for QGroundControl" }),
    " ",
    el("a", { href: `${plan}.waypoints`, textContent: ".waypoints", title: "mission for Mission Planner and MAVProxy" }),
  );
  box.onchange = () => {
    isPlanned = box.checked;
    lines.hidden = !isPlanned;
    files.hidden = true;
    void refresh();
  };
  panel.append(el("div", { title: "a flight over gaps and weak places" }, el("label", {}, box, " Fly again"), lines), files);
  const nearer = el("button", { textContent: "+", title: "nearer", onclick: () => zoomTo(zoom + 1) });
  const farther = el("button", { textContent: "−", title: "farther", onclick: () => zoomTo(zoom - 1) });
  host.append(none, again, marks, cursor, bar, el("span", { className: "zoom" }, nearer, farther));
  host.addEventListener("tile", draw);
  listen(host, { move, zoomBy: (by, x, y) => zoomTo(zoom + by, x, y) }, (x, y) => {
    const [lat, lon] = degreesOf(under(x, y));
    cursor.value = `${lat.toFixed(7)}, ${lon.toFixed(7)}`;
  });
  const resized = new ResizeObserver(draw);
  resized.observe(host);
  await refresh();
  const timer = setInterval(() => void (document.hidden || refresh()), REFRESH_MS);
  return () => {
    clearInterval(timer);
    resized.disconnect();
    delete document.body.dataset["map"];
  };
}

interface Moves {
  move: (dx: number, dy: number) => void;
  zoomBy: (by: number, x: number, y: number) => void;
}

/** Mouse, fingers and keys of a map. */
function listen(host: HTMLElement, { move, zoomBy }: Moves, hover: (x: number, y: number) => void): void {
  const fingers = new Map<number, { x: number; y: number }>();
  const local = (e: MouseEvent): [number, number] => {
    const box = host.getBoundingClientRect();
    return [e.clientX - box.left, e.clientY - box.top];
  };
  const apart = (): number => {
    const [a, b] = [...fingers.values()];
    return a && b ? Math.hypot(a.x - b.x, a.y - b.y) : 0;
  };
  host.addEventListener("pointerdown", (e) => {
    if ((e.target as HTMLElement).closest("button")) return;
    host.setPointerCapture(e.pointerId);
    fingers.set(e.pointerId, { x: e.clientX, y: e.clientY });
  });
  host.addEventListener("pointermove", (e) => {
    hover(...local(e));
    const before = fingers.get(e.pointerId);
    if (!before) return;
    const was = apart();
    fingers.set(e.pointerId, { x: e.clientX, y: e.clientY });
    move((e.clientX - before.x) / fingers.size, (e.clientY - before.y) / fingers.size);
    if (was && apart()) zoomBy(Math.log2(apart() / was), ...local(e));
  });
  for (const name of ["pointerup", "pointercancel"] as const) host.addEventListener(name, (e) => fingers.delete(e.pointerId));
  host.addEventListener("wheel", (e) => (e.preventDefault(), zoomBy(-e.deltaY / 300, ...local(e))), { passive: false });
  host.addEventListener("keydown", (e) => {
    const [w, h] = [host.clientWidth, host.clientHeight];
    const step: Record<string, [number, number]> = { ArrowLeft: [80, 0], ArrowRight: [-80, 0], ArrowUp: [0, 80], ArrowDown: [0, -80] };
    if (step[e.key]) move(...step[e.key]!);
    else if (e.key === "+") zoomBy(1, w / 2, h / 2);
    else if (e.key === "-") zoomBy(-1, w / 2, h / 2);
    else return;
    e.preventDefault();
  });
}

/** A round length on the ground at the middle of the map. */
function scaleBar(bar: SVGElement, { y }: Place, zoom: number): void {
  const [lat] = degreesOf({ x: 0.5, y });
  const px_m = (EQUATOR_M * Math.cos((lat * Math.PI) / 180)) / (SIDE * 2 ** zoom);
  const unit = units.imperial() ? 0.3048 : 1;
  const most = (150 * px_m) / unit;
  const power = 10 ** Math.floor(Math.log10(most));
  const round = [5, 2, 1].map((n) => n * power).find((n) => n <= most)!;
  const width = (round * unit) / px_m;
  bar.replaceChildren(
    svg("path", { d: `M1 12 V20 H${width + 1} V12` }),
    svg("text", { x: "6", y: "14" }, units.length(round * unit, round < 1 ? 2 : 0)),
  );
}
