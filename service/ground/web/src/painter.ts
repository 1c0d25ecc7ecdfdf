// When and how much is drawn: little while the view moves, then the rest slice by slice, so that
// no frame takes long and the page stays usable however many points there are.

import * as THREE from "three";
import { Dome } from "./dome";

/** A part of the scene of which any share can be drawn. */
export interface Gradual {
  /** How many points there are to draw. */
  readonly wanted: number;
  /** Each range adds to what the frame shows; else each draws the whole, and a larger one finer. */
  readonly isAdditive: boolean;
  /** The last range did not show all it asked for: it has to be drawn again. */
  readonly isUnbuilt: boolean;
  /** Draws the points between two shares, 0 to 1; `whole` when the others follow. */
  range(from: number, to: number, whole: boolean): void;
}

/** What lays effects over the plain frame; it draws the whole frame at once. */
export interface Effects {
  render(): void;
  resize(w: number, h: number): void;
  close(): void;
}

const MOVING_MS = 70;
const NEWS_TIMES = 3; // as long for a frame that shows news, while no hand turns the view
const SLICE_MS = 90;
const FIRST_POINTS = 100_000;
const FINER = 4; // times the triangles of the frame before, once the view rests
const MAKING_TIMES = 4; // as long as drawing them surfaces are made before they are drawn again
const UNBUILT = 0.99; // of the frame is shown while some of it is still to be made
const MIN_POINTS = 20_000;
const MAX_SLICES = 64; // showing a slice takes its time however few the points
const SHOWN_FROM = 0.5; // of the points; until then the last, thinned frame with large points stays
const BLURRED = [1, 0.75, 0.5]; // of the screen's pixels along each side, while surfaces move
const EFFECTS_TIMES = 3; // of the points drawn while moving, once the view stands still

/** Work given to the graphics card, until it has done it. */
interface Work {
  sync: WebGLSync | null;
  since: number;
  kind: "whole" | "slice" | "finer";
}

export class Painter {
  /** Draw all points in every frame, however long it takes. */
  fullDetail = false;
  /** Draw with all pixels of the screen in every frame. */
  isFilmed = false;
  effects: Effects | null = null;
  frames_per_s = 0;
  /** Share of the points that the frame shows so far. */
  shown = 0;
  /** The frame shows what is no more: it is drawn again, at the next tick or when the graphics card is done. */
  stale = true;
  gradual: Gradual | null = null;
  /** The view is being moved by hand: frames have to follow each other fast. */
  hasty = false;
  readonly dome = new Dome();
  /** Objects drawn with every slice; all others are in the first frame only. */
  readonly again = new Set<THREE.Object3D>();
  private moving = FIRST_POINTS;
  private slice = FIRST_POINTS;
  private blur = 0; // in BLURRED
  private ratio = 0; // pixels of the screen for one of the page, when sharp
  private finer = 0; // share of the surfaces' triangles in the frame
  private finer_ms = 0; // that the last finer frame took
  private finerAt = 0;
  private work: Work | null = null;
  private settled = false;

  constructor(
    private readonly renderer: THREE.WebGLRenderer,
    private readonly scene: THREE.Scene,
    private readonly camera: THREE.PerspectiveCamera,
    private readonly world: THREE.Group,
  ) {}

  /** True when the frame is whole and nothing is being drawn. */
  get still(): boolean {
    return this.settled && this.shown >= 1 && !this.work && !this.stale;
  }

  /**
   * One tick: a new frame when something changed; once the scene rests, the whole frame unless
   * it is that already, slice by slice.
   * Nothing is given to the graphics card before it has done what it was given.
   */
  tick(now: number, resting: boolean, before: readonly (() => void)[]): void {
    const presenting = this.renderer.xr.isPresenting;
    if (!presenting && this.work && !this.done(this.work, now)) return;
    if (presenting && this.work) this.paced(this.work, now);
    this.work = null;
    if (this.stale) {
      this.stale = false;
      this.frame(now, false, before);
    } else if (resting && !this.settled) this.frame(now, true, before);
    else if (resting && this.shown < 1) this.addSlice(now);
  }

  private frame(now: number, still: boolean, before: readonly (() => void)[]): void {
    const isSharp = this.sharpen(still);
    for (const call of before) call();
    this.whole(still);
    this.settled = still || (isSharp && this.shown >= 1);
    this.give("whole", now);
  }

