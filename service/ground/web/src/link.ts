// The honest state of a scan that comes in: heard when, how fast, how late, how much is missing.

import { el, size } from "./dom";
import type { Link } from "./live";

const SILENT_S = 5;
const STILL_S = 15; // without a keyframe: the drone hovers, or its computer does not keep up
const WINDOW_MS = 5000;

export class LinkState {
  readonly element = el("span", { className: "state" });
  finished = false;
  /** Of the connection to the portal; empty while it stands. */
  cut = "connecting";
  private link: Link | null = null;
  private at = 0;
  private grown = performance.now();
  private readonly received: { at: number; bytes: number }[] = [];

  constructor() {
    this.element.setAttribute("role", "status");
  }

  news(link: Link): void {
    this.link = link;
    this.at = performance.now();
    if (link.received_bytes === null) return;
    this.received.push({ at: this.at, bytes: link.received_bytes });
    while (this.at - this.received[0]!.at > WINDOW_MS) this.received.shift();
  }

  /** A keyframe has come. */
  grew(): void {
    this.grown = performance.now();
  }

  /** Nothing of this scan was heard for a while, and it has not finished. */
  get isSilent(): boolean {
    return !this.finished && this.element.classList.contains("silent");
  }

  /** Shows the state as it is now. */
  draw(): void {
    const [kind, text] = this.words();
    this.element.className = `state ${kind}`;
    if (this.element.textContent !== text) this.element.textContent = text;
  }

  private words(): [string, string] {
    const { link } = this;
    if (this.cut) return ["cut", this.cut];
    if (!link) return ["cut", "connected"];
    const silent = link.silent_s + (performance.now() - this.at) / 1000;
    const backlog = link.backlog ? [`backlog ${link.backlog}`] : [];
    if (link.trouble) return ["silent", link.trouble];
    if (this.finished && !backlog.length) return ["finished", "finished"];
    const parts = [`last heard ${ago(silent)} ago`];
    if (silent > SILENT_S) return ["silent", ["silent", ...parts, ...backlog].join(" · ")];
    const rate = this.rate();
    if (rate !== null) parts.push(`${size(rate)}/s`);
    if (link.lag_s !== null) parts.push(`lag ${link.lag_s.toFixed(1)} s`);
    const still = (performance.now() - this.grown) / 1000;
    if (!this.finished && still > STILL_S) parts.push(`no keyframe for ${ago(still)}`);
    const what = this.finished ? "finished, receiving the rest" : "receiving";
    return ["receiving", [what, ...parts, ...backlog].join(" · ")];
  }

  /** Bytes a second over the last seconds; null where nothing is received here. */
  private rate(): number | null {
    const [first, last] = [this.received[0], this.received.at(-1)];
    if (!first || !last || last.at === first.at) return null;
    return (1000 * (last.bytes - first.bytes)) / (last.at - first.at);
  }
}

function ago(seconds: number): string {
  if (seconds < 120) return `${Math.floor(seconds)} s`;
  if (seconds < 7200) return `${Math.floor(seconds / 60)} min`;
  return seconds < 172800 ? `${Math.floor(seconds / 3600)} h` : `${Math.floor(seconds / 86400)} days`;
}
