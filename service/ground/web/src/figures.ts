// What clicked places measure: lengths, slope, area, volume over a base plane, height profile.

import { Vector3 } from "three";

export type Points = (use: (x: number, y: number, z: number) => void) => void;

export interface Step {
  distance_m: number;
  level_m: number;
  height_m: number;
  slope_deg: number;
}

/** From the place before the last to the last. */
export function lastStep(places: Vector3[]): Step {
  const [a, b] = [places.at(-2)!, places.at(-1)!];
  const level_m = Math.hypot(b.x - a.x, b.y - a.y);
  const height_m = b.z - a.z;
  const slope_deg = (Math.atan2(height_m, level_m) * 180) / Math.PI;
  return { distance_m: a.distanceTo(b), level_m, height_m, slope_deg };
}

/** Length of the way through all places, m. */
export const along = (places: Vector3[]): number =>
  places.slice(1).reduce((sum, p, i) => sum + p.distanceTo(places[i]!), 0);

/** Area of the polygon seen from above, m². */
export function area(places: Vector3[]): number {
  const twice = places.reduce((sum, p, i) => {
    const q = places[(i + 1) % places.length]!;
    return sum + p.x * q.y - q.x * p.y;
  }, 0);
  return Math.abs(twice) / 2;
}

function inside(places: Vector3[], x: number, y: number): boolean {
  let odd = false;
  places.forEach((p, i) => {
    const q = places[(i + 1) % places.length]!;
    if (p.y > y !== q.y > y && x < ((q.x - p.x) * (y - p.y)) / (q.y - p.y) + p.x) odd = !odd;
  });
  return odd;
}

/** Height of the plane through the places by least squares; null when they lie on a line. */
export function basePlane(places: Vector3[]): ((x: number, y: number) => number) | null {
  const mean = places.reduce((s, p) => s.add(p), new Vector3()).divideScalar(places.length);
  let [xx, xy, yy, xz, yz] = [0, 0, 0, 0, 0];
  for (const p of places) {
    const d = p.clone().sub(mean);
    xx += d.x * d.x;
    xy += d.x * d.y;
    yy += d.y * d.y;
    xz += d.x * d.z;
    yz += d.y * d.z;
  }
  const det = xx * yy - xy * xy;
  if (!(det > 1e-6 * xx * yy)) return null;
  const [a, b] = [(xz * yy - yz * xy) / det, (yz * xx - xz * xy) / det];
  return (x, y) => mean.z + a * (x - mean.x) + b * (y - mean.y);
}

export interface Volume {
  above_m3: number;
  below_m3: number;
  /** Share of the area that no point shows. */
  unseen: number;
}

const POINTS_PER_CELL = 1.5; // about the points' distance: a point at a wall widens it by half a cell
const MAX_CELLS = 1_000_000;
const CORNER_CELLS = 5;

/**
 * Volume between the cloud and the plane through the corners; null where there are no points.
 *
 * A cell has the mean height of its points. A hole is filled from the lower side of its border:
 * what hides ground stands higher than the ground.
 */
export function volume(places: Vector3[], points: Points): Volume | null {
  const xs = places.map((p) => p.x), ys = places.map((p) => p.y);
  const [west, east, south, north] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const found: number[] = [];
  points((x, y, z) => {
    if (x >= west && x <= east && y >= south && y <= north) found.push(x, y, z);
  });
  const box = (east - west) * (north - south);
  const cell = Math.sqrt(box * Math.max((3 * POINTS_PER_CELL) / found.length, 1 / MAX_CELLS));
  const base = found.length ? basePlane(settled(places, points, CORNER_CELLS * cell)) : null;
  if (!base) return null;
  const cols = Math.ceil((east - west) / cell), rows = Math.ceil((north - south) / cell);
  const sum = new Float64Array(cols * rows), n = new Uint32Array(cols * rows);
  for (let i = 0; i < found.length; i += 3) {
    const col = Math.min(cols - 1, Math.floor((found[i]! - west) / cell));
    const row = Math.min(rows - 1, Math.floor((found[i + 1]! - south) / cell));
    sum[row * cols + col]! += found[i + 2]! - base(found[i]!, found[i + 1]!);
    n[row * cols + col]! += 1;
  }
  let heights: Float64Array = sum.map((s, i) => (n[i]! ? s / n[i]! : NaN));
  for (let round = 0; round < PINHOLE_ROUNDS; round++) heights = withoutPinholes(heights, cols, rows);
  const filled = withoutHoles(heights, cols, rows);
  let [above, below, cells, unseen] = [0, 0, 0, 0];
  filled.forEach((h, i) => {
    const x = west + ((i % cols) + 0.5) * cell, y = south + (Math.floor(i / cols) + 0.5) * cell;
    if (!inside(places, x, y)) return;
    cells += 1;
    unseen += Number.isNaN(heights[i]!) ? 1 : 0;
    if (h > 0) above += h;
    else below -= h;
  });
  const per = area(places) / Math.max(1, cells);
  return { above_m3: above * per, below_m3: below * per, unseen: unseen / Math.max(1, cells) };
}

