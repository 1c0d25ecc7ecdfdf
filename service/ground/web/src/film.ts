// A flight of the camera through chosen views, as a video file.

import * as THREE from "three";
import { el, notify, saveBlob } from "./dom";
import type { Stage } from "./stage";

const FRAMES_PER_S = 30;
const BITS_PER_S = 16e6;
const KINDS = ["video/mp4;codecs=avc1.640028", "video/webm;codecs=vp9", "video/webm"];

interface View {
  from: THREE.Vector3;
  at: THREE.Vector3;
}

/** Views to fly through, the time from one to the next, and the button that records. */
export function filmBox({ stage, id }: { stage: Stage; id: { scan: string } }): HTMLElement {
  const views: View[] = [];
  const words = el("p", { className: "quiet" });
  const seconds = el("input", { type: "number", min: "0.5", max: "60", step: "0.5", value: "4" });
  const record = el("button", { textContent: "Record" });
  const write = (): void => {
    words.textContent = `${views.length} ${views.length === 1 ? "view" : "views"}; two or more make a path`;
    record.disabled = views.length < 2;
  };
  const add = el("button", {
    textContent: "Add view",
    title: "the camera flies through this view",
    onclick: () => {
      views.push({ from: stage.camera.position.clone(), at: stage.controls.target.clone() });
      write();
    },
  });
  const clear = el("button", { textContent: "Clear", onclick: () => ((views.length = 0), write()) });
  record.onclick = () => {
    record.disabled = true;
    record.textContent = "Recording";
    void film(stage, views, Number(seconds.value) || 4)
      .then((video) => saveBlob(`${id.scan}.${video.type.includes("mp4") ? "mp4" : "webm"}`, video), notify)
      .finally(() => ((record.textContent = "Record"), write()));
  };
  write();
  const panel = el(
    "div",
    { className: "settings" },
    words,
    el("label", {}, el("span", { textContent: "Seconds each" }), seconds),
    el("p", { className: "acts" }, add, clear, record),
  );
  return el("details", { className: "group" }, el("summary", { textContent: "Film" }), panel);
}

/** The video of the camera's way through the views, as long as it takes; it is recorded while it is drawn. */
async function film(stage: Stage, views: View[], each_s: number): Promise<Blob> {
  const type = typeof MediaRecorder === "undefined" ? undefined : KINDS.find((kind) => MediaRecorder.isTypeSupported(kind));
  if (!type) throw new Error("this browser records no video");
  const from = new THREE.CatmullRomCurve3(views.map((v) => v.from));
  const at = new THREE.CatmullRomCurve3(views.map((v) => v.at));
  const stream = stage.renderer.domElement.captureStream(FRAMES_PER_S);
  const recorder = new MediaRecorder(stream, { mimeType: type, videoBitsPerSecond: BITS_PER_S });
  const parts: Blob[] = [];
  recorder.ondataavailable = ({ data }) => data.size && parts.push(data);
  const stopped = new Promise<void>((resolve) => (recorder.onstop = () => resolve()));
  stage.follow = false;
  stage.controls.enabled = false;
  stage.painter.isFilmed = true; // else a slow card's film would be as coarse as its view while it moves
  try {
    recorder.start();
    const whole_ms = 1000 * each_s * (views.length - 1);
    const began = performance.now();
    await new Promise<void>((done) => {
      const step = (): void => {
        const share = Math.min(1, (performance.now() - began) / whole_ms);
        stage.camera.position.copy(from.getPoint(share));
        stage.controls.target.copy(at.getPoint(share));
        stage.controls.update();
        stage.touch();
        if (share < 1) requestAnimationFrame(step);
        else done();
      };
      requestAnimationFrame(step);
    });
    await new Promise((resolve) => setTimeout(resolve, 1000 / FRAMES_PER_S));
    recorder.stop();
    await stopped;
  } finally {
    stage.controls.enabled = true;
    stage.painter.isFilmed = false;
    for (const track of stream.getTracks()) track.stop(); // it would read every later frame too
  }
  return new Blob(parts, { type });
}
