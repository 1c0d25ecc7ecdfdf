// The keyframes in the scene: of each a surface and its points, so that a correction is a matrix.

import * as THREE from "three";
import type { Part } from "./api";
import { Before } from "./before";
import { type Chunk, EDGE_PX, FIRST, isVoid, sigmaAt, viewsAt } from "./depth";
import { Ground, type Samples } from "./fill";
import type { Gradual } from "./painter";
import { type Colour, COLOURS, SHADE } from "./shade";
import { BEHIND, type Card, LEVELS, Surface } from "./surface";
import { length } from "./units";

/** Between the keyframes' numbers of two scans that are drawn together. */
export const STRIDE = 2 ** 33;

/** Distinct also for the colour-blind (Okabe and Ito 2008). */
const PARTS = ["#e69f00", "#56b4e9", "#009e73", "#f0e442", "#0072b2", "#d55e00", "#cc79a7"];

/** Of the change since an earlier date, as on the maps of `site compare`. */
const CHANGES: [string, string][] = [["higher", "#d03027"], ["lower", "#2b6fd0"], ["as before", "#9a9a9a"], ["not seen before", "#3a3a3a"]];

const SIGMA_STEP_M = 0.02;
const MAX_SIGMA_M = 255 * SIGMA_STEP_M;
const PHOTOGRAPHED = 0.3; // share of the shading
const SHARP_PX = 1.3; // of the screen, between two vertices of a surface
const BUILD_MS = [25, 60] as const; // for finer surfaces, a frame while the view moves, and at rest
const GROUND_SAMPLES = 400_000; // of the heightfield below
const GROUND_MS = 1500; // between two of them
const SAMPLED = 40_000; // values that a range of colours is of: it is found again while the scan grows
const NEWEST = 5; // keyframes that show how far the camera looks
const MAX_TRIANGLES = 12_000_000; // in memory

const VERTEX = /* glsl */ `
  #define SIGMA_M float(${MAX_SIGMA_M})
  attribute vec3 rgb;
  attribute float sigma;
  attribute float views;
  uniform float size;    // of a point, in distances to its neighbour
  uniform float apart;   // of neighbours, in depths of the camera that took them
  uniform float thin;    // as 1, for the points left out of the frame
  uniform float height_px;
  varying vec3 shown;
  #include <clipping_planes_pars_vertex>
  ${SHADE}
  void main() {
    vec4 world = modelMatrix * vec4(position, 1.0);
    vec4 seen = viewMatrix * world;
    gl_Position = projectionMatrix * seen;
    float gap = size * thin * apart * position.z * length(modelMatrix[2].xyz);
    gl_PointSize = clamp(gap * projectionMatrix[1][1] * height_px / max(-seen.z, 0.01), 1.5, 40.0);
    shown = shade(world.xyz, linear(rgb), sigma * SIGMA_M, views * 255.0);
    vec4 mvPosition = seen;
    #include <clipping_planes_vertex>
  }
`;

const FRAGMENT = /* glsl */ `
  varying vec3 shown;
  #include <clipping_planes_pars_fragment>
  void main() {
    #include <clipping_planes_fragment>
    vec2 c = gl_PointCoord - 0.5;
    if (dot(c, c) > 0.25) discard;
    gl_FragColor = vec4(shown, 1.0);
    #include <colorspace_fragment>
  }
`;

/** What is drawn of the keyframes. */
export type Layer = "surface" | "points" | "ground" | "none";

interface Held {
  object: THREE.Points<THREE.BufferGeometry, THREE.ShaderMaterial>;
  surface: Surface;
  shown: boolean;
  unit_m: number;
  points: number;
  layer: number;
  values: Uint8Array; // of the colours of 200 points
  time: number;
  T: number[];
  scale: number;
}

