"""A scan folder against the truth of a simulated flight."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import cKDTree

from recon import se3
from recon.surface import metrics
from recon.surface.metrics import Fit
from recon.surface.raster import grid_over, rasterise_points, reliable
from recon.types import F32, F64
from service.errors import InputError
from service.georeference import LocalFrame, between_frames
from service.sim.truth import (
    MAX_JSON_BYTES,
    SeenSurface,
    Truth,
    heights_below,
    read_truth,
    read_tum,
    reading,
    seen_surface,
)
from service.small_file import read_json

REACH_M = 5.0
COMPLETE_WITHIN_M = 0.5
DSM_CELL_M = 0.25
MAX_POINTS = 300_000


@dataclass(frozen=True, slots=True, eq=False)
class ScanResult:
    """A scan folder's results, in the truth's frame when the scan is georeferenced."""

    points: F64  # (N, 3)
    sigma_m: F32 | None  # (N,)
    absolute_m: F32 | None  # (N,) sigma of the height in the world
    times_s: F64  # (P,)
    poses: F64  # (P, 4, 4)
    placed: bool  # False: coordinates are the scan's own


def score(
    scan_folder: Path,
    truth_folder: Path,
    say: Callable[[str], object] = lambda text: None,
    near_track_m: float = 40.0,
) -> dict[str, Any]:
    """All figures of a scan against the truth, ready for JSON; InputError for missing parts. Ground
    within ``near_track_m`` of the ground track counts apart, too."""
    say("reading the truth and the scan")
    truth = read_truth(truth_folder)
    scan = read_scan(scan_folder, truth.frame)
    at_truth, known = metrics.poses_at(truth.times_s, truth.poses, scan.times_s)
    pairs = int(known.sum())
    report: dict[str, Any] = {
        "points": len(scan.points),
        "poses": len(scan.times_s),
        "poses_compared": pairs,
        "altitude_m": truth.agl_m,
        "georeferenced": scan.placed,
    }
    if pairs < 2 and not scan.placed:
        raise InputError(
            f"{scan_folder}: no pose lies within the flight's time and there is no georeference; "
            "was the scan made from this flight's video?"
        )
    say("comparing trajectory and surface")
    fits = alignments(scan, truth, at_truth, known)
    report["trajectory"] = {
        name: asdict(metrics.trajectory_errors(fit.poses(scan.poses[known]), at_truth[known]))
        for name, fit in fits["trajectory"].items()
        if pairs >= 2
    }
    report["surface"] = {
        name: _surface_part(scan, scan.absolute_m if name == "raw" else scan.sigma_m, truth, fit)
        for name, fit in fits["surface"].items()
    }
    best = "rigid" if scan.placed else "similarity"
    report["judged_after"] = best
    # A wrong scale moves the rim of a placed map: only the similarity shows what else is wrong.
    chosen = fits["surface"] if scan.placed else {best: fits["surface"][best]}
    report["dsm"] = {name: _dsm(scan, truth, fit) for name, fit in chosen.items()}
    say("completeness")
    seen = seen_surface(truth)
    report["completeness"] = _completeness(scan, truth, seen, fits["surface"][best], near_track_m)
    for name, fit in fits["surface"].items():
        report["surface"][name]["fit"] = _fit_size(fit, scan.points)
    return report


def alignments(
    scan: ScanResult, truth: Truth, at_truth: F64, known: Any
) -> dict[str, dict[str, Fit]]:
    """Alignments by name: from the trajectory, and refined on the surface."""
    by_track = {"raw": Fit.identity()} if scan.placed else {}
    on_surface = dict(by_track)
    for name, with_scale in (("rigid", False), ("similarity", True)):
        fit = Fit.identity()
        if known.sum() >= 2:
            fit = metrics.fit_trajectory(scan.poses[known], at_truth[known], with_scale)
        by_track[name] = fit
        on_surface[name] = metrics.fit_surface(scan.points, truth.surface, fit, with_scale, REACH_M)
    return {"trajectory": by_track, "surface": on_surface}


def _surface_part(scan: ScanResult, sigma_m: F32 | None, truth: Truth, fit: Fit) -> dict[str, Any]:
    """Errors of the cloud after one fit, and how honest sigmas (N,) of them are."""
    step = max(1, -(-len(scan.points) // MAX_POINTS))
    points = fit.points(scan.points[::step])
    distance, signed = metrics.distances(points, truth.surface, REACH_M)
    out: dict[str, Any] = asdict(metrics.surface_errors(distance, signed, REACH_M))
    out["median_percent_of_altitude"] = 100.0 * out["median_m"] / truth.agl_m
    out["rms_percent_of_altitude"] = 100.0 * out["rms_m"] / truth.agl_m
    away = _distance_to(truth.poses[:, :3, 3], points)
    out["median_percent_of_distance"] = 100.0 * float(np.nanmedian(distance / away))
    if sigma_m is not None:
        claim = metrics.honesty(distance, sigma_m[::step] * np.float32(fit.scale))
        out["honesty"] = None if claim is None else asdict(claim)
    return out


def _dsm(scan: ScanResult, truth: Truth, fit: Fit) -> dict[str, float]:
    """The certain surface of the cloud against the truth's height at each cell's middle.
    ``known_share`` is that of the cells with any point; a step is a metre within a cell."""
    points = fit.points(scan.points)
    sigma = np.full(len(points), 0.1, np.float32) if scan.sigma_m is None else scan.sigma_m
    grid = grid_over(points[:, :2], DSM_CELL_M, margin_cells=1)
    measured = rasterise_points(points, np.zeros((len(points), 3), np.uint8), sigma, grid)
    model = reliable(measured)
    places = grid.centres(*np.indices(grid.shape).reshape(2, -1))
    height = heights_below(truth.surface, places).reshape(grid.shape)  # NaN outside
    error = (model.height_m - height)[model.known & np.isfinite(height)]
    if not len(error):
        return {"cell_m": DSM_CELL_M, "cells": 0}
    level = maximum_filter(height, 3) - minimum_filter(height, 3) < 1.0  # no NaN next to it
    away = (model.height_m - height)[model.known & level]
    return {
        "cell_m": DSM_CELL_M,
        "cells": len(error),
        "known_share": float(model.known.sum() / measured.known.sum()),
        "rms_m": float(np.sqrt(np.mean(error**2))),
        "median_m": float(np.median(error)),
        "nmad_m": float(1.4826 * np.median(np.abs(error - np.median(error)))),
        "within_30cm": float(np.mean(np.abs(error) < 0.3)),
        "rms_away_from_steps_m": float(np.sqrt(np.mean(away**2))) if len(away) else float("nan"),
    }


def _fit_size(fit: Fit, points: F64) -> dict[str, float]:
    """How much a fit moves the cloud: shift of its middle, turn and scale."""
    middle = points.mean(axis=0)
    shift = fit.points(middle[None])[0] - middle
    return {
        "shift_m": float(np.linalg.norm(shift)),
        "shift_up_m": float(shift[2]),
        "turn_deg": float(np.degrees(np.linalg.norm(se3.so3_log(fit.R)))),
        "scale": fit.scale,
    }


def _distance_to(track: F64, points: F64) -> F64:
    """(N,) distance of each of ``points`` to the nearest place of ``track``."""
    return np.asarray(cKDTree(track).query(points)[0])


def _completeness(
    scan: ScanResult, truth: Truth, seen: SeenSurface, fit: Fit, near_track_m: float
) -> dict[str, float]:
    """Share of the seen surface that the cloud has: in all, by steepness, and near the
    ground track."""
    covered = metrics.share_covered(seen.places, fit.points(scan.points), COMPLETE_WITHIN_M)
    flat = np.abs(seen.normals[:, 2]) > 0.5
    near = _distance_to(truth.poses[:, :2, 3], seen.places[:, :2]) < near_track_m
    return {
        "share": float(covered.mean()),
        "share_flat": float(covered[flat].mean()) if flat.any() else float("nan"),
        "share_steep": float(covered[~flat].mean()) if (~flat).any() else float("nan"),
        "steep_part": float((~flat).mean()),
        "share_near_track": float(covered[near].mean()) if near.any() else float("nan"),
        "near_track_m": near_track_m,
        "seen_m2": seen.area_m2,
        "within_m": COMPLETE_WITHIN_M,
    }


def read_scan(folder: Path, frame: LocalFrame) -> ScanResult:
    """The scan in ``folder``, brought into ``frame`` when it is georeferenced."""
    if not folder.is_dir():
        raise InputError(f"scan {folder}: no such folder")
    summary = read_json(folder / "scan.json", dict[str, Any], MAX_JSON_BYTES, "summary of a scan")
    points, own_m, whole_m = _read_cloud(folder / "cloud.laz")
    if len(points) == 0:
        raise InputError(f"scan {folder}: cloud.laz contains no points; nothing to score")
    times, poses = read_tum(folder / "trajectory.tum")
    origin, epsg = summary.get("origin"), summary.get("epsg")
    if not origin or not epsg:
        return ScanResult(points, own_m, whole_m, times, poses, False)
    with reading(folder / "scan.json"):
        own = LocalFrame(origin["lat_deg"], origin["lon_deg"], origin["alt_amsl_m"])
    if own.epsg != epsg:
        raise InputError(f"scan {folder}: EPSG {epsg} in scan.json is not that of its origin")
    enu = frame.to_enu(own.to_geodetic(own.from_utm(points)))
    return ScanResult(enu, own_m, whole_m, times, between_frames(frame, own) @ poses, True)


def _read_cloud(path: Path) -> tuple[F64, F32 | None, F32 | None]:
    """Points (N, 3), sigma_m and sigma_absolute_m (N,), or None, of a LAZ file."""
    import laspy

    with reading(path, laspy.errors.LaspyException):
        las = laspy.read(str(path))
        points = np.asarray(las.xyz, np.float64)
    names = set(las.point_format.extra_dimension_names)
    own, absolute = (
        np.asarray(las[name], np.float32) if name in names else None
        for name in ("sigma_m", "sigma_absolute_m")
    )
    return points, own, absolute
