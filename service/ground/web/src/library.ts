// The list of scans: look, open, rename, tag, download, make files, delete, bring back.

import * as api from "./api";
import { count, date, el, notify, size } from "./dom";
import { jobList } from "./jobs";
import * as units from "./units";
import { vehicleStrip } from "./vehicle";

/** What can be made, as the server and as people call it. */
const KINDS: [string, string][] = [
  ["all", "all maps"], ["laz", "cloud, LAZ"], ["copc", "cloud, COPC"],
  ["ply", "cloud, PLY"], ["dsm", "surface model, GeoTIFF"], ["dtm", "bare ground, GeoTIFF"],
  ["ortho", "orthophoto, GeoTIFF"], ["contours", "contours, GeoJSON"], ["gpkg", "contours, GeoPackage"],
  ["dxf", "contours, DXF"], ["coverage", "coverage, GeoTIFF"], ["kmz", "orthophoto, KMZ"],
  ["stac", "STAC item"], ["glb", "mesh, glTF"], ["obj", "mesh, OBJ"],
  ["3dtiles", "points, 3D Tiles"], ["3dtiles-mesh", "mesh, 3D Tiles"], ["geojson", "track, GeoJSON"],
  ["kml", "track, KML"], ["mcap", "recording, Foxglove"], ["ros2", "recording, ROS 2"],
  ["refine", "refined scan"],
];

/** Those whose heights can be converted. */
const WITH_HEIGHTS = new Set(["laz", "copc", "ply", "dsm", "dtm", "contours", "gpkg", "dxf", "coverage", "all", "obj", "3dtiles", "3dtiles-mesh", "geojson"]);
const DATUMS = ["EGM96", "EGM2008", "ellipsoid"];
const HEIGHTS: [string, api.Heights][] = [
  ["heights as flown", { vertical_datum: null, to_datum: null }],
  ...DATUMS.flatMap((vertical_datum): [string, api.Heights][] => [
    [`flown above ${vertical_datum}`, { vertical_datum, to_datum: null }],
    ...DATUMS.filter((to) => to !== vertical_datum).map((to_datum): [string, api.Heights] => [
      `${vertical_datum} to ${to_datum}`, { vertical_datum, to_datum },
    ]),
  ]),
];

const REFRESH_MS = 3000;

/** Shows the list and keeps it as the server has it; gives what ends that. */
export async function showLibrary(root: HTMLElement): Promise<() => void> {
  const list = el("main", { className: "cards" });
  const search = el("input", { type: "search", placeholder: "find by name, tag or drone" });
  search.setAttribute("aria-label", "find");
  const bin = el("section", { className: "bin" });
  bin.setAttribute("aria-label", "bin");
  const again = (): void => void load().catch(notify);
  let scans: api.Scan[] = [];
  const title = (job: api.Job): string =>
    scans.find((s) => s.drone === job.drone && s.scan === job.scan)?.title ?? job.scan;
  const [upload, line, endUploads] = uploads(again);
  const cut = el("p", { className: "stale", hidden: true });
  cut.setAttribute("role", "status");
  const leave = el("button", {
    textContent: "Log out",
    title: "End this browser's session",
    onclick: () => void api.ask("/api/logout", "POST").then(() => location.reload(), notify),
  });
  root.replaceChildren(
    el("header", {}, el("h1", { textContent: "skyrelief" }), search, vehicleStrip(), importForm(again, upload), leave),
    cut,
    line,
    jobList(title, (job) => cards.get(`${job.drone}/${job.scan}`)?.element.querySelector(".made") ?? null),
    list,
    bin,
  );
  let cards = new Map<string, Card>();
  let seen = "";
  const draw = (): void => {
    const wanted = search.value.toLowerCase();
    const shown = scans.filter((s) =>
      [s.title, s.scan, s.drone, ...s.tags].join(" ").toLowerCase().includes(wanted),
    );
    cards = new Map(shown.map((s) => [`${s.drone}/${s.scan}`, kept(cards.get(`${s.drone}/${s.scan}`), s, again)]));
    arrange(list, [...cards.values()].map((c) => c.element));
    if (!shown.length) list.replaceChildren(empty(scans.length > 0));
  };
  search.oninput = draw;
  async function load(): Promise<void> {
    const [found, deleted] = await Promise.all([api.scans(), api.bin()]).catch((error: Error) => {
      cut.hidden = false;
      cut.textContent = `${error.message}${seen && "; this list is not up to date"}`;
      throw error;
    });
    cut.hidden = true;
    const news = JSON.stringify([found, deleted]);
    if (news === seen) return;
    seen = news;
    scans = found;
    draw();
    bin.replaceChildren(...binRows(deleted, again));
  }
  const refresh = setInterval(() => void (document.hidden || load().catch(() => undefined)), REFRESH_MS);
  await load().catch(() => undefined);
  return () => {
    clearInterval(refresh);
    endUploads();
  };
}

interface Card {
  content: string;
  element: HTMLElement;
}

/** The card of a scan: the one there is while nothing of the scan changed. */
function kept(old: Card | undefined, s: api.Scan, again: () => void): Card {
  const content = JSON.stringify(s);
  if (old?.content === content) return old;
  const element = card(s, again);
  if (old) leaveAsFound(old.element, element);
  return { content, element };
}

