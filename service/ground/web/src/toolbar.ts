// The view's controls: colour, navigation, measuring, what is shown, and settings.

import * as THREE from "three";
import * as api from "./api";
import type { Cameras } from "./cameras";
import { el, notify } from "./dom";
import { clipBox, linkButton } from "./explore";
import { coverageKeys, key } from "./keys";
import { filmBox } from "./film";
import type { Ruler } from "./measure";
import type { Notes } from "./notes";
import type { Cloud, Layer } from "./points";
import { type Colour, COLOURS } from "./shade";
import type { Stage } from "./stage";
import * as units from "./units";

const COVERAGE_EVERY_MS = 5000;
const [MAX_PHONE_BYTES, MAX_UNASKED_BYTES] = [12e6, 80e6];

export interface Parts {
  stage: Stage;
  cloud: Cloud;
  cameras: Cameras;
  ruler: Ruler;
  notes: Notes;
  legend: HTMLElement;
  coverage: HTMLElement;
  time: { toEnd: () => void };
  finished: () => boolean;
  id: { drone: string; scan: string };
  /** The scan as last heard of. */
  known: () => api.Scan;
  learn: (scan: api.Scan) => void;
}

/** Everything right of the title; `refresh` takes in what is known of the scan. */
export function toolbar(parts: Parts): { element: HTMLElement; refresh: () => void } {
  const { stage } = parts;
  const bar = el("span", { className: "tools" });
  const follow = el("button", {
    textContent: "Follow",
    title: "follow the aircraft",
    onclick: () => ((stage.follow = !stage.follow), stage.touch()),
  });
  stage.before.push(() => {
    pressed(follow, stage.follow);
    follow.hidden = parts.finished();
  });
  const colour = colours(parts);
  const whole = el("button", {
    textContent: "Whole site",
    title: "show all of it; W A S D R F fly",
    onclick: () => ((stage.follow = false), stage.frame()),
  });
  const layers = showGroup(parts, colour);
  bar.append(
    group(colour),
    group(whole, follow, linkButton(parts)),
    group(...measure(parts), cameraButton(parts.cameras), coverageButton(parts)),
    ...layers.elements,
    clipBox(parts),
    filmBox(parts),
    settings(parts),
  );
  void stage.vr().then((button) => button && bar.append(button));
  return { element: bar, refresh: layers.refresh };
}

const group = (...children: HTMLElement[]): HTMLElement => el("span", { className: "group" }, ...children);

const word = (colour: Colour): string => (colour === "sigma" ? "accuracy" : colour);

function colours({ cloud, legend }: Parts): HTMLSelectElement {
  const select = el(
    "select",
    {},
    ...COLOURS.filter((c) => cloud.offers(c)).map((c) => el("option", { value: c, textContent: word(c) })),
  );
  cloud.named = () => {
    const known = [...select.options].map((o) => o.value);
    for (const c of COLOURS.filter((one) => cloud.offers(one) && !known.includes(one))) select.append(el("option", { value: c, textContent: word(c) }));
    if (select.value === "scan") select.dispatchEvent(new Event("change"));
  };
  select.setAttribute("aria-label", "colour by");
  select.onchange = () => {
    cloud.colour(select.value as Colour);
    cloud.scaled();
  };
  cloud.scaled = () => {
    const words = cloud.scale();
    const keys = cloud.keys();
    legend.hidden = words === null && !keys.length;
    if (keys.length) legend.replaceChildren(el("p", { className: "keys" }, ...keys.map(([name, colour]) => key(name, colour))));
    if (words)
      legend.replaceChildren(
        el("span", { textContent: words[0] }),
        el("i", {}),
        el("span", { textContent: words[1] }),
      );
  };
  return select;
}

