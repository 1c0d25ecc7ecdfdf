// A finished scan as 3D Tiles: detail comes and goes with the distance.

import * as THREE from "three";
import { TilesRenderer } from "3d-tiles-renderer/three";
import type { Origin } from "./api";
import type { Stage } from "./stage";

const A = 6378137.0; // WGS 84
const E2 = 6.69437999014e-3;

/** East, north, up at the origin to earth-centred metres. */
export function eastNorthUp(origin: Origin): THREE.Matrix4 {
  const lat = THREE.MathUtils.degToRad(origin.lat_deg);
  const lon = THREE.MathUtils.degToRad(origin.lon_deg);
  const [sa, ca, so, co] = [Math.sin(lat), Math.cos(lat), Math.sin(lon), Math.cos(lon)];
  const n = A / Math.sqrt(1 - E2 * sa * sa);
  const h = origin.alt_amsl_m;
  return new THREE.Matrix4().set(
    -so, -sa * co, ca * co, (n + h) * ca * co,
    co, -sa * so, ca * so, (n + h) * ca * so,
    0, ca, sa, (n * (1 - E2) + h) * sa,
    0, 0, 0, 1,
  );
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
    if (!document.body.dataset["tilesMiddle"] && !box.setFromObject(tiles.group).isEmpty())
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
