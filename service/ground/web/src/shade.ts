// The colour that a place of the map is shown in: the camera's own, or that of a figure.

import { CHANGE } from "./before";

export const COLOURS = ["colour", "height", "sigma", "views", "age", "scan", "change"] as const;
export type Colour = (typeof COLOURS)[number];

/** GLSL: MODE, which a shader is compiled for, is this colour: software rendering computes every branch that it holds. */
export const shows = (colour: Colour): string => `MODE == ${COLOURS.indexOf(colour)}`;

/** GLSL: the colour that a place is shown in; linear, as `rgb`. */
export const SHADE = /* glsl */ `
  uniform vec2 range;
  uniform float age;
  uniform vec3 part;
  uniform vec3 higher, lower, same, unseen;
  ${CHANGE}
  vec3 linear(vec3 s) {
    return mix(s / 12.92, pow((s + 0.055) / 1.055, vec3(2.4)), step(0.04045, s));
  }
  vec3 ramp(float t) {
    t = clamp(t, 0.0, 1.0);
    vec3 low = mix(vec3(0.27, 0.0, 0.33), vec3(0.13, 0.57, 0.55), min(2.0 * t, 1.0));
    return linear(mix(low, vec3(0.99, 0.91, 0.14), max(2.0 * t - 1.0, 0.0)));
  }
  float gray(vec3 rgb) {
    return pow(max(dot(rgb, vec3(0.21, 0.72, 0.07)), 0.0), 0.4545);
  }
  vec3 shade(vec3 world, vec3 rgb, float sigma_m, float views) {
    #if ${shows("height")}
      return ramp((world.z - range.x) / max(range.y - range.x, 0.01));
    #elif ${shows("sigma")}
      return ramp(sigma_m / max(range.y, 0.01));
    #elif ${shows("views")}
      return ramp(views / 8.0);
    #elif ${shows("age")}
      return ramp(age);
    #elif ${shows("scan")}
      return part * (0.3 + 0.7 * gray(rgb));
    #elif ${shows("change")}
      float d = change(world, 0.15 + 3.0 * sigma_m);
      vec3 kind = d > 1e8 ? unseen : mix(same, d > 0.0 ? higher : lower, min(abs(d) / 0.3, 1.0));
      return kind * (0.4 + 0.6 * gray(rgb));
    #else
      return rgb;
    #endif
  }
`;
