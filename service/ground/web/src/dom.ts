// Elements without HTML strings: names given by people are only ever text.

type Child = Node | string | null | false;

export function el<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  props: Partial<HTMLElementTagNameMap[K]> & { onclick?: (event: MouseEvent) => void } = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  const node = document.createElement(tag);
  Object.assign(node, props);
  for (const child of children) if (child) node.append(child);
  return node;
}

const SHORT = 28; // letters

/** A text of which no line break parts what is between two commas, if it is short: a number stays with its unit. */
export const unbroken = (text: string): (HTMLElement | string)[] =>
  text.split(/(?<=,) /).flatMap((part, i) => [i ? " " : "", el("span", { textContent: part, className: part.length < SHORT ? "figure" : "" })]);

/** The way back to the list; a phone shows its arrow only. */
export const toScans = (): HTMLElement => el("a", { href: "#/", className: "back" }, "‹ ", el("span", { textContent: "Scans" }));

/** Says what went wrong, for a few seconds. */
export function notify(error: unknown): void {
  const text = error instanceof Error ? error.message : String(error);
  const note = el("div", { className: "note", textContent: text });
  note.setAttribute("role", "alert");
  document.body.append(note);
  setTimeout(() => note.remove(), 6000);
}

const SHOWN_LETTERS = 30;

/** The beginning of a text, for a label. */
export const short = (text: string): string => (text.length > SHOWN_LETTERS ? `${text.slice(0, SHOWN_LETTERS - 1)}…` : text);

export const count = (n: number | null | undefined): string =>
  n === null || n === undefined ? "?" : Math.round(n).toLocaleString("en");

export function size(bytes: number): string {
  if (bytes < 1e3) return `${bytes.toFixed(0)} B`;
  if (bytes < 1e6) return `${(bytes / 1e3).toFixed(0)} kB`;
  return bytes < 1e9 ? `${(bytes / 1e6).toFixed(1)} MB` : `${(bytes / 1e9).toFixed(2)} GB`;
}

export const date = (unix_s: number | null): string =>
  unix_s === null ? "no date" : new Date(unix_s * 1000).toLocaleString("en-GB", { dateStyle: "medium", timeStyle: "short" });

/** An element of SVG with its attributes. */
export function svg<K extends keyof SVGElementTagNameMap>(tag: K, attributes: Record<string, string>, text = ""): SVGElementTagNameMap[K] {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.textContent = text;
  return node;
}

/** Gives the browser a text as a file to download. */
export function save(name: string, text: string, type = "application/geo+json"): void {
  saveBlob(name, new Blob([text], { type }));
}

export function saveBlob(name: string, blob: Blob): void {
  const href = URL.createObjectURL(blob);
  el("a", { href, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(href), 10_000);
}

/** The clipboard; over plain HTTP only the older way works. */
export async function copy(text: string): Promise<void> {
  if (navigator.clipboard) return navigator.clipboard.writeText(text);
  const area = el("textarea", { value: text });
  document.body.append(area);
  area.select();
  const done = document.execCommand("copy");
  area.remove();
  if (!done) throw new Error("this browser does not let the page copy");
}