/** Opens, chooses and focuses in `now` what is open, chosen and focused in `old`. */
function leaveAsFound(old: HTMLElement, now: HTMLElement): void {
  now.querySelector("details")!.open = old.querySelector("details")!.open;
  const [before, after] = [old, now].map((e) => [...e.querySelectorAll("select")]) as [HTMLSelectElement[], HTMLSelectElement[]];
  after.forEach((select, i) => {
    select.value = before[i]?.value ?? select.value;
    select.dispatchEvent(new Event("change"));
  });
  const focused = document.activeElement;
  if (!focused || !old.contains(focused)) return;
  const same = [...now.querySelectorAll<HTMLElement>(focused.tagName)];
  queueMicrotask(() => same.find((e) => e.textContent === focused.textContent)?.focus());
}

/** Makes `elements` the content of `place`; what is there already stays, with its focus. */
function arrange(place: HTMLElement, elements: HTMLElement[]): void {
  for (const old of [...place.children]) if (!elements.includes(old as HTMLElement)) old.remove();
  elements.forEach((element, i) => {
    if (place.children[i] !== element) place.insertBefore(element, place.children[i] ?? null);
  });
}

/** What an empty list says: how scans get here. */
function empty(filtered: boolean): HTMLElement {
  if (filtered) return el("p", { className: "empty", textContent: "No scan has that name, tag or drone." });
  return el(
    "div",
    { className: "empty" },
    el("h2", { textContent: "No scans yet" }),
    el("p", { textContent: "They appear here as soon as a drone connects. Or upload (or drop here) a ZIP of a scan folder, its scan.db, an MCAP, or a video with its flight log." }),
  );
}

function importForm(again: () => void, upload: (files: FileList | null) => void): HTMLElement {
  const folder = el("input", { placeholder: "folder or .mcap on this machine", size: 30 });
  folder.setAttribute("aria-label", "folder to import");
  const act = el("button", {
    textContent: "Import",
    onclick: () => void api.importFolder(folder.value).then(() => (again(), notify(`${folder.value} is imported`)), notify),
  });
  const chosen = el("input", { type: "file", multiple: true, hidden: true });
  chosen.onchange = () => upload(chosen.files);
  const send = el("button", {
    textContent: "Upload",
    title: "or drop on this page: a ZIP of a scan folder, its scan.db, an MCAP, or a video with its flight log",
    onclick: () => chosen.click(),
  });
  return el("span", { className: "import" }, folder, act, send, chosen);
}

/** Uploads files that are chosen, or dropped on the page; a video goes with the other files, which
 * are its log and camera. Gives the way to choose, the line of progress, and what ends it. */
function uploads(again: () => void): [(files: FileList | null) => void, HTMLElement, () => void] {
  const line = el("p", { className: "upload", hidden: true });
  line.setAttribute("role", "status");
  let queue = Promise.resolve();
  const upload = (list: FileList | null): void => {
    const files = [...(list ?? [])];
    const isScan = (file: File): boolean => /\.(zip|db|mcap)$/i.test(file.name);
    const recording = files.filter((file) => !isScan(file));
    const groups = files.filter(isScan).map((file) => [file]);
    if (recording.length) groups.push(recording);
    for (const group of groups)
      queue = queue.then(async () => {
        const name = group.map((file) => file.name).join(", ");
        line.hidden = false;
        const show = (share: number): void => {
          line.textContent = share < 1 ? `${name}: ${Math.floor(100 * share)} % sent` : `${name}: importing`;
        };
        show(0);
        await api.upload(group, show).then(() => (again(), notify(`${name} has arrived`)), notify);
        line.hidden = true;
      });
  };
  const over = (event: DragEvent): void => {
    event.preventDefault();
    document.body.classList.toggle("drop", event.type === "dragover");
  };
  const drop = (event: DragEvent): void => {
    over(event);
    upload(event.dataTransfer?.files ?? null);
  };
  window.addEventListener("dragover", over);
  window.addEventListener("dragleave", over);
  window.addEventListener("drop", drop);
  const end = (): void => {
    window.removeEventListener("dragover", over);
    window.removeEventListener("dragleave", over);
    window.removeEventListener("drop", drop);
  };
  return [upload, line, end];
}

function card(s: api.Scan, again: () => void): HTMLElement {
  const open = api.viewAddress(s);
  const newest = s.newest ?? null;
  const image = s.preview
    ? el("img", { src: api.file(s, "preview.jpg"), alt: `preview of ${s.title}`, loading: "lazy" })
    : newest !== null
      ? el("img", { src: api.keyframe(s, newest), alt: `newest image of ${s.title}`, loading: "lazy" })
      : el("div", { className: "blank", textContent: "no preview yet" });
  return el(
    "article",
    {},
    el("a", { href: open, className: "thumbnail" }, image),
    el(
      "h2",
      {},
      el("a", { href: open, textContent: s.title }),
      s.finished || s.trouble ? null : el("span", { className: s.growing ? "badge" : "badge silent", textContent: s.growing ? "growing" : "not finished" }),
    ),
    facts(s),
    s.trouble ? el("p", { className: "trouble", textContent: s.trouble }) : null,
    el("p", { className: "tags" }, ...s.tags.map((t) => el("span", { textContent: t }))),
    downloads(s),
    el("ul", { className: "jobs made" }),
    el(
      "p",
      { className: "acts" },
      s.origin ? el("a", { href: api.mapAddress(s), textContent: "Map", className: "button" }) : null,
      el("button", { textContent: "Rename", onclick: () => rename(s, again) }),
      el("button", { textContent: "Tags", onclick: () => retag(s, again) }),
      el("button", { textContent: "Delete", onclick: () => remove(s, again) }),
      makeMenu(s, again),
    ),
  );
}

