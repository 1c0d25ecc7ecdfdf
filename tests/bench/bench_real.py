"""Real flights: the quality of a replayed scan, by itself and against surveyed truth where there is
some.

Each set is a folder below ``--data``; a set that is not there is left out. No figure needs a
simulator. Seams compare the surfaces of two visits, targets are surveyed, the log is the
autopilot's. A flight that cannot be reconstructed has no figure but its trust; one that is refused
has the reason.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from bench_options import DataOptions
from pyproj import Transformer

from recon import se3
from recon.camera_model import project, rays
from recon.mapping.disagreement import NORMAL_MEDIAN
from recon.similarity import umeyama
from recon.types import F64, DepthMap, Keyframe
from service.bench import BenchResult
from service.cameras import open_camera
from service.errors import InputError, OutsideError
from service.offline.refine.control_points import ScanImages, candidates_of
from service.offline.refine.revisions import Revisions
from service.offline.refine.survey_file import Sighting, SurveyPoint
from service.scans.drawing import debug_path, load_debug
from service.scans.track import local_frame
from service.scans.trust import Trust
from service.stream.store import ScanStore

REVISIT = 6
"""Keyframes apart that see the same ground are two visits of it."""

SEAM_POINTS, SEAM_PAIRS = 400, 400
MIN_OVERLAP = 0.2
MIN_TARGET_DISTANCE_M = 10.0
MIN_PLANE_POINTS = 30
BOARD = ("--pattern", "9x6", "--square-m", "0.03")


@dataclass(frozen=True, slots=True, eq=False)
class ReplayedSet:
    """A replayed set."""

    data: Path  # the set's folder
    source: str
    scan: Path  # the scan folder
    summary: dict[str, Any]  # scan.json


Check = Callable[[ReplayedSet], Iterator[tuple[str, float, str]]]
"""Yields (figure, value, unit)."""


@dataclass(frozen=True, slots=True)
class RealSet:
    """A data set: its folder, how to replay it, and its known truth."""

    name: str
    source: str
    telemetry: str = ""
    boards: str = ""  # folder of chessboards by the same camera
    checks: tuple[Check, ...] = ()


def run(options: DataOptions) -> list[BenchResult]:
    """Replay every set that is there, and measure. Raises InputError when there is none."""
    if options.data is None:
        raise InputError("bench real needs --data with the folder that holds the real sets")
    there = [one for one in SETS if (options.data / one.source).exists()]
    if not there:
        raise InputError(f"{options.data} holds none of {', '.join(s.name for s in SETS)}")
    results = []
    for one in there:
        with tempfile.TemporaryDirectory(prefix="skyrelief-real-") as folder:
            try:
                flight = _replayed(one, options, Path(folder))
            except InputError as error:
                results.append(BenchResult(f"{one.name}: refused: {error}", 1.0, ""))
                continue
            if options.previews is not None:
                _keep_preview(flight, options.previews, one.name)
            for check in (_placed, seams, *one.checks):
                for what, value, unit in check(flight):
                    results.append(BenchResult(f"{one.name}: {what}", value, unit))
    return results


def _replayed(one: RealSet, options: DataOptions, folder: Path) -> ReplayedSet:
    assert options.data is not None
    source = options.data / one.source
    words = ["replay", str(source), "--out", str(folder / "scan"), "--backend", options.backend]
    words += ["--set", "scan.keep_debug=true"]  # whole depth images, for the seams
    if one.telemetry:
        words += ["--telemetry", str(options.data / one.telemetry)]
    if one.boards:
        model = folder / "camera.yaml"
        skyrelief("calibrate", str(options.data / one.boards), *BOARD, "--out", str(model))
        words += ["--camera-model", str(model)]
    skyrelief(*words)
    data = options.data / one.source.split("/")[0]
    summary = json.loads((folder / "scan" / "scan.json").read_text(encoding="utf-8"))
    return ReplayedSet(data, str(source), folder / "scan", summary)


def _keep_preview(flight: ReplayedSet, folder: Path, name: str) -> None:
    """Copy the scan's preview. Raises OutsideError when it cannot be written."""
    to = folder / f"{'-'.join(re.findall('[a-z0-9]+', name.lower()))}.jpg"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copy(flight.scan / "preview.jpg", to)
    except OSError as error:
        raise OutsideError(f"{to}: cannot be written: {error.strerror}") from error


