// What a scan is called: as somebody named it, else by its place and date.

import type { Scan } from "./api";
import { date } from "./dom";

const half = (value: number, positive: string, negative: string): string => `${Math.abs(value).toFixed(4)}° ${value < 0 ? negative : positive}`;

/** A place in words. */
export const placeName = (lat_deg: number, lon_deg: number): string => `${half(lat_deg, "N", "S")}, ${half(lon_deg, "E", "W")}`;

export function nameOf(s: Scan): string {
  if (s.title !== s.scan) return s.title;
  const place = s.origin ? placeName(s.origin.lat_deg, s.origin.lon_deg) : s.drone;
  return s.started_unix_s === null ? s.scan : `${place}, ${date(s.started_unix_s)}`;
}
