// Bloom and depth of field over the plain frame, for those whose graphics card has the time.

import * as THREE from "three";
import { EffectComposer } from "three/addons/postprocessing/EffectComposer.js";
import { OutputPass } from "three/addons/postprocessing/OutputPass.js";
import { Pass } from "three/addons/postprocessing/Pass.js";
import { ShaderPass } from "three/addons/postprocessing/ShaderPass.js";
import { UnrealBloomPass } from "three/addons/postprocessing/UnrealBloomPass.js";
import { BokehShader } from "three/addons/shaders/BokehShader.js";
import type { Dome } from "./dome";
import type { Effects } from "./painter";

export class Look implements Effects {
  private readonly composer: EffectComposer;
  private readonly focus = new ShaderPass({ ...BokehShader, defines: { ...BokehShader.defines, DEPTH_PACKING: 0 } }, "tColor");

  /** Effects over `scene` as `dome` shows it, sharpest at the distance of `target`. */
  constructor(
    renderer: THREE.WebGLRenderer,
    private readonly dome: Dome,
    scene: THREE.Scene,
    private readonly camera: THREE.PerspectiveCamera,
    private readonly target: THREE.Vector3,
    bloom: boolean,
    depthOfField: boolean,
    isLight: boolean,
  ) {
    const size = renderer.getSize(new THREE.Vector2());
    this.composer = new EffectComposer(renderer);
    const plain = new Pass();
    plain.needsSwap = false;
    plain.render = (_, __, into) => dome.render(renderer, scene, camera, true, true, into);
    this.composer.addPass(plain);
    this.focus.enabled = depthOfField;
    this.composer.addPass(this.focus);
    if (bloom) this.composer.addPass(new UnrealBloomPass(size, 0.25, 0.4, isLight ? 1 : 0.7)); // a light sky would shine over all
    this.composer.addPass(new OutputPass());
  }

  render(): void {
    const { camera, dome, target } = this;
    const values = { focus: camera.position.distanceTo(target), aspect: camera.aspect, aperture: 2e-5, maxblur: 0.008, nearClip: camera.near, farClip: camera.far, tDepth: dome.depth };
    for (const [name, value] of Object.entries(values)) this.focus.uniforms[name]!.value = value;
    this.composer.render();
  }

  resize(w: number, h: number): void {
    this.composer.setSize(w, h);
  }

  close(): void {
    this.composer.dispose();
  }
}
