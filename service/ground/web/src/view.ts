// One scan in 3D: live cloud, track, cameras, key figures, image of a keyframe.

import { Matrix4, type Object3D } from "three";
import * as api from "./api";
import { Cameras } from "./cameras";
import { compass } from "./compass";
import { isVoid } from "./depth";
import { count, el, notify, toScans, unbroken } from "./dom";
import { Images, takeView, timeSlider } from "./explore";
import { jobsOf } from "./jobs";
import { LinkState } from "./link";
import { LiveView, type LastPose, type News } from "./live";
import { Ruler, type Scene } from "./measure";
import { nameOf } from "./names";
import { Notes } from "./notes";
import { eachPoint, HOVER_POINTS, onScreen, pickAt } from "./pick";
import { awaited, placing } from "./place";
import { Cloud } from "./points";
import { SiteView } from "./site";
import { canDraw, Stage } from "./stage";
import { toolbar } from "./toolbar";
import * as units from "./units";
import { vehicleStrip } from "./vehicle";

const ASK_EVERY_MS = 2000;
const NADIR_DEG = -75; // steeper, roll and heading say little

/** Shows a scan; gives what closes it. */
export async function showView(root: HTMLElement, drone: string, name: string, place?: string): Promise<() => void> {
  const scan = await api.scan(drone, name);
  const parts = await api.parts(scan).catch((error: unknown) => (notify(error), []));
  return view(root, scan, parts, place);
}

function view(root: HTMLElement, scan: api.Scan, parts: api.Part[], place?: string): () => void {
  const id = { drone: scan.drone, scan: scan.scan };
  const figures = el("dl", { className: "panel figures" });
  const link = new LinkState();
  const title = el("h1", {});
  const report = el("a", { href: api.file(id, "report.html"), textContent: "Report" });
  const map = el("a", { href: api.mapAddress(id), textContent: "Map", hidden: !scan.origin });
  const changes = el("a", { href: api.file(id, "change.html"), textContent: "Changes" });
  const back = el("a", { className: "newer", hidden: true });
  const bar = el("header", {}, toScans(), title, link.element, back, vehicleStrip(), map, report, changes);
  const host = el("main", { className: "stage" });
  const legend = el("div", { className: "panel legend", hidden: true });
  const coverage = el("div", { className: "panel coverage", hidden: true });
  const side = el("aside", { className: "side", tabIndex: 0 }, jobsOf(() => known), legend, coverage, figures);
  side.setAttribute("aria-label", "figures");
  const page = el("div", { className: "view" }, bar, host, side);
  root.replaceChildren(page);
  const cloud = new Cloud();
  cloud.datum_m = scan.origin?.alt_amsl_m ?? 0;
  cloud.parts = parts;
  let known = scan;
  const learn = (now: api.Scan): void => {
    known = now;
    link.finished ||= now.finished;
    title.textContent = title.title = nameOf(now);
    for (const page of [report, changes]) page.hidden = !now.files.some((f) => page.href.endsWith(`/${f.name}`));
  };
  learn(scan);
  if (!canDraw()) {
    figures.hidden = true;
    host.append(
      el("p", { className: "blank", textContent: "This browser cannot draw in 3D (no WebGL 2). The list and the downloads work." }),
    );
    return () => undefined;
  }
  const stage = new Stage(host);
  cloud.card = stage.card;
  const cameras = new Cameras();
  const canvas = stage.renderer.domElement;
  const target = (): Object3D => (stage.model.children.length ? stage.model : cloud.group);
  const scene: Scene = {
    canvas,
    pick: (x, y, quick) => pickAt(canvas, stage.camera, target(), x, y, quick ? HOVER_POINTS : undefined),
    seen: (place) => onScreen(canvas, stage.camera, place),
    points: (use) => eachPoint(cloud.group, use),
    origin: scan.origin,
    scaleSigma: () => known.quality?.scale_sigma,
  };
  cameras.shows = cloud.shows;
  const ruler = new Ruler(scene, id, nameOf(scan));
  ruler.offer = placing(scan, () => ruler.rewrite());
  const notes = new Notes(scene, id, (point) => stage.lookAt(point));
  const empty = el("p", { className: "blank", textContent: scan.finished ? "This scan has no points." : "No points yet." });
  host.append(empty, notes.overlay, ruler.overlay, ruler.cursor);
  side.prepend(ruler.panel, notes.panel);
  const site = { stage, cloud, cameras, id };
  const others = new SiteView(stage, cloud, cameras);
  const images = new Images(site, () => !ruler.active && !notes.active);
  const time = timeSlider(site, () => images.refresh());
  side.append(images.element);
  host.append(time.element);
  stage.before.push(ruler.draw, notes.draw, () => {
    cloud.screen(stage.camera, stage.renderer.domElement.height / 2);
    const { gain, shading, behind } = cloud;
    Object.assign(stage.painter.dome, { gain, shading, behind });
    document.body.dataset["gain"] = String(gain);
  });
  stage.drawGradually(cloud);
  stage.add(cameras.group);
  stage.before.push(() => cameras.seenFrom(stage.camera.position));
  stage.addAgain(cloud.group);
  stage.add(cloud.ground.mesh);
  host.append(compass(stage));
  const tools = toolbar({ ...site, ruler, notes, legend, coverage, time, finished: () => link.finished, known: () => known, learn });
  bar.append(menuOf(bar, tools.element), tools.element);
  if (awaited(scan)) ruler.toggle();

  let last: LastPose | undefined;
  let framed = takeView(stage, place);
  const goTo = (): void => {
    if (takeView(stage, location.hash.split("/")[4])) stage.touch();
  };
  addEventListener("hashchange", goTo);
  const reach = (): number => Math.max(cloud.reach || (last?.agl_m ?? 40), 5);
  const news = (item: News): void => {
    if (item.type === "link") return link.news(item);
    stage.touch();
    if (item.type === "site") others.news(item);
    if (item.type === "repose") {
      cloud.repose(item.seq, item.T, item.scale);
      cameras.put(item.seq, item.T);
    }
    if (item.type === "track") {
      stage.setTrack(item.track);
      last = item.last;
      if (last) {
        cameras.aircraft(last.T, reach());
        stage.goAlong(others.own.clone().multiply(new Matrix4().fromArray(last.T)).toArray(), reach());
      }
    }
    if (item.type === "state") {
      link.finished = item.finished;
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
      cameras.put(chunk.seq, isVoid(chunk) ? null : chunk.T);
      images.arrived(chunk.seq);
      link.grew();
      time.refresh();
      empty.hidden = true;
      document.body.dataset["chunk"] = `${chunk.seq} ${Date.now()}`;
      if (cloud.own.keyframes <= 1 && !framed) stage.frame();
    },
    news,
    (text) => (link.cut = text),
  );
  const asked = api.every(ASK_EVERY_MS, async () => {
    if (link.finished && (report.hidden || !known.meshed)) learn(await api.scan(id.drone, id.scan));
    tools.refresh();
    const scan = link.isSilent && (await newer(known));
    if (scan) linkTo(back, scan);
    else back.hidden = true;
  });
  const clock = setInterval(() => {
    link.draw();
    figures.classList.toggle("old", link.isSilent);
    if (cameras.refresh()) stage.touch();
    if (cloud.refresh()) stage.touch();
    const now = rows(cloud, known, link.finished, last, others.words);
    const text = (nodes: Iterable<Element>): string => [...nodes].map((node) => node.textContent).join();
    if (text(now) !== text(figures.children)) figures.replaceChildren(...now); // or the page is laid out again
    document.body.dataset["points"] = String(cloud.total);
    document.body.dataset["drawn"] = String(cloud.drawn);
    document.body.dataset["fps"] = stage.painter.frames_per_s.toFixed(1);
  }, 300);
  return () => {
    removeEventListener("hashchange", goTo);
    clearInterval(clock);
    asked();
    images.close();
    live.close();
    others.close();
    ruler.close();
    notes.close();
    stage.close();
  };
}

