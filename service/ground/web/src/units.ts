// Lengths as the operator reads them: metric or imperial, kept in the browser.

const FOOT = 0.3048;
const NAME = "skyrelief.units";

/** True for feet; false for metres. */
export function imperial(): boolean {
  try {
    return localStorage.getItem(NAME) === "imperial";
  } catch {
    return false; // storage is switched off
  }
}

export function setImperial(on: boolean): void {
  try {
    localStorage.setItem(NAME, on ? "imperial" : "metric");
  } catch {
    throw new Error("this browser does not let the page keep the unit");
  }
}

export const length = (m: number, digits = 2): string =>
  imperial() ? `${(m / FOOT).toFixed(digits)} ft` : `${m.toFixed(digits)} m`;

/** The accuracy (one sigma) of a length. */
export const accuracy = (m: number): string => `±${length(m, m < 10 ? 2 : 0)}`;

/** The accuracy of a position: horizontal, vertical. */
export const sigmas = (h_m: number, v_m: number): string => `${accuracy(h_m)} across, ${accuracy(v_m)} up`;

/** The longest round length of at most `m`: metres, and as it is read. */
export const round = (m: number): [number, string] => {
  const unit = imperial() ? FOOT : 1;
  const tens = 10 ** Math.floor(Math.log10(Math.max(m, 1e-6) / unit));
  const value = tens * ([5, 2, 1].find((k) => k * tens * unit <= m) ?? 1);
  const digits = Math.max(0, -Math.floor(Math.log10(value) + 1e-9));
  const far = unit === 1 && value >= 1000;
  return [value * unit, far ? `${value / 1000} km` : length(value * unit, digits)];
};

export const area = (m2: number): string =>
  imperial() ? `${(m2 / FOOT ** 2).toFixed(1)} ft²` : `${m2.toFixed(1)} m²`;

/** Imperial volumes of earth are cubic yards. */
export const volume = (m3: number): string => {
  const value = imperial() ? m3 / (3 * FOOT) ** 3 : m3;
  const digits = value < 10 ? 2 : value < 100 ? 1 : 0;
  const text = value.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits });
  return `${text} ${imperial() ? "yd³" : "m³"}`;
};

export const speed = (m_s: number): string =>
  imperial() ? `${((m_s * 3600) / 1609.344).toFixed(1)} mph` : `${m_s.toFixed(1)} m/s`;

/** A small share of something; never none of it. */
export const share = (value: number): string =>
  `${value < 0.001 ? Number((100 * value).toPrecision(1)) : (100 * value).toFixed(value < 0.1 ? 1 : 0)} %`;