/** The ruler and the notes: both take clicks, so one at a time. */
function measure({ ruler, notes }: Parts): HTMLElement[] {
  const length = el("button", {
    textContent: "Measure",
    title: "click points: distance, height, slope, area, volume, profile",
    onclick: () => ((notes.active && notes.toggle()), ruler.toggle()),
  });
  const words = el("button", {
    textContent: "Notes",
    title: "places with a text, kept with the scan",
    hidden: !notes.isPossible,
    onclick: () => ((ruler.active && ruler.toggle()), notes.toggle()),
  });
  ruler.changed = () => pressed(length, ruler.active);
  notes.changed = () => pressed(words, notes.active);
  return [length, words];
}

/** Marks a button that stays down, also for those who do not see it. */
function pressed(button: HTMLElement, on: boolean): void {
  button.classList.toggle("on", on);
  button.setAttribute("aria-pressed", String(on));
}

function cameraButton(cameras: Cameras): HTMLElement {
  const button = el("button", { textContent: "Cameras", title: "where images were taken; click one to see it" });
  button.onclick = () => {
    cameras.toggle();
    pressed(button, cameras.shown);
  };
  return button;
}

/** The coverage layer next to the scene: gaps and weak places, new every few seconds. */
function coverageButton({ coverage, id }: Parts): HTMLElement {
  const button = el("button", { textContent: "Coverage", title: "gaps and weak places so far" });
  const image = el("img", { alt: "coverage: gaps red, weak yellow, good green" });
  const none = el("p", { textContent: "No surface yet." });
  const keys = coverageKeys();
  image.onerror = () => coverage.replaceChildren(none);
  image.onload = () => coverage.replaceChildren(image, keys);
  const refresh = async (): Promise<void> => {
    if (coverage.hidden) return;
    image.src = `${api.scanAddress(id)}/coverage.png?t=${Date.now()}`;
    await image.decode();
  };
  api.whileShown(coverage, COVERAGE_EVERY_MS, refresh);
  button.onclick = () => {
    coverage.hidden = !coverage.hidden;
    pressed(button, !coverage.hidden);
    void refresh().catch(() => undefined); // which the panel says
  };
  return button;
}

/** A layer of a file that is made from the scan. */
interface Product {
  name: string;
  kind: string;
  title: string;
  /** What of the keyframes lies below it. */
  below: "ground" | "none";
  has: (scan: api.Scan) => boolean;
  /** Shows it; gives what removes it. */
  open: () => Promise<() => void>;
}

function productsOf({ stage, id, known }: Parts): Product[] {
  const { origin } = known();
  const mesh: Product = {
    name: "Mesh",
    kind: "glb",
    title: "the closed surface, as it is exported",
    below: "ground", // beyond its edge
    has: (scan) => scan.meshed,
    open: async () => {
      const remove = await stage.load(api.file(id, "mesh.glb"));
      document.body.dataset["mesh"] = "shown";
      return () => {
        remove();
        delete document.body.dataset["mesh"];
      };
    },
  };
  const splats: Product = {
    name: "Splats",
    kind: "splat",
    title: "3D Gaussians, as soft as the images",
    below: "ground", // they are of what was measured alone
    has: (scan) => scan.files.some((f) => f.name === "splat.ply"),
    open: async () => {
      const { showSplats } = await import("./splats");
      return showSplats(stage, api.file(id, "splat.ply"));
    },
  };
  if (!origin) return [mesh, splats]; // tiles lie on the globe
  const tiles: Product = {
    name: "Tiles",
    kind: "3dtiles",
    title: "3D Tiles: detail where one looks",
    below: "none",
    has: (scan) => scan.tiles,
    open: async () => {
      const { showTiles } = await import("./tiles");
      return showTiles(stage, `${api.scanAddress(id)}/tiles/tileset.json`, origin, () => 2);
    },
  };
  return [tiles, mesh, splats];
}

/**
 * Surface, points or a product: one at a time. Figures, time and what was measured alone are of the keyframes: who
 * asks for them from a product gets the surface.
 */
