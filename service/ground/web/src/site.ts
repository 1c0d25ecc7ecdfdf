// A scan in flight among those that ties join it to: each is drawn where the ground station puts it.

import * as THREE from "three";
import * as api from "./api";
import type { Cameras } from "./cameras";
import { LiveView, type SiteNews } from "./live";
import { type Cloud, STRIDE } from "./points";
import type { Stage } from "./stage";
import * as units from "./units";

const MAX_OTHERS = 6; // a portal serves few live views

/** Places this scan's cloud, cameras and track, and adds the clouds of the others. */
export class SiteView {
  /** For the figures: ties and sigma; empty while no other scan is tied to this one. */
  words = "";
  readonly own = new THREE.Matrix4();
  private readonly others = new Map<string, LiveView>();

  constructor(private readonly stage: Stage, private readonly cloud: Cloud, private readonly cameras: Cameras) {}

  close(): void {
    for (const view of this.others.values()) view.close();
  }

  /** The last place stays when the ground station follows this scan no longer. */
  news({ scans }: SiteNews): void {
    const own = scans.find((s) => s.own);
    if (!own) return;
    this.own.fromArray(own.T);
    const [east, north, up] = own.sigma_m;
    this.words = own.ties ? `joined in ${own.ties} places, ${units.sigmas(Math.hypot(east, north), up)}` : "";
    this.cloud.move(0, own.T);
    this.cameras.move(this.own);
    this.stage.moveTrack(this.own);
    for (const scan of scans.filter((s) => !s.own)) {
      const name = `${scan.drone}/${scan.scan}`;
      if (!this.others.has(name) && this.others.size < MAX_OTHERS) this.others.set(name, this.open(scan, this.others.size + 1));
      const k = [...this.others.keys()].indexOf(name) + 1;
      if (k > 0) this.cloud.move(k, scan.T);
    }
    const names = [`${own.drone}/${own.scan}`, ...this.others.keys()];
    const earlier = scans.filter((s) => s.earlier).map((s) => names.indexOf(`${s.drone}/${s.scan}`));
    if (this.others.size) this.cloud.name(names, earlier.filter((k) => k > 0));
    document.body.dataset["ties"] = String(own.ties);
  }

  private open(scan: { drone: string; scan: string }, k: number): LiveView {
    return new LiveView(
      `${api.liveAddress(scan)}?layer=0`,
      (chunk) => {
        chunk.seq += k * STRIDE;
        this.cloud.add(chunk);
        this.stage.touch();
      },
      (item) => {
        if (item.type !== "repose") return;
        this.cloud.repose(item.seq + k * STRIDE, item.T, item.scale);
        this.stage.touch();
      },
      () => undefined,
    );
  }
}
