// The scene around the cloud: renderer, camera, track, cameras flown, mesh, tiles, VR.

import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { VRButton } from "three/addons/webxr/VRButton.js";
import { type Gradual, Painter } from "./painter";
import { type Card, sharpen } from "./surface";

/** Sky above, ground below the horizon. */
const DARK = ["#243648", "#465a6b", "#2b3036", "#171b20"];
const LIGHT = ["#c6dcf3", "#f3f8fd", "#ffffff", "#f1f1ee"];
const INPUTS = ["click", "input", "change"];
// Until then a part of many points is drawn: after a movement, after other news.
const MOVED_MS = 250;
const NEWS_MS = 500;
const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i; // names of cards that are none
const LOWEST = Math.PI / 2; // the eye is not turned below what it looks at: the ground has no other side
const MARGIN = 0.92; // of the scene that is filled
const OUTLINE_POINTS = 1000;

/** False when this browser cannot draw in 3D. */
export function canDraw(): boolean {
  try {
    return document.createElement("canvas").getContext("webgl2") !== null;
  } catch {
    return false;
  }
}

export class Stage {
  readonly renderer = new THREE.WebGLRenderer({
    powerPreference: "high-performance",
    preserveDrawingBuffer: true, // nothing is drawn while nothing changes
  });
  readonly scene = new THREE.Scene();
  readonly camera = new THREE.PerspectiveCamera(60, 1, 0.1, 20000);
  readonly controls: OrbitControls;
  readonly model = new THREE.Group();
  follow = true;
  isLight = false;
  readonly painter: Painter;
  /** Called before each frame. */
  readonly before: (() => void)[] = [];
  private readonly world = new THREE.Group(); // what VR shrinks and lays at one's feet
  private readonly track = new THREE.Line(
    new THREE.BufferGeometry(),
    new THREE.LineBasicMaterial({ color: 0xff6b4a }),
  );
  private readonly watcher: ResizeObserver;
  private rests = 0; // from this time on
  private moved = 0; // by hand, until then
  private ticking = false;
  private closed = false; // what is still loading may come later
  private unload: () => void = () => undefined;
  private framed = false; // the view is still that of frame()
  private readonly keys = new Set<string>();
  private last = performance.now();

  constructor(private readonly host: HTMLElement) {
    this.camera.up.set(0, 0, 1);
    this.camera.position.set(0, -120, 90);
    this.controls = new OrbitControls(this.camera, this.renderer.domElement);
    this.controls.maxPolarAngle = LOWEST;
    this.controls.addEventListener("start", () => {
      if (this.follow) this.touch();
      this.follow = this.framed = false;
    });
    this.controls.addEventListener("change", () => this.changed(MOVED_MS, !this.follow));
    this.track.frustumCulled = false;
    this.world.add(this.track, this.model);
    this.scene.add(this.world, new THREE.AmbientLight(0xffffff, Math.PI));
    this.painter = new Painter(this.renderer, this.scene, this.camera, this.world);
    this.light(false);
    host.append(this.renderer.domElement);
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.xr.enabled = true;
    this.watcher = new ResizeObserver(() => this.resize());
    this.watcher.observe(host);
    this.resize();
    addEventListener("keydown", this.press);
    addEventListener("keyup", this.release);
    for (const name of INPUTS) addEventListener(name, this.input);
  }

  /** A light or a dark background. */
  light(on: boolean): void {
    this.isLight = on;
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [1, 256];
    const paint = canvas.getContext("2d")!;
    const ramp = paint.createLinearGradient(0, 0, 0, 256);
    (on ? LIGHT : DARK).forEach((colour, k) => ramp.addColorStop([0, 0.42, 0.5, 1][k]!, colour));
    paint.fillStyle = ramp;
    paint.fillRect(0, 0, 1, 256);
    const texture = new THREE.CanvasTexture(canvas);
    texture.colorSpace = THREE.SRGBColorSpace;
    (this.scene.background as THREE.Texture | null)?.dispose();
    this.scene.background = texture;
    this.touch();
  }

  /** What draws here. */
  get card(): Card {
    const gl = this.renderer.getContext();
    const name = String(gl.getParameter(gl.getExtension("WEBGL_debug_renderer_info")?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER));
    return { software: SOFTWARE.test(name), anisotropy: this.renderer.capabilities.getMaxAnisotropy() };
  }

  add(object: THREE.Object3D): void {
    this.world.add(object);
  }

  /** Adds an object that is drawn with every slice of the points. */
  addAgain(object: THREE.Object3D): void {
    this.world.add(object);
    this.painter.again.add(object);
  }

