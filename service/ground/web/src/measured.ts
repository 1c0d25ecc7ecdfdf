// One measurement: its places, what they measure, and the ways out as GeoJSON, CSV and print.

import type { Vector3 } from "three";
import type { Origin, Triple } from "./api";
import { date, el, svg } from "./dom";
import { along, area, lastStep, type Points, profile, type Volume, volume } from "./figures";
import { placeOf } from "./globe";
import * as units from "./units";

export interface Measured {
  places: Vector3[];
  volume: Volume | null;
  /** Along the way, NaN where unknown. */
  heights: Float64Array | null;
}

export const measured = (places: Vector3[], points: Points): Measured => ({
  places,
  volume: places.length > 2 ? volume(places, points) : null,
  heights: places.length > 1 ? profile(places, points) : null,
});

/** What the places measure, as a list of names and texts. */
export function wordsOf({ places, volume }: Measured, scaleSigma: number | null | undefined): Record<string, string> {
  const step = lastStep(places);
  const words: Record<string, string> = {
    Distance: units.length(step.distance_m),
    Horizontal: units.length(step.level_m),
    Height: `${step.height_m >= 0 ? "+" : ""}${units.length(step.height_m)}`,
    Slope: `${step.slope_deg.toFixed(1)}° (${((100 * step.height_m) / step.level_m).toFixed(0)} %)`,
  };
  if (places.length > 2) {
    words["Along"] = units.length(along(places));
    words["Area"] = units.area(area(places));
  }
  if (volume) {
    words["Volume above"] = units.volume(volume.above_m3);
    words["Volume below"] = units.volume(volume.below_m3);
    words["Base"] = "plane of the points";
    words["Not seen"] = `${(100 * volume.unseen).toFixed(1)} % of the area`;
  }
  if (scaleSigma) words["Accuracy"] = `±${units.share(scaleSigma)} by the scale${volume ? `, ±${units.share(3 * scaleSigma)} of volumes` : ""}`;
  return words;
}

/** The figures in metres, by name. */
function numbersOf({ places, volume }: Measured): Record<string, number> {
  const numbers: Record<string, number> = {};
  const put = (name: string, value: number): number => (numbers[name] = Number(value.toFixed(3)));
  if (places.length > 1) {
    for (const [name, value] of Object.entries(lastStep(places))) put(`last_${name}`, value);
    put("length_m", along(places));
  }
  if (places.length > 2) put("area_m2", area(places));
  if (volume) {
    put("volume_above_m3", volume.above_m3);
    put("volume_below_m3", volume.below_m3);
    put("volume_unseen_share", volume.unseen);
  }
  return numbers;
}

/** Longitude, latitude and metres above mean sea level. */
export const spotsOf = (origin: Origin, places: Vector3[]): Triple[] =>
  places.map((p) => {
    const { lon_deg, lat_deg, alt_m } = placeOf(origin, p);
    return [Number(lon_deg.toFixed(9)), Number(lat_deg.toFixed(9)), Number(alt_m.toFixed(3))];
  });

export interface Named extends Measured {
  name: string;
}

export function geojsonOf(origin: Origin, all: Named[]): string {
  const features = all.map((one) => {
    const spots = spotsOf(origin, one.places);
    const geometry =
      spots.length === 1
        ? { type: "Point", coordinates: spots[0] }
        : spots.length === 2
          ? { type: "LineString", coordinates: spots }
          : { type: "Polygon", coordinates: [[...spots, spots[0]]] };
    return { type: "Feature", properties: { ...(one.name && { name: one.name }), ...numbersOf(one) }, geometry };
  });
  return JSON.stringify({ type: "FeatureCollection", features }, null, 1);
}

const COLUMNS = [
  "length_m", "area_m2", "volume_above_m3", "volume_below_m3", "volume_unseen_share",
  "last_distance_m", "last_level_m", "last_height_m", "last_slope_deg",
];

