// Three pages behind the address: the list of scans, and one scan in 3D or on a map.

import "./style.css";
import { notify } from "./dom";
import { showLibrary } from "./library";

const root = document.getElementById("app")!;
let close: () => void = () => undefined;
let turn = 0;

async function show(): Promise<void> {
  const mine = ++turn;
  close();
  close = () => undefined;
  const [page, drone, scan, place] = location.hash.replace(/^#\//, "").split("/").map(decodeURIComponent);
  let end: () => void;
  if (page === "view" && drone && scan) end = await (await import("./view")).showView(root, drone, scan, place);
  else if (page === "map" && drone && scan) end = await (await import("./map")).showMap(root, drone, scan);
  else end = await showLibrary(root);
  if (mine === turn) close = end;
  else end(); // another page was asked for meanwhile
}

addEventListener("hashchange", () => void show().catch(notify));
void show().catch(notify);
