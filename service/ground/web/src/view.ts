// One scan in 3D: live cloud, track, key figures, measuring, mesh.

import * as THREE from "three";
import * as api from "./api";
import { count, el, tell } from "./dom";
import { LiveView, type LastPose, type News } from "./live";
import { Ruler } from "./measure";
import { Cloud, COLOURS, type Colour } from "./points";
import { canDraw, Stage } from "./stage";
import { vehicleStrip } from "./vehicle";

/** Shows a scan; returns what closes it. */
export function showView(root: HTMLElement, drone: string, name: string): () => void {
  const figures = el("div", { className: "figures" });
  const state = el("span", { className: "state" });
  const bar = el("nav", {}, el("a", { href: "#/", textContent: "‹ scans" }), el("b", { textContent: name }), state, vehicleStrip());
  const host = el("div", { className: "stage" });
  root.replaceChildren(el("div", { className: "view" }, bar, host, figures));
  const id = { drone, scan: name };
  void api.scan(drone, name).then((s) => {
    bar.querySelector("b")!.textContent = s.title;
    if (s.files.some((f) => f.name === "report.html"))
      bar.append(el("a", { href: api.file(s, "report.html"), textContent: "report" }));
  }, tell);
  if (!canDraw()) {
    host.append(
      el("p", { className: "blank", textContent: "This browser cannot draw in 3D (no WebGL 2). The list and the downloads work." }),
    );
    return () => undefined;
  }
  const stage = new Stage(host);
  const cloud = new Cloud();
  const ruler = new Ruler();
  stage.add(cloud.group);
  stage.add(ruler.group);
  tools(bar, stage, cloud, ruler, id);

  let last: LastPose | undefined;
  let link = "";
  let framed = false;
  const reach = (): number => Math.max(last?.agl_m ?? 40, 5);
  const news = (item: News): void => {
    if (item.type === "repose") cloud.repose(item.seq, item.T, item.scale);
    if (item.type === "track") {
      stage.setTrack(item.track);
      last = item.last;
      if (last) stage.setCamera(last.T, reach());
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
      if (cloud.keyframes === 1) stage.frame();
    },
    news,
    (text) => (link = text),
  );
  const clock = setInterval(() => {
    state.textContent = link;
    figures.replaceChildren(...rows(cloud, stage, last, ruler));
    document.body.dataset["points"] = String(cloud.total);
    document.body.dataset["fps"] = stage.frames_per_s.toFixed(1);
  }, 300);
  return () => {
    clearInterval(clock);
    live.close();
    stage.close();
  };
}

function rows(cloud: Cloud, stage: Stage, last: LastPose | undefined, ruler: Ruler): HTMLElement[] {
  const facts: [string, string][] = [
    ["points", count(cloud.total)],
    ["keyframes", String(cloud.keyframes)],
  ];
  if (last) {
    facts.push(["speed", `${last.speed_m_s.toFixed(1)} m/s`]);
    if (last.agl_m !== null) facts.push(["height", `${last.agl_m.toFixed(1)} m`]);
    if (last.alt_amsl_m !== null) facts.push(["AMSL", `${last.alt_amsl_m.toFixed(1)} m`]);
    facts.push(["flown", `${last.distance_m.toFixed(0)} m`]);
    facts.push(["camera", `${last.roll_deg}° ${last.pitch_deg}° ${last.yaw_deg}°`]);
    facts.push(["pose σ", `${last.sigma_m.toFixed(2)} m`]);
    facts.push(["from", last.sources.join(", ")]);
    if (last.lat_deg !== null && last.lon_deg !== null)
      facts.push(["at", `${last.lat_deg.toFixed(6)}, ${last.lon_deg.toFixed(6)}`]);
  }
  facts.push(["picture", `${stage.frames_per_s.toFixed(0)} /s`]);
  if (ruler.active) facts.push(["ruler", ruler.text()]);
  return facts.map(([k, v]) => el("div", {}, el("dt", { textContent: k }), el("dd", { textContent: v })));
}

function tools(bar: HTMLElement, stage: Stage, cloud: Cloud, ruler: Ruler, id: { drone: string; scan: string }): void {
  const colour = el("select", {}, ...COLOURS.map((c) => el("option", { value: c, textContent: c })));
  colour.setAttribute("aria-label", "colour by");
  colour.onchange = () => cloud.colour(colour.value as Colour);
  const size = el("input", { type: "range", min: "50", max: "1500", value: "300", title: "point size" });
  size.oninput = () => cloud.pointSize(Number(size.value));
  const budget = el("input", { type: "range", min: "5", max: "8", step: "0.1", value: "6.5", title: "points drawn at most" });
  budget.oninput = () => {
    cloud.budget = 10 ** Number(budget.value);
    cloud.thin();
  };
  const follow = el("button", { textContent: "Follow", onclick: () => void (stage.follow = true) });
  const whole = el("button", { textContent: "Whole site", onclick: () => ((stage.follow = false), stage.frame()) });
  const measure = el("button", {
    textContent: "Measure",
    onclick: () => {
      ruler.active = !ruler.active;
      ruler.clear();
      measure.classList.toggle("on", ruler.active);
    },
  });
  stage.renderer.domElement.addEventListener("click", (event) => {
    if (!ruler.active) return;
    const box = stage.renderer.domElement.getBoundingClientRect();
    const x = (2 * (event.clientX - box.left)) / box.width - 1;
    const y = 1 - (2 * (event.clientY - box.top)) / box.height;
    const target = stage.model.children.length ? stage.model : cloud.group;
    ruler.pick(new THREE.Vector2(x, y), stage.camera, target);
  });
  bar.append(colour, size, budget, follow, whole, measure, meshButton(stage, cloud, id));
  void stage.vr().then((button) => button && bar.append(button));
}

/** Shows the mesh in place of the points; makes it first where there is none. */
function meshButton(stage: Stage, cloud: Cloud, id: { drone: string; scan: string }): HTMLElement {
  const button = el("button", { textContent: "Mesh" });
  const show = async (): Promise<void> => {
    if (stage.model.children.length) {
      stage.model.clear();
      cloud.group.visible = true;
      return;
    }
    const scan = await api.scan(id.drone, id.scan);
    if (!scan.files.some((f) => f.name === "mesh.glb")) await madeMesh(scan);
    await stage.load(api.file(id, "mesh.glb"));
    cloud.group.visible = false;
    document.body.dataset["mesh"] = "shown";
  };
  button.onclick = async () => {
    button.disabled = true;
    await show().catch(tell);
    button.disabled = false;
    button.classList.toggle("on", stage.model.children.length > 0);
  };
  return button;
}

async function madeMesh(scan: api.Scan): Promise<void> {
  if (!confirm("There is no mesh yet. Make one now?")) throw new Error("no mesh");
  await api.make(scan, "glb");
  for (;;) {
    const job = ((await api.scan(scan.drone, scan.scan)).jobs ?? []).filter((j) => j.kind === "glb").at(-1);
    if (job?.state === "failed") throw new Error(job.error ?? "failed");
    if (!job || job.state === "done") return;
    await new Promise((resolve) => setTimeout(resolve, 700));
  }
}
