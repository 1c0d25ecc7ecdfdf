// A scan on a flat map: layers over the operator's own basemap, heights, the track, measuring, two dates
// side by side; grows while it flies.

import type { Vector3 } from "three";
import * as api from "./api";
import { el, notify, short, svg, toScans } from "./dom";
import { degreesOf, FlatMap, Layer, type Place, placeOf, tileJson } from "./flatmap";
import { coordinates, placeOf as globeOf, pointOf } from "./globe";
import { coverageKeys } from "./keys";
import { Ruler, type Scene } from "./measure";
import { nameOf } from "./names";
import { comparison } from "./swipe";
import { Terrain } from "./terrain";
import * as units from "./units";

const REFRESH_MS = 2000;
const COVERAGE = "Coverage";
const TERRAIN = "terrain";
const LAYERS: [string, string, boolean][] = [
  ["ortho", "Orthophoto", true],
  [TERRAIN, "Height", false],
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
    el("a", { href: api.controlAddress(id), textContent: "Control points" }),
    el("a", { href: `${at}/ortho.kml`, textContent: "KML" }),
  );
  const heights = new Terrain((z, x, y) => `${at}/${TERRAIN}/${z}/${x}/${y}.png`, `${at}/${TERRAIN}.json`);
  const ramp = el("p", { className: "ramp", hidden: true }, el("span", {}), el("i", {}), el("span", {}));
  let contours: Layer | null = null;
  let track: Place[] = [];
  let growing = true; // until it is known
  let hasAnswer = false;
  const way = svg("svg", { class: "overlay track" });
  const lettering = svg("svg", { class: "overlay heights" });
  const marks = svg("svg", { class: "overlay notes" });
  const again = svg("svg", { class: "overlay refly" });
  const plan = `${api.scanAddress(id)}/refly`;
  let flight: { polygon: boolean; places: Place[] }[] = [];
  let isPlanned = false; // whether the flight over weak places is shown
  let notes: { place: Place; text: string }[] = [];
  const captions: (() => void)[] = []; // write what the panel states about layers
  const map = new FlatMap(host);
  const showsTrack = el("input", { type: "checkbox", checked: true, onchange: () => map.draw() });
  const ruler = new Ruler(sceneOf(map, heights, scan), id, nameOf(scan));
  const measure = el("button", { textContent: "Measure", title: "click points: distance, height, slope, area, volume, profile", onclick: () => ruler.toggle() });
  measure.setAttribute("aria-pressed", "false");
  ruler.changed = () => {
    measure.classList.toggle("on", ruler.active);
    measure.setAttribute("aria-pressed", String(ruler.active));
  };
  head.insertBefore(measure, state.nextSibling);
  const twins = comparison(map, scan, ["ortho", TERRAIN, "dsm", "contours"], [way, lettering]);
  if (scan.origin) map.middle = placeOf(scan.origin.lat_deg, scan.origin.lon_deg);
  map.over.push(() => {
    for (const write of captions) write();
    way.replaceChildren(...(showsTrack.checked && track.length ? [svg("polyline", { points: map.path(track) })] : []));
    const interval_m = (contours?.seen && contours.intervals_m[Layer.zoomOf(map.zoom)]) || 0;
    lettering.replaceChildren(...(interval_m > 0 ? heights.labels(interval_m) : []).map(({ place, height_m, turn_deg }) => {
      const [x, y] = map.seen(place).map((v) => v.toFixed(1)) as [string, string];
      return svg("text", { x, y, dy: "4", transform: `rotate(${turn_deg.toFixed(0)} ${x} ${y})` }, units.length(height_m, interval_m < 1 ? 1 : 0));
    }));
    ruler.draw();
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
    document.body.dataset["map"] = map.loading || !hasAnswer ? "loading" : "shown";
  });
  const add = (layer: Layer, title: string, on: boolean): void => {
    layer.seen = on;
    map.add(layer);
    const box = el("input", { type: "checkbox", checked: on });
    box.onchange = () => {
      layer.seen = box.checked;
      twins.follow();
      document.body.dataset["map"] = "loading"; // until it is drawn
      void layer.refresh().then(() => map.draw(), notify);
    };
    const share = el("input", { type: "range", min: "0", max: "1", step: "0.05", value: "1" });
    share.setAttribute("aria-label", `${title}, opacity`);
    share.oninput = () => layer.opacity(Number(share.value));
    const words = el("span", { textContent: ` ${title}` });
    panel.append(el("div", {}, el("label", {}, box, words), share));
    captions.push(() => {
      const step_m = layer.seen ? layer.intervals_m[Layer.zoomOf(map.zoom)] : undefined;
      words.textContent = step_m ? ` ${title}, ${units.length(step_m, step_m < 1 ? 1 : 0)}` : ` ${title}`;
    });
    const keys = title === COVERAGE ? coverageKeys() : layer === heights ? ramp : null;
    if (!keys) return;
    panel.append(keys);
    captions.push(() => (keys.hidden = !layer.seen));
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
      growing && api.track(id).then((found) => (track = (found.geometry?.coordinates ?? []).map(([lon, lat]) => placeOf(lat, lon))), () => undefined),
      ...map.layers.map((layer) => layer.refresh()),
    ]);
    growing = now.growing;
    hasAnswer = true;
    if (now.finished) say("finished", "finished");
    else if (now.growing) say("receiving", "receiving");
    else say("silent", "silent");
    notes = features.flatMap(({ geometry: g, properties }) =>
      g.type === "Point" ? [{ place: placeOf(g.coordinates[1], g.coordinates[0]), text: short(properties.text) }] : [],
    );
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
  const side = el("aside", { className: "side", tabIndex: 0 }, panel);
  side.setAttribute("aria-label", "layers");
  root.replaceChildren(el("div", { className: "view flat" }, head, host, side));
  if (basemap) add(new Layer((z, x, y) => `/tiles/basemap/${z}/${x}/${y}`), "Basemap", true);
  for (const [layer, title, on] of LAYERS) {
    const one = layer === TERRAIN ? heights : new Layer((z, x, y) => `${at}/${layer}/${z}/${x}/${y}.png`, `${at}/${layer}.json`);
    if (layer === "contours") contours = one;
    add(one, title, on);
  }
  heights.ranged = () => {
    const [low, high] = heights.range!.map((m) => units.length(m, 1));
    [ramp.firstChild!.textContent, ramp.lastChild!.textContent] = [low!, high!];
  };
  panel.append(el("div", {}, el("label", {}, showsTrack, " Flown track")));
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
  panel.append(twins.chooser);
  host.append(none, way, again, lettering, ruler.overlay, marks, twins.divider, cursor);
  side.prepend(ruler.panel);
  map.onHover = (place) => {
    const [lat, lon] = degreesOf(place);
    const height_m = heights.heightAt(place);
    cursor.value = height_m === null || !scan.origin ? `${lat.toFixed(7)}, ${lon.toFixed(7)}` : coordinates(scan.origin, pointOf(scan.origin, [lon, lat, height_m]));
  };
  await refresh();
  const end = api.every(REFRESH_MS, refresh);
  return () => {
    end();
    map.close();
    ruler.close();
    delete document.body.dataset["map"];
  };
}