  /** The points that are drawn bit by bit; their object is added by `addAgain`. */
  drawGradually(points: Gradual): void {
    this.painter.gradual = points;
  }

  close(): void {
    removeEventListener("keydown", this.press);
    removeEventListener("keyup", this.release);
    for (const name of INPUTS) removeEventListener(name, this.input);
    this.tick(false);
    this.closed = true;
    this.unload();
    this.watcher.disconnect();
    this.controls.dispose();
    this.painter.dome.close();
    this.renderer.dispose();
  }

  setTrack(track: [number, number, number][]): void {
    this.track.geometry.dispose();
    this.track.geometry = new THREE.BufferGeometry().setFromPoints(
      track.map(([x, y, z]) => new THREE.Vector3(x, y, z)),
    );
  }

  /** Moves the track as a whole. */
  moveTrack(T: THREE.Matrix4): void {
    T.decompose(this.track.position, this.track.quaternion, this.track.scale);
    this.touch();
  }

  /** In follow mode the view goes along with the camera at T, which looks `reach` metres far. */
  goAlong(T: number[], reach: number): void {
    if (!this.follow) return;
    this.framed = false;
    const eye = new THREE.Vector3().setFromMatrixPosition(new THREE.Matrix4().fromArray(T));
    const axis = new THREE.Vector3(T[8], T[9], T[10]);
    const looked = eye.clone().addScaledVector(axis, reach);
    const offset = this.camera.position.clone().sub(this.controls.target);
    if (offset.length() > 4 * reach || offset.length() < 0.3 * reach) offset.setLength(2 * reach);
    this.controls.target.copy(looked);
    this.camera.position.copy(looked).add(offset);
  }

  /** Turns about a place from now on; the view keeps its direction and distance. */
  lookAt(point: THREE.Vector3): void {
    this.follow = this.framed = false;
    this.camera.position.add(point).sub(this.controls.target);
    this.controls.target.copy(point);
    this.touch();
  }

  /** Looks at all points from the south and above, as close as the time slider leaves room, also
   * after the scene changes its size. */
  frame(): void {
    const points = this.outline();
    if (!points.length) return;
    const box = new THREE.Box3().setFromPoints(points);
    const reach = Math.max(box.getSize(new THREE.Vector3()).length(), 1);
    const back = new THREE.Vector3(0, -0.65, 0.76).normalize();
    const right = new THREE.Vector3().crossVectors(this.camera.up, back).normalize();
    const up = new THREE.Vector3().crossVectors(back, right);
    const high = MARGIN * Math.tan(THREE.MathUtils.degToRad(this.camera.fov / 2));
    const low = high * Math.max(0.1, 1 - (2 * this.covered()) / (this.host.clientHeight || 1)); // a keyboard leaves little
    const wide = high * this.camera.aspect;
    // From (x, y, d) along right, up and back all are in sight if d is at least each of these, less or plus x or y.
    const least = (x: number, y: number): number => points.reduce((d, p) => Math.max(d, p.dot(back) + x * p.dot(right) + y * p.dot(up)), -Infinity);
    const [east, west, top, bottom] = [least(1 / wide, 0), least(-1 / wide, 0), least(0, 1 / high), least(0, -1 / low)];
    const d = Math.max((east + west) / 2, (high * top + low * bottom) / (high + low), least(0, 0) + reach / 100);
    const y = ((top - d) * high + (d - bottom) * low) / 2;
    const axis = right.multiplyScalar((wide * (east - west)) / 2).addScaledVector(up, y);
    const middle = box.getCenter(new THREE.Vector3()).dot(back);
    this.controls.target.copy(axis).addScaledVector(back, middle);
    this.camera.position.copy(axis).addScaledVector(back, d);
    this.camera.near = reach / 2000;
    this.camera.far = reach * 20;
    this.camera.updateProjectionMatrix();
    this.framed = true;
  }

  /** Some of the points of each keyframe, which are shuffled. */
  private outline(): THREE.Vector3[] {
    const found: THREE.Vector3[] = [];
    for (const object of this.painter.again)
      object.traverse((node) => {
        if (!(node instanceof THREE.Points)) return;
        const xyz = (node as THREE.Points).geometry.getAttribute("position");
        for (let i = 0; i < Math.min(xyz.count, OUTLINE_POINTS); i++)
          found.push(new THREE.Vector3().fromBufferAttribute(xyz, i).applyMatrix4(node.matrixWorld));
      });
    return found;
  }

  /** How much of the scene's lower end the time slider covers, pixels. */
  private covered(): number {
    const slider = this.host.querySelector<HTMLElement>(".time");
    return slider?.offsetParent ? this.host.clientHeight - slider.offsetTop : 0;
  }

