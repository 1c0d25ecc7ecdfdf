// Two dates of one place on the map: another scan's layers right of a line that is dragged.

import * as api from "./api";
import { date, el, notify } from "./dom";
import { type FlatMap, Layer } from "./flatmap";
import { nameOf } from "./names";
import { Terrain } from "./terrain";

interface Comparison {
  /** Where the other scan is chosen; hidden while none lies here. */
  chooser: HTMLElement;
  divider: HTMLElement;
  /** Shows of the other scan what is shown of this one. */
  follow: () => void;
}

/** Compares these layers of a scan, which the map already has, with another scan's; `drawings` are of the scan. */
export function comparison(map: FlatMap, scan: api.Scan, names: string[], drawings: SVGElement[]): Comparison {
  const others = el("select", {}, el("option", { value: "", textContent: "none" }));
  others.setAttribute("aria-label", "compare with");
  const chooser = el("div", { className: "compare", hidden: true }, el("span", { textContent: "Compare with" }), others);
  const slider = el("input", { type: "range", min: "0", max: "100", step: "0.1", value: "50" });
  slider.setAttribute("aria-label", "line between the two dates");
  const left = el("span", {});
  const right = el("span", {});
  const line = el("p", {}, left, right);
  const divider = el("div", { className: "swipe", hidden: true }, line, slider);
  let found: api.Scan[] = [];
  /** The date of a scan, which sets it apart from another of its place, where two were flown together with the drone. */
  const labelOf = (s: api.Scan): string => {
    if (s.title !== s.scan) return nameOf(s);
    const when = date(s.started_unix_s);
    const isShared = [scan, ...found].filter((o) => date(o.started_unix_s) === when).length > 1;
    return isShared ? `${when}, ${s.drone}` : when;
  };
  let twins: { own: Layer; twin: Layer }[] = [];
  const cut = (): void => {
    const share = Number(slider.value);
    line.style.left = `${share}%`;
    const { clientWidth: w, clientHeight: h } = map.host;
    // A layer is a point next to its tiles: the clip is in pixels of the map.
    const box = (from: number, to: number): string => `polygon(${from}px 0, ${to}px 0, ${to}px ${h}px, ${from}px ${h}px)`;
    const at = (w * share) / 100;
    for (const { own, twin } of twins) {
      own.element.style.clipPath = box(0, at);
      twin.element.style.clipPath = box(at, w);
    }
    for (const drawing of drawings) drawing.style.clipPath = twins.length ? box(0, at) : "";
  };
  const follow = (): void => {
    for (const { own, twin } of twins) twin.seen = own.seen;
    void Promise.all(twins.map(({ twin }) => twin.refresh())).then(() => map.draw(), notify);
  };
  const choose = (): void => {
    for (const { own, twin } of twins) {
      map.remove(twin);
      own.element.style.clipPath = "";
    }
    twins = [];
    divider.hidden = !others.value;
    if (others.value) {
      left.textContent = labelOf(scan);
      right.textContent = labelOf(found[others.selectedIndex - 1]!);
      const at = `/tiles/${others.value}`;
      for (const name of names) {
        const own = map.layers.find((layer) => layer.about?.endsWith(`/${name}.json`));
        if (!own) continue;
        const twin = new (name === "terrain" ? Terrain : Layer)((z, x, y) => `${at}/${name}/${z}/${x}/${y}.png`, `${at}/${name}.json`);
        map.add(twin);
        twins.push({ own, twin });
      }
      cut();
    }
    follow();
  };
  slider.oninput = cut;
  others.onchange = choose;
  map.over.push(cut);
  void api.scans().then((all) => {
    found = all.filter((s) => s.origin && (s.drone !== scan.drone || s.scan !== scan.scan) && overlap(s, scan));
    others.append(...found.map((s) => el("option", { value: `${encodeURIComponent(s.drone)}/${encodeURIComponent(s.scan)}`, textContent: labelOf(s) })));
    chooser.hidden = !found.length;
  }, notify);
  return { chooser, divider, follow };
}

/** Whether the outlines of two scans have ground in common. */
function overlap(a: api.Scan, b: api.Scan): boolean {
  const [p, q] = [a.corners_lat_lon, b.corners_lat_lon];
  if (!p || !q) return false;
  return [0, 1].every((k) => {
    const [u, v] = [p.map((c) => c[k]!), q.map((c) => c[k]!)];
    return Math.min(Math.max(...u), Math.max(...v)) > Math.max(Math.min(...u), Math.min(...v));
  });
}
