// The pages behind the address: the list of scans; one scan in 3D, on a map, with its control points.

import "./style.css";
import * as api from "./api";
import { el } from "./dom";
import { showLibrary } from "./library";

const root = document.getElementById("app")!;
let close: () => void = () => undefined;
let turn = 0;
let shown = ""; // page and scan

async function show(): Promise<void> {
  const mine = ++turn;
  close();
  close = () => undefined;
  for (const dialog of document.querySelectorAll("dialog")) dialog.close(); // they belong to the page that is left
  for (const child of root.children) child.toggleAttribute("inert", true); // seen until the next page stands there
  const [page, drone, scan, place] = location.hash.replace(/^#\//, "").split("/").map(decodeURIComponent);
  let end: () => void;
  if (page === "view" && drone && scan) end = await (await loaded(import("./view"))).showView(root, drone, scan, place);
  else if (page === "map" && drone && scan) end = await (await loaded(import("./map"))).showMap(root, drone, scan);
  else if (page === "control" && drone && scan) end = await (await loaded(import("./control"))).showControl(root, drone, scan);
  else end = await showLibrary(root);
  document.title = [...new Set([root.querySelector("h1")?.textContent, "skyrelief"])].filter(Boolean).join(" · ");
  if (mine === turn) close = end;
  else end(); // another page was asked for meanwhile
}

const loaded = <T>(part: Promise<T>): Promise<T> =>
  part.catch(() => {
    throw new Error(api.NO_ANSWER);
  });

/** Shows what stands in place of a page that cannot be shown. */
function fail(error: unknown): void {
  const why = error instanceof Error ? error.message : String(error);
  const unknown = error instanceof api.Refused && error.status === 404;
  root.replaceChildren(
    el(
      "main",
      { className: "empty" },
      el("h1", { textContent: unknown ? "There is no such scan" : "This scan cannot be shown" }),
      el("p", { textContent: unknown ? `${why}. It may have been deleted or not arrived yet.` : why }),
      el("p", {}, el("button", { textContent: "Try again", onclick: () => location.reload() }), " ", el("a", { href: "#/", textContent: "All scans" })),
    ),
  );
}

function start(): void {
  const asked = location.hash.split("/").slice(0, 4).join("/");
  if (asked === shown && asked.startsWith("#/view/")) return; // the view itself goes to the place
  shown = asked;
  const showing = show();
  const mine = turn;
  void showing.catch((error: unknown) => mine === turn && ((shown = ""), fail(error)));
}
addEventListener("hashchange", start);
start();