export class Cloud implements Gradual {
  readonly group = new THREE.Group();
  card: Card = { software: true, anisotropy: 1 };
  budget = 3_000_000;
  drawn = 0;
  /** What is added to heights that are shown: the origin's altitude above the sea. */
  datum_m = 0;
  /** The scans of a site, by the numbers of their keyframes; none for a single scan. */
  parts: Part[] = [];
  /** Scans of an earlier date, as multiples of STRIDE: not drawn, but compared with. */
  private readonly earlier = new Set<number>();
  private readonly past = new THREE.Group();
  private readonly before = new Before();
  private isStale = false;
  private isUnscaled = false; // something came or moved since the range of the colours was set
  /** Called when the range of the colours has followed what came or moved. */
  scaled: () => void = () => undefined;
  /** Called when there are parts to colour by. */
  named = (): void => undefined;
  private readonly moves = new Map<number, THREE.Matrix4>();
  private readonly chunks = new Map<number, Held>();
  private last = Infinity;
  private kind: Layer = "surface";
  private camera: THREE.PerspectiveCamera | null = null;
  private unbuilt = false;
  private exposure = 1;
  private readonly counts = new Float64Array(256); // of each value of colours
  private measured = false;
  private groundStale = false;
  private groundAt = -Infinity;
  private isNew = false; // what came last was in no frame yet: that is first
  private scaledAt = -Infinity;
  private mode: Colour = "colour";
  private readonly defines = { MODE: 0 };
  private readonly shared = {
    size: { value: 1.3 },
    thin: { value: 1 },
    height_px: { value: 400 },
    behind: { value: 0 },
    range: { value: new THREE.Vector2(0, 1) },
    ...this.before.uniforms,
    ...Object.fromEntries(["higher", "lower", "same", "unseen"].map((name, k) => [name, { value: new THREE.Color(CHANGES[k]![1]) }])),
  };

  /** What lies below the surfaces; not measured. */
  readonly ground = new Ground(this.shared, this.defines);

  get total(): number {
    let sum = 0;
    for (const held of this.chunks.values()) sum += held.points;
    return sum;
  }

  /** Points of the keyframes that are shown. */
  private get shownPoints(): number {
    let sum = 0;
    for (const held of this.chunks.values()) if (held.shown) sum += held.points;
    return sum;
  }

  /** Keyframes of this scan that are shown, and their points. */
  get own(): { keyframes: number; points: number; newest: number } {
    const out = { keyframes: 0, points: 0, newest: -1 };
    let time = -Infinity;
    for (const [seq, held] of this.chunks) {
      if (seq >= STRIDE || !held.shown) continue;
      out.points += held.points;
      if (held.layer <= FIRST) continue; // its image is still to come
      out.keyframes += 1;
      if (held.time >= time) [time, out.newest] = [held.time, seq];
    }
    return out;
  }

  /** Whether a keyframe of this scan is shown. */
  readonly shows = (seq: number): boolean => this.chunks.get(seq)?.shown ?? true;