  /** Sets how many pixels the frame has; true when it has all. */
  private sharpen(still: boolean): boolean {
    this.ratio ||= this.renderer.getPixelRatio();
    const isWhole = still || this.fullDetail || this.isFilmed || this.effects !== null || this.renderer.xr.isPresenting || this.gradual?.isAdditive;
    const share = isWhole ? 1 : BLURRED[this.blur]!;
    if (this.renderer.getPixelRatio() !== this.ratio * share) this.renderer.setPixelRatio(this.ratio * share);
    return share === 1;
  }

  /** As many points may a frame have as while the view is moved. */
  private get times(): number {
    return this.hasty || this.gradual?.isAdditive ? 1 : NEWS_TIMES;
  }

  /** Draws the frame again; when the view stands still, slices follow unless effects lie over it. */
  private whole(still: boolean): void {
    const wanted = Math.max(1, this.gradual?.wanted ?? 0);
    const last = still && this.effects !== null;
    const points = last ? EFFECTS_TIMES * this.moving : this.times * this.moving;
    const share = this.fullDetail ? 1 : Math.min(1, points / wanted);
    this.finer = share;
    this.gradual?.range(0, share, still && !last);
    if (this.renderer.xr.isPresenting) this.renderer.render(this.scene, this.camera);
    else if (this.effects) this.effects.render();
    else this.dome.render(this.renderer, this.scene, this.camera, true, !still || share > SHOWN_FROM || !this.gradual?.isAdditive);
    this.shown = last || !this.gradual?.wanted ? 1 : this.gradual.isUnbuilt ? Math.min(share, UNBUILT) : share;
  }

  /** Draws the next slice of the points over the frame there is. */
  private addSlice(now: number): void {
    const gradual = this.gradual;
    if (!gradual) return;
    if (!gradual.isAdditive) {
      const share = gradual.isUnbuilt ? Math.max(this.shown, this.finer) : Math.min(1, FINER * Math.max(this.shown, this.finer));
      this.finer = share;
      gradual.range(0, share, true);
      if (gradual.isUnbuilt && now - this.finerAt < MAKING_TIMES * this.finer_ms) return; // the next tick makes more
      this.finerAt = now;
      this.dome.render(this.renderer, this.scene, this.camera, true, true);
      this.shown = gradual.isUnbuilt ? Math.min(share, UNBUILT) : share;
      return this.give("finer", now);
    }
    const next = Math.min(1, this.shown + this.slice / Math.max(1, gradual.wanted));
    gradual.range(this.shown, next, true);
    const hidden = this.world.children.filter((c) => c.visible && !this.again.has(c));
    const background = this.scene.background;
    for (const object of hidden) object.visible = false;
    this.scene.background = null;
    this.dome.render(this.renderer, this.scene, this.camera, false, next > SHOWN_FROM);
    this.scene.background = background;
    for (const object of hidden) object.visible = true;
    gradual.range(0, next, true); // for the figures
    this.shown = next;
    this.give("slice", now);
  }

  private give(kind: Work["kind"], now: number): void {
    const gl = this.renderer.getContext() as WebGL2RenderingContext;
    const sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    this.work = { sync, since: now, kind };
  }

  /** True when the graphics card has done the work; takes its time into account. */
  private done(work: Work, now: number): boolean {
    const gl = this.renderer.getContext() as WebGL2RenderingContext;
    if (work.sync) {
      if (gl.clientWaitSync(work.sync, 0, 0) === gl.TIMEOUT_EXPIRED) return false;
      gl.deleteSync(work.sync);
    }
    this.paced(work, now);
    return true;
  }

  /** Fits the number of points to the time that the last ones took. */
  private paced(work: Work, now: number): void {
    const ms = Math.max(now - work.since, 1);
    if (work.kind === "finer") {
      this.finer_ms = ms;
      return;
    }
    if (work.kind === "slice") {
      const least = Math.max(MIN_POINTS, (this.gradual?.wanted ?? 0) / MAX_SLICES);
      this.slice = Math.max(least, this.slice * Math.min(Math.max(SLICE_MS / ms, 0.25), 1.2));
      return;
    }
    this.frames_per_s = 1000 / ms;
    const most = Math.max(this.gradual?.wanted ?? 0, FIRST_POINTS);
    const fits = (this.times * MOVING_MS) / ms;
    const change = Math.min(Math.max(fits, 0.5), 1.2);
    if (fits < 0.7) this.blur = Math.min(this.blur + 1, BLURRED.length - 1);
    else if (fits > 3) this.blur = Math.max(this.blur - 1, 0);
    this.moving = Math.min(Math.max(this.moving * change, MIN_POINTS), most);
  }
}