/** The corners at the median height of the points around each: a single point is off by its noise. */
function settled(places: Vector3[], points: Points, reach_m: number): Vector3[] {
  const around = places.map((): number[] => []);
  const near = (a: number, b: number): boolean => Math.abs(a - b) < reach_m;
  points((x, y, z) =>
    places.forEach((p, i) => {
      if (near(x, p.x) && near(y, p.y) && near(z, p.z)) around[i]!.push(z);
    }),
  );
  return places.map((p, i) => new Vector3(p.x, p.y, around[i]!.length ? median(around[i]!) : p.z));
}

const PINHOLE_ROUNDS = 2;
const PINHOLE_NEIGHBOURS = 5; // of 8: more than a straight edge has

/** The heights with each cell that most neighbours surround at their mean. */
function withoutPinholes(heights: Float64Array, cols: number, rows: number): Float64Array {
  return heights.map((h, i) => {
    if (!Number.isNaN(h)) return h;
    const known: number[] = [];
    for (let row = Math.floor(i / cols) - 1; row <= Math.floor(i / cols) + 1; row++)
      for (let col = (i % cols) - 1; col <= (i % cols) + 1; col++)
        if (row >= 0 && row < rows && col >= 0 && col < cols && !Number.isNaN(heights[row * cols + col]!))
          known.push(heights[row * cols + col]!);
    return known.length < PINHOLE_NEIGHBOURS ? h : known.reduce((a, b) => a + b) / known.length;
  });
}

const NEAR_CELLS = 8;

/**
 * The heights with each hole (NaN) filled from the lower half of its border, nearest cell first.
 *
 * A cell of the border counts with the median of those near it: the cells next to a wall hold
 * points that stereo put too high, and a hole would spread them.
 */
function withoutHoles(heights: Float64Array, cols: number, rows: number): Float64Array {
  const out = heights.slice();
  const around = (i: number): number[] => {
    const [col, row] = [i % cols, Math.floor(i / cols)];
    return [col > 0 ? i - 1 : i, col < cols - 1 ? i + 1 : i, row > 0 ? i - cols : i, row < rows - 1 ? i + cols : i];
  };
  const spread = (queue: number[], take: (i: number, from: number) => boolean): number[] => {
    for (let k = 0; k < queue.length; k++)
      for (const i of around(queue[k]!)) if (take(i, queue[k]!)) queue.push(i);
    return queue;
  };
  const seen = new Uint8Array(out.length);
  for (let first = 0; first < out.length; first++) {
    if (!Number.isNaN(out[first]!) || seen[first]) continue;
    seen[first] = 1;
    const hole = spread([first], (i) => Number.isNaN(out[i]!) && !seen[i] && (seen[i] = 1) > 0);
    const border = hole.flatMap(around).filter((i) => !Number.isNaN(out[i]!));
    const [low, high] = border.reduce(([a, b], i) => [Math.min(a!, out[i]!), Math.max(b!, out[i]!)], [Infinity, -Infinity]);
    const lower = new Set(border.filter((i) => out[i]! <= (low! + high!) / 2));
    const level = new Map([...lower].map((i) => [i, median(near(i, cols, lower).map((k) => out[k]!))]));
    spread([...lower], (i, from) => {
      if (!Number.isNaN(out[i]!)) return false;
      out[i] = level.get(from) ?? out[from]!;
      return true;
    });
  }
  return out;
}

/** Those of the cells that lie within NEAR_CELLS of one, rows and columns. */
function near(i: number, cols: number, cells: Set<number>): number[] {
  const found: number[] = [];
  for (let row = -NEAR_CELLS; row <= NEAR_CELLS; row++)
    for (let col = -NEAR_CELLS; col <= NEAR_CELLS; col++) {
      const there = (i % cols) + col;
      if (there >= 0 && there < cols && cells.has(i + row * cols + col)) found.push(i + row * cols + col);
    }
  return found;
}

function median(values: number[]): number {
  const sorted = values.sort((a, b) => a - b);
  const half = sorted.length >> 1;
  return sorted.length % 2 ? sorted[half]! : (sorted[half - 1]! + sorted[half]!) / 2;
}

/** Mean heights along the way through the places, of points near it; NaN where there are none. */
export function profile(places: Vector3[], points: Points, bins = 120): Float64Array {
  const legs = places.slice(1).map((q, i) => {
    const p = places[i]!;
    return { p, q, dx: q.x - p.x, dy: q.y - p.y, length: Math.hypot(q.x - p.x, q.y - p.y) };
  });
  const total = legs.reduce((sum, leg) => sum + leg.length, 0);
  const half = Math.max(total / bins, 0.05);
  const sum = new Float64Array(bins), n = new Uint32Array(bins);
  points((x, y, z) => {
    let from = 0;
    for (const { p, dx, dy, length } of legs) {
      const on = ((x - p.x) * dx + (y - p.y) * dy) / length;
      const off = Math.abs((x - p.x) * dy - (y - p.y) * dx) / length;
      if (off <= half && on >= 0 && on < length) {
        const bin = Math.min(bins - 1, Math.floor(((from + on) / total) * bins));
        sum[bin]! += z;
        n[bin]! += 1;
      }
      from += length;
    }
  });
  return sum.map((s, i) => (n[i]! ? s / n[i]! : NaN));
}