/** The map as what is measured in: places in metres east, north and up of the scan's origin. */
function sceneOf(map: FlatMap, heights: Terrain, { origin, quality }: api.Scan): Scene {
  const point = (place: Place, height_m: number) => {
    const [lat, lon] = degreesOf(place);
    return pointOf(origin!, [lon, lat, height_m]);
  };
  return {
    canvas: map.host,
    origin,
    pick: (x, y) => {
      const box = map.host.getBoundingClientRect();
      const place = map.under(x - box.left, y - box.top);
      const height_m = origin && heights.heightAt(place);
      return height_m === null ? null : point(place, height_m);
    },
    seen: (spot) => {
      const { lat_deg, lon_deg } = globeOf(origin!, spot);
      const [x, y] = map.seen(placeOf(lat_deg, lon_deg));
      return { x, y };
    },
    points: (use) => {
      // By the affine map of three places: over a scan it is exact to far less than a pixel.
      const { middle } = map;
      const step = 1e-6;
      const zero_m = origin!.alt_amsl_m;
      const [o, a, b] = [middle, { x: middle.x + step, y: middle.y }, { x: middle.x, y: middle.y + step }].map((p) => point(p, zero_m)) as [Vector3, Vector3, Vector3];
      const [ax, bx] = [a.clone().sub(o).divideScalar(step), b.clone().sub(o).divideScalar(step)];
      heights.eachHeight(({ x, y }, height_m) => {
        const [u, v] = [x - middle.x, y - middle.y];
        use(o.x + u * ax.x + v * bx.x, o.y + u * ax.y + v * bx.y, o.z + u * ax.z + v * bx.z + height_m - zero_m);
      });
    },
    scaleSigma: () => quality?.scale_sigma,
  };
}
