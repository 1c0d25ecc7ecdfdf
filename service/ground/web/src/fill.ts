// The ground below the surfaces: a heightfield of all points, its gaps filled from the lower side of what is around
// them, in the colours of the points. So there is no hole where nothing was seen.

import * as THREE from "three";
import { SHADE, shows } from "./shade";
import { DRAWN_BEHIND } from "./surface";

const CELLS = 256; // along the longer side
const MIN_CELL_M = 0.05;
const CLOSED = 24; // a gap of up to twice as many cells between known ones is filled
const RIM = 5; // cells that fade around
const MARGIN = CLOSED + 2; // cells around all samples: gaps are closed as far from them as anywhere
const STEP_M = 0.5; // a neighbour that stands higher is another surface
const SMOOTHINGS = 60;
const SPIKE = 4; // cells around one that is compared with them
const SPIKE_M = 2;
const FIGURES = 0.4; // of the brightness, where colours show figures: of heights alone it has any
const BELOW = 1; // cells by which it lies below what is measured

const VERTEX = /* glsl */ `
  attribute vec4 tint;
  varying vec4 shown;
  varying vec3 where;
  ${DRAWN_BEHIND}
  #include <clipping_planes_pars_vertex>
  void main() {
    vec4 mvPosition = modelViewMatrix * vec4(position, 1.0);
    where = (modelMatrix * vec4(position, 1.0)).xyz;
    gl_Position = drawn(mvPosition, 1.0);
    vec3 linear = mix(tint.rgb / 12.92, pow((tint.rgb + 0.055) / 1.055, vec3(2.4)), step(0.04045, tint.rgb));
    shown = vec4(linear, tint.a);
    #include <clipping_planes_vertex>
  }
`;
const FRAGMENT = /* glsl */ `
  varying vec4 shown;
  varying vec3 where;
  #include <clipping_planes_pars_fragment>
  ${SHADE}
  void main() {
    #include <clipping_planes_fragment>
    float noise = fract(52.9829189 * fract(dot(gl_FragCoord.xy, vec2(0.06711056, 0.00583715))));
    if (shown.a <= noise) discard;  // fades without the sky behind taking part in exposure
    #if ${shows("colour")}
      vec3 rgb = shown.rgb;
    #elif ${shows("height")}
      vec3 rgb = float(${FIGURES}) * shade(where, shown.rgb, 0.0, 0.0);
    #else
      vec3 rgb = vec3(float(${FIGURES}) * (0.08 + dot(shown.rgb, vec3(0.21, 0.72, 0.07))));
    #endif
    gl_FragColor = vec4(rgb, 0.0); // not measured
    #include <colorspace_fragment>
  }
`;

/** Calls `use` with places, m, and colours, 0 to 255. */
export type Samples = (use: (x: number, y: number, z: number, r: number, g: number, b: number) => void) => void;

/** Heights and colours in cells, row by row from the south. */
export interface Field {
  west: number;
  south: number;
  cell: number;
  cols: number;
  rows: number;
  z: Float32Array;
  rgb: Float32Array; // 3 of each
  alpha: Float32Array; // 0: nothing here
}

