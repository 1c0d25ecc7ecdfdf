"""``skyrelief score``: a scan folder against the truth of a simulated flight."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer


def score(
    scan_dir: Annotated[Path, typer.Argument(help="Scan folder of replay or run.")],
    truth_dir: Annotated[Path, typer.Argument(help="truth/ of simulate.")],
    deliverables: Annotated[
        bool, typer.Option("--deliverables", help="Measure the exported files in it as well.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Report as one JSON object.")] = False,
) -> None:
    """Accuracy, completeness and trajectory error of a scan of a simulated flight."""
    from service.sim import scoring

    report = scoring.score(scan_dir, truth_dir, deliverables)
    print(json.dumps(report) if as_json else _text(report))


def _text(report: dict[str, Any]) -> str:
    """The report as lines for people."""
    lines = [
        f"{report['points']} points, {report['poses_compared']} of {report['poses']} poses "
        f"compared, flown {report['altitude_m']:.1f} m above the ground"
        + ("" if report["georeferenced"] else "; the scan has no georeference"),
        "",
        "surface              median      rms      p90     bias   <0.25 m   <0.5 m   of altitude",
    ]
    for name, s in report["surface"].items():
        lines.append(
            f"  {_label(name):<16} {s['median_m']:7.3f} m {s['rms_m']:6.3f} m {s['p90_m']:6.3f} m "
            f"{s['bias_m']:+6.3f} m  {s['share_25cm']:7.1%}  {s['share_50cm']:7.1%} "
            f"  {s['median_percent_of_altitude']:8.2f} %"
        )
    for name, s in report["surface"].items():
        if s.get("honesty") and name == report["judged_after"]:
            h = s["honesty"]
            lines.append(
                f"  sigma: {h['within_1_sigma']:.0%} within 1, {h['within_2_sigma']:.0%} within 2 "
                f"(a Gaussian has 68 % and 95 %), median {h['median_sigma_m']:.3f} m"
            )
    for name, d in report["dsm"].items():
        if d["cells"]:
            lines.append(
                f"  DSM {_label(name)}, {d['cell_m']:g} m cells: rms {d['rms_m']:.3f} m, "
                f"{d['rms_away_from_steps_m']:.3f} m away from steps, median "
                f"{d['median_m']:+.3f} m, {d['within_30cm']:.1%} within 0.3 m, "
                f"{d['known_share']:.1%} of the cells seen are known"
            )
    c = report["completeness"]
    lines += [
        "",
        f"completeness: {c['share']:.1%} of {c['seen_m2']:.0f} m2 seen lies within "
        f"{c['within_m']:g} m of a point ({c['share_flat']:.1%} of ground and roofs, "
        f"{c['share_steep']:.1%} of walls)",
        "",
        "trajectory              rms   median      max     turn    drift",
    ]
    for name, t in report["trajectory"].items():
        lines.append(
            f"  {_label(name):<16} {t['rms_m']:6.2f} m {t['median_m']:6.2f} m {t['max_m']:6.2f} m "
            f"{t['median_deg']:6.2f} deg {t['drift_percent']:5.2f} % of path"
        )
    for name, s in report["surface"].items():
        f = s["fit"]
        if name != "raw":
            lines.append(
                f"  the {_label(name)} moved the cloud by {f['shift_m']:.2f} m "
                f"({f['shift_up_m']:+.2f} m up), {f['turn_deg']:.2f} deg, scale {f['scale']:.4f}"
            )
    return "\n".join(lines + _files(report.get("deliverables", {})))


def _files(found: dict[str, Any]) -> list[str]:
    """A line per exported file and fit."""
    lines = ["", "exported files: median, 95th percentile (of clouds the 90th)"] if found else []
    for part in found.values():
        if "trouble" in part:
            lines.append(f"  {part['file']}: {part['trouble']}")
        for name in ("raw", "rigid", "similarity"):
            figures = part.get(name)
            if not figures:
                continue
            tail = "p95_m" if "p95_m" in figures else "p90_m"
            words = [f"{figures['median_m']:7.3f} m", f"{figures[tail]:6.3f} m"]
            words += [w.format(figures[key]) for key, w in _WORDS.items() if key in figures]
            lines.append(f"  {part['file']}, {_label(name)}: {'  '.join(words)}")
    return lines


_WORDS = {
    "rms_m": "rms {:.3f} m",
    "median_percent_of_altitude": "median {:.2f} % of altitude",
    "within_30cm": "{:.1%} within 0.3 m",
    "within_50cm": "{:.1%} within 0.5 m",
    "completeness": "{:.1%} complete",
}


def _label(name: str) -> str:
    return {"raw": "as delivered", "rigid": "rigid fit", "similarity": "similarity fit"}[name]
