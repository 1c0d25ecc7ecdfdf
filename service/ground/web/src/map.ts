// A scan on a flat map: layers as XYZ tiles over the operator's own basemap; grows while it flies.

import * as api from "./api";
import { el, notify, short, svg, toScans } from "./dom";
import { degreesOf, FlatMap, Layer, type Place, placeOf, tileJson } from "./flatmap";
import { coverageKeys } from "./keys";
import { nameOf } from "./names";
import * as units from "./units";

const REFRESH_MS = 2000;
const COVERAGE = "Coverage";
const LAYERS: [string, string, boolean][] = [
  ["ortho", "Orthophoto", true],
  ["dsm", "Surface (shaded)", false],
  ["coverage", COVERAGE, false],
  ["contours", "Contours", false],
];

/** Shows the map of a scan; gives what closes it. */
export async function showMap(root: HTMLElement, drone: string, name: string): Promise<() => void> {
  const scan = await api.scan(drone, name);
  const id = { drone: scan.drone, scan: scan.scan };
  const at = `/tiles/${encodeURIComponent(id.drone)}/${encodeURIComponent(id.scan)}`;
  const host = el("main", { className: "map", tabIndex: 0 });
  host.setAttribute("aria-label", "map: drag to move, plus and minus to zoom");
  const cursor = el("output", { className: "cursor" });
  const none = el("p", { className: "blank", textContent: scan.finished ? "This scan has no surface." : "No surface yet." });
  const panel = el("fieldset", { className: "panel layers" }, el("legend", { textContent: "Layers" }));
  const open = api.viewAddress(id);
  const state = el("span", { className: "state" });
  state.setAttribute("role", "status");
  const head = el(
    "header",
    {},
    toScans(),
    el("h1", { textContent: nameOf(scan), title: nameOf(scan) }),
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
  const captions: (() => void)[] = []; // write what the panel states about layers
  const map = new FlatMap(host);
  if (scan.origin) map.middle = placeOf(scan.origin.lat_deg, scan.origin.lon_deg);
  map.over.push(() => {
    for (const write of captions) write();
    marks.replaceChildren(
      ...notes.flatMap(({ place, text }) => {
        const [x, y] = map.seen(place);
        const at = { cx: x.toFixed(1), cy: y.toFixed(1), r: "5" };
        return [svg("circle", at), svg("text", { x: at.cx, y: (y - 10).toFixed(1) }, text)];
      }),
    );
    again.replaceChildren(
      ...(isPlanned ? flight : []).map(({ polygon, places }) => svg(polygon ? "polygon" : "polyline", { points: map.path(places) })),
    );
    document.body.dataset["map"] = map.loading ? "loading" : "shown";
  });
  const add = (layer: Layer, title: string, on: boolean): void => {
    layer.shown = on;
    map.add(layer);
    const box = el("input", { type: "checkbox", checked: on });
    box.onchange = () => {
      layer.shown = box.checked;
      document.body.dataset["map"] = "loading"; // until it is drawn
      void layer.refresh().then(() => map.draw(), notify);
    };
    const share = el("input", { type: "range", min: "0", max: "1", step: "0.05", value: "1" });
    share.setAttribute("aria-label", `${title}, opacity`);
    share.oninput = () => layer.opacity(Number(share.value));
    const words = el("span", { textContent: ` ${title}` });
    panel.append(el("div", {}, el("label", {}, box, words), share));
    captions.push(() => {
      const step_m = layer.shown ? layer.intervals_m[Layer.zoomOf(map.zoom)] : undefined;
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
      ...map.layers.map((layer) => layer.refresh()),
    ]);
    if (now.finished) say("finished", "finished");
    else if (now.growing) say("receiving", "receiving");
    else say("silent", "silent");
    notes = features.map(({ geometry: { coordinates }, properties }) => ({
      place: placeOf(coordinates[1], coordinates[0]),
      text: short(properties.text),
    }));
    if (found?.bounds && map.isFree) map.frame(found.bounds);
    map.layers.forEach((layer) => layer.retry());
    map.draw();
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
  host.append(none, again, marks, cursor);
  map.onHover = (place) => {
    const [lat, lon] = degreesOf(place);
    cursor.value = `${lat.toFixed(7)}, ${lon.toFixed(7)}`;
  };
  await refresh();
  const timer = setInterval(() => void (document.hidden || refresh()), REFRESH_MS);
  return () => {
    clearInterval(timer);
    map.close();
    delete document.body.dataset["map"];
  };
}
