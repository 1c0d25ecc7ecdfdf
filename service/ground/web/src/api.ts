// The portal's HTTP interface, typed; see /api/openapi.json.

export interface Origin {
  lat_deg: number;
  lon_deg: number;
  alt_amsl_m: number;
}

export interface Job {
  number: number;
  drone: string;
  scan: string;
  kind: string;
  title: string;
  state: "waiting" | "running" | "done" | "failed" | "cancelled";
  doing: string;
  percent: number;
  left_s: number | null;
  ended_s: number | null; // ago
  file: string | null;
  error: string | null;
}

export interface Scan {
  drone: string;
  scan: string;
  title: string;
  tags: string[];
  edition: number;
  files: { name: string; what: string; bytes: number }[];
  preview: boolean;
  thumbnail: boolean;
  tiles: boolean;
  /** mesh.glb is of the scan as it is now. */
  meshed: boolean;
  maps: boolean;
  started_unix_s: number | null;
  origin: Origin | null;
  /** Latitude and longitude of the corners of what was measured, NW first, clockwise. */
  corners_lat_lon?: [number, number][] | null;
  finished: boolean;
  growing: boolean;
  trouble: string | null;
  newest?: number | null;
  counts?: { keyframes?: number; points?: number };
  quality?: {
    area_m2?: number | null;
    sigma_median_m?: number | null;
    sigma_absolute_median_m?: number | null;
    position_sigma_h_median_m?: number | null;
    position_sigma_v_median_m?: number | null;
    scale_sigma?: number | null;
    trust?: { level: string; reasons: string[] } | null;
  };
  notes?: string[];
  jobs?: Job[];
}

/** What the portal refused, in its own words. */
export class Refused extends Error {
  constructor(
    message: string,
    readonly status: number,
  ) {
    super(message);
  }
}

export const NO_ANSWER = "the ground station does not answer";

const PATIENCE_MS = 30_000;

/** The JSON answer; throws Refused when the portal refuses, and NO_ANSWER when nothing comes. */
export async function ask<T>(path: string, method = "GET", body?: unknown): Promise<T> {
  const init: RequestInit = { method };
  if (method === "GET") init.signal = AbortSignal.timeout(PATIENCE_MS);
  if (body !== undefined) {
    init.body = JSON.stringify(body);
    init.headers = { "content-type": "application/json" };
  }
  const answer = await fetch(path, init).catch(() => {
    throw new Error(NO_ANSWER);
  });
  const content = (await answer.json().catch((error: unknown) => {
    if (error instanceof SyntaxError) return {}; // no JSON
    throw new Error(NO_ANSWER); // cut, or too late
  })) as { error?: string };
  if (!answer.ok) throw new Refused(content.error ?? `the portal answered ${answer.status}`, answer.status);
  return content as T;
}

/** Does `job` again and again while the page is seen, `wait_ms` after it has ended: a slow station's answers
 * would queue up, and all other requests behind them. Gives what ends it. */
export function every(wait_ms: number, job: () => Promise<unknown>): () => void {
  let [timer, ended] = [0, false];
  const next = (): void => void (ended || (timer = window.setTimeout(turn, wait_ms)));
  const turn = (): void => (document.hidden ? next() : void job().then(next, next));
  next();
  return () => {
    ended = true;
    clearTimeout(timer);
  };
}

/** As `every`, at once and until `element` is taken from the page. */
export function whileShown(element: Element, wait_ms: number, job: () => Promise<unknown>): void {
  const end = every(wait_ms, async () => (element.isConnected ? job() : end()));
  void job();
}

const place = (s: { drone: string; scan: string }): string =>
  `/api/scans/${encodeURIComponent(s.drone)}/${encodeURIComponent(s.scan)}`;

/** A scan of a site, and the numbers of its first and last keyframe there. */
export interface Part {
  name: string;
  keyframes: [number, number];
}

/** The scans of a site; none for a single scan. */
export async function parts(s: Scan): Promise<Part[]> {
  if (!s.files.some((f) => f.name === "site.json")) return [];
  const { scans } = await ask<{ scans?: (Part | null)[] }>(file(s, "site.json"));
  if (!Array.isArray(scans)) throw new Error("site.json is damaged: it lists no scans");
  return scans.filter((p): p is Part => Array.isArray(p?.keyframes));
}

/** The page that shows a scan on a map. */
export const mapAddress = (s: { drone: string; scan: string }): string =>
  `#/map/${encodeURIComponent(s.drone)}/${encodeURIComponent(s.scan)}`;