function facts(s: api.Scan): HTMLElement {
  const rows: [string, string][] = [["Drone", s.drone], ["Flown", date(s.started_unix_s)]];
  if (s.origin) rows.push(["Place", `${s.origin.lat_deg.toFixed(5)}, ${s.origin.lon_deg.toFixed(5)}`]);
  const { area_m2, sigma_median_m, position_sigma_h_median_m: across, position_sigma_v_median_m: up, trust } = s.quality ?? {};
  const size: string[] = [];
  if (s.counts?.points !== undefined) size.push(`${count(s.counts.points)} points`);
  else if (s.counts?.keyframes !== undefined) size.push(`${s.counts.keyframes} keyframes`);
  if (area_m2) size.push(`${count(area_m2)} m²`);
  if (size.length) rows.push(["Size", size.join(", ")]);
  const sigma: string[] = [];
  if (sigma_median_m) sigma.push(`detail ${units.accuracy(sigma_median_m)}`);
  if (s.origin && across && up) sigma.push(`position ${units.sigmas(across, up)}`);
  if (sigma.length) rows.push(["Accuracy", sigma.join(", ")]);
  if (trust) rows.push(["Trust", [trust.level, ...trust.reasons].join("; ")]);
  return el(
    "dl",
    { className: "facts" },
    ...rows.flatMap(([k, v]) => [el("dt", { textContent: k }), el("dd", { textContent: v })]),
  );
}

function downloads(s: api.Scan): HTMLElement {
  const rows = s.files.map((f) =>
    el(
      "li",
      {},
      el("a", { href: api.file(s, f.name), textContent: f.name, download: "" }),
      ` ${f.what}, ${size(f.bytes)}`,
    ),
  );
  const maps = el("a", { href: `${api.scanAddress(s)}/maps.zip`, textContent: "maps.zip", download: "" });
  if (s.maps) rows.push(el("li", {}, maps, " all maps with a manifest"));
  return el(
    "details",
    {},
    el("summary", { textContent: rows.length === 1 ? "1 file" : `${rows.length} files` }),
    el("ul", {}, ...rows),
  );
}

/** A kind to choose and a button that makes it. */
function makeMenu(s: api.Scan, again: () => void): HTMLElement {
  const kinds = el("select", {}, ...KINDS.map(([value, textContent]) => el("option", { value, textContent })));
  kinds.setAttribute("aria-label", "deliverable");
  const heights = el("select", {}, ...HEIGHTS.map(([text], i) => el("option", { value: String(i), textContent: text })));
  heights.setAttribute("aria-label", "heights");
  kinds.onchange = () => (heights.hidden = !s.origin || !WITH_HEIGHTS.has(kinds.value));
  heights.hidden = !s.origin;
  const chosen = (): api.Heights | undefined => (heights.hidden ? undefined : HEIGHTS[Number(heights.value)]![1]);
  const act = el("button", { textContent: "Make", onclick: () => void make(s, kinds.value, chosen()).then(again, notify) });
  act.setAttribute("aria-label", `Make a deliverable of ${s.title}`);
  return el("span", { className: "group" }, kinds, heights, act);
}

async function make(s: api.Scan, kind: string, heights?: api.Heights): Promise<void> {
  await api.make(s, kind, heights);
  await api.finished(s, kind);
}

function rename(s: api.Scan, again: () => void): void {
  const title = prompt("Name of this scan", s.title);
  if (title !== null) void api.label(s, { title }).catch(notify).then(again);
}

function retag(s: api.Scan, again: () => void): void {
  const text = prompt("Tags, separated by commas", s.tags.join(", "));
  if (text === null) return;
  const tags = text.split(",").map((t) => t.trim()).filter(Boolean);
  void api.label(s, { tags }).catch(notify).then(again);
}

function remove(s: api.Scan, again: () => void): void {
  if (confirm(`Move “${s.title}” to the bin?`)) void api.remove(s).then(again, notify);
}

function binRows(names: string[], again: () => void): HTMLElement[] {
  if (!names.length) return [];
  const rows = names.map((name) =>
    el(
      "li",
      {},
      name.split("~").slice(0, 2).join(" / "),
      " ",
      el("button", {
        textContent: "Restore",
        onclick: () => void api.restore(name).then(again, notify),
      }),
    ),
  );
  return [el("h2", { textContent: "Bin" }), el("ul", {}, ...rows)];
}
