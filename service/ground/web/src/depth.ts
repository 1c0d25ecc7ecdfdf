// Depth images as they are stored: the sections of docs/wire.md, decoded.

/** The head of a binary message, as service/ground/live.py describes it. */
export interface Head {
  seq: number;
  /** -1: tiles of the narrow radio; FIRST. */
  layer: number;
  time_unix_s: number;
  size: [number, number];
  K: [number, number, number, number];
  box: [number, number, number, number];
  low: number;
  step: number;
  T: number[];
  scale: number;
  bytes: number[];
}

/** A layer of a keyframe: the pixels of its box. */
export interface Chunk extends Head {
  w: number;
  h: number;
  /** Of each pixel; 0 where it is not known, else its code of inverse depth plus 1. */
  codes: Uint32Array;
  /** Codes of sigma of 4x4 pixels, 0 unknown; empty: none is. */
  sigma: Uint8Array;
  /** Views of 2x2 pixels; empty: one. */
  views: Uint8Array;
  /** Of the box and of EDGE_PX around it: as measured where that is known, else as the whole keyframe's image shows it. */
  colour: ImageData | null;
  /** There is such an image. */
  isWhole: boolean;
}

/** Pixels around the box whose colours are known. */
export const EDGE_PX = 8;

/** The layer of a first depth, of a keyframe that is still to come. */
export const FIRST = -2;

/** True for a keyframe that is withdrawn: all it had was a first depth, now void. */
export const isVoid = (chunk: Head): boolean => chunk.layer < 0 && !chunk.box[2];

const MARGIN = 3;
const CONTEXT = [[0, -1], [0, -2], [0, -3], [-1, -2], [-1, -1], [-1, 0], [-1, 1], [-1, 2], [-2, -1], [-2, 0], [-2, 1], [-3, 0]];
const NEIGHBOURS = [[-1, 0], [-1, -1], [-1, 1], [0, -2], [-2, 0], [-2, -1], [-2, 1], [-1, 2], [-1, -2]];
const NEAREST_M = 0.0005;

/** The chunk in a binary message; throws when it is cut short. */
export async function decode(data: ArrayBuffer): Promise<Chunk> {
  const length = new DataView(data).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length))) as Head;
  let at = 4 + length;
  const sections = head.bytes.map((n) => new Uint8Array(data, (at += n) - n, n));
  const [mask, depth, sigma, views, colour, small] = sections as [Bytes, Bytes, Bytes, Bytes, Bytes, Bytes];
  const [, , w, h] = head.box;
  const none = new Uint8Array(0);
  if (!w) return { ...head, w, h, codes: new Uint32Array(0), sigma: none, views: none, colour: null, isWhole: false };
  const known = knownPixels(mask, w, h);
  const [symbols, sigmas, counts, own, whole] = await Promise.all([
    inflated(depth.subarray(18)),
    inflated(sigma),
    inflated(views),
    opened(colour),
    small.length ? opened(small).catch(() => null) : null, // it may come from anybody
  ]);
  const codes = restored(depth, symbols, known, w, h);
  const nearest = (1 / NEAREST_M - head.low) / head.step;
  for (let i = 0; i < codes.length; i++) if (codes[i]! > nearest) codes[i] = 0;
  return { ...head, w, h, codes, sigma: sigmas, views: counts, colour: completed(head, codes, own, whole), isWhole: whole !== null };
}

type Bytes = Uint8Array<ArrayBuffer>;

const opened = (jpeg: Bytes): Promise<ImageBitmap> =>
  createImageBitmap(new Blob([jpeg], { type: "image/jpeg" }), { colorSpaceConversion: "none", premultiplyAlpha: "none" });

/** The colours of the box and its edge: the layer's own are noise where nothing is new. */
function completed({ box, size }: Head, codes: Uint32Array, own: ImageBitmap, whole: ImageBitmap | null): ImageData {
  const [x, y, w, h] = box;
  const [across, down] = [w + 2 * EDGE_PX, h + 2 * EDGE_PX];
  const context = new OffscreenCanvas(across, down).getContext("2d", { willReadFrequently: true })!;
  context.drawImage(own, EDGE_PX, EDGE_PX);
  own.close();
  const measured = context.getImageData(0, 0, across, down);
  if (!whole) return measured;
  context.imageSmoothingQuality = "high";
  context.drawImage(whole, EDGE_PX - x, EDGE_PX - y, size[0], size[1]);
  whole.close();
  const all = context.getImageData(0, 0, across, down);
  const [from, to] = [measured, all].map(({ data }) => new Uint32Array(data.buffer)) as [Uint32Array, Uint32Array];
  for (let i = 0, at = EDGE_PX * across + EDGE_PX; i < codes.length; at += across - w)
    for (const end = i + w; i < end; i++, at++) if (codes[i]) to[at] = from[at]!;
  return all;
}