function showGroup(parts: Parts, colour: HTMLSelectElement): { elements: HTMLElement[]; refresh: () => void } {
  const { stage, cloud, known, finished, time } = parts;
  const surface = el("button", { textContent: "Surface", className: "on", title: "the depth images as they are" });
  const points = el("button", { textContent: "Points" });
  const measured = el("button", { textContent: "Measured only", title: "without what is filled in where nothing was seen" });
  const buttons = [surface, points];
  let by = colour.value; // of the keyframes; a product has its own colours
  let isProduct = false;
  let turn = 0; // of what is loading, the last is shown
  const only = (on: boolean): void => {
    cloud.measuredOnly = on;
    pressed(measured, on);
  };
  const show = (chosen: HTMLButtonElement, layer: Layer, remove?: () => void): void => {
    turn++;
    if (!isProduct) by = colour.value;
    isProduct = remove !== undefined;
    stage.shows(remove ?? (() => undefined));
    cloud.layer = layer;
    if (isProduct) {
      only(false);
      time.toEnd();
    }
    const was = colour.value;
    colour.value = isProduct ? "colour" : by;
    if (colour.value !== was) cloud.colour(colour.value as Colour); // also of the ground around a product
    parts.legend.classList.toggle("off", isProduct);
    measured.disabled = layer === "points";
    stage.touch();
    buttons.forEach((b) => pressed(b, b === chosen));
  };
  const toSurface = (): void => show(surface, "surface");
  surface.onclick = toSurface;
  points.onclick = () => show(points, "points");
  colour.addEventListener("change", () => {
    if (!isProduct) return;
    by = colour.value;
    toSurface();
  });
  cloud.leftEnd = () => isProduct && toSurface();
  measured.onclick = () => {
    if (isProduct) toSurface();
    only(!cloud.measuredOnly);
  };
  const rows = productsOf(parts).map((product) => {
    const { name, kind, title, below, has, open } = product;
    const button = el("button", { title, hidden: !has(known()) });
    const load = async (): Promise<void> => {
      const own = ++turn;
      const remove = await open();
      if (own === turn) show(button, below, remove);
      else remove();
    };
    button.onclick = async () => {
      button.disabled = true;
      try {
        parts.learn(await made(product, parts));
        button.textContent = name;
        await load();
      } catch (error) {
        notify(error);
      }
      button.disabled = false;
    };
    if (button.hidden) void api.products(parts.id).then((all) => (button.hidden = !all.some((p) => p.kind === kind)), notify);
    buttons.push(button);
    return { product, button, load };
  });
  /** Names what there is by now. A finished scan is shown as its mesh, until somebody chooses. */
  const refresh = (): void => {
    for (const { product: { name, has }, button } of rows) button.textContent = has(known()) ? name : `Make ${name.toLowerCase()}`;
    const [mesh] = rows.filter(({ product }) => product.kind === "glb");
    const isUntouched = !turn && colour.value === "colour" && cloud.isWhole && !cloud.measuredOnly && !cloud.parts.length;
    if (isUntouched && finished() && mesh!.product.has(known()) && fits(known())) void mesh!.load().catch(notify);
  };
  refresh();
  return { elements: [group(...buttons), group(measured)], refresh };
}

/**
 * Whether a mesh is small enough to be loaded unasked: a phone has little memory, and a link may be dear. The surface
 * has levels of detail, and takes a tenth of the bytes.
 */
function fits({ files }: api.Scan): boolean {
  const bytes = files.find((f) => f.name === "mesh.glb")?.bytes ?? Infinity;
  const { connection } = navigator as { connection?: { saveData: boolean } };
  const isPhone = connection?.saveData || matchMedia("(pointer: coarse), (max-width: 600px)").matches;
  return bytes < (isPhone ? MAX_PHONE_BYTES : MAX_UNASKED_BYTES);
}

/** Makes a product unless it is there; gives the scan that has it. */
async function made({ kind, has }: Product, { id }: Parts): Promise<api.Scan> {
  const scan = await api.scan(id.drone, id.scan);
  if (has(scan)) return scan;
  await api.make(scan, kind);
  return api.finished(scan, kind);
}

