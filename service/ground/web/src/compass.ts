// Where north is, and how long a metre: of the place that the view turns about.

import { Vector3 } from "three";
import { el } from "./dom";
import type { Stage } from "./stage";
import * as units from "./units";

const WIDEST_PX = 120;

/** A needle and a scale bar, drawn with each frame. */
export function compass(stage: Stage): HTMLElement {
  const needle = el("button", { className: "needle", textContent: "N", title: "north; click to look from the south" });
  needle.onclick = () => {
    stage.follow = false;
    const { target } = stage.controls;
    const offset = stage.camera.position.clone().sub(target);
    stage.camera.position.copy(target).add(new Vector3(0, -Math.hypot(offset.x, offset.y), offset.z));
    stage.touch();
  };
  const bar = el("i", {});
  const text = el("span", {});
  let last = "";
  stage.before.push(() => {
    const { camera, controls, renderer } = stage;
    const gaze = controls.target.clone().sub(camera.position);
    const turn = (Math.atan2(gaze.x, gaze.y) * 180) / Math.PI;
    const high = renderer.domElement.clientHeight || 1;
    const pixel_m = (2 * gaze.length() * Math.tan((camera.fov * Math.PI) / 360)) / high;
    const [length, words] = units.round(WIDEST_PX * pixel_m);
    const now = `${turn.toFixed(0)} ${(length / pixel_m).toFixed(0)} ${words}`;
    if (now === last) return;
    last = now;
    needle.style.rotate = `${-turn}deg`;
    bar.style.width = `${length / pixel_m}px`;
    text.textContent = words;
  });
  return el("div", { className: "compass" }, needle, el("span", { className: "bar" }, bar, text));
}
