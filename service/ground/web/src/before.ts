// Heights of the ground at an earlier date, as a texture that the cloud's colours are compared with.

import * as THREE from "three";
import { eachPoint } from "./pick";

const CELL_M = 0.5;
const MAX_CELLS = 1024; // along a side

/** GLSL: metres by which a place lies above (or, negative, below) the ground of the earlier date. */
export const CHANGE = /* glsl */ `
  uniform highp sampler2D before;  // lowest and highest height of a cell; the first is larger: unknown
  uniform vec3 before_at;          // west, south, size of a cell

  /** Beyond all heights within a cell around, and the slack; 1e9 where nothing is known. */
  float change(vec3 p, float slack) {
    ivec2 cell = ivec2(floor((p.xy - before_at.xy) / before_at.z));
    ivec2 size = textureSize(before, 0);
    vec2 known = vec2(1e9, -1e9);
    for (int k = 0; k < 9; k++) {
      ivec2 at = cell + ivec2(k % 3 - 1, k / 3 - 1);
      if (any(lessThan(at, ivec2(0))) || any(greaterThanEqual(at, size))) continue;
      vec2 z = texelFetch(before, at, 0).rg;
      if (z.x <= z.y) known = vec2(min(known.x, z.x), max(known.y, z.y));
    }
    if (known.x > known.y) return 1e9;
    return max(p.z - known.y - slack, 0.0) - max(known.x - slack - p.z, 0.0);
  }
`;

export class Before {
  readonly uniforms = {
    before: { value: texture(1, 1) },
    before_at: { value: new THREE.Vector3(0, 0, CELL_M) },
  };

  /** Takes in the heights of all points below `root`. */
  build(root: THREE.Object3D): void {
    const box = new THREE.Box2();
    eachPoint(root, (x, y) => box.expandByPoint(new THREE.Vector2(x, y)));
    if (box.isEmpty()) return;
    const extent = box.getSize(new THREE.Vector2());
    const cell = Math.max(CELL_M, Math.max(extent.x, extent.y) / (MAX_CELLS - 1));
    const [w, h] = [extent.x, extent.y].map((m) => Math.floor(m / cell) + 1) as [number, number];
    const next = texture(w, h);
    const heights = next.image.data as Float32Array;
    eachPoint(root, (x, y, z) => {
      const k = Math.floor((y - box.min.y) / cell) * w + Math.floor((x - box.min.x) / cell);
      const known = heights[2 * k]! <= heights[2 * k + 1]!;
      heights[2 * k] = known ? Math.min(heights[2 * k]!, z) : z;
      heights[2 * k + 1] = known ? Math.max(heights[2 * k + 1]!, z) : z;
    });
    this.uniforms.before.value.dispose();
    this.uniforms.before.value = next;
    this.uniforms.before_at.value.set(box.min.x, box.min.y, cell);
  }
}

/** Nothing known. */
function texture(w: number, h: number): THREE.DataTexture {
  const data = new Float32Array(2 * w * h);
  for (let k = 0; k < data.length; k += 2) data.set([1, 0], k);
  const made = new THREE.DataTexture(data, w, h, THREE.RGFormat, THREE.FloatType);
  made.needsUpdate = true;
  return made;
}