/** The page that shows a scan in 3D. */
export const viewAddress = (s: { drone: string; scan: string }): string =>
  `#/view/${encodeURIComponent(s.drone)}/${encodeURIComponent(s.scan)}`;

/** Where everything of a scan lies. */
export const scanAddress = place;

export const scans = (): Promise<Scan[]> => ask("/api/scans");
export const scan = (drone: string, name: string): Promise<Scan> =>
  ask(place({ drone, scan: name }));
export const label = (s: Scan, body: { title?: string; tags?: string[] }): Promise<unknown> =>
  ask(place(s), "PATCH", { ...body, edition: s.edition });
export const remove = (s: Scan): Promise<unknown> => ask(place(s), "DELETE");
/** What heights are above as flown, and what they are converted to; null: unknown, or as flown. */
export interface Heights {
  vertical_datum: string | null;
  to_datum: string | null;
}

export const make = (s: { drone: string; scan: string }, kind: string, heights?: Heights): Promise<Job> =>
  ask(`${place(s)}/exports`, "POST", { kind, ...heights });
/** A product that can be made of a scan: what it is, the file that there is, about how large and how long. */
export interface Product {
  kind: string;
  group: string;
  title: string;
  text: string;
  file: string;
  bytes: number | null;
  about_bytes: number | null;
  about_s: number | null;
  heights: boolean;
  impossible: string | null;
}

export const products = (s: { drone: string; scan: string }): Promise<Product[]> => ask(`${place(s)}/exports`);
export type Triple = [number, number, number];

/** A point in a scan without georeference, and its longitude, latitude, metres above mean sea level. */
export interface Pair {
  scan: Triple;
  place: Triple;
}

/** Aligns a scan that points place with a scan or a site. */
export const align = (s: Scan, { drone, scan }: Scan, points: Pair[]): Promise<Job> =>
  ask(`${place(s)}/alignment`, "POST", { drone, scan, points });

/** The scan, when its newest job of a kind has ended; throws the job's error. */
export async function finished(s: Scan, kind: string): Promise<Scan> {
  for (;;) {
    const now = await scan(s.drone, s.scan);
    const job = (now.jobs ?? []).filter((j) => j.kind === kind).at(-1);
    if (job?.state === "failed") throw new Error(job.error ?? "failed");
    if (job?.state === "cancelled") throw new Error(`${kind} is cancelled`);
    if (!job || job.state === "done") return now;
    await new Promise((resolve) => setTimeout(resolve, 500));
  }
}

/** A place (longitude, latitude, metres above mean sea level) with a text, or the places of a measurement. */
export interface Annotation {
  id: number;
  geometry: { type: "Point"; coordinates: Triple } | { type: "LineString"; coordinates: Triple[] };
  properties: { text: string; by: string; made_unix_s: number };
}

/** The flight over weak places: of each line the ground that its images cover, and the line. */
export interface Refly {
  features: {
    geometry: { type: "Polygon"; coordinates: [number, number][][] } | { type: "LineString"; coordinates: [number, number][] };
  }[];
}
export const refly = (s: { drone: string; scan: string }): Promise<Refly> => ask(`${place(s)}/refly.geojson`);
/** The flight path: longitude, latitude, metres above mean sea level. */
export const track = (s: { drone: string; scan: string }): Promise<{ geometry: { coordinates: Triple[] } | null }> => ask(`${place(s)}/track.geojson`);
export const annotations = (s: { drone: string; scan: string }): Promise<{ features: Annotation[] }> =>
  ask(`${place(s)}/annotations`);
export const annotate = (s: { drone: string; scan: string }, coordinates: number[], text: string): Promise<Annotation> =>
  ask(`${place(s)}/annotations`, "POST", { coordinates, text });
/** Keeps the places of a measurement under a name. */
export const saveMeasurement = (s: { drone: string; scan: string }, line: Triple[], text: string): Promise<Annotation> =>
  ask(`${place(s)}/annotations`, "POST", { line, text });
export const eraseAnnotation = (s: { drone: string; scan: string }, number: number): Promise<unknown> =>
  ask(`${place(s)}/annotations/${number}`, "DELETE");

export type Px = [number, number];

/** A point in a keyframe's image; null: its place is not known, it is not marked. */
export interface Sight {
  keyframe_seq: number;
  expected_px: Px | null;
  marked_px: Px | null;
}

/** A surveyed point: longitude, latitude, metres above mean sea level; how far the map is off: east, north, up. */
export interface ControlPoint {
  name: string;
  role: "control" | "check";
  place: [number, number, number | null];
  sigma_m: [number, number];
  marks: number;
  off_m: Triple | null;
  why_not: string;
  images: Sight[];
}

