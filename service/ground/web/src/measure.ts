// Measuring in the view: click points, read distance, height difference and area.

import * as THREE from "three";

export class Ruler {
  readonly group = new THREE.Group();
  active = false;
  private readonly places: THREE.Vector3[] = [];
  private readonly line = new THREE.Line(
    new THREE.BufferGeometry(),
    new THREE.LineBasicMaterial({ color: 0xff3b30, depthTest: false }),
  );
  private readonly caster = new THREE.Raycaster();

  constructor() {
    this.line.renderOrder = 10;
    this.line.frustumCulled = false;
    this.group.add(this.line);
  }

  /** Adds the point of the scene under the pointer; false when there is none. */
  pick(pointer: THREE.Vector2, camera: THREE.Camera, target: THREE.Object3D): boolean {
    this.caster.setFromCamera(pointer, camera);
    const reach = camera.position.length();
    this.caster.params.Points.threshold = Math.max(0.05, reach * 0.003);
    const hits = this.caster.intersectObject(target, true);
    const best = hits.reduce<THREE.Intersection | null>((found, hit) => {
      const near = (h: THREE.Intersection): number => h.distanceToRay ?? 0;
      return !found || near(hit) < near(found) ? hit : found;
    }, null);
    if (!best) return false;
    this.places.push(best.point.clone());
    this.redraw();
    return true;
  }

  clear(): void {
    this.places.length = 0;
    this.redraw();
  }

  /** What the points picked so far measure. */
  text(): string {
    const n = this.places.length;
    if (n < 2) return n ? "click the next point" : "click a point";
    const a = this.places[n - 2]!;
    const b = this.places[n - 1]!;
    let length = 0;
    for (let i = 1; i < n; i++) length += this.places[i]!.distanceTo(this.places[i - 1]!);
    const parts = [
      `last ${a.distanceTo(b).toFixed(2)} m`,
      `height ${(b.z - a.z).toFixed(2)} m`,
      `along ${length.toFixed(2)} m`,
    ];
    if (n > 2) parts.push(`area ${this.area().toFixed(1)} m²`);
    return parts.join(" · ");
  }

  /** Area of the polygon seen from above, m². */
  private area(): number {
    let sum = 0;
    this.places.forEach((p, i) => {
      const q = this.places[(i + 1) % this.places.length]!;
      sum += p.x * q.y - q.x * p.y;
    });
    return Math.abs(sum) / 2;
  }

  private redraw(): void {
    this.line.geometry.setFromPoints(this.places);
  }
}
