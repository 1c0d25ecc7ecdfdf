// Long work on scans: what is made, how far it is, how long it takes yet, and a button that stops it.

import * as api from "./api";
import { el, notify } from "./dom";
import { nameOf } from "./names";

const ASK_EVERY_MS = 1000;
const ENDED_S = 60;

interface Row {
  element: HTMLElement;
  show: (job: api.Job) => void;
}

/** The jobs of one scan, and alignments: the last clicks of one are made in the other scan's view. */
export function jobsOf(scan: () => api.Scan): HTMLElement {
  const others = new Map<number, Promise<string>>();
  return jobList((job) => {
    if (job.drone === scan().drone && job.scan === scan().scan) return nameOf(scan());
    if (job.kind !== "align") return null;
    const name = others.get(job.number) ?? api.scan(job.drone, job.scan).then(nameOf, () => job.scan);
    others.set(job.number, name);
    return name;
  });
}

/** The scan that a job belongs to, as `keyOf` names it: an upload's is the one it has become. */
export const ownerOf = ({ kind, state, file, drone, scan }: api.Job): string => (kind === "scan" && state === "done" && file ? file : `${drone}/${scan}`);

/** What a job's scan is called; null: the job is not shown. */
type NameOf = (job: api.Job) => string | Promise<string> | null;

/**
 * A list that keeps itself up to date while it is in the page; hidden while there is nothing. A job is shown where
 * `homeOf` says, with its history; all others here, until a while after they have ended.
 */
export function jobList(name: NameOf, homeOf: (job: api.Job) => Element | null = () => null): HTMLElement {
  const list = el("ul", {});
  const section = el("section", { className: "panel jobs", hidden: true }, list);
  section.setAttribute("aria-label", "jobs");
  let rows = new Map<number, Row>();
  const refresh = async (): Promise<void> => {
    const all = await api.jobs().catch(() => []);
    const jobs = all.filter((job) => name(job) !== null && (homeOf(job) || (job.ended_s ?? 0) < ENDED_S));
    const names = await Promise.all(jobs.map(name));
    const old = rows; // not before: another turn may have drawn them meanwhile
    rows = new Map(jobs.map((job, k) => [job.number, old.get(job.number) ?? row(job, names[k]!)]));
    for (const [number, { element }] of old) if (!rows.has(number)) element.remove();
    for (const job of jobs) {
      const { element, show } = rows.get(job.number)!;
      const home = homeOf(job) ?? list;
      show(job);
      if (element.parentElement !== home) home.append(element);
    }
    section.hidden = !list.children.length;
  };
  api.whileShown(section, ASK_EVERY_MS, refresh);
  return section;
}

function row(job: api.Job, name: string): Row {
  const what = `${job.title} of ${name}`;
  const bar = el("progress", { max: 100 });
  bar.setAttribute("aria-label", what);
  const words = el("span", { className: "words" });
  const stop = el("button", { textContent: "Cancel", onclick: () => void api.cancel(job.number).catch(notify) });
  stop.setAttribute("aria-label", `Cancel ${what}`);
  const get = el("a", { className: "button", textContent: "Download", hidden: true, download: "" });
  get.setAttribute("aria-label", `Download ${what}`);
  const element = el("li", {}, el("strong", {}, job.title, el("span", { className: "of", textContent: ` of ${name}` })), bar, words, stop, get);
  const show = (now: api.Job): void => {
    const ended = now.state !== "waiting" && now.state !== "running";
    element.className = now.state;
    bar.hidden = stop.hidden = ended;
    bar.value = now.percent;
    words.textContent = wordsOf(now);
    const address = now.state === "done" ? madeAt(now) : null;
    get.hidden = !address;
    if (address) get.href = address;
  };
  return { element, show };
}

/** The address of what a job has made; null for a scan, which is a card. */
function madeAt(job: api.Job): string | null {
  return job.file === null || job.kind === "scan" || job.kind === "align" ? null : api.product(job, job.file);
}

function wordsOf(job: api.Job): string {
  if (job.state === "failed") return job.error ?? "failed";
  if (job.state !== "running") return job.state;
  const left = job.left_s === null ? [] : [`${duration(job.left_s)} left`];
  return [`${job.percent} %`, ...left, job.doing].filter(Boolean).join(" · ");
}

export const duration = (s: number): string => (s < 90 ? `${s} s` : `${Math.round(s / 60)} min`);