export interface ControlPoints {
  size_px: Px;
  points: ControlPoint[];
}

const control = (s: { drone: string; scan: string }): string => `${place(s)}/control-points`;
export const controlPoints = (s: { drone: string; scan: string }): Promise<ControlPoints> => ask(control(s));
/** Gives a scan its control points: the text of their file, and of Pix4D's file of marks. */
export const setControlPoints = (s: { drone: string; scan: string }, text: string, marks?: string): Promise<ControlPoints> =>
  ask(control(s), "PUT", { text, ...(marks === undefined ? {} : { marks }) });
/** Marks a point in the image of a keyframe; null takes the mark away. */
export const mark = (s: { drone: string; scan: string }, name: string, keyframe_seq: number, uv_px: Px | null): Promise<ControlPoints> =>
  ask(control(s), "POST", { name, keyframe_seq, uv_px });
/** The image of a keyframe as the camera has it. */
export const controlImage = (s: { drone: string; scan: string }, seq: number): string => `${control(s)}/images/${seq}.jpg`;
/** The page of a scan's control points. */
export const controlAddress = (s: { drone: string; scan: string }): string =>
  `#/control/${encodeURIComponent(s.drone)}/${encodeURIComponent(s.scan)}`;

/** Whether this browser may change anything, with a session that can be ended. */
export const hasSession = (): Promise<boolean> => ask<{ session: boolean }>("/api/status").then(({ session }) => session);
export const jobs = (): Promise<Job[]> => ask("/api/jobs");
export const cancel = (number: number): Promise<Job> => ask(`/api/jobs/${number}`, "DELETE");
export const bin = (): Promise<string[]> => ask("/api/bin");
export const restore = (name: string): Promise<unknown> =>
  ask(`/api/bin/${encodeURIComponent(name)}/restore`, "POST", {});
export const importFolder = (folder: string): Promise<unknown> =>
  ask("/api/import", "POST", { folder });
/** Sends files as a new scan; `progress` hears how much of them has gone, 0 to 1. */
export async function upload(files: File[], progress: (share: number) => void): Promise<void> {
  const parts = files.map((f) => `name=${encodeURIComponent(f.name)}&bytes=${f.size}`);
  const where = `/api/upload?${parts.join("&")}`;
  await ask(where); // the reason of a refusal, before much is sent
  await new Promise<void>((done, failed) => {
    const request = new XMLHttpRequest();
    request.open("POST", where);
    request.responseType = "json";
    request.upload.onprogress = (event) => progress(event.loaded / Math.max(event.total, 1));
    request.onerror = () => failed(new Error("the upload was cut off: the connection was lost"));
    request.onload = () => {
      const answer = request.response as { error?: string } | null;
      if (request.status < 300) done();
      else failed(new Refused(answer?.error ?? `${request.status}`, request.status));
    };
    request.send(new Blob(files));
  });
}
/** Sigma of heights in the world; where the points' is not known, the track's. */
export const heightSigma = (quality: Scan["quality"]): number | null | undefined =>
  quality?.sigma_absolute_median_m ?? quality?.position_sigma_v_median_m;

/** The image of a keyframe. */
export const keyframe = (s: { drone: string; scan: string }, seq: number): string => `${place(s)}/keyframes/${seq}.jpg`;

/** The orthophoto as it is now; an error while there is no surface. */
export const mapThumbnail = (s: { drone: string; scan: string }): string =>
  `/tiles/${encodeURIComponent(s.drone)}/${encodeURIComponent(s.scan)}/thumbnail.png`;

export const file = (s: { drone: string; scan: string }, name: string): string =>
  `${place(s)}/files/${encodeURIComponent(name)}`;
/** The address of a product; a folder comes as a zip. */
export const product = (s: { drone: string; scan: string }, name: string): string =>
  name.includes(".") ? file(s, name) : `${place(s)}/${name}.zip`;

export function liveAddress(s: { drone: string; scan: string }): string {
  const scheme = location.protocol === "https:" ? "wss:" : "ws:";
  return `${scheme}//${location.host}${place(s)}/live`;
}

export interface Vehicle {
  connected: boolean | null;
  trouble?: string | null;
  battery_percent?: number | null;
  battery_volts?: number | null;
  satellites?: number | null;
  speed_m_s?: number | null;
  height_above_home_m?: number | null;
  home_distance_m?: number | null;
}

export const vehicle = (): Promise<Vehicle> => ask("/api/vehicle");
export const order = (action: string, metres?: number): Promise<{ result: string }> =>
  ask("/api/vehicle", "POST", metres === undefined ? { action } : { action, metres });