/** One row each: name, figures, and the places as WKT (RFC 4180). */
export function csvOf(origin: Origin, all: Named[]): string {
  const quoted = (text: string): string => `"${text.replaceAll('"', '""')}"`;
  const rows = all.map((one) => {
    const numbers = numbersOf(one);
    const wkt = `LINESTRING Z (${spotsOf(origin, one.places).map((spot) => spot.join(" ")).join(", ")})`;
    return [quoted(one.name), ...COLUMNS.map((name) => numbers[name] ?? ""), quoted(wkt)].join(",");
  });
  return [["name", ...COLUMNS, "places"].join(","), ...rows, ""].join("\r\n");
}

/** Prints the measurements of a scan, or saves them as PDF, as the browser offers. */
export function print(title: string, origin: Origin | null, scaleSigma: number | null | undefined, view: HTMLElement, all: Named[]): void {
  const image = view instanceof HTMLCanvasElement ? [el("img", { src: view.toDataURL("image/jpeg", 0.9), alt: "" })] : [];
  const sections = all.map((one) =>
    el(
      "section",
      {},
      el("h2", { textContent: one.name }),
      el("dl", {}, ...Object.entries(wordsOf(one, scaleSigma)).flatMap(([k, v]) => [el("dt", { textContent: k }), el("dd", { textContent: v })])),
      one.heights ? chart(one.heights, origin, along(one.places)) : null,
    ),
  );
  const sheet = el("div", { className: "sheet" }, el("h1", { textContent: title }), el("p", { textContent: date(Date.now() / 1000) }), ...image, ...sections);
  document.body.append(sheet);
  addEventListener("afterprint", () => sheet.remove(), { once: true });
  // An image that is not decoded yet would be printed blank.
  void Promise.all(image.map((one) => one.decode().catch(() => undefined))).then(() => window.print());
}

const [WIDE, HIGH, LEFT, RIGHT, TOP, BOTTOM] = [290, 120, 40, 8, 8, 20];

/** The heights along the way as a line, over axes of height and distance. */
export function chart(heights: Float64Array, origin: Origin | null, length_m: number): HTMLElement {
  const known = heights.filter((z) => !Number.isNaN(z));
  if (!known.length) return el("p", { textContent: "No points along the line." });
  const [low, high] = [known.reduce((a, b) => Math.min(a, b)), known.reduce((a, b) => Math.max(a, b))];
  const datum = origin?.alt_amsl_m ?? 0;
  const span = Math.max(high - low, 0.1);
  const x = (m: number): number => LEFT + ((WIDE - LEFT - RIGHT) * m) / length_m;
  const y = (z: number): number => TOP + ((HIGH - TOP - BOTTOM) * (low + span - z)) / span;
  let [path, pen] = ["", "M"];
  heights.forEach((z, i) => {
    if (Number.isNaN(z)) return void (pen = "M");
    path += `${pen}${x(((i + 0.5) * length_m) / heights.length).toFixed(1)} ${y(z).toFixed(1)}`;
    pen = "L";
  });
  const words = `${units.length(low + datum)} to ${units.length(high + datum)} over ${units.length(length_m, 1)}`;
  const drawing = svg("svg", { viewBox: `0 0 ${WIDE} ${HIGH}`, role: "img", "aria-label": `height profile: ${words}` });
  const [rise] = units.round(span / 2);
  for (let z = Math.ceil((low + datum) / rise) * rise; z <= low + span + datum + 1e-9; z += rise)
    drawing.append(
      svg("path", { d: `M${LEFT} ${y(z - datum).toFixed(1)}H${WIDE - RIGHT}`, class: "grid" }),
      svg("text", { x: String(LEFT - 4), y: (y(z - datum) + 3).toFixed(1), class: "up" }, units.length(z, rise < 1 ? 1 : 0)),
    );
  const [stride] = units.round(length_m / 3);
  for (let m = 0; m <= length_m + 1e-9; m += stride)
    drawing.append(
      svg("path", { d: `M${x(m).toFixed(1)} ${TOP}V${HIGH - BOTTOM}`, class: "grid" }),
      svg("text", { x: x(m).toFixed(1), y: String(HIGH - 7) }, units.length(m, stride < 1 ? 1 : 0)),
    );
  drawing.append(svg("path", { d: path }));
  const figure = el("figure", { className: "profile" }, el("figcaption", { textContent: `Profile ${words}` }));
  figure.prepend(drawing);
  return figure;
}
