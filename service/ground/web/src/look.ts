// Bloom and depth of field over the plain frame, for those whose graphics card has the time.

import * as THREE from "three";
import { BokehPass } from "three/addons/postprocessing/BokehPass.js";
import { EffectComposer } from "three/addons/postprocessing/EffectComposer.js";
import { OutputPass } from "three/addons/postprocessing/OutputPass.js";
import { RenderPass } from "three/addons/postprocessing/RenderPass.js";
import { UnrealBloomPass } from "three/addons/postprocessing/UnrealBloomPass.js";
import type { Effects } from "./painter";

export class Look implements Effects {
  private readonly composer: EffectComposer;
  private readonly focus: BokehPass;

  /** Effects over `scene`, sharpest at the distance of `target`. */
  constructor(
    renderer: THREE.WebGLRenderer,
    scene: THREE.Scene,
    private readonly camera: THREE.PerspectiveCamera,
    private readonly target: THREE.Vector3,
    bloom: boolean,
    depthOfField: boolean,
    isLight: boolean,
  ) {
    const size = renderer.getSize(new THREE.Vector2());
    this.composer = new EffectComposer(renderer);
    this.composer.addPass(new RenderPass(scene, camera));
    this.focus = new BokehPass(scene, camera, { focus: 100, aperture: 2e-5, maxblur: 0.008 });
    this.focus.enabled = depthOfField;
    this.composer.addPass(this.focus);
    if (bloom) this.composer.addPass(new UnrealBloomPass(size, 0.25, 0.4, isLight ? 1 : 0.7)); // a light sky would shine over all
    this.composer.addPass(new OutputPass());
  }

  render(): void {
    const uniforms = this.focus.uniforms as Record<string, THREE.IUniform>;
    uniforms["focus"]!.value = this.camera.position.distanceTo(this.target);
    this.composer.render();
  }

  resize(w: number, h: number): void {
    this.composer.setSize(w, h);
  }

  close(): void {
    this.composer.dispose();
  }
}
