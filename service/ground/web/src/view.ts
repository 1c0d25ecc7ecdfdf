// One scan in 3D: live cloud, track, cameras, key figures, latest picture.

import * as api from "./api";
import { Cameras } from "./cameras";
import { count, el, tell } from "./dom";
import { LiveView, type LastPose, type News } from "./live";
import { Ruler } from "./measure";
import { Cloud } from "./points";
import { canDraw, Stage } from "./stage";
import { toolbar } from "./toolbar";
import { vehicleStrip } from "./vehicle";

const PICTURE_EVERY_MS = 1500;

/** Shows a scan; returns what closes it. */
export function showView(root: HTMLElement, drone: string, name: string): () => void {
  const figures = el("div", { className: "panel figures" });
  const state = el("span", { className: "state" });
  const title = el("b", { textContent: name });
  const bar = el("nav", {}, el("a", { href: "#/", textContent: "‹ Scans" }), title, state, vehicleStrip());
  const host = el("div", { className: "stage" });
  const legend = el("div", { className: "panel legend", hidden: true });
  const coverage = el("div", { className: "panel coverage", hidden: true });
  const latest = el("figure", { className: "panel latest", hidden: true });
  const view = el("div", { className: "view" }, bar, host, figures, legend, coverage, latest);
  root.replaceChildren(view);
  const id = { drone, scan: name };
  const cloud = new Cloud();
  const facts = api.scan(drone, name);
  void facts.then((s) => {
    title.textContent = s.title;
    cloud.datum_m = s.origin?.alt_amsl_m ?? 0;
    if (s.files.some((f) => f.name === "report.html"))
      bar.append(el("a", { href: api.file(s, "report.html"), textContent: "Report" }));
  }, tell);
  if (!canDraw()) {
    figures.hidden = true;
    host.append(
      el("p", { className: "blank", textContent: "This browser cannot draw in 3D (no WebGL 2). The list and the downloads work." }),
    );
    return () => undefined;
  }
  const stage = new Stage(host);
  const cameras = new Cameras();
  const ruler = new Ruler({
    camera: stage.camera,
    canvas: stage.renderer.domElement,
    target: () => (stage.model.children.length ? stage.model : cloud.group),
    cloud: cloud.group,
  });
  host.append(ruler.overlay, ruler.cursor);
  view.append(ruler.panel);
  stage.before.push(ruler.draw);
  void facts.then((s) => (ruler.origin = s.origin), () => undefined);
  stage.drawGradually(cloud);
  stage.add(cameras.group);
  stage.addAgain(cloud.group);
  bar.append(toolbar({ stage, cloud, cameras, ruler, legend, coverage, id }));

  let last: LastPose | undefined;
  let link = "";
  let framed = false;
  let newest = -1;
  const reach = (): number => Math.max(last?.agl_m ?? 40, 5);
  const news = (item: News): void => {
    stage.touch();
    if (item.type === "repose") {
      cloud.repose(item.seq, item.T, item.scale);
      cameras.put(item.seq, item.T);
    }
    if (item.type === "track") {
      stage.setTrack(item.track);
      last = item.last;
      if (last) {
        cameras.aircraft(last.T, reach());
        stage.goAlong(last.T, reach());
      }
    }
    if (item.type === "state") {
      link = item.finished ? "finished" : "receiving";
      if (item.finished && !framed) stage.frame();
      framed ||= item.finished;
      stage.follow &&= !item.finished;
    }
  };
  const live = new LiveView(
    api.liveAddress(id),
    (chunk) => {
      cloud.add(chunk);
      stage.touch();
      cameras.put(chunk.seq, chunk.T);
      newest = Math.max(newest, chunk.seq);
      document.body.dataset["chunk"] = `${chunk.seq} ${Date.now()}`;
      if (cloud.keyframes === 1) stage.frame();
    },
    news,
    (text) => (link = text),
  );
  const stopPictures = keepLatest(id, latest, cameras, stage, () => newest);
  const clock = setInterval(() => {
    state.textContent = link;
    state.className = `state ${link}`;
    if (cameras.refresh()) stage.touch();
    figures.replaceChildren(...rows(cloud, stage, last));
    document.body.dataset["points"] = String(cloud.total);
    document.body.dataset["drawn"] = String(cloud.drawn);
    document.body.dataset["fps"] = stage.painter.frames_per_s.toFixed(1);
  }, 300);
  return () => {
    clearInterval(clock);
    stopPictures();
    live.close();
    ruler.close();
    stage.close();
  };
}

/** Keeps the picture of the newest keyframe in the corner and in its frustum. */
function keepLatest(
  id: { drone: string; scan: string },
  place: HTMLElement,
  cameras: Cameras,
  stage: Stage,
  newest: () => number,
): () => void {
  let shown = -1;
  const timer = setInterval(() => {
    const seq = newest();
    if (seq === shown) return;
    shown = seq;
    const image = new Image();
    image.alt = `keyframe ${seq}`;
    image.onload = () => {
      cameras.show(seq, image);
      stage.touch();
      place.hidden = false;
      place.replaceChildren(image, el("figcaption", { textContent: `latest picture, keyframe ${seq}` }));
      document.body.dataset["picture"] = String(seq);
    };
    image.src = `${api.scanAddress(id)}/keyframes/${seq}.jpg`;
  }, PICTURE_EVERY_MS);
  return () => clearInterval(timer);
}

function rows(cloud: Cloud, stage: Stage, last: LastPose | undefined): HTMLElement[] {
  const facts: [string, string][] = [
    ["Points", count(cloud.total)],
    ["Drawn", count(cloud.drawn)],
    ["Keyframes", String(cloud.keyframes)],
  ];
  if (last) {
    facts.push(["Speed", `${last.speed_m_s.toFixed(1)} m/s`]);
    if (last.agl_m !== null) facts.push(["Height", `${last.agl_m.toFixed(1)} m`]);
    if (last.alt_amsl_m !== null) facts.push(["AMSL", `${last.alt_amsl_m.toFixed(1)} m`]);
    facts.push(["Flown", `${last.distance_m.toFixed(0)} m`]);
    facts.push(["Camera", `${last.roll_deg}° ${last.pitch_deg}° ${last.yaw_deg}°`]);
    facts.push(["Pose σ", `${last.sigma_m.toFixed(2)} m`]);
    facts.push(["From", last.sources.join(", ")]);
    if (last.lat_deg !== null && last.lon_deg !== null)
      facts.push(["At", `${last.lat_deg.toFixed(6)}, ${last.lon_deg.toFixed(6)}`]);
  }
  facts.push(["Pictures", `${stage.painter.frames_per_s.toFixed(stage.painter.frames_per_s < 3 ? 1 : 0)} /s`]);
  return facts.map(([k, v]) => el("div", {}, el("dt", { textContent: k }), el("dd", { textContent: v })));
}
