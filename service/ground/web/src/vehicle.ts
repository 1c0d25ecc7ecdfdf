// The vehicle's figures and the operator's buttons; hidden where no vehicle was named.

import * as api from "./api";
import { askText, sure } from "./dialog";
import { el, notify } from "./dom";

const ASK_EVERY_MS = 1000;

/** A strip of figures and buttons that keeps itself up to date while it is in the page. */
export function vehicleStrip(): HTMLElement {
  const figures = el("span", { className: "state" });
  const none = el("button", { textContent: "No vehicle", onclick: () => notify(none.title) });
  const acts = [
    el("button", { textContent: "Start scan", onclick: () => void give("start") }),
    el("button", { textContent: "Stop scan", onclick: () => void give("stop") }),
    el("button", { textContent: "Baseline", onclick: () => void baseline() }),
  ];
  const strip = el("span", { className: "vehicle", hidden: true }, figures, none, ...acts);
  const refresh = async (): Promise<void> => {
    const now = await api.vehicle().catch(() => ({ connected: null }) as api.Vehicle);
    strip.hidden = now.connected === null;
    figures.textContent = words(now);
    none.title = now.trouble ?? "looking for it";
    none.hidden = now.connected === true;
    for (const shown of [figures, ...acts]) shown.hidden = !now.connected;
  };
  api.whileShown(strip, ASK_EVERY_MS, refresh);
  return strip;
}

function words(v: api.Vehicle): string {
  const parts: string[] = [];
  const add = (value: number | null | undefined, text: (x: number) => string): void => {
    if (value !== null && value !== undefined) parts.push(text(value));
  };
  add(v.battery_percent, (x) => `battery ${x.toFixed(0)} %`);
  add(v.battery_volts, (x) => `${x.toFixed(1)} V`);
  add(v.satellites, (x) => `${x} satellites`);
  add(v.speed_m_s, (x) => `${x.toFixed(1)} m/s`);
  add(v.height_above_home_m, (x) => `${x.toFixed(1)} m up`);
  add(v.home_distance_m, (x) => `${x.toFixed(0)} m from home`);
  return ["vehicle", ...parts].join(" · ");
}

async function give(action: string): Promise<void> {
  const words = `${action[0]!.toUpperCase()}${action.slice(1)} the scan`;
  if (await sure(`${words} on the vehicle?`, words))
    void api.order(action).then((a) => notify(`${action}: ${a.result}`), notify);
}

async function baseline(): Promise<void> {
  const text = await askText("Baseline in metres", "0", "0 follows the altitude", { inputMode: "decimal" });
  if (text === null) return;
  const metres = Number(text);
  if (!Number.isFinite(metres)) return notify("not a number");
  void api.order("baseline", metres).then((a) => notify(`baseline ${metres} m: ${a.result}`), notify);
}