/** The filled heightfield of samples; null without any. */
export function filled(samples: Samples): Field | null {
  const box = new THREE.Box2();
  const p = new THREE.Vector2();
  samples((x, y) => box.expandByPoint(p.set(x, y)));
  if (box.isEmpty()) return null;
  const extent = box.getSize(new THREE.Vector2());
  const cell = Math.max(MIN_CELL_M, Math.max(extent.x, extent.y) / CELLS);
  const [west, south] = [box.min.x - MARGIN * cell, box.min.y - MARGIN * cell];
  const [cols, rows] = [extent.x, extent.y].map((m) => Math.ceil(m / cell) + 2 * MARGIN + 1) as [number, number];
  const n = cols * rows;
  const [low, sum, count, rgb] = [new Float32Array(n).fill(Infinity), new Float32Array(n), new Float32Array(n), new Float32Array(3 * n)];
  samples((x, y, z, r, g, b) => {
    const k = Math.floor((y - south) / cell) * cols + Math.floor((x - west) / cell);
    low[k] = Math.min(low[k]!, z);
    sum[k]! += z;
    count[k]! += 1;
    rgb[3 * k]! += r;
    rgb[3 * k + 1]! += g;
    rgb[3 * k + 2]! += b;
  });
  const z = new Float32Array(n);
  const known = new Uint8Array(n);
  for (let k = 0; k < n; k++) {
    if (!count[k]) continue;
    known[k] = 1;
    const mean = sum[k]! / count[k]!;
    z[k] = mean - low[k]! > 2 * STEP_M ? low[k]! : mean;
    for (let c = 0; c < 3; c++) rgb[3 * k + c]! /= count[k]!;
  }
  dropSpikes(z, known, cols, rows);
  const near = distance(known, cols, rows, 1);
  const grown = Uint8Array.from(near, (d) => (d <= CLOSED ? 1 : 0));
  const inside = distance(grown, cols, rows, 0);
  const alpha = Float32Array.from(near, (d, k) => (d === 0 || inside[k]! > CLOSED ? 1 : Math.max(0, 1 - d / RIM)));
  fill(z, rgb, known, cols, rows);
  smooth(z, rgb, known, alpha, cols, rows);
  return { west, south, cell, cols, rows, z, rgb, alpha };
}

/** Cells that stand alone above those around them are no ground. */
function dropSpikes(z: Float32Array, known: Uint8Array, cols: number, rows: number): void {
  const dropped: number[] = [];
  for (let j = 0; j < rows; j++)
    for (let i = 0; i < cols; i++) {
      const k = j * cols + i;
      if (!known[k]) continue;
      let [alike, lower] = [0, 0];
      for (let v = Math.max(0, j - SPIKE); v <= Math.min(rows - 1, j + SPIKE); v++)
        for (let u = Math.max(0, i - SPIKE); u <= Math.min(cols - 1, i + SPIKE); u++) {
          const m = v * cols + u;
          if (!known[m]) continue;
          if (z[m]! < z[k]! - SPIKE_M) lower++;
          else alike++;
        }
      if (lower > 3 * alike) dropped.push(k);
    }
  for (const k of dropped) known[k] = 0;
}

/** Steps (chamfer) from each cell to the nearest one of this value. */
function distance(cells: Uint8Array, cols: number, rows: number, value: number): Float32Array {
  const out = Float32Array.from(cells, (one) => (one === value ? 0 : 1e6));
  const pass = (from: number, to: number, by: number): void => {
    for (let j = from; j !== to; j += by)
      for (let i = by > 0 ? 0 : cols - 1; i >= 0 && i < cols; i += by) {
        const k = j * cols + i;
        let least = out[k]!;
        if (i - by >= 0 && i - by < cols) least = Math.min(least, out[k - by]! + 1);
        if (j - by >= 0 && j - by < rows) {
          least = Math.min(least, out[k - by * cols]! + 1);
          if (i > 0) least = Math.min(least, out[k - by * cols - 1]! + 1.4);
          if (i + 1 < cols) least = Math.min(least, out[k - by * cols + 1]! + 1.4);
        }
        out[k] = least;
      }
  };
  pass(0, rows, 1);
  pass(rows - 1, -1, -1);
  return out;
}

