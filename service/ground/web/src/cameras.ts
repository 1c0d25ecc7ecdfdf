// The drone, where images were taken (a frustum per keyframe), and one image in its frustum.

import * as THREE from "three";

const CORNERS: [number, number][] = [
  [-0.66, -0.37], [0.66, -0.37], [0.66, 0.37], [-0.66, 0.37],
];

export class Cameras {
  readonly group = new THREE.Group();
  private readonly taken = new Map<number, THREE.Matrix4>();
  /** Whether the camera of a keyframe is shown. */
  shows: (seq: number) => boolean = () => true;
  private readonly all = new THREE.LineSegments(
    new THREE.BufferGeometry(),
    new THREE.LineBasicMaterial({ color: 0x6f8296, transparent: true, opacity: 0.55 }),
  );
  private readonly now = new THREE.LineSegments(
    new THREE.BufferGeometry().setFromPoints(frustum()),
    new THREE.LineBasicMaterial({ color: 0x59b4ff }),
  );
  private readonly image = new THREE.Mesh(
    pane(),
    new THREE.MeshBasicMaterial({ side: THREE.DoubleSide, toneMapped: false }),
  );
  private readonly drone = quadcopter();
  private live: number[] | null = null;
  private standing: number | null = null; // the keyframe that time is set to
  private reach = 10;
  private stale = false;
  private drawn = 0; // frusta

  constructor() {
    for (const object of [this.all, this.now, this.image]) object.frustumCulled = false;
    this.all.visible = false;
    for (const object of [this.now, this.image]) {
      object.matrixAutoUpdate = false;
      object.visible = false;
    }
    this.drone.visible = false;
    this.group.add(this.all, this.now, this.image, this.drone);
  }

  get shown(): boolean {
    return this.all.visible;
  }

  /** Shows or hides the frusta of the keyframes; the aircraft's stays. */
  toggle(): void {
    this.all.visible = !this.all.visible;
    this.refresh();
  }

  /** A keyframe taken, or moved, at T (16 numbers, column by column); null: it is withdrawn. */
  put(seq: number, T: number[] | null): void {
    if (T) this.taken.set(seq, new THREE.Matrix4().fromArray(T));
    else this.taken.delete(seq);
    this.stale = true;
  }

  /** The keyframe whose camera or image centre is drawn nearest to a place (px), at most `near` away. */
  at(place: THREE.Vector2, camera: THREE.Camera, size: THREE.Vector2, near: number): number | null {
    if (!this.shown) return null;
    camera.updateMatrixWorld();
    let best: { seq: number; px: number } | null = null;
    for (const [seq, T] of this.taken) {
      if (!this.shows(seq)) continue;
      for (const z of [0, this.reach / 12]) {
        const p = new THREE.Vector3(0, 0, z).applyMatrix4(T).applyMatrix4(this.group.matrixWorld).project(camera);
        const seen = new THREE.Vector2((size.x / 2) * (1 + p.x), (size.y / 2) * (1 - p.y));
        const px = p.z < 1 ? seen.distanceTo(place) : Infinity;
        if (px <= near && px < (best?.px ?? Infinity)) best = { seq, px };
      }
    }
    return best?.seq ?? null;
  }

  /** Puts the aircraft where a keyframe was taken; null: where it is now. */
  stand(seq: number | null): void {
    this.standing = seq;
    const T = seq === null ? this.live : (this.taken.get(seq)?.toArray() ?? null);
    if (T) this.place(T);
  }

  /** The aircraft's camera is at T and looks `reach` metres far. */
  aircraft(T: number[], reach: number): void {
    this.live = T;
    if (Math.abs(reach - this.reach) > 0.2 * this.reach) {
      this.reach = reach;
      this.stale = true;
    }
    if (this.standing === null) this.place(T);
  }

  private place(T: number[]): void {
    const s = this.reach / 4;
    this.now.matrix.fromArray(T).scale(new THREE.Vector3(s, s, s));
    this.now.matrixWorldNeedsUpdate = true;
    this.now.visible = true;
    const e = this.now.matrix.elements;
    this.drone.position.setFromMatrixPosition(this.now.matrix);
    this.drone.rotation.z = Math.atan2(e[9] - e[5], e[8] - e[4]); // ahead: along the view, and where its upper side points
    this.drone.scale.setScalar(s / 3);
    this.drone.visible = true;
  }

  /** From within the length of its frustum the aircraft would hide what is looked at: it is not drawn. */
  seenFrom(eye: THREE.Vector3): void {
    for (const object of [this.now, this.image, this.drone]) {
      const isNear = eye.distanceTo(new THREE.Vector3().setFromMatrixPosition(object.matrixWorld)) < this.reach / 4;
      object.traverse((part) => (isNear ? part.layers.disable(0) : part.layers.enable(0)));
    }
  }

