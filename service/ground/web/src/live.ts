// The live WebSocket: binary chunks and JSON news, as service/ground/live.py describes them.

import { NO_ANSWER } from "./api";
import { type Chunk, decode } from "./depth";

export interface LastPose {
  T: number[];
  lat_deg: number | null;
  lon_deg: number | null;
  alt_amsl_m: number | null;
  agl_m: number | null;
  speed_m_s: number;
  distance_m: number;
  roll_deg: number;
  pitch_deg: number;
  yaw_deg: number;
  sigma_h_v_m: [number, number];
  sources: string[];
}

export type News =
  | { type: "repose"; seq: number; scale: number; T: number[] }
  | { type: "track"; track: [number, number, number][]; last?: LastPose }
  | { type: "state"; finished: boolean; keyframes: number }
  | SiteNews
  | Link;

/** Where this scan and those tied to it are shown, in this scan's coordinates. */
export interface SiteNews {
  type: "site";
  scans: { drone: string; scan: string; own: boolean; earlier: boolean; ties: number; sigma_m: [number, number, number]; T: number[] }[];
}

/** How the scan comes in, once a second. */
export interface Link {
  type: "link";
  silent_s: number;
  received_bytes: number | null;
  lag_s: number | null;
  backlog: number;
  trouble: string | null;
}

/** Keeps a live view open until closed; connects again after a break. */
export class LiveView {
  private socket: WebSocket | null = null;
  private closed = false;
  private work = Promise.resolve(); // messages are handled in their order

  constructor(
    private readonly address: string,
    private readonly onChunk: (chunk: Chunk) => void,
    private readonly onNews: (news: News) => void,
    private readonly onState: (state: string) => void,
  ) {
    this.open();
  }

  close(): void {
    this.closed = true;
    this.socket?.close();
  }

  private open(): void {
    this.onState("connecting");
    const socket = new WebSocket(this.address);
    this.socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onopen = () => this.onState("");
    socket.onmessage = ({ data }: MessageEvent<ArrayBuffer | string>) => {
      const opened = typeof data === "string" ? null : decode(data);
      opened?.catch(() => undefined); // thrown below
      this.work = this.work.then(async () => {
        const chunk = await opened;
        if (this.closed) return;
        if (chunk) this.onChunk(chunk);
        else this.onNews(JSON.parse(data as string) as News);
      }).catch((error: unknown) => console.error(error));
    };
    socket.onclose = ({ code, reason }) => {
      if (this.closed) return;
      this.onState(code === 1008 ? reason || "refused" : `${reason || NO_ANSWER}; trying again`);
      if (code !== 1008) setTimeout(() => this.closed || this.open(), 1500);
    };
  }
}
