// The scene around the cloud: renderer, camera, track, aircraft, mesh, VR.

import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { VRButton } from "three/addons/webxr/VRButton.js";

/** False when this browser cannot draw in 3D. */
export function canDraw(): boolean {
  try {
    return document.createElement("canvas").getContext("webgl2") !== null;
  } catch {
    return false;
  }
}

export class Stage {
  readonly renderer = new THREE.WebGLRenderer({ antialias: true, powerPreference: "high-performance" });
  readonly scene = new THREE.Scene();
  readonly camera = new THREE.PerspectiveCamera(60, 1, 0.1, 20000);
  readonly controls: OrbitControls;
  readonly model = new THREE.Group();
  follow = true;
  private readonly world = new THREE.Group(); // what VR shrinks and lays at one's feet
  private readonly track = new THREE.Line(
    new THREE.BufferGeometry(),
    new THREE.LineBasicMaterial({ color: 0xeb3c28 }),
  );
  private readonly frustum = new THREE.LineSegments(
    new THREE.BufferGeometry(),
    new THREE.LineBasicMaterial({ color: 0x2a6df4 }),
  );
  private readonly watcher: ResizeObserver;
  private frames = 0;
  private since = performance.now();
  frames_per_s = 0;

  constructor(private readonly host: HTMLElement) {
    this.scene.background = new THREE.Color(0xeef1f4);
    this.camera.up.set(0, 0, 1);
    this.camera.position.set(0, -120, 90);
    this.controls = new OrbitControls(this.camera, this.renderer.domElement);
    this.controls.addEventListener("start", () => (this.follow = false));
    this.track.frustumCulled = false;
    this.frustum.frustumCulled = false;
    this.frustum.matrixAutoUpdate = false;
    this.frustum.geometry.setFromPoints(frustumLines());
    this.frustum.visible = false;
    this.world.add(this.track, this.frustum, this.model);
    this.scene.add(this.world, new THREE.AmbientLight(0xffffff, 2));
    host.append(this.renderer.domElement);
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.xr.enabled = true;
    this.watcher = new ResizeObserver(() => this.resize());
    this.watcher.observe(host);
    this.resize();
    this.renderer.setAnimationLoop(() => this.draw());
  }

  add(object: THREE.Object3D): void {
    this.world.add(object);
  }

  close(): void {
    this.renderer.setAnimationLoop(null);
    this.watcher.disconnect();
    this.controls.dispose();
    this.renderer.dispose();
  }

  setTrack(track: [number, number, number][]): void {
    this.track.geometry.dispose();
    this.track.geometry = new THREE.BufferGeometry().setFromPoints(
      track.map(([x, y, z]) => new THREE.Vector3(x, y, z)),
    );
  }

  /** Puts the aircraft's camera at its pose; in follow mode the view goes along. */
  setCamera(T: number[], reach: number): void {
    const s = reach / 4;
    this.frustum.matrix.fromArray(T).scale(new THREE.Vector3(s, s, s));
    this.frustum.matrixWorldNeedsUpdate = true;
    this.frustum.visible = true;
    if (!this.follow) return;
    const eye = new THREE.Vector3().setFromMatrixPosition(new THREE.Matrix4().fromArray(T));
    const axis = new THREE.Vector3(T[8], T[9], T[10]);
    const looked = eye.clone().addScaledVector(axis, reach);
    const offset = this.camera.position.clone().sub(this.controls.target);
    if (offset.length() > 4 * reach || offset.length() < 0.3 * reach) offset.setLength(2 * reach);
    this.controls.target.copy(looked);
    this.camera.position.copy(looked).add(offset);
  }

  /** Looks at everything there is, from the south and above. */
  frame(): void {
    const box = new THREE.Box3().setFromObject(this.world);
    if (box.isEmpty()) return;
    const centre = box.getCenter(new THREE.Vector3());
    const reach = Math.max(box.getSize(new THREE.Vector3()).length(), 1);
    this.controls.target.copy(centre);
    this.camera.position.copy(centre).add(new THREE.Vector3(0, -0.4 * reach, 0.47 * reach));
    this.camera.near = reach / 2000;
    this.camera.far = reach * 20;
    this.camera.updateProjectionMatrix();
  }

  /** Shows a mesh made by skyrelief: glTF with y up, turned back to z up. */
  async load(address: string): Promise<void> {
    const { scene } = await new GLTFLoader().loadAsync(address);
    scene.rotation.x = Math.PI / 2;
    this.model.clear();
    this.model.add(scene);
  }

  /** The button that enters VR, or null where the browser has no WebXR. */
  async vr(): Promise<HTMLElement | null> {
    const offered = await navigator.xr?.isSessionSupported("immersive-vr").catch(() => false);
    if (!offered) return null;
    this.renderer.xr.addEventListener("sessionstart", () => this.layAtFeet());
    this.renderer.xr.addEventListener("sessionend", () => this.world.matrix.identity());
    return VRButton.createButton(this.renderer);
  }

  /** In VR y is up and one is small: the site becomes a table model of four metres. */
  private layAtFeet(): void {
    const box = new THREE.Box3().setFromObject(this.world);
    const centre = box.getCenter(new THREE.Vector3());
    const scale = 4 / Math.max(box.getSize(new THREE.Vector3()).length(), 1);
    this.world.matrixAutoUpdate = false;
    this.world.matrix
      .makeTranslation(0, 0.8, -2)
      .multiply(new THREE.Matrix4().makeScale(scale, scale, scale))
      .multiply(new THREE.Matrix4().makeRotationX(-Math.PI / 2))
      .multiply(new THREE.Matrix4().makeTranslation(-centre.x, -centre.y, -box.min.z));
    this.world.matrixWorldNeedsUpdate = true;
  }

  private draw(): void {
    if (!this.renderer.xr.isPresenting) this.controls.update();
    this.renderer.render(this.scene, this.camera);
    this.frames += 1;
    const now = performance.now();
    if (now - this.since > 1000) {
      this.frames_per_s = (1000 * this.frames) / (now - this.since);
      this.frames = 0;
      this.since = now;
    }
  }

  private resize(): void {
    const { clientWidth: w, clientHeight: h } = this.host;
    if (!w || !h) return;
    this.camera.aspect = w / h;
    this.camera.updateProjectionMatrix();
    this.renderer.setSize(w, h);
  }
}

/** A pyramid along z with a mark at its upper (minus y) side. */
function frustumLines(): THREE.Vector3[] {
  const corners = [
    [-0.6, -0.4], [0.6, -0.4], [0.6, 0.4], [-0.6, 0.4],
  ].map(([x, y]) => new THREE.Vector3(x, y, 1));
  const out: THREE.Vector3[] = [];
  corners.forEach((corner, i) => {
    out.push(new THREE.Vector3(), corner, corner, corners[(i + 1) % 4]!);
  });
  const mark = [new THREE.Vector3(-0.2, -0.42, 1), new THREE.Vector3(0, -0.62, 1)];
  out.push(mark[0]!, mark[1]!, mark[1]!, new THREE.Vector3(0.2, -0.42, 1));
  return out;
}
