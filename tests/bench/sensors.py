"""The table of docs/reports/sensors.md: one simulated flight under each subset of its sensors.

    python tests/bench/sensors.py FLIGHT OUT [ROW ...]

``FLIGHT`` is made by ``skyrelief simulate``. The flight's other logs are made as it was, with
the sensors' noise of their row and without images. Prints a row of the table for each, or
only for the rows named; scans that lie in ``OUT`` already are not made again.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from typer.testing import CliRunner

from mavlink.telemetry.logs import load_telemetry
from recon.surface import metrics
from recon.types import F64
from service.cli import app
from service.sim.scoring import read_scan
from service.sim.truth import Truth, read_truth

GNSS, HEIGHT = ("fusion.gnss=false",), ("fusion.altitude=false",)
ATTITUDE = ("fusion.attitude=false",)
ROWS: dict[str, tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    "all": ("all, GNSS wanders", (), ()),
    "white": ("all, GNSS of 1 m in each fix", ("--gnss-noise", "white"), ()),
    "exact": ("all, exact", ("--gnss-noise", "exact"), ()),
    "boresight": ("all, camera 2 degrees off", ("--boresight-deg", "1.2:1.6"), ()),
    "noaltitude": ("no altitude, no rangefinder", (), HEIGHT),
    "noattitude": ("no attitude", (), ATTITUDE),
    "nogravity": ("GNSS alone", (), (*ATTITUDE, *HEIGHT)),
    "nognss": ("no GNSS", (), GNSS),
    "noloops": ("no GNSS, no loops", (), (*GNSS, "fusion.loops=false")),
    "vision": ("vision alone", (), (*GNSS, *ATTITUDE, *HEIGHT)),
}
"""Row to its name, the simulator's options and the settings of the replay."""

HEAD = (
    "| sensors | rms | less mean | mean | mean of fixes | rigid | scaled | drift | step | surface |"
)
NEAR_M, APART_S = 35.0, 10.0
"""Poses so near in place and so far apart in time lie on two legs."""

FLOWN = {
    "pattern": "--pattern", "duration_s": "--duration-s", "height_m": "--height-m",
    "speed_m_s": "--speed-m-s", "heading_deg": "--heading-deg", "legs": "--legs",
    "spacing_m": "--spacing-m", "camera_pitch_deg": "--camera-pitch-deg",
    "wobble_deg": "--wobble-deg", "sway_m": "--sway-m",
}  # fmt: skip


def skyrelief(*words: str) -> str:
    """What a command prints; its exception when it fails."""
    result = CliRunner().invoke(app, list(words))
    if result.exception is not None:
        raise result.exception
    return result.stdout


def log_of(flight: Path, out: Path, noise: tuple[str, ...]) -> Path:
    """The flight's log with other noise; made when it is not there."""
    folder = out / "_".join(["log", *noise]).replace("-", "").replace(":", "_")
    if not (folder / "flight.tlog").exists():
        options = json.loads((flight / "truth" / "params.json").read_text())["options"]
        words = [w for name, option in FLOWN.items() if options["plan"][name] is not None
                 for w in (option, str(options["plan"][name]))]  # fmt: skip
        skyrelief(
            "simulate", "--out", str(folder), "--no-video", "--depth-frames", "0", *words,
            "--seed", str(options["seed"]), "--fps", str(options["fps"]),
            "--size", "{}x{}".format(*options["size_px"]), "--relief-m", str(options["relief_m"]),
            "--density", str(options["density"]), *noise,
        )  # fmt: skip
    return folder / "flight.tlog"


def bias(log: Path, truth: Truth) -> F64:
    """(3,) metres by which the autopilot's positions are off on average, ENU."""
    history = load_telemetry(log).history
    states = [history.state_at(round(t * 1e9)) for t in truth.times_s]
    reported = [[s.lat_deg, s.lon_deg, s.alt_amsl_m] for s in states if s and s.lat_deg is not None]
    known = [s is not None and s.lat_deg is not None for s in states]
    return np.asarray(
        (truth.frame.to_enu(np.array(reported)) - truth.poses[known, :3, 3]).mean(axis=0)
    )


def row(flight: Path, out: Path, key: str, truth: Truth) -> str:
    """One row of the table, from a fresh log, replay and score."""
    name, noise, settings = ROWS[key]
    log, scan = log_of(flight, out, noise), out / key
    if not (scan / "scan.json").exists():
        shutil.rmtree(scan, ignore_errors=True)
        replay(flight, log, scan, settings)
    report = json.loads(skyrelief("score", str(scan), str(flight / "truth"), "--json"))
    found = read_scan(scan, truth.frame)
    at, known = metrics.poses_at(truth.times_s, truth.poses, found.times_s)
    poses, at = found.poses[known], at[known]
    placed = ["local", "", "", ""]
    if report["georeferenced"]:
        off = poses[:, :3, 3] - at[:, :3, 3]
        means = off.mean(axis=0), bias(log, truth)
        placed = [f"{v:.2f}" for v in (rms(off), rms(off - means[0]))]
        placed += [vector(v) for v in means]
    track = report["trajectory"]
    fits = [f"{track[fit]['rms_m']:.2f}" for fit in ("rigid", "similarity")]
    drift = f"{track['rigid']['drift_percent']:.2f}"
    fitted = metrics.fit_trajectory(poses, at, False).poses(poses)
    apart = step(fitted[:, :3, 3] - at[:, :3, 3], at[:, :3, 3], found.times_s[known])
    surface = f"{report['surface'][report['judged_after']]['median_m']:.3f}"
    return " | ".join(["| " + name, *placed, *fits, drift, apart, surface]) + " |" + reported(scan)


def replay(flight: Path, log: Path, scan: Path, settings: tuple[str, ...]) -> None:
    """The flight through the whole onboard path."""
    skyrelief(
        "replay", str(flight / "flight.mp4"), "--telemetry", str(log),
        "--camera-model", str(flight / "camera.yaml"), "--out", str(scan), "--backend", "cpu",
        *(word for setting in settings for word in ("--set", setting)), "--json",
    )  # fmt: skip


def step(off: F64, places: F64, times_s: F64) -> str:
    """Median metres by which two legs are off against each other; "" of a single leg."""
    pairs = cKDTree(places[:, :2]).query_pairs(NEAR_M, output_type="ndarray")
    pairs = pairs[np.abs(times_s[pairs[:, 0]] - times_s[pairs[:, 1]]) > APART_S]
    if not len(pairs):
        return ""
    return f"{np.median(np.linalg.norm(off[pairs[:, 0]] - off[pairs[:, 1]], axis=1)):.2f}"


def reported(scan: Path) -> str:
    """The boresight that the scan reports, when it is sure of one."""
    summary: dict[str, Any] = json.loads((scan / "scan.json").read_text())
    found = (summary.get("run") or {}).get("graph") or {}
    bore = found.get("boresight") or {}
    return f" boresight {bore['deg']}" if bore.get("sure") else ""


def rms(off: F64) -> float:
    """Root of the mean squared length of (N, 3)."""
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def vector(v: F64) -> str:
    """East, north, up."""
    return " ".join(f"{x:+.2f}" for x in v)


if __name__ == "__main__":
    at, into = Path(sys.argv[1]), Path(sys.argv[2])
    exact = read_truth(at / "truth")
    print(HEAD, "|---|" + "---|" * 9, sep="\n")
    for which in sys.argv[3:] or ROWS:
        print(row(at, into, which, exact), flush=True)
