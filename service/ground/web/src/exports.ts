// The one dialog for all that leaves a scan: each product with what it is, its size and its time; and its files.

import * as api from "./api";
import { modal } from "./dialog";
import { el, notify, size } from "./dom";
import { duration } from "./jobs";
import { nameOf } from "./names";
import { keyOf } from "./overview";

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

let open: { dialog: HTMLDialogElement; of: api.Scan; rows: Map<string, HTMLElement> } | null = null;

/** Where the open dialog shows a job; null: it is not of its scan. */
export const homeInDialog = (job: api.Job): Element | null =>
  open && open.of.drone === job.drone && open.of.scan === job.scan ? (open.rows.get(job.kind)?.querySelector(".made") ?? null) : null;

/** Shows the dialog of a scan; `again` is called when it has a new file. */
export async function showExports(s: api.Scan, again: () => void): Promise<void> {
  const heights = el("select", {}, ...HEIGHTS.map(([text], i) => el("option", { value: String(i), textContent: text })));
  heights.setAttribute("aria-label", "heights");
  const list = el("div", { className: "products" });
  const files = el("ul", { className: "files" });
  const close = el("form", { method: "dialog" }, el("button", { textContent: "Close" }));
  const words = el("p", { className: "quiet", textContent: "Products are made on the ground station, from the scan as it is now." });
  const [dialog, closed] = modal(
    `Export ${nameOf(s)}`, "export", close, words,
    s.origin ? el("label", { className: "heights" }, "Heights ", heights) : null,
    list, el("h3", { textContent: "Files of the scan" }), files,
  );
  const fill = async (made = ""): Promise<void> => {
    const [products, now] = await Promise.all([api.products(s), api.scan(s.drone, s.scan)]);
    if (!dialog.open) return; // closed meanwhile: jobs are shown on the card again
    const rows = new Map<string, HTMLElement>();
    const groups = new Map<string, HTMLElement[]>();
    for (const product of products) {
      const row = rowOf(now, product, () => HEIGHTS[Number(heights.value)]![1], () => void fill(product.kind).then(again, notify));
      const jobs = open?.rows.get(product.kind)?.querySelector(".made");
      if (jobs) row.querySelector(".made")!.replaceWith(jobs); // what runs stays in its place
      rows.set(product.kind, row);
      groups.set(product.group, [...(groups.get(product.group) ?? []), row]);
    }
    open = { dialog, of: s, rows };
    const focused = document.activeElement?.ariaLabel;
    list.replaceChildren(...[...groups].flatMap(([group, members]) => [el("h3", { textContent: group }), ...members]));
    if (document.activeElement === document.body) {
      const same = [...list.querySelectorAll<HTMLElement>("[aria-label]")].find((e) => e.ariaLabel === focused);
      (same ?? rows.get(made)?.querySelector<HTMLElement>(".acts > *"))?.focus();
    }
    const others = now.files.filter((f) => !products.some((p) => p.file === f.name));
    files.replaceChildren(...others.map((f) => el("li", {}, el("a", { href: api.file(s, f.name), textContent: f.name, download: "" }), ` ${f.what}, ${size(f.bytes)}`)));
  };
  await fill().catch((error: unknown) => (notify(error), dialog.close()));
  await closed;
  if (open?.dialog === dialog) open = null;
  // The card may be another one by now, and its scan be named otherwise.
  if (document.activeElement === document.body) document.querySelector<HTMLElement>(`[data-exports="${keyOf(s)}"]`)?.focus();
}

function rowOf(s: api.Scan, p: api.Product, heights: () => api.Heights, again: () => void): HTMLElement {
  const act = el("button", { textContent: p.bytes === null ? "Make" : "Make again", disabled: p.impossible !== null });
  act.setAttribute("aria-label", `${act.textContent} ${p.title}`);
  act.onclick = () => {
    act.disabled = true;
    void api.make(s, p.kind, s.origin && p.heights ? heights() : undefined)
      .then(() => api.finished(s, p.kind))
      .catch(notify)
      .finally(again);
  };
  const get = el("a", { className: "button", textContent: "Download", href: api.product(s, p.file), download: "" });
  get.setAttribute("aria-label", `Download ${p.title}`);
  const figures = p.impossible ?? (p.bytes === null ? about(p) : [size(p.bytes), p.file].join(" · "));
  return el(
    "div",
    { className: "product" },
    el("div", {}, el("strong", { textContent: p.title }), el("p", { textContent: p.text }), el("p", { className: "quiet", textContent: figures })),
    el("span", { className: "acts" }, p.bytes === null ? null : get, act),
    el("ul", { className: "jobs made" }),
  );
}

/** The size and time that a product will take. */
const about = ({ about_bytes, about_s }: api.Product): string =>
  [about_bytes === null ? "" : `about ${size(about_bytes)}`, about_s === null ? "" : `about ${duration(about_s)}`].filter(Boolean).join(", ");
