// The cloud in the scene: one Points object per chunk, so that a correction is a matrix.

import * as THREE from "three";
import type { Part } from "./api";
import { Before, CHANGE } from "./before";
import type { Chunk } from "./live";
import type { Gradual } from "./painter";
import { length } from "./units";

/** Between the keyframes' numbers of two scans that are drawn together. */
export const STRIDE = 2 ** 33;

export const COLOURS = ["colour", "height", "sigma", "views", "age", "scan", "change"] as const;
export type Colour = (typeof COLOURS)[number];

/** Distinct also for the colour-blind (Okabe and Ito 2008). */
const PARTS = ["#e69f00", "#56b4e9", "#009e73", "#f0e442", "#0072b2", "#d55e00", "#cc79a7"];

/** Of the change since an earlier date, as on the maps of `site compare`. */
const CHANGES: [string, string][] = [["higher", "#d03027"], ["lower", "#2b6fd0"], ["as before", "#9a9a9a"], ["not seen before", "#3a3a3a"]];

const MAX_SIGMA_M = 5.1; // of the 255 steps of a chunk
const VERTEX = /* glsl */ `
  #define SIGMA_M float(${MAX_SIGMA_M})
  attribute vec3 rgb;
  attribute float sigma;
  attribute float views;
  uniform float size;    // of a point, in distances to its neighbour
  uniform float apart;   // of neighbours, in depths of the camera that took them
  uniform float thin;    // as 1, for the points left out of the frame
  uniform float height_px;
  uniform float mode;
  uniform vec2 range;
  uniform float age;
  uniform vec3 part;
  uniform vec3 higher, lower, same, unseen;
  varying vec3 shown;
  #include <clipping_planes_pars_vertex>
  ${CHANGE}
  vec3 linear(vec3 s) {
    return mix(s / 12.92, pow((s + 0.055) / 1.055, vec3(2.4)), step(0.04045, s));
  }
  vec3 ramp(float t) {
    t = clamp(t, 0.0, 1.0);
    vec3 low = mix(vec3(0.27, 0.0, 0.33), vec3(0.13, 0.57, 0.55), min(2.0 * t, 1.0));
    return mix(low, vec3(0.99, 0.91, 0.14), max(2.0 * t - 1.0, 0.0));
  }
  void main() {
    vec4 world = modelMatrix * vec4(position, 1.0);
    vec4 seen = viewMatrix * world;
    gl_Position = projectionMatrix * seen;
    float gap = size * thin * apart * position.z * length(modelMatrix[2].xyz);
    gl_PointSize = clamp(gap * projectionMatrix[1][1] * height_px / max(-seen.z, 0.01), 1.5, 40.0);
    vec3 s = rgb;
    if (mode > 0.5) s = ramp((world.z - range.x) / max(range.y - range.x, 0.01));
    if (mode > 1.5) s = ramp(sigma * SIGMA_M / max(range.y, 0.01));
    if (mode > 2.5) s = ramp(views * 255.0 / 8.0);
    if (mode > 3.5) s = ramp(age);
    shown = linear(s);
    if (mode > 4.5) shown = part * (0.3 + 0.7 * dot(rgb, vec3(0.30, 0.59, 0.11)));
    if (mode > 5.5) {
      float d = change(world.xyz, 0.15 + 3.0 * sigma * SIGMA_M);
      vec3 kind = d > 1e8 ? unseen : mix(same, d > 0.0 ? higher : lower, min(abs(d) / 0.3, 1.0));
      shown = kind * (0.4 + 0.6 * dot(rgb, vec3(0.30, 0.59, 0.11)));
    }
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

interface Held {
  object: THREE.Points<THREE.BufferGeometry, THREE.ShaderMaterial>;
  unit_m: number;
  points: number;
  time: number;
  T: number[];
  scale: number;
}

export class Cloud implements Gradual {
  readonly group = new THREE.Group();
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
  /** Called when there are parts to colour by. */
  named = (): void => undefined;
  private readonly moves = new Map<number, THREE.Matrix4>();
  private readonly chunks = new Map<number, Held>();
  private last = Infinity;
  private readonly shared = {
    size: { value: 1.3 },
    thin: { value: 1 },
    height_px: { value: 400 },
    mode: { value: 0 },
    range: { value: new THREE.Vector2(0, 1) },
    ...this.before.uniforms,
    ...Object.fromEntries(["higher", "lower", "same", "unseen"].map((name, k) => [name, { value: new THREE.Color(CHANGES[k]![1]) }])),
  };

  get total(): number {
    let sum = 0;
    for (const held of this.chunks.values()) sum += held.points;
    return sum;
  }

  /** Points of the keyframes that are shown. */
  private get visible(): number {
    let sum = 0;
    for (const held of this.chunks.values()) if (held.object.visible) sum += held.points;
    return sum;
  }

  get keyframes(): number {
    return this.chunks.size;
  }

  /** Adds a chunk, in place of the one with the same number. */
  add(chunk: Chunk): void {
    this.remove(chunk.seq);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(chunk.xyz, 3, false));
    geometry.setAttribute("rgb", new THREE.BufferAttribute(chunk.rgb, 3, true));
    geometry.setAttribute("sigma", new THREE.BufferAttribute(chunk.sigma, 1, true));
    geometry.setAttribute("views", new THREE.BufferAttribute(chunk.views, 1, true));
    const material = new THREE.ShaderMaterial({
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      clipping: true,
      uniforms: { ...this.shared, age: { value: 0 }, apart: { value: chunk.apart }, part: { value: this.partOf(chunk.seq) } },
    });
    const object = new THREE.Points(geometry, material);
    object.matrixAutoUpdate = false;
    const held = { object, unit_m: chunk.unit_m, points: chunk.points, time: chunk.time_unix_s, T: chunk.T, scale: 1 };
    this.chunks.set(chunk.seq, held);
    object.visible = this.isShown(chunk.seq);
    this.place(chunk.seq, held);
    this.groupOf(chunk.seq).add(object);
  }

  private groupOf(seq: number): THREE.Group {
    const isPast = this.earlier.has(Math.floor(seq / STRIDE));
    this.isStale ||= isPast;
    return isPast ? this.past : this.group;
  }

  /** Compares with what has come of the earlier date, when that is shown; true when it is news. */
  refresh(): boolean {
    if (!this.isStale || COLOURS[this.shared.mode.value] !== "change") return false;
    this.isStale = false;
    this.before.build(this.past);
    return true;
  }

  /** The keyframes and when they were taken, in order. */
  moments(): { seq: number; time: number }[] {
    const own = [...this.chunks].filter(([seq]) => seq < STRIDE);
    const all = own.map(([seq, held]) => ({ seq, time: held.time }));
    return all.sort((a, b) => a.seq - b.seq);
  }

  /** Shows the keyframes up to `seq` only. */
  until(seq: number): void {
    this.last = seq;
    for (const [own, { object }] of this.chunks) object.visible = this.isShown(own);
  }

  private isShown(seq: number): boolean {
    return seq < STRIDE ? seq <= this.last : !this.earlier.has(Math.floor(seq / STRIDE));
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
    for (const [seq, { object }] of this.chunks) {
      object.material.uniforms["part"]!.value = this.partOf(seq);
      this.groupOf(seq).add(object);
      object.visible = this.isShown(seq);
    }
    this.named();
  }

  /** Moves a chunk to its corrected pose; its points stay as they are. */
  repose(seq: number, T: number[], scale: number): void {
    const held = this.chunks.get(seq);
    if (held) this.place(seq, Object.assign(held, { T, scale }));
  }

  colour(mode: Colour): void {
    this.shared.mode.value = COLOURS.indexOf(mode);
    if (mode === "height") this.heightScale();
    if (mode === "sigma") this.sigmaScale();
    if (mode === "age") this.ages();
  }

  /** True for a colour that has something to show. */
  offers(mode: Colour): boolean {
    return (mode !== "scan" || this.parts.length > 0) && (mode !== "change" || this.earlier.size > 0);
  }

  /** The name and colour of each part or kind of change; none for other colours. */
  keys(): [string, string][] {
    const mode = COLOURS[this.shared.mode.value];
    if (mode === "change") return CHANGES;
    return mode !== "scan" ? [] : this.parts.map(({ name }, k) => [name, PARTS[k % PARTS.length]!]);
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
      sigma: [length(0), `σ ${length(y)} and more`],
      views: ["1 view", "8 views"],
      age: ["first", "last"],
      scan: null,
      change: null,
    };
    return words[COLOURS[this.shared.mode.value]!];
  }

  /** Diameter of a point in distances to its neighbour; 1 closes the surface just so. */
  pointSize(distances: number): void {
    this.shared.size.value = distances;
  }

  /** Half the height of what is drawn into, pixels of the screen. */
  screen(half_px: number): void {
    this.shared.height_px.value = half_px;
  }

  /** Points to draw: all, or the budget; none while they are hidden. */
  get wanted(): number {
    return this.group.visible ? Math.min(this.visible, this.budget) : 0;
  }

  /**
   * Draws the points between two shares of what is wanted. Each chunk's points are shuffled, so
   * any part of them is an even sample; drawn alone, a part has larger points.
   */
  range(from: number, to: number, whole: boolean): void {
    const share = Math.min(1, this.budget / Math.max(1, this.visible));
    this.shared.thin.value = 1 / Math.sqrt(Math.max(1e-6, share * (whole ? 1 : to)));
    this.drawn = 0;
    for (const { object, points } of this.chunks.values()) {
      const [start, end] = [Math.ceil(points * share * from), Math.ceil(points * share * to)];
      object.geometry.setDrawRange(start, end - start);
      if (this.group.visible && object.visible) this.drawn += end - start;
    }
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

  /** Quantiles of a figure of 200 points of each chunk. */
  private sample(
    name: string,
    figure: (values: THREE.BufferAttribute | THREE.InterleavedBufferAttribute, i: number, object: THREE.Object3D) => number,
  ): (share: number) => number {
    const found: number[] = [];
    for (const { object } of this.chunks.values()) {
      const values = object.geometry.getAttribute(name);
      for (let i = 0; i < Math.min(values.count, 200); i++) found.push(figure(values, i, object));
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
    held.object.matrix.fromArray(held.T).scale(new THREE.Vector3(unit, unit, unit));
    const move = this.moves.get(Math.floor(seq / STRIDE));
    if (move) held.object.matrix.premultiply(move);
    this.isStale ||= this.earlier.has(Math.floor(seq / STRIDE));
    held.object.updateMatrixWorld(true);
  }

  private remove(seq: number): void {
    const held = this.chunks.get(seq);
    if (!held) return;
    held.object.removeFromParent();
    held.object.geometry.dispose();
    held.object.material.dispose();
    this.chunks.delete(seq);
  }
}
