// The point of the scene under the pointer, and all points of the cloud for figures.

import * as THREE from "three";

const RADII_PX = [3, 6, 12];
const SAME_SURFACE = 1.02;
/** Points looked at while the pointer hovers; each keyframe's are shuffled, so any part will do. */
export const HOVER_POINTS = 300_000;

/** Calls `use` with each Points object below `root`, and its coordinates. */
function eachCloud(root: THREE.Object3D, use: (object: THREE.Points, xyz: ArrayLike<number>) => void): void {
  root.traverse((node) => {
    if (!(node instanceof THREE.Points)) return;
    const xyz = (node.geometry as THREE.BufferGeometry).getAttribute("position");
    if (xyz instanceof THREE.BufferAttribute) use(node, xyz.array);
  });
}

/** Calls `use` with every point below `root`, drawn or not, in metres. */
export function eachPoint(root: THREE.Object3D, use: (x: number, y: number, z: number) => void): void {
  eachCloud(root, (object, xyz) => {
    const e = object.matrixWorld.elements;
    for (let i = 0; i + 2 < xyz.length; i += 3) {
      const [x, y, z] = [xyz[i]!, xyz[i + 1]!, xyz[i + 2]!];
      use(
        e[0] * x + e[4] * y + e[8] * z + e[12],
        e[1] * x + e[5] * y + e[9] * z + e[13],
        e[2] * x + e[6] * y + e[10] * z + e[14],
      );
    }
  });
}

interface Candidate {
  px2: number;
  depth: number;
  object: THREE.Points;
  at: number;
}

/** The points within the largest radius of the pointer (-1 to 1), at most `limit` looked at. */
function candidates(root: THREE.Object3D, camera: THREE.Camera, pointer: THREE.Vector2, size: THREE.Vector2, limit: number): Candidate[] {
  const found: Candidate[] = [];
  const reach2 = RADII_PX.at(-1)! ** 2;
  const whole = new THREE.Matrix4();
  const view = new THREE.Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse);
  let total = 0;
  eachCloud(root, (_, xyz) => (total += xyz.length / 3));
  const part = Math.min(1, limit / Math.max(1, total));
  eachCloud(root, (object, xyz) => {
    const e = whole.multiplyMatrices(view, object.matrixWorld).elements;
    const end = 3 * Math.ceil((part * xyz.length) / 3);
    for (let i = 0; i < end; i += 3) {
      const [x, y, z] = [xyz[i]!, xyz[i + 1]!, xyz[i + 2]!];
      const w = e[3] * x + e[7] * y + e[11] * z + e[15];
      if (w <= 0) continue;
      const u = ((e[0] * x + e[4] * y + e[8] * z + e[12]) / w - pointer.x) * (size.x / 2);
      const v = ((e[1] * x + e[5] * y + e[9] * z + e[13]) / w - pointer.y) * (size.y / 2);
      const px2 = u * u + v * v;
      if (px2 <= reach2) found.push({ px2, depth: w, object, at: i / 3 });
    }
  });
  return found;
}

/**
 * The point of the scene under `pointer`; null when there is none.
 *
 * Of points: within the smallest radius that has any, on the nearest surface, the one
 * closest to the pointer. Of a mesh: where the ray meets it, unless that was filled in.
 */
export function pick(root: THREE.Object3D, camera: THREE.Camera, pointer: THREE.Vector2, size: THREE.Vector2, limit = Infinity): THREE.Vector3 | null {
  camera.updateMatrixWorld();
  const near = candidates(root, camera, pointer, size, limit);
  for (const radius of RADII_PX) {
    const within = near.filter((c) => c.px2 <= radius * radius);
    if (!within.length) continue;
    const front = SAME_SURFACE * within.reduce((depth, c) => Math.min(depth, c.depth), Infinity);
    const best = within.reduce((a, b) => (b.depth <= front && (a.depth > front || b.px2 < a.px2) ? b : a));
    const xyz = best.object.geometry.getAttribute("position") as THREE.BufferAttribute;
    return new THREE.Vector3().fromBufferAttribute(xyz, best.at).applyMatrix4(best.object.matrixWorld);
  }
  const caster = new THREE.Raycaster();
  caster.setFromCamera(pointer, camera);
  const meshes: THREE.Object3D[] = [];
  root.traverse((node) => node instanceof THREE.Mesh && meshes.push(node));
  const hit = caster.intersectObjects(meshes, false)[0];
  return hit && isMeasured(hit) ? hit.point : null;
}

/** Whether a mesh of ours says that two corners of the triangle were measured; any other one says nothing. */
function isMeasured({ object, face }: THREE.Intersection): boolean {
  const measured = (object as THREE.Mesh<THREE.BufferGeometry>).geometry.getAttribute("_measured");
  return !measured || !face || [face.a, face.b, face.c].filter((k) => measured.getX(k) > 0.5).length > 1;
}

/** The point of a scene at a place of the page. */
export function pickAt(canvas: HTMLElement, camera: THREE.Camera, root: THREE.Object3D, x: number, y: number, limit?: number): THREE.Vector3 | null {
  const box = canvas.getBoundingClientRect();
  const pointer = new THREE.Vector2((2 * (x - box.left)) / box.width - 1, 1 - (2 * (y - box.top)) / box.height);
  return pick(root, camera, pointer, new THREE.Vector2(box.width, box.height), limit);
}

/** Where a camera sees a place, in CSS pixels of its canvas; null behind it. */
export function onScreen(canvas: HTMLElement, camera: THREE.Camera, place: THREE.Vector3): { x: number; y: number } | null {
  camera.updateMatrixWorld();
  const q = place.clone().applyMatrix4(camera.matrixWorldInverse);
  if (q.z > -1e-3) return null;
  q.applyMatrix4(camera.projectionMatrix);
  return { x: (canvas.clientWidth / 2) * (1 + q.x), y: (canvas.clientHeight / 2) * (1 - q.y) };
}
