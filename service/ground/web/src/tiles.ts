// A finished scan as 3D Tiles: detail comes and goes with the distance.

import * as THREE from "three";
import { TilesRenderer } from "3d-tiles-renderer/three";
import type { Origin } from "./api";
import { eastNorthUp } from "./globe";
import type { Stage } from "./stage";

/** Their colours are sRGB, while three.js takes them as linear: too bright. */
function linearColours(shader: { vertexShader: string }): void {
  const linear = "vColor.rgb = mix(vColor.rgb / 12.92, pow((vColor.rgb + 0.055) / 1.055, vec3(2.4)), step(0.04045, vColor.rgb));";
  shader.vertexShader = shader.vertexShader.replace("#include <color_vertex>", `#include <color_vertex>\n${linear}`);
}

/** Puts the tiles at `address` into the stage, on the scan's own axes; returns what removes them. */
export function showTiles(stage: Stage, address: string, origin: Origin, pointSize: () => number): () => void {
  const tiles = new TilesRenderer(address);
  tiles.errorTarget = 4;
  tiles.setCamera(stage.camera);
  tiles.setResolutionFromRenderer(stage.camera, stage.renderer);
  tiles.addEventListener("load-model", ({ scene }: { scene: THREE.Object3D }) => {
    stage.touch();
    scene.traverse((node) => {
      if (!(node instanceof THREE.Points)) return;
      node.material.onBeforeCompile = linearColours;
      node.material.size = pointSize();
      node.material.sizeAttenuation = false;
      document.body.dataset["tiles"] = String(Number(document.body.dataset["tiles"] ?? 0) + 1);
    });
  });
  const place = new THREE.Group();
  place.applyMatrix4(eastNorthUp(origin).invert());
  place.add(tiles.group);
  stage.model.add(place);
  const update = (): void => {
    stage.camera.updateMatrixWorld();
    tiles.update();
    const box = new THREE.Box3();
    if (!document.body.dataset["tilesMiddle"] && tiles.loadProgress === 1 && !box.setFromObject(tiles.group).isEmpty())
      document.body.dataset["tilesMiddle"] = JSON.stringify(box.getCenter(new THREE.Vector3()).toArray());
  };
  for (const name of ["needs-update", "needs-render", "load-tileset"] as const)
    tiles.addEventListener(name, stage.touch);
  const loading = setInterval(() => tiles.loadProgress < 1 && stage.touch(), 300);
  stage.before.push(update);
  return () => {
    stage.before.splice(stage.before.indexOf(update), 1);
    clearInterval(loading);
    stage.model.remove(place);
    tiles.dispose();
    delete document.body.dataset["tiles"];
    delete document.body.dataset["tilesMiddle"];
  };
}
