"""Sites against the truth of simulated flights: seams, bias, changes, volumes; and a real set.

Two flights cross one place. For each seed their receivers and attitudes wander on their own; the
images stay. ``--rounds`` is the number of seeds. Four drones fly at once. With ``--data`` the
real nadir set is cut into even and odd images, as two flights.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bench_site_drones
import bench_site_scale
import numpy as np
from bench_options import DataOptions
from bench_real import skyrelief

from recon import se3
from recon.camera_model import rays
from recon.types import F64, Keyframe
from service.bench import BenchResult
from service.georeference import LocalFrame
from service.scans.track import local_frame
from service.sim.flight import FlightPlan, Sensors
from service.sim.recording import (
    ORIGIN,
    Simulation,
    SimulationOptions,
    prepare,
    write,
)
from service.sim.telemetry import FlightMessages
from service.sim.truth import Truth, read_truth
from service.stream.store import ScanStore

MAX_SEEDS = 10
SITE_M, CHANGES = 220.0, 24
NEAR_M = 12.0
"""Between the ground of two keyframes whose errors are compared."""

FOUND_M = 1.5
"""Between the middle of a box and the object that is it."""

REAL = "caliterra_nadir/frames"


def run(options: DataOptions) -> list[BenchResult]:
    """Every figure; flights are rendered once and replayed for each seed."""
    if options.scans:
        return bench_site_scale.run(options)
    with tempfile.TemporaryDirectory(prefix="skyrelief-site-") as folder:
        results = _simulated(Path(folder), options)
        results += bench_site_drones.run(Path(folder) / "drones")
        if options.data is not None and (options.data / REAL).is_dir():
            results += _real(Path(folder) / "real", options.data / REAL, options)
    return results


def flight_options(heading_deg: float, date: int) -> SimulationOptions:
    """A flight of three legs over the middle of the place."""
    plan = FlightPlan("legs", 40.0, heading_deg=heading_deg, spacing_m=25.0, centred=True)
    return SimulationOptions(
        plan, seed=3, flight_seed=round(heading_deg), size_px=(1280, 720), fps=5.0,
        site_m=SITE_M, changes=CHANGES, date=date, depth_frames=2,
    )  # fmt: skip


def _simulated(folder: Path, options: DataOptions) -> list[BenchResult]:
    flown = {}
    for name, heading, date in (("one", 0.0, 1), ("two", 90.0, 1), ("later", 90.0, 2)):
        flown[name] = prepare(flight_options(heading, date))
        write(flown[name], folder / name)
    truths = [read_truth(folder / name) for name in ("one", "two")]
    seams, unchanged = [], 0
    seeds = min(options.rounds, MAX_SEEDS)
    for seed in range(seeds):
        scans = [_replayed(folder, flown, name, seed, options) for name in ("one", "two")]
        out = folder / f"site-{seed}"
        skyrelief("site", "compare", *map(str, scans), "--out", str(out))
        seams.append(seam_of(out, scans, truths))
        unchanged += not json.loads((out / "change.json").read_text())["objects"]
    later = _replayed(folder, flown, "later", 99, options)
    skyrelief("site", "compare", str(folder / "one-0"), str(later), "--out", str(folder / "change"))
    change = json.loads((folder / "change" / "change.json").read_text())
    places = [read_truth(folder / name) for name in ("one", "later")]
    off = seam_of(folder / "change", [folder / "one-0", later], places).site_m
    results = _seam_results(seams, truths[0].agl_m)
    results.append(
        BenchResult("flights without change that show none", 100.0 * unchanged / seeds, "%",
                    note=f"{seeds} pairs; goal 95 %")
    )  # fmt: skip
    return results + change_results(change, folder / "one", folder / "change" / "change.tif", off)


def _replayed(
    folder: Path, flown: dict[str, Simulation], name: str, seed: int, options: DataOptions
) -> Path:
    """The scan of a flight whose sensors err by ``seed``."""
    simulation, out = flown[name], folder / f"{name}-{seed}"
    sensors = Sensors(
        simulation.flight, simulation.options.noise, np.random.default_rng([seed, *name.encode()])
    )
    log = folder / f"{name}-{seed}.tlog"
    FlightMessages(
        sensors, ORIGIN, simulation.options.started_unix_s, simulation.surface_range,
        simulation.options.telemetry,
    ).write_tlog(log)  # fmt: skip
    skyrelief(
        "replay", str(folder / name / "flight.mp4"), "--telemetry", str(log), "--camera-model",
        str(folder / name / "camera.yaml"), "--out", str(out), "--backend", options.backend,
    )  # fmt: skip
    return out


# ---- seams and bias --------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Seam:
    """Offsets of two scans of a site from each other and from the truth."""

    before_m: float  # median distance between the two where both see the ground
    after_m: float
    alone_m: F64  # (2, 3) mean error of each scan by its own fixes
    site_m: F64  # (3,) mean error of the site


def seam_of(site: Path, scans: Sequence[Path], truths: Sequence[Truth]) -> Seam:
    """The seam of a site of two scans, against the truths of their flights."""
    document = json.loads((site / "site.json").read_text())
    ranges = [range(s["keyframes"][0], s["keyframes"][1] + 1) for s in document["scans"]]
    after = [_errors(site, r, truth) for r, truth in zip(ranges, truths, strict=True)]
    before = [_errors(scan, None, truth) for scan, truth in zip(scans, truths, strict=True)]
    return Seam(
        _between(*before), _between(*after),
        np.array([np.mean([e for _, e in rows], axis=0) for rows in before]),
        np.mean([np.mean([e for _, e in rows], axis=0) for rows in after], axis=0),
    )  # fmt: skip


def _errors(folder: Path, seqs: Sequence[int] | None, truth: Truth) -> list[tuple[F64, F64]]:
    """True positions and errors, in the truth's frame, of the surface that a scan's keyframes
    see."""
    with ScanStore.open(folder / "scan.db", read_only=True) as store:
        frame = local_frame(store.header)
        assert frame is not None  # the simulated flights have fixes
        found = [
            _ground_error(one, truth, frame)
            for seq in (store.seqs() if seqs is None else seqs)
            if (one := store.keyframe(seq)) is not None
        ]
    return [each for each in found if each is not None]


def _ground_error(one: Keyframe, truth: Truth, frame: LocalFrame) -> tuple[F64, F64] | None:
    """(3,) true centre of the surface that the keyframe sees, and (3,) its median error."""
    k = int(np.argmin(np.abs(truth.times_s - one.time_ns * 1e-9)))
    h, w = one.depth.depth_m.shape
    v, u = (x.ravel() for x in np.mgrid[4 : h - 4 : 9j, 4 : w - 4 : 13j].astype(np.int64))
    z = one.depth.depth_m[v, u].astype(np.float64)
    ways = rays(one.depth.K, np.column_stack([u, v]).astype(np.float64))[np.isfinite(z)]
    if len(ways) < 20:
        return None
    there = se3.transform(one.depth.T_world_camera, ways * z[np.isfinite(z), None])
    there = ORIGIN.to_enu(frame.to_geodetic(there))
    T = truth.poses[k]
    turned = ways @ T[:3, :3].T
    far, _ = truth.surface.cast(np.tile(T[:3, 3], (len(ways), 1)), turned)
    true = T[:3, 3] + turned * far[:, None]
    good = np.isfinite(true).all(axis=1)
    return np.median(true[good], axis=0), np.median((there - true)[good], axis=0)


def _between(one: Sequence[tuple[F64, F64]], two: Sequence[tuple[F64, F64]]) -> float:
    """Median distance between the errors of keyframes that see the same ground."""
    apart = [
        float(np.linalg.norm(e - f))
        for p, e in one
        for q, f in two
        if np.linalg.norm((p - q)[:2]) < NEAR_M
    ]
    return float(np.median(apart)) if apart else float("nan")


def _seam_results(seams: Sequence[Seam], height_m: float) -> list[BenchResult]:
    after = np.array([s.after_m for s in seams])
    before = float(np.median([s.before_m for s in seams]))
    alone = float(np.sqrt(np.mean([np.sum(s.alone_m**2, axis=1).mean() for s in seams])))
    site = float(np.sqrt(np.mean([np.sum(s.site_m**2) for s in seams])))
    many = f"{len(seams)} pairs of flights, GNSS wanders by 1 m"
    return [
        BenchResult("seam, median", float(np.median(after)), "m", peer="by fixes",
                    peer_value=before, note=many),
        BenchResult("seam over the height, median", 100.0 * float(np.median(after))
                    / height_m, "%", note="goal 0.1 %"),
        BenchResult("bias of the site, rms", site, "m", peer="one flight",
                    peer_value=alone, note="goal 0.75 of one flight's"),
    ]  # fmt: skip


# ---- changes ---------------------------------------------------------------------------------


def change_results(
    change: dict[str, Any], flight: Path, map_: Path, off_m: F64
) -> list[BenchResult]:
    """Boxes found, false objects and volumes, of a comparison of date 1 with date 2.

    A box counts where both flights have surface all around it, by ``map_``, the change.tif. It is
    expected at its place in the site, which the fixes shift by ``off_m`` (3,) from the truth.
    """
    boxes = json.loads((flight / "truth" / "changes.json").read_text())
    middles = ORIGIN.to_utm(
        np.array([[*np.mean(b["outline_m"], axis=0), 0.0] for b in boxes]) + off_m
    )[:, :2]
    places = np.array([[o["east_m"], o["north_m"]] for o in change["objects"]]).reshape(-1, 2)
    seen = [k for k, m in enumerate(middles) if _is_compared(map_, m)]
    found, used = [], set()
    for k in seen:
        off = np.linalg.norm(places - middles[k], axis=1) if len(places) else np.array([np.inf])
        near = int(np.argmin(off))
        sign = 1.0 if boxes[k]["date"] == 2 else -1.0
        if off[near] < FOUND_M and sign * change["objects"][near]["volume_m3"] > 0:
            found.append((k, near))
            used.add(near)
    all_near = {
        n for n, p in enumerate(places) if np.linalg.norm(middles - p, axis=1).min() < 2 * FOUND_M
    }
    wrong = len(places) - len(used | all_near)
    true = sum(boxes[k]["volume_m3"] for k, _ in found)
    measured = sum(abs(change["objects"][n]["volume_m3"]) for _, n in found)
    hectares = change["compared_m2"] / 1e4
    share = 100.0 * len(found) / max(len(seen), 1)
    error = 100.0 * abs(measured / true - 1.0) if true else float("nan")
    return [
        BenchResult("boxes found", share, "%", note=f"of {len(seen)}; goal 95 %"),
        BenchResult("false objects", wrong / hectares, "/ha", note="goal 1"),
        BenchResult("volume of the boxes found, error", error, "%",
                    note=f"{true:.0f} m3; goal 2 %"),
    ]  # fmt: skip


def _is_compared(map_: Path, middle: F64) -> bool:
    """True where the map has a difference all around a place."""
    import rasterio

    with rasterio.open(map_) as image:
        row, col = image.index(*middle)
        if not (3 <= row < image.height - 3 and 3 <= col < image.width - 3):
            return False
        part = image.read(1, window=((row - 3, row + 4), (col - 3, col + 4)))
        return bool((part != image.nodata).mean() > 0.8)


# ---- a real set ------------------------------------------------------------------------------


def _real(folder: Path, frames: Path, options: DataOptions) -> list[BenchResult]:
    """Even and odd images of one flight as two: nothing may differ."""
    images = sorted(p for p in frames.iterdir() if p.suffix.lower() in (".jpg", ".jpeg"))
    scans = []
    for k, name in enumerate(("even", "odd")):
        (folder / name).mkdir(parents=True)
        for path in images[k::2]:
            shutil.copy(path, folder / name / path.name)
        scans.append(folder / f"{name}-scan")
        skyrelief("replay", str(folder / name), "--out", str(scans[-1]),
                  "--backend", options.backend)  # fmt: skip
    out = folder / "site"
    skyrelief("site", "compare", *map(str, scans), "--out", str(out))
    return real_results(out)


def real_results(out: Path) -> list[BenchResult]:
    """Seam over sigma and objects of a comparison that should show nothing."""
    import rasterio

    with rasterio.open(out / "change.tif") as image:
        height, sigma = image.read(1, masked=True), image.read(2, masked=True)
    change = json.loads((out / "change.json").read_text())
    seam = float(np.median(np.abs(height.compressed())))
    usual = float(np.median(sigma.compressed()))
    return [
        BenchResult("real, even and odd images: seam", seam, "m", peer="sigma",
                    peer_value=usual, note="goal: at most sigma"),
        BenchResult("real, even and odd images: objects", float(len(change["objects"])), "",
                    note="goal 0"),
    ]  # fmt: skip
