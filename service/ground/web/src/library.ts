// All scans on a map and as cards: look, open, export, rename, tag, delete, bring back.

import * as api from "./api";
import { count, date, el, notify, unbroken } from "./dom";
import { askText } from "./dialog";
import { homeInDialog, showExports } from "./exports";
import { jobList, ownerOf } from "./jobs";
import { nameOf, placeName } from "./names";
import { keyOf, Overview } from "./overview";
import * as units from "./units";
import { vehicleStrip } from "./vehicle";

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
  const title = (job: api.Job): string => {
    const found = scans.find((s) => s.drone === job.drone && s.scan === job.scan);
    return found ? nameOf(found) : job.scan;
  };
  const overview = new Overview();
  let chosen: string[] = []; // on the map; none: all
  const all = el("button", { textContent: "Show all", onclick: () => (overview.whole(), choose([])) });
  const which = el("p", { className: "chosen", hidden: true }, el("span", {}), all);
  which.setAttribute("role", "status");
  const choose = (some: api.Scan[]): void => {
    chosen = some.map(keyOf);
    draw();
  };
  overview.onChoose = choose;
  const [upload, line, endUploads] = uploads(again);
  const cut = el("p", { className: "stale", hidden: true });
  cut.setAttribute("role", "status");
  const leave = el("button", {
    textContent: "Log out",
    title: "End this browser's session",
    hidden: true, // until it is known to have one
    onclick: () => void api.ask("/api/logout", "POST").then(() => location.reload(), notify),
  });
  void api.hasSession().then((has) => (leave.hidden = !has), () => undefined);
  root.replaceChildren(
    el("header", {}, el("h1", { textContent: "skyrelief" }), search, vehicleStrip(), importForm(again, upload), leave),
    cut,
    line,
    jobList(title, (job) => homeInDialog(job) ?? cards.get(ownerOf(job))?.element.querySelector(".made") ?? null),
    overview.element,
    which,
    list,
    bin,
  );
  let cards = new Map<string, Card>();
  let seen = "";
  const draw = (): void => {
    const wanted = search.value.toLowerCase();
    const found = scans.filter((s) =>
      [nameOf(s), s.scan, s.drone, ...s.tags].join(" ").toLowerCase().includes(wanted),
    );
    chosen = chosen.filter((key) => found.some((s) => keyOf(s) === key));
    const shown = chosen.length ? found.filter((s) => chosen.includes(keyOf(s))) : found;
    which.hidden = !chosen.length;
    which.firstChild!.textContent = `${shown.length} of ${found.length} scans, at the place chosen on the map`;
    overview.show(found);
    cards = new Map(shown.map((s) => [keyOf(s), kept(cards.get(keyOf(s)), s, again, overview)]));
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
  await load().catch(() => undefined);
  const end = api.every(REFRESH_MS, load);
  return () => {
    end();
    overview.close();
    endUploads();
  };
}

interface Card {
  content: string;
  element: HTMLElement;
}

/** The card of a scan: the one there is while nothing of the scan changed. */
function kept(old: Card | undefined, s: api.Scan, again: () => void, overview: Overview): Card {
  const content = JSON.stringify(s);
  if (old?.content === content) return old;
  const element = card(s, again);
  const mark = (on: boolean) => (): void => overview.mark(on ? s : null);
  element.onmouseenter = mark(true);
  element.onmouseleave = mark(false);
  element.addEventListener("focusin", mark(true));
  element.addEventListener("focusout", mark(false));
  if (old) leaveAsFound(old.element, element);
  return { content, element };
}

/** Opens and focuses in `now` what is open and focused in `old`, and takes over its jobs; its image until there is another. */
function leaveAsFound(old: HTMLElement, now: HTMLElement): void {
  const [was, is] = [old, now].map((one) => one.querySelector<HTMLImageElement>(".thumbnail img"));
  if (was?.naturalWidth && is && was.src !== is.src) {
    const place = is.parentElement!;
    is.replaceWith(was);
    is.loading = "eager"; // out of the page
    // The image before this one may have come meanwhile, in place of the old one.
    const show = (): void => (was.parentElement ? was.replaceWith(is) : place.replaceChildren(is));
    void is.decode().then(show, () => (show(), is.onerror?.("")));
  }
  now.querySelector("details")!.open = old.querySelector("details")!.open;
  const focused = old.contains(document.activeElement) ? document.activeElement : null;
  now.querySelector(".made")!.replaceWith(old.querySelector(".made")!);
  if (!focused) return;
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
    el("p", { textContent: "They appear here as soon as a drone connects. Or upload (or drop here) a ZIP of a scan folder, its scan.db, an MCAP, or a video with its flight log, unless that is inside." }),
  );
}