def skyrelief(*words: str) -> None:
    """Run a command. Raises InputError with its last line when it refuses its input, OutsideError
    when it fails."""
    command = [sys.executable, "-m", "service.cli", *words]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no output"])[-1]
        if done.returncode == InputError.exit_code:
            raise InputError(last)
        raise OutsideError(f"skyrelief {words[0]} of {words[1]} failed: {last}")


# ---- figures without truth -------------------------------------------------------------------


def _placed(flight: ReplayedSet) -> Iterator[tuple[str, float, str]]:
    run = flight.summary["run"]
    with ScanStore.open(flight.scan / "scan.db") as store:
        placed = sum("vision" in pose.sources for pose in store.poses())
    yield "frames placed by vision", 100.0 * placed / max(run["frames"], 1), "%"
    yield "unbroken stretches", float(run["segments"]), ""
    level = Trust(flight.summary["quality"]["trust"]["level"])
    yield f"trust: {level.value}", float(list(Trust).index(level)), ""
    yield "points", flight.summary["counts"]["points"] / 1e6, "M"


def seams(flight: ReplayedSet) -> Iterator[tuple[str, float, str]]:
    """Distance between two visits of the same ground, in metres and in their claimed sigmas.

    Whole depth images are compared: a map keeps surface a second time only where the first visit
    was unsure of it.
    """
    with ScanStore.open(flight.scan / "scan.db") as store:
        maps = [whole_depth(store, keyframe) for keyframe in _keyframes(flight)]
    rng = np.random.default_rng(1)
    pairs = [(a, b) for a in range(len(maps)) for b in range(a + REVISIT, len(maps))]
    rng.shuffle(pairs)
    found = (shared_ground(maps[a], maps[b], rng) for a, b in pairs)
    some = list(islice((one for one in found if one is not None), SEAM_PAIRS))
    yield "seams: pairs of visits that share ground", float(len(some)), ""
    if some:
        apart, sigma = map(np.concatenate, zip(*some, strict=True))
        off = np.abs(apart / sigma)
        yield "seams, median", float(np.median(np.abs(apart))), "m"
        sigmas = float(np.median(off)) / NORMAL_MEDIAN
        yield "seams, robust rms over the claimed sigma", sigmas, ""
        yield "seams, within the claimed sigma", 100.0 * float(np.mean(off < 1.0)), "%"


def _keyframes(flight: ReplayedSet) -> list[Keyframe]:
    """Those that the cloud is made of."""
    left_out = flight.summary["run"]["apart"] + flight.summary["run"]["false"]
    with ScanStore.open(flight.scan / "scan.db") as store:
        return [
            keyframe
            for keyframe in store.keyframes()
            if not any(first <= keyframe.seq <= last for first, last in left_out)
        ]


def whole_depth(store: ScanStore, keyframe: Keyframe) -> DepthMap:
    """Its depth with the surface that was known before, at the scale that it has in the end."""
    stages = load_debug(debug_path(store.path.parent, keyframe.seq))
    if stages is None:
        return keyframe.depth
    repose = store.repose(keyframe.seq)
    grown = np.float32(1.0 if repose is None else repose.scale)
    return replace(
        keyframe.depth, depth_m=stages["depth_m"] * grown, sigma_m=stages["sigma_m"] * grown
    )


def shared_ground(a: DepthMap, b: DepthMap, rng: np.random.Generator) -> tuple[F64, F64] | None:
    """Depth differences of a's points in b (n,) and the sigmas of them; None without overlap."""
    known = np.flatnonzero(np.isfinite(a.depth_m))
    if not len(known):
        return None
    some = rng.choice(known, min(SEAM_POINTS, len(known)), replace=False)
    T_b_a = se3.inverse(b.T_world_camera) @ a.T_world_camera
    p = se3.transform(T_b_a, _points(a, some))
    at = np.rint(project(b.K, p))
    h, w = b.depth_m.shape
    inside = np.all((at >= 0) & (at < (w, h)), axis=1)  # NaN: behind b
    cols, rows = at[inside].astype(int).T
    there = b.depth_m[rows, cols]
    both = np.isfinite(there)
    if both.sum() < MIN_OVERLAP * len(some):
        return None
    sigma = np.hypot(a.sigma_m.ravel()[some][inside][both], b.sigma_m[rows, cols][both])
    return (p[inside, 2] - there)[both], sigma.astype(np.float64)