/** The button that shows the tools where there is no room for them: on a phone the surface comes first. */
function menuOf(bar: HTMLElement, tools: HTMLElement): HTMLElement {
  const button = el("button", { className: "menu", textContent: "Menu" });
  const show = (on: boolean): void => {
    bar.classList.toggle("open", on);
    button.setAttribute("aria-expanded", String(on));
  };
  button.onclick = () => show(!bar.classList.contains("open"));
  tools.addEventListener("click", (event) => (event.target as HTMLElement).matches("button") && show(false));
  show(false);
  return button;
}

/** The scan that the drone of a silent one makes by now. */
async function newer({ drone, started_unix_s }: api.Scan): Promise<api.Scan | undefined> {
  const growing = (await api.scans()).filter((s) => s.drone === drone && s.growing);
  return growing.find((s) => (s.started_unix_s ?? 0) > (started_unix_s ?? 0));
}

function linkTo(link: HTMLAnchorElement, scan: api.Scan): void {
  link.href = api.viewAddress(scan);
  link.textContent = `back as scan ${nameOf(scan)}: open`;
  link.hidden = false;
}

/** The figures; of a finished scan none of the moment. */
function rows(cloud: Cloud, { counts, quality }: api.Scan, finished: boolean, last: LastPose | undefined, site: string): HTMLElement[] {
  const kept = counts?.points; // of those drawn, after what other images see through is removed: known for all together
  const facts: [string, string][] = [["Images", String(cloud.own.keyframes)]];
  if (kept === undefined || cloud.isWhole) facts.unshift(["Points", count(kept ?? cloud.own.points)]);
  if (finished && quality?.sigma_median_m) facts.push(["Relative", units.accuracy(quality.sigma_median_m)]);
  const [across, up] = finished ? [quality?.position_sigma_h_median_m, api.heightSigma(quality)] : (last?.sigma_h_v_m ?? []);
  if (across && up) facts.push(["Absolute", units.sigmas(across, up)]);
  if (finished && quality?.scale_sigma) facts.push(["Scale", `±${units.share(quality.scale_sigma)}`]);
  if (last && cloud.isWhole) facts.push(["Flown", units.length(last.distance_m, 0)]);
  if (last && !finished) {
    facts.push(["Speed", units.speed(last.speed_m_s)]);
    if (last.agl_m !== null) facts.push(["Height", units.length(last.agl_m, 1)]);
    if (last.alt_amsl_m !== null) facts.push(["AMSL", units.length(last.alt_amsl_m, 1)]);
    facts.push(["Camera", last.pitch_deg < NADIR_DEG ? "looks down" : `${last.pitch_deg}°, heading ${Math.round((last.yaw_deg + 360) % 360)}°`]);
    facts.push(["By", last.sources.join(", ")]);
    if (last.lat_deg !== null && last.lon_deg !== null)
      facts.push(["At", `${last.lat_deg.toFixed(6)}, ${last.lon_deg.toFixed(6)}`]);
  }
  if (site) facts.push(["Site", site]);
  return facts.map(([k, v]) => el("div", {}, el("dt", { textContent: k }), el("dd", {}, ...unbroken(v))));
}