function importForm(again: () => void, upload: (files: FileList | null) => void): HTMLElement {
  const folder = el("input", { placeholder: "folder or .mcap on this machine", size: 30 });
  folder.setAttribute("aria-label", "folder to import");
  const box = el("details", { className: "group import" });
  const close = (): void => void (box.open = false); // it would cover the jobs
  const act = el("button", {
    textContent: "Import",
    onclick: () => {
      const from = folder.value; // the next one may be written meanwhile
      close();
      void api.importFolder(from).then(() => (again(), notify(`${from} is imported`)), notify);
    },
  });
  const chosen = el("input", { type: "file", multiple: true, hidden: true });
  chosen.onchange = () => (close(), upload(chosen.files));
  const send = el("button", {
    textContent: "Upload",
    title: "a ZIP of a scan folder, its scan.db, an MCAP, or a video with its flight log, unless that is inside",
    onclick: () => chosen.click(),
  });
  const menu = el("div", { className: "settings" }, el("p", {}, folder, act), el("p", {}, send, "or drop files on this page"), chosen);
  const summary = el("summary", { textContent: "Add scans" });
  // Not onkeydown: what that returns, false for a letter, keeps the letter from the field.
  box.addEventListener("keydown", ({ key }) => {
    if (key !== "Escape" || !box.open) return;
    close();
    summary.focus();
  });
  box.append(summary, menu);
  return box;
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
  const name = nameOf(s);
  const badge = s.growing ? "badge" : "badge silent";
  const button = (textContent: string, onclick: () => void): HTMLElement => el("button", { textContent, onclick });
  const export_ = button("Export…", () => void showExports(s, again).catch(notify));
  export_.setAttribute("aria-label", `Export ${name}`);
  export_.dataset["exports"] = keyOf(s);
  const more = el("summary", { textContent: "More", className: "button" });
  more.setAttribute("aria-label", `more for ${name}`);
  const go = el("a", { href: open, textContent: "Open", className: "button on" });
  go.setAttribute("aria-label", `Open ${name}`);
  return el(
    "article",
    {},
    el("a", { href: open, className: "thumbnail", tabIndex: -1 }, thumbnail(s, name)),
    el(
      "h2",
      {},
      el("a", { href: open, textContent: name }),
      s.finished || s.trouble ? null : el("span", { className: badge, textContent: s.growing ? "growing" : "not finished" }),
    ),
    facts(s),
    s.trouble ? el("p", { className: "trouble", textContent: s.trouble }) : null,
    el("p", { className: "tags" }, ...s.tags.map((t) => el("span", { textContent: t }))),
    el("ul", { className: "jobs made" }),
    el(
      "p",
      { className: "acts" },
      go,
      s.origin ? el("a", { href: api.mapAddress(s), textContent: "Map", className: "button" }) : null,
      export_,
      el(
        "details",
        { className: "more" },
        more,
        el(
          "span",
          { className: "acts" },
          el("a", { href: api.controlAddress(s), textContent: "Control points", className: "button" }),
          button("Rename…", () => void rename(s, again)),
          button("Tags…", () => void retag(s, again)),
          button("Delete", () => void api.remove(s).then(() => (notify(`${name} is in the bin`), again()), notify)),
        ),
      ),
    ),
  );
}

/** The scan from above, also while it grows; without a georeference its newest image. */
function thumbnail(s: api.Scan, name: string): HTMLElement {
  const newest = s.newest ?? null;
  const kept = s.thumbnail ? "thumbnail.webp" : s.preview ? "preview.jpg" : null;
  if (kept) return el("img", { src: api.file(s, kept), alt: `${name} from above`, loading: "lazy" });
  if (newest !== null) {
    const image = el("img", { src: api.keyframe(s, newest), alt: `newest image of ${name}`, className: "whole" });
    if (!s.origin) return image;
    const map = el("img", { src: `${api.mapThumbnail(s)}?v=${s.counts?.keyframes}`, alt: `${name} from above, so far` });
    map.onerror = () => map.replaceWith(image);
    return map;
  }
  return el("div", { className: "blank", textContent: "no image yet" });
}

function facts(s: api.Scan): HTMLElement {
  const rows: [string, string][] = [["Drone", s.drone]];
  const isNamed = s.title !== s.scan; // else its name is place and date
  if (isNamed) rows.push(["Flown", date(s.started_unix_s)]);
  if (s.origin && isNamed) rows.push(["Place", placeName(s.origin.lat_deg, s.origin.lon_deg)]);
  const { area_m2, sigma_median_m, position_sigma_h_median_m: across, trust } = s.quality ?? {};
  const up = api.heightSigma(s.quality);
  const size: string[] = [];
  if (s.counts?.points !== undefined) size.push(`${count(s.counts.points)} points`);
  else if (s.counts?.keyframes !== undefined) size.push(`${s.counts.keyframes} keyframes`);
  if (area_m2) size.push(`${count(area_m2)} m²`);
  if (size.length) rows.push(["Size", size.join(", ")]);
  const sigma: string[] = [];
  if (sigma_median_m) sigma.push(`relative ${units.accuracy(sigma_median_m)}`);
  if (s.origin && across && up) sigma.push(`absolute ${units.sigmas(across, up)}`);
  if (sigma.length) rows.push(["Accuracy", sigma.join(", ")]);
  if (trust) rows.push(["Trust", [trust.level, ...trust.reasons].join("; ")]);
  return el(
    "dl",
    { className: "facts" },
    ...rows.flatMap(([k, v]) => [el("dt", { textContent: k }), el("dd", {}, ...unbroken(v))]),
  );
}

async function rename(s: api.Scan, again: () => void): Promise<void> {
  const title = await askText("Name of this scan", s.title === s.scan ? "" : s.title, `none: ${s.scan}`, { maxLength: 200 });
  if (title !== null) await api.label(s, { title }).catch(notify).then(again);
}

async function retag(s: api.Scan, again: () => void): Promise<void> {
  const text = await askText("Tags", s.tags.join(", "), "separated by commas");
  if (text === null) return;
  const tags = text.split(",").map((t) => t.trim()).filter(Boolean);
  await api.label(s, { tags }).catch(notify).then(again);
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