  /** Adds a keyframe, in place of the one with the same number; of one that is withdrawn nothing stays. */
  add(chunk: Chunk): void {
    this.remove(chunk.seq);
    this.groundStale = this.isNew = true;
    if (isVoid(chunk)) return;
    const { xyz, rgb, sigma, views, unit_m } = pointsOf(chunk);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(xyz, 3, false));
    geometry.setAttribute("rgb", new THREE.BufferAttribute(rgb, 3, true));
    geometry.setAttribute("sigma", new THREE.BufferAttribute(sigma, 1, true));
    geometry.setAttribute("views", new THREE.BufferAttribute(views, 1, true));
    const own = { age: { value: 0 }, part: { value: this.partOf(chunk.seq) } };
    const material = new THREE.ShaderMaterial({
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      defines: this.defines,
      clipping: true,
      uniforms: { ...this.shared, ...own, apart: { value: 1 / chunk.K[0] } },
    });
    const object = new THREE.Points(geometry, material);
    object.matrixAutoUpdate = false;
    const surface = new Surface(chunk, { ...this.shared, ...own }, this.defines, this.card);
    const held: Held = { object, surface, shown: true, unit_m, points: sigma.length, layer: chunk.layer, values: rgb.slice(0, 600), time: chunk.time_unix_s, T: chunk.T, scale: chunk.scale };
    this.chunks.set(chunk.seq, held);
    this.place(chunk.seq, held);
    this.groupOf(chunk.seq).add(object, surface.mesh);
    this.expose(held, 1);
    this.shared.behind.value = BEHIND * middleDepth([...this.chunks.values()]);
    this.show(chunk.seq, held);
  }

  /** Takes in a keyframe's colours, or out: as bright as the day, by the rule of preview and map. */
  private expose({ values, points }: Held, sign: 1 | -1): void {
    for (const value of values) this.counts[value]! += sign * points;
    const total = this.counts.reduce((sum, count) => sum + count, 0);
    let [top, sum] = [0, this.counts[0]!];
    while (top < 255 && sum < 0.98 * total) sum += this.counts[++top]!;
    this.exposure = total ? Math.min(Math.max(230 / Math.max(top, 1), 1), 2) ** 2.2 : 1;
  }

  /** By which somebody wants it brighter than the day. */
  brightness = 1;

  private get showsFigures(): boolean {
    return this.group.visible && this.mode !== "colour";
  }

  /** What colours are shown with: the exposure, but for those of figures. */
  get gain(): number {
    return this.brightness * (this.showsFigures ? 1 : this.exposure);
  }

  /** Share of the usual shading by relief: photographs of a closed surface have shade of their own. */
  get shading(): number {
    return this.kind === "points" || this.showsFigures ? 1 : PHOTOGRAPHED;
  }

  /** How far the camera looks by now, m: as the newest keyframes do, since it climbs and sinks; 0 without any. */
  get reach(): number {
    const own = [...this.chunks].filter(([seq]) => seq < STRIDE).map(([, held]) => held);
    return middleDepth(own.sort((a, b) => b.time - a.time).slice(0, NEWEST));
  }

  /** Metres by which what is not measured is drawn behind. */
  get behind(): number {
    return this.shared.behind.value;
  }

  /** Shows the keyframes as surfaces or as points, the filled ground alone, or nothing. */
  set layer(kind: Layer) {
    this.kind = kind;
    this.group.visible = kind === "surface" || kind === "points";
    for (const [seq, held] of this.chunks) this.show(seq, held);
    this.showGround();
  }

  /** Shows only what was measured, without the ground below. */
  set measuredOnly(only: boolean) {
    this.measured = only;
    this.showGround();
  }

  get measuredOnly(): boolean {
    return this.measured;
  }

  private showGround(): void {
    this.ground.mesh.visible = (this.kind === "surface" || this.kind === "ground") && !this.measured;
  }

  /** An even sample of the points that are shown. */
  private readonly samples: Samples = (use) => {
    const share = Math.min(1, GROUND_SAMPLES / Math.max(1, this.shownPoints));
    for (const { object, shown, points } of this.chunks.values()) {
      if (!shown) continue;
      const e = object.matrixWorld.elements;
      const xyz = (object.geometry.getAttribute("position") as THREE.BufferAttribute).array;
      const rgb = (object.geometry.getAttribute("rgb") as THREE.BufferAttribute).array;
      for (let i = 0; i < 3 * Math.ceil(share * points); i += 3) {
        const [x, y, z] = [xyz[i]!, xyz[i + 1]!, xyz[i + 2]!];
        use(
          e[0] * x + e[4] * y + e[8] * z + e[12],
          e[1] * x + e[5] * y + e[9] * z + e[13],
          e[2] * x + e[6] * y + e[10] * z + e[14],
          rgb[i]!, rgb[i + 1]!, rgb[i + 2]!,
        );
      }
    }
  };

  get layer(): Layer {
    return this.kind;
  }

  private show(seq: number, held: Held): void {
    held.shown = this.isShown(seq);
    held.object.visible = held.shown && this.kind === "points";
    held.surface.mesh.visible = held.shown && this.kind === "surface";
  }

  private groupOf(seq: number): THREE.Group {
    const isPast = this.earlier.has(Math.floor(seq / STRIDE));
    this.isStale ||= isPast;
    return isPast ? this.past : this.group;
  }

  /** Takes what has come into the ground, and into the earlier date when that is shown; true when it is news. */
  refresh(): boolean {
    const grew = this.groundStale && !this.isNew && this.ground.mesh.visible && performance.now() - this.groundAt > GROUND_MS;
    if (grew) {
      this.groundStale = false;
      this.ground.build(this.samples);
      this.groundAt = performance.now();
    }
    const isRescaled = this.isUnscaled && this.showsFigures && performance.now() - this.scaledAt > GROUND_MS;
    if (isRescaled) {
      this.colour(this.mode);
      this.scaled();
    }
    return this.compare() || grew || isRescaled;
  }

  private compare(): boolean {
    if (!this.isStale || this.mode !== "change") return false;
    this.isStale = false;
    this.before.build(this.past);
    return true;
  }

  /** When the keyframes of this scan were taken, unix seconds, in order. */
  moments(): number[] {
    const own = [...this.chunks].filter(([seq]) => seq < STRIDE);
    return own.map(([, held]) => held.time).sort((a, b) => a - b);
  }

  /** False while the time slider leaves keyframes out. */
  get isWhole(): boolean {
    return this.last === Infinity;
  }

  /** Called when the time slider leaves keyframes out. */
  leftEnd: () => void = () => undefined;

  /** Shows the keyframes up to a time only, unix seconds. */
  until(time: number): void {
    if (time === this.last) return;
    this.last = time;
    if (!this.isWhole) this.leftEnd();
    this.groundStale = true;
    for (const [own, held] of this.chunks) this.show(own, held);
  }

  private isShown(seq: number): boolean {
    const time = this.chunks.get(seq)?.time ?? 0;
    return seq < STRIDE ? time <= this.last : !this.earlier.has(Math.floor(seq / STRIDE));
  }

  /** Moves all chunks of a scan, numbered from k * STRIDE on, as a whole. */
  move(k: number, T: number[]): void {
    this.moves.set(k, new THREE.Matrix4().fromArray(T));
    for (const [seq, held] of this.chunks) if (Math.floor(seq / STRIDE) === k) this.place(seq, held);
  }

  /** Names the scans that are together here; `earlier` are those of an earlier date. */
  name(names: string[], earlier: number[]): void {
    if (names.length === this.parts.length) return;
    this.parts = names.map((name, k) => ({ name, keyframes: [k * STRIDE, (k + 1) * STRIDE - 1] }));
    for (const k of earlier) this.earlier.add(k);
    for (const [seq, held] of this.chunks) {
      held.object.material.uniforms["part"]!.value = this.partOf(seq); // the surface has the same
      this.groupOf(seq).add(held.object, held.surface.mesh);
      this.show(seq, held);
    }
    this.named();
  }

  /** Moves a chunk to its corrected pose; its points stay as they are. */
  repose(seq: number, T: number[], scale: number): void {
    const held = this.chunks.get(seq);
    if (held) this.place(seq, Object.assign(held, { T, scale }));
  }

  colour(mode: Colour): void {
    this.isUnscaled = false;
    this.scaledAt = performance.now();
    if (mode !== this.mode) this.compile(mode);
    if (mode === "height") this.heightScale();
    if (mode === "sigma") this.sigmaScale();
    if (mode === "age") this.ages();
  }

  private compile(mode: Colour): void {
    this.mode = mode;
    this.defines.MODE = COLOURS.indexOf(mode);
    this.ground.mesh.material.needsUpdate = true;
    for (const { object, surface } of this.chunks.values()) object.material.needsUpdate = surface.mesh.material.needsUpdate = true;
  }

  /** True for a colour that has something to show. */
  offers(mode: Colour): boolean {
    return (mode !== "scan" || this.parts.length > 0) && (mode !== "change" || this.earlier.size > 0);
  }

  /** The name and colour of each part or kind of change; none for other colours. */
  keys(): [string, string][] {
    if (this.mode === "change") return CHANGES;
    return this.mode !== "scan" ? [] : this.parts.map(({ name }, k) => [name, PARTS[k % PARTS.length]!]);
  }

  private partOf(seq: number): THREE.Color {
    const k = this.parts.findIndex(({ keyframes: [first, last] }) => first <= seq && seq <= last);
    return new THREE.Color(k < 0 ? "#ffffff" : PARTS[k % PARTS.length]);
  }

  /** The words at both ends of the colour scale; null where there is none. */
  scale(): [string, string] | null {
    const { x, y } = this.shared.range.value;
    const words: Record<Colour, [string, string] | null> = {
      colour: null,
      height: [x, y].map((z) => length(z + this.datum_m, 1)) as [string, string],
      sigma: ["±" + length(0), `±${length(y)} and more`],
      views: ["1 view", "8 views"],
      age: ["first", "last"],
      scan: null,
      change: null,
    };
    return words[this.mode];
  }

  /** Diameter of a point in distances to its neighbour; 1 closes the surface just so. */
  pointSize(distances: number): void {
    this.shared.size.value = distances;
  }

  /** The camera, and half the height of what it draws into, pixels of the screen. */
  screen(camera: THREE.PerspectiveCamera, half_px: number): void {
    this.camera = camera;
    this.isNew = false;
    this.shared.height_px.value = half_px;
  }

  /** Points are drawn slice by slice; surfaces as a whole, each time finer. */
  get isAdditive(): boolean {
    return this.kind === "points";
  }

  /** Some surfaces that the last range asked for are still to be made. */
  get isUnbuilt(): boolean {
    return this.kind === "surface" && this.unbuilt;
  }

  /** Points to draw: all, or the budget; triangles of the sharpest image; none while they are hidden. */
  get wanted(): number {
    if (!this.group.visible) return 0;
    if (this.kind === "surface") return cost(this.seen(), 0);
    return Math.min(this.shownPoints, this.budget);
  }

  /**
   * Draws the points between two shares of what is wanted. Each keyframe's points are shuffled, so
   * any part of them is an even sample; drawn alone, a part has larger points. Of surfaces, the
   * finest levels within the share.
   */
  range(from: number, to: number, whole: boolean): void {
    if (this.kind === "surface") return this.fit(to, BUILD_MS[whole ? 1 : 0]);
    const share = Math.min(1, this.budget / Math.max(1, this.shownPoints));
    this.shared.thin.value = 1 / Math.sqrt(Math.max(1e-6, share * (whole ? 1 : to)));
    this.drawn = 0;
    for (const { object, points } of this.chunks.values()) {
      const [start, end] = [Math.ceil(points * share * from), Math.ceil(points * share * to)];
      object.geometry.setDrawRange(start, end - start);
      if (this.group.visible && object.visible) this.drawn += end - start;
    }
  }

  /** The surfaces in sight, and the level at which each is sharp. */
  private seen(): [Surface, number][] {
    const camera = this.camera;
    if (!camera) return [];
    camera.updateMatrixWorld();
    const frustum = new THREE.Frustum().setFromProjectionMatrix(new THREE.Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse));
    const focal_px = camera.projectionMatrix.elements[5]! * this.shared.height_px.value;
    const eye = new THREE.Vector3().setFromMatrixPosition(camera.matrixWorld);
    const found: [Surface, number][] = [];
    for (const { surface } of this.chunks.values()) {
      if (!surface.mesh.visible || !surface.triangles || !surface.isSeen(frustum)) continue;
      const level = Math.floor(Math.log2(SHARP_PX / surface.magnified(eye, focal_px)));
      found.push([surface, Math.min(Math.max(level, 0), LEVELS - 1)]);
    }
    return found;
  }

  private fit(share: number, build_ms: number): void {
    const seen = this.seen();
    const room = share * cost(seen, 0);
    let coarser = 0;
    while (coarser < LEVELS - 1 && cost(seen, coarser) > 1.01 * room) coarser++;
    const until = performance.now() + build_ms;
    this.unbuilt = false;
    this.drawn = 0;
    for (const [surface, level] of seen) {
      const is = surface.show(Math.min(level + coarser, LEVELS - 1), performance.now() < until);
      this.unbuilt ||= !is;
      this.drawn += surface.drawn;
    }
    let kept = 0;
    for (const { surface } of this.chunks.values()) kept += surface.kept;
    for (const { surface } of this.chunks.values()) if (kept > MAX_TRIANGLES) kept -= surface.shrink();
  }

  /** Heights of the middle 96 % of a sample of the points, for the colour scale. */
  private heightScale(): void {
    const p = new THREE.Vector3();
    const height = this.sample("position", (xyz, i, { matrixWorld }) => p.fromBufferAttribute(xyz, i).applyMatrix4(matrixWorld).z);
    this.shared.range.value.set(height(0.02), height(0.98));
  }

  /** The sigma that 2 % of a sample of the points exceed, for the colour scale. */
  private sigmaScale(): void {
    this.shared.range.value.set(0, MAX_SIGMA_M * this.sample("sigma", (sigma, i) => sigma.getX(i))(0.98));
  }

  /** Quantiles of a figure of some points of each chunk, at most 200. */
  private sample(
    name: string,
    figure: (values: THREE.BufferAttribute | THREE.InterleavedBufferAttribute, i: number, object: THREE.Object3D) => number,
  ): (share: number) => number {
    const found: number[] = [];
    const each = Math.min(200, Math.ceil(SAMPLED / this.chunks.size));
    for (const { object } of this.chunks.values()) {
      const values = object.geometry.getAttribute(name);
      for (let i = 0; i < Math.min(values.count, each); i++) found.push(figure(values, i, object));
    }
    found.sort((a, b) => a - b);
    return (share) => found[Math.floor(share * (found.length - 1))] ?? 0;
  }

  private ages(): void {
    const times = [...this.chunks.values()].map((held) => held.time);
    const first = Math.min(...times);
    const span = Math.max(Math.max(...times) - first, 1e-3);
    for (const held of this.chunks.values()) {
      held.object.material.uniforms["age"]!.value = (held.time - first) / span;
    }
  }

  private place(seq: number, held: Held): void {
    const unit = held.unit_m * held.scale;
    const move = this.moves.get(Math.floor(seq / STRIDE));
    this.isStale ||= this.earlier.has(Math.floor(seq / STRIDE));
    this.groundStale = this.isUnscaled = true;
    for (const [object, size] of [[held.object, unit], [held.surface.mesh, held.scale]] as [THREE.Object3D, number][]) {
      object.matrix.fromArray(held.T).scale(new THREE.Vector3(size, size, size));
      if (move) object.matrix.premultiply(move);
      object.updateMatrixWorld(true);
    }
  }

  private remove(seq: number): void {
    const held = this.chunks.get(seq);
    if (!held) return;
    held.object.removeFromParent();
    held.object.geometry.dispose();
    held.object.material.dispose();
    held.surface.close();
    this.chunks.delete(seq);
    this.expose(held, -1);
  }
}