  fieldOfView(degrees: number): void {
    this.camera.fov = degrees;
    this.camera.updateProjectionMatrix();
  }

  /** Removes the product shown before; `remove` is called when another takes its place, or at the end. */
  shows(remove: () => void): void {
    this.unload();
    this.unload = remove;
    if (this.closed) remove();
  }

  /** Shows a mesh made by skyrelief: glTF with y up, turned back to z up. Returns what removes it. */
  async load(address: string): Promise<() => void> {
    const { scene } = await new GLTFLoader().loadAsync(address);
    scene.rotation.x = Math.PI / 2;
    const { card } = this;
    scene.traverse((node) => {
      const map = node instanceof THREE.Mesh && (node.material as THREE.MeshStandardMaterial).map;
      if (map) sharpen(map, card);
    });
    this.model.add(scene);
    this.touch();
    return () => void this.model.remove(scene);
  }

  /** The button that enters VR, or null where the browser has no WebXR. */
  async vr(): Promise<HTMLElement | null> {
    const offered = await navigator.xr?.isSessionSupported("immersive-vr").catch(() => false);
    if (!offered) return null;
    this.renderer.xr.addEventListener("sessionstart", () => (this.layAtFeet(), this.touch()));
    this.renderer.xr.addEventListener("sessionend", () => (this.world.matrix.identity(), this.touch()));
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

  /** Something changed that is to be seen: the next tick draws a frame. */
  readonly touch = (): void => this.changed(NEWS_MS);

  private changed(busy_ms: number, byHand = false): void {
    if (byHand) this.moved = performance.now() + busy_ms;
    document.body.dataset["still"] = "no";
    this.painter.stale = true;
    this.rests = Math.max(this.rests, performance.now() + busy_ms);
    this.tick(true);
  }

  /** Ticks at the pace of the screen, or of the headset, or not at all. */
  private tick(on: boolean): void {
    if (on === this.ticking || this.closed) return;
    this.ticking = on;
    this.last = performance.now();
    this.renderer.setAnimationLoop(on ? () => this.draw() : null);
  }

  /** One tick; the last one when all is drawn and nothing changes. */
  private draw(): void {
    const now = performance.now();
    const presenting = this.renderer.xr.isPresenting;
    if (!presenting) {
      if (this.fly((now - this.last) / 1000)) this.changed(MOVED_MS, true);
      this.controls.update();
    }
    this.last = now;
    if (presenting) this.painter.stale = true;
    this.painter.hasty = now < this.moved;
    this.painter.tick(now, now >= this.rests, this.before);
    const still = this.painter.still ? "yes" : "no";
    if (document.body.dataset["still"] !== still) document.body.dataset["still"] = still;
    if (this.painter.still && !presenting) this.tick(false);
  }

  /** W A S D fly over the ground, R and F up and down; faster the farther one looks. */
  private fly(seconds: number): boolean {
    if (!this.keys.size) return false;
    const has = (key: string): number => (this.keys.has(key) ? 1 : 0);
    const gaze = this.controls.target.clone().sub(this.camera.position);
    const step = gaze.length() * Math.min(seconds, 0.1);
    const ahead = gaze.setZ(0).normalize();
    const right = new THREE.Vector3().crossVectors(ahead, this.camera.up);
    const move = ahead.multiplyScalar(has("w") - has("s")).addScaledVector(right, has("d") - has("a"));
    move.z += has("r") - has("f");
    move.multiplyScalar(step);
    this.camera.position.add(move);
    this.controls.target.add(move);
    this.follow = this.framed = false;
    return true;
  }

  private readonly press = (event: KeyboardEvent): void => {
    const typing = event.target instanceof HTMLInputElement || event.target instanceof HTMLSelectElement;
    const key = event.key.toLowerCase();
    if (!typing && !event.ctrlKey && !event.metaKey && "wasdrf".includes(key)) {
      this.keys.add(key);
      this.changed(MOVED_MS);
    }
  };

  private readonly release = (event: KeyboardEvent): void => {
    this.keys.delete(event.key.toLowerCase());
  };

  /** Any control may change what is seen; what a click on the scene changes, its own listeners say. */
  private readonly input = (event: Event): void => {
    if (event.target !== this.renderer.domElement) this.touch();
  };

  private resize(): void {
    const { clientWidth: w, clientHeight: h } = this.host;
    if (!w || !h) return;
    this.camera.aspect = w / h;
    this.camera.updateProjectionMatrix();
    this.renderer.setSize(w, h);
    this.painter.effects?.resize(w, h);
    if (this.framed) this.frame();
    this.touch();
  }
}