def _points(depth: DepthMap, known: npt.NDArray[np.intp]) -> F64:
    """(n, 3) points in the camera's frame, of flat indices whose depth is known."""
    v, u = np.divmod(known, depth.depth_m.shape[1])
    z = depth.depth_m.ravel()[known].astype(np.float64)
    return np.asarray(rays(depth.K, np.stack([u, v], axis=1).astype(np.float64)) * z[:, None])


# ---- figures with truth -----------------------------------------------------------------------


def from_log(flight: ReplayedSet) -> Iterator[tuple[str, float, str]]:
    """Horizontal distance of the delivered track to the fixes that it was replayed with."""
    from mavlink.telemetry.logs import load_telemetry

    (path,) = flight.data.glob("*.tlog")
    history = load_telemetry(path).history
    with ScanStore.open(flight.scan / "scan.db") as store:
        times = [pose.time_unix_ns for pose in store.poses()]
    states = ((time_ns, history.state_at(time_ns)) for time_ns in times)
    yield from _off_fixes(flight, {t: (s.lat_deg, s.lon_deg) for t, s in states if s is not None})


def from_tags(flight: ReplayedSet) -> Iterator[tuple[str, float, str]]:
    """Horizontal distance of the delivered track to the positions in the images' tags."""
    with ScanStore.open(flight.scan / "scan.db") as store:
        start_ns = store.header.started_unix_ns
    tags = ((image.time_ns, image.geotag) for image in open_camera(flight.source))
    yield from _off_fixes(
        flight, {start_ns + t: (tag.lat_deg, tag.lon_deg) for t, tag in tags if tag is not None}
    )


def _off_fixes(
    flight: ReplayedSet, fixes: Mapping[int, tuple[float | None, float | None]]
) -> Iterator[tuple[str, float, str]]:
    """The track against latitudes and longitudes by unix time in ns; None: no fix then."""
    with ScanStore.open(flight.scan / "scan.db") as store:
        frame, poses = local_frame(store.header), store.poses()
    placed = {_tick(pose.time_unix_ns): pose.T_world_camera[:2, 3] for pose in poses}
    off = [
        frame.to_enu(np.array([[lat, lon, 0.0]]))[0, :2] - placed[_tick(time_ns)]
        for time_ns, (lat, lon) in fixes.items()
        if frame is not None and lat is not None and lon is not None and _tick(time_ns) in placed
    ]
    if off:
        rms_m = float(np.sqrt(np.square(off).sum(axis=1).mean()))
        yield "track to fixes, horizontal rms", rms_m, "m"


def level_ground(flight: ReplayedSet) -> Iterator[tuple[str, float, str]]:
    """:func:`flatness` of the depth images that the cloud is made of."""
    return flatness(keyframe.depth for keyframe in _keyframes(flight))


def flatness(maps: Iterable[DepthMap]) -> Iterator[tuple[str, float, str]]:
    """Robust distance of points on nearly flat ground from one plane, and each keyframe's own."""
    points = []
    for depth in maps:
        known = np.flatnonzero(np.isfinite(depth.depth_m))[::97]
        points.append(se3.transform(depth.T_world_camera, _points(depth, known)))
    if not points:
        return
    sigma_m, slope = _off_plane(np.concatenate(points))
    yield "flat ground, robust sigma about a plane", sigma_m, "m"
    own = [_off_plane(xyz)[0] for xyz in points if len(xyz) > MIN_PLANE_POINTS]
    if own:
        yield "flat ground, keyframes about their own planes", float(np.median(own)), "m"
    yield "flat ground, slope", slope, "deg"


def _off_plane(xyz: F64) -> tuple[float, float]:
    """Robust sigma in m of the heights of points (N, 3) about a plane, and its slope in degrees."""
    weight = np.ones(len(xyz))
    A = np.c_[xyz[:, :2] - xyz[:, :2].mean(axis=0), np.ones(len(xyz))]
    for _ in range(10):
        plane = np.linalg.lstsq(A * weight[:, None], xyz[:, 2] * weight, rcond=None)[0]
        r = xyz[:, 2] - A @ plane
        weight = 1.0 / (1.0 + (r / (2.0 * np.median(np.abs(r)) + 1e-9)) ** 2)
    slope = float(np.degrees(np.arctan(np.hypot(*plane[:2]))))
    return float(np.median(np.abs(r))) / NORMAL_MEDIAN, slope