function settings({ stage, cloud, ruler }: Parts): HTMLElement {
  const panel = el("div", { className: "settings" });
  const slide = (text: string, min: number, max: number, step: number, value: number, set: (v: number) => void, words: (v: number) => string): void => {
    const shown = el("output", { textContent: words(value) });
    const input = el("input", { type: "range" });
    Object.assign(input, { min: String(min), max: String(max), step: String(step) });
    input.value = String(value);
    input.oninput = () => {
      set(Number(input.value));
      shown.textContent = words(Number(input.value));
    };
    panel.append(el("label", {}, el("span", { textContent: text }), input, shown));
  };
  slide("Point size", 0.3, 1.5, 0.1, 1.3, (v) => cloud.pointSize(v), (v) => `${v.toFixed(1)} x`);
  slide("Shading", 0, 3, 0.1, 1, (v) => (stage.painter.dome.strength = v), (v) => v.toFixed(1));
  slide("Points drawn", 5, 8, 0.1, 6.5, (v) => (cloud.budget = 10 ** v), (v) => `${(10 ** (v - 6)).toFixed(1)} M`);
  slide("Field of view", 20, 100, 1, 60, (v) => stage.fieldOfView(v), (v) => `${v}°`);
  slide("Exposure", -2, 2, 0.1, 0, (v) => (cloud.brightness = 2 ** v), (v) => `${v > 0 ? "+" : ""}${v.toFixed(1)} EV`);
  const tone = el("select", {});
  const tones: [string, THREE.ToneMapping][] = [
    ["none", THREE.NoToneMapping],
    ["Reinhard", THREE.ReinhardToneMapping],
    ["ACES", THREE.ACESFilmicToneMapping],
    ["neutral", THREE.NeutralToneMapping],
  ];
  for (const [name, value] of tones) tone.append(el("option", { textContent: name, value: String(value) }));
  tone.onchange = () => (stage.renderer.toneMapping = Number(tone.value) as THREE.ToneMapping);
  panel.append(el("label", {}, el("span", { textContent: "Tone" }), tone));
  const bloom = el("input", { type: "checkbox" });
  const blur = el("input", { type: "checkbox" });
  bloom.onchange = blur.onchange = () => void looks(stage, bloom, blur).catch(notify);
  const full = el("input", { type: "checkbox" });
  full.onchange = () => (stage.painter.fullDetail = full.checked);
  const feet = el("input", { type: "checkbox", checked: units.imperial() });
  feet.onchange = () => {
    try {
      units.setImperial(feet.checked);
    } catch (error) {
      notify(error);
    }
    ruler.rewrite();
  };
  const light = el("input", { type: "checkbox" });
  light.onchange = () => {
    stage.light(light.checked);
    if (stage.painter.effects) bloom.onchange?.(new Event("change"));
  };
  panel.append(
    el("label", { title: "feet, cubic yards and miles an hour" }, el("span", { textContent: "Imperial" }), feet),
    el("label", {}, el("span", { textContent: "Light scene" }), light),
    el("label", { title: "draw all points also while the view moves" }, el("span", { textContent: "Full detail" }), full),
    el("label", {}, el("span", { textContent: "Bloom" }), bloom),
    el("label", {}, el("span", { textContent: "Depth of field" }), blur),
  );
  const box = el("details", { className: "group" }, el("summary", { textContent: "Settings" }), panel);
  return box;
}

async function looks(stage: Stage, bloom: HTMLInputElement, blur: HTMLInputElement): Promise<void> {
  const { Look } = await import("./look");
  const { painter, renderer, scene, camera, controls } = stage;
  painter.effects?.close();
  const wanted = bloom.checked || blur.checked; // by now
  painter.effects = wanted ? new Look(renderer, painter.dome, scene, camera, controls.target, bloom.checked, blur.checked, stage.isLight) : null;
  document.body.dataset["effects"] = wanted ? "yes" : "no";
  stage.touch();
}
