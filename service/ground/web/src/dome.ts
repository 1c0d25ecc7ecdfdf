// Eye-dome lighting: the scene is drawn into a target with its depth, and what stands behind its
// neighbours is shaded (Boucheny 2009). So a cloud without normals looks like a surface. And exposure.

import * as THREE from "three";

const FRAGMENT = /* glsl */ `
  uniform sampler2D colour;
  uniform highp sampler2D depth;
  uniform vec2 pixel;
  uniform vec2 planes;
  uniform float strength;
  uniform float shading;
  uniform float gain;
  varying vec2 place;

  uniform float behind;

  float metres(vec2 at) {
    float d = texture2D(depth, at).x;
    return planes.x * planes.y / (planes.y - d * (planes.y - planes.x));
  }
  float far(vec2 at) {
    return log2(metres(at));
  }
  void main() {
    vec4 found = texture2D(colour, place); // alpha: 1 where it is measured
    vec3 seen = found.rgb;
    if (texture2D(depth, place).x < 1.0) {
      float here = log2(max(metres(place) - behind * (1.0 - found.a), planes.x));
      float sum = max(0.0, here - far(place + vec2(pixel.x, 0.0)))
        + max(0.0, here - far(place - vec2(pixel.x, 0.0)))
        + max(0.0, here - far(place + vec2(0.0, pixel.y)))
        + max(0.0, here - far(place - vec2(0.0, pixel.y)));
      seen *= mix(1.0, max(0.35, exp(-strength * sum)), shading);
    }
    gl_FragColor = vec4(gain * seen, 1.0);
    #include <tonemapping_fragment>
    #include <colorspace_fragment>
  }
`;
const RADIUS_PX = 1.5;
const STRENGTH = 12;

export class Dome {
  /** 1 is usual, 0 switches it off. */
  strength = 1;
  /** Share of it that the present colours get. */
  shading = 1;
  /** What all that is drawn is multiplied with, but for the sky. */
  gain = 1;
  /** Metres by which what is not measured was drawn behind. */
  behind = 0;
  private readonly target = new THREE.WebGLRenderTarget(1, 1, {
    type: THREE.HalfFloatType,
    depthTexture: new THREE.DepthTexture(1, 1, THREE.UnsignedIntType),
  });
  private readonly uniforms = {
    colour: { value: this.target.texture },
    depth: { value: this.depth },
    pixel: { value: new THREE.Vector2() },
    planes: { value: new THREE.Vector2() },
    strength: { value: 0 },
    shading: { value: 1 },
    gain: { value: 1 },
    behind: { value: 0 },
  };
  private readonly sheet = new THREE.Mesh(
    new THREE.PlaneGeometry(2, 2),
    new THREE.ShaderMaterial({
      vertexShader: "varying vec2 place; void main() { place = uv; gl_Position = vec4(position.xy, 0.0, 1.0); }",
      fragmentShader: FRAGMENT,
      uniforms: this.uniforms,
      depthTest: false,
      depthWrite: false,
    }),
  );
  private readonly flat = new THREE.OrthographicCamera(-1, 1, 1, -1, 0, 1);

  constructor() {
    this.sheet.frustumCulled = false;
  }

  /** Depth of what was drawn last. */
  get depth(): THREE.DepthTexture {
    return this.target.depthTexture!;
  }

  /** Draws the scene, over what was drawn before unless `clear`; shows it when `show`, on the screen or `into` a target. */
  render(
    renderer: THREE.WebGLRenderer, scene: THREE.Scene, camera: THREE.PerspectiveCamera,
    clear: boolean, show: boolean, into: THREE.WebGLRenderTarget | null = null,
  ): void {
    const size = renderer.getDrawingBufferSize(new THREE.Vector2());
    if (size.x !== this.target.width || size.y !== this.target.height) this.target.setSize(size.x, size.y);
    renderer.setRenderTarget(this.target);
    renderer.autoClear = clear;
    scene.backgroundIntensity = 1 / this.gain; // soft splats leave no depth that sets them apart from the sky
    renderer.render(scene, camera);
    scene.backgroundIntensity = 1;
    renderer.setRenderTarget(into);
    renderer.autoClear = true;
    if (!show) return;
    const radius = RADIUS_PX * renderer.getPixelRatio();
    this.uniforms.pixel.value.set(radius / size.x, radius / size.y);
    this.uniforms.planes.value.set(camera.near, camera.far);
    this.uniforms.strength.value = this.strength * STRENGTH;
    this.uniforms.shading.value = this.shading;
    this.uniforms.gain.value = this.gain;
    this.uniforms.behind.value = this.behind;
    renderer.render(this.sheet, this.flat);
  }

  close(): void {
    this.target.dispose();
    this.sheet.geometry.dispose();
    this.sheet.material.dispose();
  }
}