async function inflated(data: Uint8Array<ArrayBuffer>): Promise<Uint8Array> {
  if (!data.length) return data;
  const stream = new Blob([data]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Section 1.2: the mask, with a margin of unknown pixels. */
function knownPixels(data: Uint8Array, w: number, h: number): Uint8Array {
  const row = w + 2 * MARGIN;
  const out = new Uint8Array(row * (h + 2 * MARGIN));
  if (!data.length) {
    for (let v = 0; v < h; v++) out.fill(1, (v + MARGIN) * row + MARGIN, (v + MARGIN) * row + MARGIN + w);
    return out;
  }
  const offsets = CONTEXT.map(([v, u]) => v! * row + u!);
  const chances = new Uint16Array(4096).fill(2048);
  let [span, code, at] = [0xffffffff, 0, 0];
  const next = (): number => data[at++] ?? 0;
  for (let k = 0; k < 4; k++) code = code * 256 + next();
  for (let v = 0; v < h; v++)
    for (let u = 0, i = (v + MARGIN) * row + MARGIN; u < w; u++, i++) {
      let context = 0;
      for (let k = 0; k < 12; k++) context |= out[i + offsets[k]!]! << k;
      const chance = chances[context]!;
      const bound = Math.floor(span / 4096) * chance;
      if (code < bound) {
        span = bound;
        chances[context] = chance + ((4096 - chance) >> 4);
      } else {
        code -= bound;
        span -= bound;
        chances[context] = chance - (chance >> 4);
        out[i] = 1;
      }
      for (; span < 0x1000000; span *= 256) code = (code * 256 + next()) % 0x100000000;
    }
  return out;
}

/** Section 1.3, method 2: the codes plus 1 of the known pixels, else 0. */
function restored(depth: Uint8Array, symbols: Uint8Array, known: Uint8Array, w: number, h: number): Uint32Array {
  const weights = new DataView(depth.buffer, depth.byteOffset, 18);
  const weight = NEIGHBOURS.map((_, k) => weights.getInt16(2 * k, true));
  const row = w + 2 * MARGIN;
  const offsets = NEIGHBOURS.map(([v, u]) => v! * row + u!);
  const codes = new Int32Array(known.length);
  const out = new Uint32Array(w * h);
  let count = 0;
  for (const one of known) count += one;
  let [at, escaped, last] = [0, count, 0];
  for (let v = 0; v < h; v++)
    for (let u = 0, i = (v + MARGIN) * row + MARGIN; u < w; u++, i++) {
      if (!known[i]) continue;
      const base = known[i - 1] ? codes[i - 1]! : known[i - row] ? codes[i - row]! : known[i - row + 1] ? codes[i - row + 1]! : known[i - row - 1] ? codes[i - row - 1]! : last;
      let sum = 2048;
      for (let k = 0; k < 9; k++) {
        const n = i + offsets[k]!;
        if (known[n]) sum += weight[k]! * (codes[n]! - base);
      }
      let residual = symbols[at++]!;
      if (residual === 255) {
        residual = symbols[escaped]! + 256 * symbols[escaped + 1]!;
        escaped += 2;
      }
      const guess = Math.min(Math.max(base + Math.floor(sum / 4096), 0), 65535);
      last = codes[i] = (guess + (residual & 1 ? -(residual + 1) / 2 : residual / 2)) & 65535;
      out[v * w + u] = last + 1;
    }
  return out;
}

const SIGMA_M = Float32Array.from({ length: 256 }, (_, c) => (c ? 0.001 * 2 ** ((c - 1) / 4) : 0));

/** Sigma of a pixel's depth, m; 0 unknown. */
export function sigmaAt(chunk: Chunk, x: number, y: number): number {
  return SIGMA_M[chunk.sigma[(y >> 2) * Math.ceil(chunk.w / 4) + (x >> 2)] ?? 0]!;
}

/** Stereo pairs that agree in a pixel. */
export function viewsAt(chunk: Chunk, x: number, y: number): number {
  return chunk.views[(y >> 1) * Math.ceil(chunk.w / 2) + (x >> 1)] || 1;
}