/** Gives unknown cells the lowest height and the mean colour of ever larger blocks around them. */
function fill(z: Float32Array, rgb: Float32Array, known: Uint8Array, cols: number, rows: number): void {
  if (cols <= 1 && rows <= 1) return;
  const [w, h] = [(cols + 1) >> 1, (rows + 1) >> 1];
  const [coarse, colours, has] = [new Float32Array(w * h), new Float32Array(3 * w * h), new Uint8Array(w * h)];
  for (let j = 0; j < h; j++)
    for (let i = 0; i < w; i++) {
      const m = j * w + i;
      let [lowest, count] = [Infinity, 0];
      for (let v = 2 * j; v < Math.min(2 * j + 2, rows); v++)
        for (let u = 2 * i; u < Math.min(2 * i + 2, cols); u++) {
          const k = v * cols + u;
          if (!known[k]) continue;
          lowest = Math.min(lowest, z[k]!);
          for (let c = 0; c < 3; c++) colours[3 * m + c]! += rgb[3 * k + c]!;
          count++;
        }
      if (!count) continue;
      has[m] = 1;
      coarse[m] = lowest;
      for (let c = 0; c < 3; c++) colours[3 * m + c]! /= count;
    }
  fill(coarse, colours, has, w, h);
  for (let k = 0; k < known.length; k++) {
    if (known[k]) continue;
    const m = (Math.floor(k / cols) >> 1) * w + ((k % cols) >> 1);
    z[k] = coarse[m]!;
    for (let c = 0; c < 3; c++) rgb[3 * k + c] = colours[3 * m + c]!;
  }
}

/** Smooths the cells that were filled; neighbours of a higher surface take no part. */
function smooth(z: Float32Array, rgb: Float32Array, known: Uint8Array, alpha: Float32Array, cols: number, rows: number): void {
  const open: number[] = [];
  for (let j = 1; j + 1 < rows; j++)
    for (let i = 1; i + 1 < cols; i++) if (!known[j * cols + i] && alpha[j * cols + i]) open.push(j * cols + i);
  const around = [1, -1, cols, -cols];
  for (let pass = 0; pass < SMOOTHINGS; pass++)
    for (const k of open) {
      let [sum, count] = [0, 0];
      for (const d of around) {
        const other = z[k + d]!;
        if (other > z[k]! + STEP_M) continue;
        sum += other;
        count++;
      }
      if (count) z[k] = sum / count;
      if (pass % 3) continue;
      for (let c = 0; c < 3; c++) {
        let colour = 0;
        for (const d of around) colour += rgb[3 * (k + d) + c]!;
        rgb[3 * k + c] = colour / 4;
      }
    }
}

/** The heightfield as a mesh. */
export class Ground {
  readonly mesh: THREE.Mesh<THREE.BufferGeometry, THREE.ShaderMaterial>;

  constructor(uniforms: Record<string, THREE.IUniform>, defines: Record<string, number>) {
    const material = new THREE.ShaderMaterial({
      uniforms, defines,
      vertexShader: VERTEX, fragmentShader: FRAGMENT, clipping: true, side: THREE.DoubleSide,
    });
    this.mesh = new THREE.Mesh(new THREE.BufferGeometry(), material);
    this.mesh.raycast = () => undefined; // it is not measured
  }

  build(samples: Samples): void {
    const field = filled(samples);
    if (!field) return;
    const { west, south, cell, cols, rows, z, rgb, alpha } = field;
    const position = new Float32Array(3 * cols * rows);
    const tint = new Uint8Array(4 * cols * rows);
    for (let k = 0; k < cols * rows; k++) {
      position.set([west + ((k % cols) + 0.5) * cell, south + (Math.floor(k / cols) + 0.5) * cell, z[k]! - BELOW * cell], 3 * k);
      tint.set([rgb[3 * k]!, rgb[3 * k + 1]!, rgb[3 * k + 2]!, 255 * alpha[k]!], 4 * k);
    }
    const index: number[] = [];
    for (let j = 0; j + 1 < rows; j++)
      for (let i = 0; i + 1 < cols; i++) {
        const a = j * cols + i;
        const [b, c, d] = [a + 1, a + cols, a + cols + 1];
        if (alpha[a] || alpha[b] || alpha[c] || alpha[d]) index.push(a, b, d, a, d, c);
      }
    this.mesh.geometry.dispose();
    const geometry = (this.mesh.geometry = new THREE.BufferGeometry());
    geometry.setAttribute("position", new THREE.BufferAttribute(position, 3));
    geometry.setAttribute("tint", new THREE.BufferAttribute(tint, 4, true));
    geometry.setIndex(index);
  }
}
