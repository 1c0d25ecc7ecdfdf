// What colours mean, as words beside patches of them.

import { el } from "./dom";

/** The colours of service/scans/coverage.py, over white. */
const COVERAGE_KEYS = [
  ["good", "#79d29a"], ["seldom seen", "#f8bd78"], ["unsure", "#f8e78d"], ["gap", "#e7787f"],
] as const;

export function key(text: string, colour: string): HTMLElement {
  const patch = el("i", {});
  patch.style.background = colour;
  return el("span", {}, patch, text);
}

export const coverageKeys = (): HTMLElement =>
  el("p", { className: "keys" }, ...COVERAGE_KEYS.map(([text, colour]) => key(text, colour)));
