// A scan without georeference is placed by points that one clicks in it, and then in a scan that has one.

import type { Vector3 } from "three";
import * as api from "./api";
import { el, notify } from "./dom";
import { placeOf } from "./globe";
import { nameOf } from "./names";

const MIN_POINTS = 3;

/** What was clicked in a scan without georeference, until it is clicked elsewhere too. */
let begun: { scan: api.Scan; points: api.Triple[] } | null = null;

/** Whether points of another scan wait for their places in this one. */
export const awaited = (scan: api.Scan): boolean => begun !== null && scan.origin !== null;

/** What the ruler's panel offers below its figures; null: nothing. */
export function placing(scan: api.Scan, again: () => void): (places: Vector3[]) => HTMLElement | null {
  const others = el("select", {});
  others.setAttribute("aria-label", "scan to place it on");
  if (!scan.origin) void fill(others).catch(notify);
  return (places) => (scan.origin ? end(scan, scan.origin, places, again) : begin(scan, others, places));
}

async function fill(others: HTMLSelectElement): Promise<void> {
  const found = (await api.scans()).filter((s) => s.origin && s.finished);
  others.append(...found.map((s) => el("option", { value: api.viewAddress(s), textContent: nameOf(s) })));
}

function begin(scan: api.Scan, others: HTMLSelectElement, places: Vector3[]): HTMLElement | null {
  if (places.length < MIN_POINTS || !others.options.length) return null;
  const go = (): void => {
    begun = { scan, points: places.map(({ x, y, z }) => [x, y, z]) };
    location.hash = others.value;
  };
  const act = el("button", { textContent: "Place", title: "click the same points there, then align", onclick: go });
  return el("p", { className: "acts" }, `Place these ${places.length} points on`, others, act);
}

function end(scan: api.Scan, origin: api.Origin, places: Vector3[], again: () => void): HTMLElement | null {
  if (!begun) return null;
  const { scan: from, points } = begun;
  const pairs = (): api.Pair[] =>
    points.map((point, i) => {
      const { lon_deg, lat_deg, alt_m } = placeOf(origin, places[i]!);
      return { scan: point, place: [lon_deg, lat_deg, alt_m] };
    });
  const stop = (): void => ((begun = null), again());
  const send = (): void => void api.align(from, scan, pairs()).then(stop, notify);
  const missing = points.length - places.length;
  const words =
    missing > 0
      ? `Click point ${places.length + 1} of ${points.length} of ${nameOf(from)}, in the same order.`
      : missing < 0 ? `Remove ${-missing} point(s).` : `All points of ${nameOf(from)} are placed.`;
  return el(
    "p",
    { className: "acts" },
    el("span", { textContent: words }),
    el("button", { textContent: "Align", disabled: missing !== 0, onclick: send }),
    el("button", { textContent: "Discard", title: "place no scan", onclick: stop }),
  );
}
