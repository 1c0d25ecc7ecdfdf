// A keyframe's depth image as a surface: grids of triangles in levels of detail, which the
// vertex shader displaces along the rays of its camera.

import * as THREE from "three";
import { type Chunk, EDGE_PX, FIRST, sigmaAt, viewsAt } from "./depth";
import { SHADE } from "./shade";

/** Pixels of the depth image between two vertices, by level. */
const STEPS = [1, 2, 4, 8, 16];
export const LEVELS = STEPS.length;
const FIRST_LEVEL = 2; // made when the keyframe comes

/** Two pixels are one surface if their depths differ by no more than a slope of this tangent explains, and sigmas. */
const STEEPEST = 4;
const SIGMAS = 4;
/** Vertices by which a mask grows, by level: two keyframes are cut from each other without an overlap. */
const GROWN = [2, 1, 1, 1, 1];
const AROUND = [[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [1, -1], [-1, 1], [-1, -1]] as const;
const DIP = 0.006; // of depth, by which each of them lies lower: the skirt of a roof is not that of the ground
/** What is not measured is drawn as if it were farther, so that it hides nothing measured: by this share of the depths
 * of the images, skirts by half of it. */
export const BEHIND = 0.08;
const FIRST_BEHIND = 0.7; // of it, for a first depth: coarse and blurred, it hides no surface, but the ground below
/** GLSL: where a place of the view is drawn when it is to lie behind by a share of `behind`. */
export const DRAWN_BEHIND = /* glsl */ `
  uniform float behind;   // m
  vec4 drawn(vec4 seen, float share) {
    vec4 place = projectionMatrix * seen;
    float metres = share * behind * length(modelMatrix[2].xyz);
    vec4 beyond = projectionMatrix * vec4(seen.xyz * (1.0 + metres / max(length(seen.xyz), 1e-3)), 1.0);
    place.z = beyond.z / beyond.w * place.w;
    return place;
  }
`;
const SKIRT = 32768; // of a vertex's column, for one of a skirt
const OUTSIDE_PX = 16; // grown vertices lie outside the box; attributes have no sign
const SAME = 0.03; // share of inverse depth by which neighbours of one grown vertex may differ
const MIN_TRIANGLES = 200; // triangles of a patch that is drawn, of the finest level
const MIN_COARSE = 8; // of the others

const VERTEX = /* glsl */ `
  attribute vec4 pixel;   // column (and SKIRT), row, code of inverse depth, code of sigma * 256 + views
  attribute vec2 at;      // in the texture
  uniform vec4 K;
  uniform vec2 inverse;   // of code 0, and its step
  uniform vec2 corner;
  uniform float first;    // by which it lies behind as a whole
  varying vec2 place;
  varying vec3 where;
  varying vec2 sure;      // sigma, m, and views
  varying float measured; // 1, or less for a skirt and a first depth
  ${DRAWN_BEHIND}
  #include <clipping_planes_pars_vertex>
  void main() {
    float z = 1.0 / (inverse.x + inverse.y * pixel.z);
    float skirt = step(float(${SKIRT}), pixel.x);
    vec2 p = pixel.xy - vec2(skirt * float(${SKIRT}), 0.0) - float(${OUTSIDE_PX}) + corner;
    vec4 world = modelMatrix * vec4((p - K.zw) / K.xy * z, z, 1.0);
    vec4 mvPosition = viewMatrix * world;
    measured = (1.0 - first) * (1.0 - 0.5 * skirt);
    gl_Position = drawn(mvPosition, 1.0 - measured);
    float code = floor(pixel.w / 256.0);
    sure = vec2(code > 0.0 ? 0.001 * exp2((code - 1.0) / 4.0) * length(modelMatrix[2].xyz) : 0.0, pixel.w - 256.0 * code);
    place = at;
    where = world.xyz;
    #include <clipping_planes_vertex>
  }
`;

const FRAGMENT = /* glsl */ `
  uniform sampler2D image;
  varying vec2 place;
  varying vec3 where;
  varying vec2 sure;
  varying float measured;
  #include <clipping_planes_pars_fragment>
  ${SHADE}
  void main() {
    #include <clipping_planes_fragment>
    // A level finer than the widest view of a pixel asks for: ground that lies aslant stays sharp.
    gl_FragColor = vec4(shade(where, texture2D(image, place, -1.0).rgb, sure.x, sure.y), measured);
    #include <colorspace_fragment>
  }
`;

/** How a texture is seen from aslant: as sharp as a graphics card can; software would take a third of a frame more. */
export function sharpen(texture: THREE.Texture, { software, anisotropy }: Card): void {
  texture.minFilter = software ? THREE.LinearMipmapNearestFilter : THREE.LinearMipmapLinearFilter;
  texture.anisotropy = software ? 1 : anisotropy;
}

/** What draws: a processor, or a graphics card that takes so many samples along a slope. */
export interface Card {
  software: boolean;
  anisotropy: number;
}

interface Grid {
  pixel: Uint16Array;
  at: Uint16Array;
  index: Uint16Array | Uint32Array;
}

/** The surface of one keyframe. */
export class Surface {
  readonly mesh: THREE.Mesh<THREE.BufferGeometry, THREE.ShaderMaterial>;
  /** Triangles of the finest level, about. */
  readonly triangles: number;
  private readonly levels: (THREE.BufferGeometry | undefined)[] = [];
  private readonly sphere: THREE.Sphere;

  constructor(private readonly chunk: Chunk, uniforms: Record<string, THREE.IUniform>, defines: Record<string, number>, card: Card) {
    const { K, low, step, box, colour } = chunk;
    let known = 0;
    for (const code of chunk.codes) known += code ? 1 : 0;
    this.triangles = 2 * known;
    const texture = new THREE.Texture(colour ?? undefined);
    texture.colorSpace = THREE.SRGBColorSpace;
    texture.flipY = false;
    sharpen(texture, card);
    texture.needsUpdate = colour !== null;
    const material = new THREE.ShaderMaterial({
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      defines,
      clipping: true,
      side: THREE.DoubleSide,
      uniforms: {
        ...uniforms,
        image: { value: texture },
        K: { value: new THREE.Vector4(...K) },
        inverse: { value: new THREE.Vector2(low, step) },
        corner: { value: new THREE.Vector2(box[0], box[1]) },
        first: { value: chunk.layer === FIRST ? FIRST_BEHIND : 0 },
      },
    });
    this.sphere = reach(chunk);
    this.mesh = new THREE.Mesh(this.make(FIRST_LEVEL), material);
    this.mesh.matrixAutoUpdate = false;
    this.mesh.raycast = () => undefined; // measuring takes its points
  }

  /** Pixels of the screen per pixel of the depth image, seen from `eye` by a lens of `focal_px`. */
  magnified(eye: THREE.Vector3, focal_px: number): number {
    const centre = this.sphere.center.clone().applyMatrix4(this.mesh.matrixWorld);
    const scale = this.mesh.matrixWorld.getMaxScaleOnAxis();
    const near = Math.max(centre.distanceTo(eye) - 0.7 * this.sphere.radius * scale, 0.05 * this.sphere.center.z * scale, 1e-3);
    return (this.sphere.center.z * scale * focal_px) / (this.chunk.K[0] * near);
  }

  /** Depth of its middle, in units of its camera's frame. */
  get depth(): number {
    return this.sphere.center.z;
  }

  isSeen(frustum: THREE.Frustum): boolean {
    return frustum.intersectsSphere(this.sphere.clone().applyMatrix4(this.mesh.matrixWorld));
  }

  has(level: number): boolean {
    return this.levels[level] !== undefined;
  }

  /** Draws a level, which is made when `mayMake`, or the next one there is; true when it is that level. */
  show(level: number, mayMake: boolean): boolean {
    const found = this.levels[level] ?? (mayMake ? this.make(level) : undefined);
    const rank = (k: number): number => (k >= level ? k - level : LEVELS + level - k); // rather coarser than finer
    const order = STEPS.map((_, k) => k).sort((a, b) => rank(a) - rank(b));
    this.mesh.geometry = found ?? order.map((k) => this.levels[k]).find((g) => g !== undefined)!;
    return found !== undefined;
  }

  /** Triangles in memory. */
  get kept(): number {
    return this.levels.reduce((sum, geometry) => sum + (geometry?.index?.count ?? 0) / 3, 0);
  }

  /** Triangles drawn. */
  get drawn(): number {
    return (this.mesh.geometry.index?.count ?? 0) / 3;
  }

  /** Gives up the levels finer than the first that are not drawn; returns their triangles. */
  shrink(): number {
    let freed = 0;
    this.levels.forEach((geometry, k) => {
      if (!geometry || k >= FIRST_LEVEL || geometry === this.mesh.geometry) return;
      freed += geometry.index!.count / 3;
      geometry.dispose();
      delete this.levels[k];
    });
    return freed;
  }

  close(): void {
    for (const geometry of this.levels) geometry?.dispose();
    (this.mesh.material.uniforms["image"]!.value as THREE.Texture).dispose();
    this.mesh.material.dispose();
    this.mesh.removeFromParent();
  }

  private make(level: number): THREE.BufferGeometry {
    const { pixel, at, index } = triangulate(this.chunk, level);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("pixel", new THREE.BufferAttribute(pixel, 4));
    geometry.setAttribute("at", new THREE.BufferAttribute(at, 2, true));
    geometry.setIndex(new THREE.BufferAttribute(index, 1));
    geometry.boundingSphere = this.sphere;
    return (this.levels[level] = geometry);
  }
}

/** A sphere around the points of a depth image, in its camera's frame. */
function reach({ codes, w, h, K, low, step, box }: Chunk): THREE.Sphere {
  const bounds = new THREE.Box3();
  const p = new THREE.Vector3();
  const every = Math.max(1, Math.floor(Math.min(w, h) / 60));
  for (let y = 0; y < h; y += every)
    for (let x = 0; x < w; x += every) {
      const code = codes[y * w + x]!;
      if (!code) continue;
      const z = 1 / (low + step * (code - 1));
      bounds.expandByPoint(p.set(((box[0] + x - K[2]) / K[0]) * z, ((box[1] + y - K[3]) / K[1]) * z, z));
    }
  const sphere = bounds.isEmpty() ? new THREE.Sphere(new THREE.Vector3(0, 0, 1), 0) : bounds.getBoundingSphere(new THREE.Sphere());
  sphere.radius *= 1.1;
  return sphere;
}

/**
 * The triangles of a level.
 *
 * A vertex is the known pixel nearest to the middle of its block. The mask grows by a skirt: vertices on the plane of
 * those next to them (planes are linear in inverse depth) and a little lower. A triangle is drawn where no step lies between its
 * corners, also of pixels that the level leaves out: a coarse one does not stretch from a roof to the ground.
 */
export function triangulate(chunk: Chunk, level: number): Grid {
  const { codes, w, h, low, step, K } = chunk;
  const side = STEPS[level]!;
  const ring = GROWN[level]!;
  const [cols, rows] = [Math.ceil(w / side) + 2 * ring, Math.ceil(h / side) + 2 * ring];
  const n = cols * rows;
  const code = new Float32Array(n).fill(-1);
  const isGrown = new Uint8Array(n);
  const [x, y] = [new Int16Array(n), new Int16Array(n)]; // of the vertex
  const from = new Int32Array(n); // the pixel whose sigma it has, and its colour where no image shows more
  const half = side >> 1;
  const reach = Math.max(half, 1); // of a skirt, from the last known pixel of a block
  for (let j = ring; j < rows - ring; j++)
    for (let i = ring; i < cols - ring; i++) {
      const [left, top] = [(i - ring) * side, (j - ring) * side];
      const [cx, cy] = [Math.min(left + half, w - 1), Math.min(top + half, h - 1)];
      let best = codes[cy * w + cx] ? cy * w + cx : -1;
      if (best < 0 && side > 1) {
        let least = Infinity;
        for (let v = top; v < Math.min(top + side, h); v++)
          for (let u = left; u < Math.min(left + side, w); u++) {
            const d = (u - cx) ** 2 + (v - cy) ** 2;
            if (codes[v * w + u] && d < least) [least, best] = [d, v * w + u];
          }
      }
      if (best < 0) continue;
      const k = j * cols + i;
      code[k] = codes[best]! - 1;
      x[k] = best % w;
      y[k] = (best - x[k]!) / w;
      from[k] = best;
    }
  for (let pass = 0; pass < ring; pass++) grow();
  const inverse = code.map((c) => (c < 0 ? 0 : low + step * c)); // of the depth

  /** True if no step lies between two vertices: each pixel on the way there is one surface with the one before. */
  const isOne = (a: number, b: number): boolean => {
    let [last, at] = [inverse[a]!, 0];
    const end = inverse[b]!;
    if (!last || !end) return false;
    const slack = SIGMAS * sigmaAt(chunk, from[a]! % w, (from[a]! / w) | 0);
    const [dx, dy] = [x[b]! - x[a]!, y[b]! - y[a]!];
    const pixels = Math.max(Math.abs(dx), Math.abs(dy), 1);
    for (let k = 1; k <= pixels; k++) {
      let next = end;
      if (k < pixels) {
        const [u, v] = [Math.round(x[a]! + (k * dx) / pixels), Math.round(y[a]! + (k * dy) / pixels)];
        const known = u < 0 || v < 0 || u >= w || v >= h ? 0 : codes[v * w + u]!;
        if (!known) continue;
        next = low + step * (known - 1);
      }
      if (Math.abs(next - last) > (STEEPEST * (k - at) * Math.max(next, last)) / K[0] + slack * next * last) return false;
      [last, at] = [next, k];
    }
    return true;
  };
  const [right, below] = [new Uint8Array(n), new Uint8Array(n)];
  for (let k = 0; k < n; k++) {
    right[k] = (k + 1) % cols && isOne(k, k + 1) ? 1 : 0;
    below[k] = k + cols < n && isOne(k, k + cols) ? 1 : 0;
  }

  const index = new Uint32Array(6 * (cols - 1) * (rows - 1));
  let count = 0;
  const add = (a: number, b: number, c: number): void => {
    index[count++] = a;
    index[count++] = b;
    index[count++] = c;
  };
  for (let j = 0; j + 1 < rows; j++)
    for (let i = 0; i + 1 < cols; i++) {
      const a = j * cols + i;
      const [b, c, d] = [a + 1, a + cols, a + cols + 1];
      const falling = inverse[a] && inverse[d] ? Math.abs(inverse[a]! - inverse[d]!) : Infinity;
      const rising = inverse[b] && inverse[c] ? Math.abs(inverse[b]! - inverse[c]!) : Infinity;
      if (falling < rising) {
        if (!isOne(a, d)) continue;
        if (below[a] && right[c]) add(a, c, d);
        if (right[a] && below[b]) add(a, d, b);
      } else if (rising < Infinity) {
        if (!isOne(b, c)) continue;
        if (below[a] && right[a]) add(a, c, b);
        if (below[b] && right[c]) add(b, c, d);
      }
    }
  return compact(index.subarray(0, withoutSmall(index.subarray(0, count), n, side)));

  /** Adds the vertices next to known ones. */
  function grow(): void {
    const grown: [number, number, number][] = [];
    for (let j = 0; j < rows; j++)
      for (let i = 0; i < cols; i++) {
        const k = j * cols + i;
        if (code[k]! >= 0) continue;
        let [least, sum, number, near] = [Infinity, 0, 0, -1];
        for (let twice = 0; twice < 2; twice++)
          for (const [di, dj] of AROUND) {
            const [ai, aj] = [i + di, j + dj];
            if (ai < 0 || aj < 0 || ai >= cols || aj >= rows) continue;
            const a = code[aj * cols + ai]!;
            if (a < 0) continue;
            const [bi, bj] = [ai + di, aj + dj];
            const b = bi < 0 || bj < 0 || bi >= cols || bj >= rows ? -1 : code[bj * cols + bi]!;
            const inverse = low + step * a;
            const guess = b >= 0 && step * Math.abs(a - b) < SAME * inverse ? a + (reach / side) * (a - b) : a;
            if (!twice) {
              if (near < 0) near = aj * cols + ai;
              least = Math.min(least, guess);
            } else if (step * (guess - least) < SAME * inverse) {
              sum += guess;
              number++;
            }
          }
        const guess = sum / number;
        if (number) grown.push([k, Math.min(Math.max(guess - (DIP * (low + step * guess)) / step, 0), 65535), near]);
      }
    for (const [k, c, near] of grown) {
      code[k] = c;
      isGrown[k] = 1;
      x[k] = x[near]! + reach * ((k % cols) - (near % cols));
      y[k] = y[near]! + reach * (Math.floor(k / cols) - Math.floor(near / cols));
      from[k] = from[near]!;
    }
  }

  /** Where the middle of a pixel, or of the image's nearest one, lies along an axis of the texture, 0 to 1. */
  function within(pixel: number, axis: number): number {
    const [first, size, side] = [chunk.box[axis]!, chunk.size[axis]!, chunk.box[2 + axis]!];
    const inImage = Math.min(Math.max(pixel, -first), size - 1 - first);
    return Math.min(Math.max((inImage + EDGE_PX + 0.5) / (side + 2 * EDGE_PX), 0), 1);
  }

  /** The vertices that triangles have, and their triangles; those of skirts have vertices of their own. */
  function compact(triangles: Uint32Array): Grid {
    const number = new Int32Array(2 * n).fill(-1);
    const index = new Uint32Array(triangles.length);
    const used: number[] = [];
    for (let i = 0; i < triangles.length; i += 3) {
      const skirt = isGrown[triangles[i]!]! | isGrown[triangles[i + 1]!]! | isGrown[triangles[i + 2]!]!;
      for (let c = i; c < i + 3; c++) {
        const k = 2 * triangles[c]! + skirt;
        if (number[k]! < 0) number[k] = used.push(k) - 1;
        index[c] = number[k]!;
      }
    }
    const pixel = new Uint16Array(4 * used.length);
    const at = new Uint16Array(2 * used.length);
    used.forEach((twice, v) => {
      const k = twice >> 1;
      const [fx, fy] = [from[k]! % w, (from[k]! / w) | 0];
      const sigma = chunk.sigma[(fy >> 2) * Math.ceil(w / 4) + (fx >> 2)] ?? 0;
      pixel.set([x[k]! + OUTSIDE_PX + SKIRT * (twice & 1), y[k]! + OUTSIDE_PX, Math.round(code[k]!), 256 * sigma + viewsAt(chunk, fx, fy)], 4 * v);
      const place = chunk.isWhole ? [x[k]!, y[k]!] : [fx, fy];
      at.set(place.map((p, axis) => 65535 * within(p, axis)), 2 * v);
    });
    return { pixel, at, index: used.length <= 65535 ? Uint16Array.from(index) : index };
  }
}

/** Moves the triangles of patches that are too small to be a surface to the end; returns where they begin. */
function withoutSmall(index: Uint32Array, vertices: number, side: number): number {
  const parent = Int32Array.from({ length: vertices }, (_, k) => k);
  const root = (k: number): number => {
    while (parent[k] !== k) k = parent[k] = parent[parent[k]!]!;
    return k;
  };
  for (let i = 0; i < index.length; i += 3) {
    const a = root(index[i]!);
    parent[root(index[i + 1]!)] = a;
    parent[root(index[i + 2]!)] = a;
  }
  const size = new Uint32Array(vertices);
  for (let i = 0; i < index.length; i += 3) size[root(index[i]!)]!++;
  let end = 0;
  const least = Math.max(MIN_TRIANGLES / side ** 2, MIN_COARSE);
  for (let i = 0; i < index.length; i += 3) {
    if (size[root(index[i]!)]! < least) continue;
    index.copyWithin(end, i, i + 3);
    end += 3;
  }
  return end;
}