  /** Moves all cameras as a whole. */
  move(T: THREE.Matrix4): void {
    T.decompose(this.group.position, this.group.quaternion, this.group.scale);
  }

  /** Puts the image of keyframe `seq` into its frustum. */
  show(seq: number, shown: HTMLImageElement): void {
    const T = this.taken.get(seq);
    if (!T) return;
    const texture = new THREE.Texture(shown);
    texture.colorSpace = THREE.SRGBColorSpace;
    texture.generateMipmaps = false; // three.js counts them from the size in the page, not of the image
    texture.minFilter = THREE.LinearFilter;
    texture.needsUpdate = true;
    this.image.material.map?.dispose();
    this.image.material.map = texture;
    this.image.material.needsUpdate = true;
    const s = this.reach / 4;
    const flat = ((shown.naturalHeight || 1) / (shown.naturalWidth || 1)) * (CORNERS[1]![0] / CORNERS[2]![1]);
    this.image.matrix.copy(T).scale(new THREE.Vector3(s, s * flat, s));
    this.image.matrixWorldNeedsUpdate = true;
    this.image.visible = true;
  }

  /** Draws the frusta, while they are shown, again when keyframes came; call now and then. True when it did. */
  refresh(): boolean {
    if (!this.shown) return false;
    let shown = 0;
    for (const seq of this.taken.keys()) shown += this.shows(seq) ? 1 : 0;
    if (!this.stale && shown === this.drawn) return false;
    this.stale = false;
    this.drawn = shown;
    const s = this.reach / 12;
    const lines = frustum().map((p) => p.multiplyScalar(s));
    const points: THREE.Vector3[] = [];
    for (const [seq, T] of this.taken)
      if (this.shows(seq)) for (const p of lines) points.push(p.clone().applyMatrix4(T));
    this.all.geometry.dispose();
    this.all.geometry = new THREE.BufferGeometry().setFromPoints(points);
    return true;
  }
}

/** A drone that flies along x, about two units across. */
function quadcopter(): THREE.Group {
  const [body, rotor] = [0xe8edf2, 0x59b4ff].map((color) => new THREE.MeshBasicMaterial({ color, side: THREE.DoubleSide }));
  const nose = new THREE.MeshBasicMaterial({ color: 0xff6b4a });
  const out = new THREE.Group();
  const add = (geometry: THREE.BufferGeometry, material: THREE.Material, x: number, y: number, turn = 0): void => {
    const part = new THREE.Mesh(geometry, material);
    part.position.set(x, y, 0.15);
    part.rotation.z = turn;
    out.add(part);
  };
  add(new THREE.BoxGeometry(0.8, 0.4, 0.25), body!, 0, 0);
  add(new THREE.BoxGeometry(0.15, 0.3, 0.2), nose, 0.45, 0);
  for (const turn of [Math.PI / 4, -Math.PI / 4]) add(new THREE.BoxGeometry(1.8, 0.08, 0.08), body!, 0, 0, turn);
  for (const [x, y] of [[1, 1], [1, -1], [-1, 1], [-1, -1]] as const) add(new THREE.CircleGeometry(0.38, 20), rotor!, 0.65 * x, 0.65 * y);
  return out;
}

/** A pyramid along z with a mark at its upper (minus y) side. */
function frustum(): THREE.Vector3[] {
  const corners = CORNERS.map(([x, y]) => new THREE.Vector3(x, y, 1));
  const out: THREE.Vector3[] = [];
  corners.forEach((corner, i) => {
    out.push(new THREE.Vector3(), corner, corner, corners[(i + 1) % 4]!);
  });
  const mark = [new THREE.Vector3(-0.15, -0.39, 1), new THREE.Vector3(0, -0.54, 1)];
  out.push(mark[0]!, mark[1]!, mark[1]!, new THREE.Vector3(0.15, -0.39, 1));
  return out.map((p) => p.clone());
}

/** The pyramid's base, with the image the right way up. */
function pane(): THREE.BufferGeometry {
  const geometry = new THREE.BufferGeometry().setFromPoints(
    CORNERS.map(([x, y]) => new THREE.Vector3(x, y, 1)),
  );
  geometry.setAttribute("uv", new THREE.Float32BufferAttribute([0, 1, 1, 1, 1, 0, 0, 0], 2));
  geometry.setIndex([0, 1, 2, 0, 2, 3]);
  return geometry;
}