def targets(flight: ReplayedSet) -> Iterator[tuple[str, float, str]]:
    """Distances between surveyed targets, scaled by their median, and their horizontal rms."""
    with ScanStore.open(flight.scan / "scan.db") as store:
        revisions = Revisions(store)
        states = revisions.states()
        start = store.header.started_unix_ns
        keyframe = partial(revisions.keyframe, states)
        scan = ScanImages(states, revisions.frames(), store.header, keyframe, None)
        times = {image.name: image.time_ns for image in open_camera(flight.source)}
        placed = {_tick(frame.time_unix_ns - start) for frame in scan.frames}
        surveyed = _surveyed(flight.data / "gcp_list_1600px.txt", times, placed, start)
        found = candidates_of([point for point, _ in surveyed.values()], scan, "targets")
    mapped = {c.point.name: c.before_m for c in found if c.before_m is not None}
    pairs = [
        (np.linalg.norm(mapped[a] - mapped[b]), np.linalg.norm(surveyed[a][1] - surveyed[b][1]))
        for a, b in combinations(mapped, 2)
    ]
    ratio = np.array([m / s for m, s in pairs if s > MIN_TARGET_DISTANCE_M])
    yield "targets found", float(len(mapped)), ""
    if len(ratio):
        off = np.abs(ratio / np.median(ratio) - 1.0)
        yield "distances between targets, median error", 100.0 * float(np.median(off)), "%"
        yield "distances between targets, largest error", 100.0 * float(off.max()), "%"
        yield "targets, horizontal rms after a similarity", _flat_rms(mapped, surveyed), "m"


def _surveyed(
    path: Path, times: dict[str, int], placed: set[int], start_ns: int
) -> dict[str, tuple[SurveyPoint, F64]]:
    """Targets with marks in images that were placed, and their (2,) east and north."""
    lines = path.read_text(encoding="ascii").splitlines()
    to_globe = Transformer.from_crs(lines[0].strip(), "EPSG:4326", always_xy=True)
    out: dict[str, tuple[SurveyPoint, F64]] = {}
    for number, line in enumerate(lines[1:], 2):
        east, north, _, u, v, image, name = line.split()
        if image not in times or _tick(times[image]) not in placed:
            continue
        seconds = (start_ns + times[image]) / 1e9
        mark = Sighting(number, time_unix_s=seconds, uv_px=(float(u), float(v)))
        lon, lat = to_globe.transform(float(east), float(north))
        before = out[name][0].sightings if name in out else ()
        point = SurveyPoint(name, lat, lon, 0.0, 0.03, 1.0, False, number, (*before, mark))
        out[name] = point, np.array([float(east), float(north)])
    return out


def _tick(time_ns: int) -> int:
    """A time in whole milliseconds; the poses' own are rounded to less."""
    return round(time_ns / 1e6)


def _flat_rms(mapped: dict[str, F64], surveyed: dict[str, tuple[SurveyPoint, F64]]) -> float:
    names = list(mapped)
    ours = np.array([[*mapped[n][:2], 0.0] for n in names])
    true = np.array([[*surveyed[n][1], 0.0] for n in names])
    true -= true.mean(axis=0)
    found = umeyama(ours, true, is_level=True)
    assert found is not None
    off = found.points(ours) - true
    return float(np.sqrt((off**2).sum(axis=1).mean()))


SETS = (
    RealSet("Caliterra", "caliterra_nadir/frames", checks=(from_tags,)),
    RealSet("Caliterra, video without tags", "caliterra_nadir/caliterra_0p5fps.mp4"),
    RealSet(
        "CMAC",
        "cuav_cmac_20180805/frames",
        telemetry="cuav_cmac_20180805/flight.tlog",
        boards="cuav_cmac_20180805/calibration",
        checks=(from_log, level_ground),
    ),
    RealSet("COPR", "copr_kap_gcp/images", checks=(targets,)),
    RealSet("AP Hill", "aphill_orbit_fmv/aphill_240_1fps_crf32.mp4"),
    RealSet("AP Hill, with its metadata", "aphill_orbit_fmv/aphill_klv_10s.ts"),
    RealSet("Karma", "gopro_karma_clip/karma.mp4"),
)