/** The median of the depths of surfaces, m; 0 without any. */
function middleDepth(held: Held[]): number {
  const depths = held.filter(({ surface }) => surface.triangles).map(({ surface, scale }) => surface.depth * scale).sort((a, b) => a - b);
  return depths[depths.length >> 1] ?? 0;
}

/** Triangles of surfaces that are drawn this many levels coarser than sharp. */
function cost(seen: [Surface, number][], coarser: number): number {
  return seen.reduce((sum, [surface, level]) => sum + surface.triangles / 4 ** Math.min(level + coarser, LEVELS - 1), 0);
}

/** The points of a keyframe in its camera's frame, in `unit_m`; shuffled, so that any part is an even sample. */
function pointsOf(chunk: Chunk): { xyz: Int16Array; rgb: Uint8Array; sigma: Uint8Array; views: Uint8Array; unit_m: number } {
  const { codes, w, K, low, step, box, colour } = chunk;
  const at = new Uint32Array(codes.length);
  let n = 0;
  for (let i = 0; i < codes.length; i++) if (codes[i]) at[n++] = i;
  let seed = chunk.seq + 1;
  for (let i = n - 1; i > 0; i--) {
    seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0;
    const j = Math.floor((seed / 2 ** 32) * (i + 1));
    const one = at[i]!;
    at[i] = at[j]!;
    at[j] = one;
  }
  const place = new Float32Array(3 * n);
  const [rgb, sigma, views] = [new Uint8Array(3 * n), new Uint8Array(n), new Uint8Array(n)];
  let far = 1e-3;
  for (let k = 0; k < n; k++) {
    const [u, v] = [at[k]! % w, (at[k]! / w) | 0];
    const z = 1 / (low + step * (codes[at[k]!]! - 1));
    place[3 * k] = ((box[0] + u - K[2]) / K[0]) * z;
    place[3 * k + 1] = ((box[1] + v - K[3]) / K[1]) * z;
    place[3 * k + 2] = z;
    for (let c = 0; c < 3; c++) {
      far = Math.max(far, Math.abs(place[3 * k + c]!));
      if (colour) rgb[3 * k + c] = colour.data[4 * ((v + EDGE_PX) * colour.width + u + EDGE_PX) + c]!;
    }
    sigma[k] = Math.min(Math.round(sigmaAt(chunk, u, v) / SIGMA_STEP_M), 255);
    views[k] = viewsAt(chunk, u, v);
  }
  const unit_m = far / 32767;
  return { xyz: Int16Array.from(place, (value) => Math.round(value / unit_m)), rgb, sigma, views, unit_m };
}
