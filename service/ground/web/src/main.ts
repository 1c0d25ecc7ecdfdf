// Two pages behind the address: the list of scans, and one scan in 3D.

import "./style.css";
import { tell } from "./dom";
import { showLibrary } from "./library";

const root = document.getElementById("app")!;
let close: () => void = () => undefined;

async function show(): Promise<void> {
  close();
  close = () => undefined;
  const [page, drone, scan] = location.hash.replace(/^#\//, "").split("/").map(decodeURIComponent);
  if (page === "view" && drone && scan) {
    const { showView } = await import("./view");
    close = showView(root, drone, scan);
  } else {
    await showLibrary(root);
  }
}

addEventListener("hashchange", () => void show().catch(tell));
void show().catch(tell);
