// A scan's east, north and up on the globe: latitude and longitude, UTM (as service/georeference.py).

import * as THREE from "three";
import type { Origin } from "./api";

const A = 6378137.0; // WGS 84
const F = 1 / 298.257223563;
const E2 = F * (2 - F);
const RAD = Math.PI / 180;

export interface Place {
  lat_deg: number;
  lon_deg: number;
  /** Above mean sea level, as the origin's altitude is. */
  alt_m: number;
}

export interface Utm {
  zone: string;
  east_m: number;
  north_m: number;
}

/** East, north, up at the origin to earth-centred metres. */
export function eastNorthUp(origin: Origin): THREE.Matrix4 {
  const [lat, lon] = [origin.lat_deg * RAD, origin.lon_deg * RAD];
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

/** Where a point of the scan, in metres east, north and up of `origin`, lies on the globe. */
export function placeOf(origin: Origin, point: THREE.Vector3): Place {
  const { x, y, z } = point.clone().applyMatrix4(eastNorthUp(origin));
  const p = Math.hypot(x, y);
  let lat = Math.atan2(z, p * (1 - E2));
  let n = A;
  for (let i = 0; i < 5; i++) {
    n = A / Math.sqrt(1 - E2 * Math.sin(lat) ** 2);
    lat = Math.atan2(z + E2 * n * Math.sin(lat), p);
  }
  const alt_m = p * Math.cos(lat) + z * Math.sin(lat) - (A * A) / n;
  return { lat_deg: lat / RAD, lon_deg: Math.atan2(y, x) / RAD, alt_m };
}

/** Metres east, north and up of `origin` of a longitude, latitude and height above mean sea level. */
export function pointOf(origin: Origin, [lon_deg, lat_deg, alt_m]: [number, number, number]): THREE.Vector3 {
  const there = eastNorthUp({ lat_deg, lon_deg, alt_amsl_m: alt_m });
  return new THREE.Vector3().setFromMatrixPosition(there).applyMatrix4(eastNorthUp(origin).invert());
}

/** The zone of a place, with the wider ones of Norway and Svalbard; null near the poles. */
function zoneOf({ lat_deg: lat, lon_deg: lon }: Place): number | null {
  if (lat >= 84 || lat < -80) return null;
  if (lat >= 56 && lat < 64 && lon >= 3 && lon < 12) return 32;
  if (lat >= 72 && lon >= 0 && lon < 42) return lon < 9 ? 31 : lon < 21 ? 33 : lon < 33 ? 35 : 37;
  return Math.floor((((lon + 180) % 360) + 360) % 360 / 6) + 1;
}

/** UTM on WGS 84 in the zone of the scan's origin: Krueger's series to the third order in n. */
export function utmOf(origin: Origin, place: Place): Utm | null {
  const zone = zoneOf({ ...origin, alt_m: 0 });
  if (zone === null) return null;
  const n = F / (2 - F);
  const scale = (0.9996 * A * (1 + n ** 2 / 4 + n ** 4 / 64)) / (1 + n);
  const alpha = [
    n / 2 - (2 * n ** 2) / 3 + (5 * n ** 3) / 16,
    (13 * n ** 2) / 48 - (3 * n ** 3) / 5,
    (61 * n ** 3) / 240,
  ];
  const sine = Math.sin(place.lat_deg * RAD);
  const k = (2 * Math.sqrt(n)) / (1 + n);
  const t = Math.sinh(Math.atanh(sine) - k * Math.atanh(k * sine));
  const lon = (place.lon_deg - (6 * zone - 183)) * RAD;
  const xi = Math.atan2(t, Math.cos(lon));
  const eta = Math.atanh(Math.sin(lon) / Math.hypot(1, t));
  let [east, north] = [eta, xi];
  alpha.forEach((a, i) => {
    const j = 2 * (i + 1);
    east += a * Math.cos(j * xi) * Math.sinh(j * eta);
    north += a * Math.sin(j * xi) * Math.cosh(j * eta);
  });
  const south = origin.lat_deg < 0;
  return {
    zone: `${zone}${south ? "S" : "N"}`,
    east_m: 500000 + scale * east,
    north_m: scale * north + (south ? 1e7 : 0),
  };
}

/** Coordinates as a line of text: latitude and longitude, UTM, height; without a place, metres. */
export function coordinates(origin: Origin | null, point: THREE.Vector3): string {
  if (!origin) {
    const [x, y, z] = point.toArray().map((v) => v.toFixed(2));
    return `${x} m east · ${y} m north · ${z} m up`;
  }
  const place = placeOf(origin, point);
  const utm = utmOf(origin, place);
  const parts = [`${place.lat_deg.toFixed(7)}, ${place.lon_deg.toFixed(7)}`];
  if (utm) parts.push(`UTM ${utm.zone} ${utm.east_m.toFixed(2)} ${utm.north_m.toFixed(2)}`);
  return [...parts, `${place.alt_m.toFixed(2)} m AMSL`].join(" · ");
}
