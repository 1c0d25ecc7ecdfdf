"""Four drones over one place at once: how soon each is shown where it is, and the site they leave.

Depth is the true one with noise, so no image is matched. Each drone's receiver is off and wanders.
Keyframes are stored when a clock reaches their capture; the processor time of the process that
follows them is that clock, so that other load does not count.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from bench_site_scale import noisy

from recon import se3
from recon.camera_model import rays
from recon.types import F64, Pose
from service.bench import BenchResult
from service.ground.live_site import FILE, Follower, Shown
from service.offline.site.alignment import align_site
from service.sim.flight import FlightPlan, fly
from service.sim.recording import EPOCH_UNIX_S, ORIGIN, Simulation, SimulationOptions, prepare
from service.stream.records import ScanHeader
from service.stream.store import ScanStore

HEADINGS_DEG = (0.0, 45.0, 90.0, 135.0)
SIZE_PX, SITE_M, HEIGHT_M, SPEED_M_S = (320, 180), 260.0, 60.0, 5.0
KEYFRAME_S = 1.4
OFF_M, WANDER_M = 1.0, 0.05
"""Sigmas of a receiver's error: at the start, and of what each keyframe adds."""

OVERLAP = 0.2
"""Share of a view from which two drones see the same place."""


@dataclass(frozen=True, slots=True, eq=False)
class Drone:
    """One flight: true poses, and where its receiver puts them."""

    name: str
    poses: F64  # (N, 4, 4)
    errors_m: F64  # (N, 3)
    views: list[F64]  # (4, 2) corners of the ground that each keyframe sees, m
    keyframes: list[list[bytes]]


def run(
    folder: Path, duration_s: float = 100.0, headings_deg: Sequence[float] = HEADINGS_DEG
) -> list[BenchResult]:
    """The figures of four drones that fly so long, in ``folder``."""
    drones = drones_of(duration_s, headings_deg)
    first = replace(drones[0], poses=drones[0].poses[:2], errors_m=drones[0].errors_m[:2])
    twins = [replace(first, name=drone.name) for drone in drones[:2]]
    _followed(twins, folder / "warm-up")
    live, apart_m = _followed(drones, folder / "live")
    site = align_site(
        [folder / "live" / d.name / d.name for d in drones], folder / "site", deliver=False
    )
    return _live_results(live, apart_m, drones) + _site_results(site.document, drones, folder)


def drones_of(duration_s: float, headings_deg: Sequence[float]) -> list[Drone]:
    """Four flights of three legs over the middle of one place."""
    plans = [
        FlightPlan("legs", duration_s, HEIGHT_M, SPEED_M_S, heading, spacing_m=25.0, centred=True)
        for heading in headings_deg
    ]
    simulation = prepare(
        SimulationOptions(
            plans[0], seed=3, size_px=SIZE_PX, site_m=SITE_M, depth_frames=0,
            distortion=(0.0, 0.0, 0.0, 0.0, 0.0),
        )
    )  # fmt: skip
    return [_drone(simulation, plan, k) for k, plan in enumerate(plans)]


def _drone(simulation: Simulation, plan: FlightPlan, k: int) -> Drone:
    rng = np.random.default_rng([5, k])
    K, (w, h) = simulation.options.camera.K, SIZE_PX
    edges = rays(K, np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]]))
    times_s = KEYFRAME_S * np.arange(int(np.ceil(plan.duration_s / KEYFRAME_S)), dtype=np.float64)
    poses = fly(plan, 10 + k).T_world_camera(times_s)
    wander = rng.normal(size=(len(poses), 3)) * WANDER_M
    errors = rng.normal(size=3) * OFF_M + np.cumsum(wander, axis=0)
    spread = np.diag([0.003**2] * 3 + [OFF_M**2] * 3)
    views, keyframes = [], []
    for seq, (T, error) in enumerate(zip(poses, errors, strict=True)):
        placed = se3.compose(np.eye(3), error) @ T
        A = se3.adjoint(se3.compose(np.eye(3), placed[:3, 3]))
        pose = Pose(placed, A @ spread @ A.T, ("vision", "gnss"))
        image = simulation.renderer.frame(T, seq, simulation.options.look)
        depth = simulation.renderer.depth(T)
        keyframes.append(noisy(seq, _time_ns(seq), image, depth, K, pose, rng))
        ways = edges @ T[:3, :3].T
        views.append((T[:3, 3] - ways * (T[2, 3] / ways[:, 2:]))[:, :2])
    return Drone(f"drone-{k}", poses, errors, views, keyframes)


def _time_ns(seq: int) -> int:
    return int((EPOCH_UNIX_S + seq * KEYFRAME_S) * 1e9)


# ---- in flight -------------------------------------------------------------------------------


@dataclass(slots=True, eq=False)
class Live:
    """What was seen while the drones flew."""

    together_s: dict[tuple[int, int], float]  # when two were first shown at one place
    longest_s: float = 0.0  # of a turn
    busy_s: float = 0.0  # of all turns


def _followed(drones: Sequence[Drone], store: Path) -> tuple[Live, float]:
    """The drones followed to their end, and the most that two are then shown apart, m."""
    live, begun, clock_s, flown = Live({}), time.time(), 0.0, 0
    count = max(len(d.poses) for d in drones)
    with ExitStack() as stack:
        scans = [stack.enter_context(_store(store, drone)) for drone in drones]
        follower, is_busy = Follower(store), False
        while flown < count or is_busy:
            if not is_busy:
                clock_s = max(clock_s, flown * KEYFRAME_S)
            while flown < count and flown * KEYFRAME_S <= clock_s:
                for scan, drone in zip(scans, drones, strict=True):
                    scan.add_keyframe(flown, drone.keyframes[flown])
                flown += 1
            before_s = time.process_time()
            is_busy = follower.turn(begun)
            turn_s = time.process_time() - before_s
            live.longest_s, live.busy_s = max(live.longest_s, turn_s), live.busy_s + turn_s
            clock_s += turn_s
            shown = _shown(store, drones)
            for a, b in combinations(sorted(shown), 2):
                if shown[a].group == shown[b].group:
                    live.together_s.setdefault((a, b), clock_s)
        for scan, drone in zip(scans, drones, strict=True):
            scan.finish({"frames": len(drone.poses)})
    return live, _apart_m(shown, drones)


def _store(store: Path, drone: Drone) -> ScanStore:
    header = ScanHeader(
        drone.name, drone.name, _time_ns(0), run_id=f"{1 + int(drone.name[-1]):032x}",
        origin_lat_deg=ORIGIN.lat_deg, origin_lon_deg=ORIGIN.lon_deg,
        origin_alt_amsl_m=ORIGIN.alt_amsl_m, epsg=ORIGIN.epsg, georeference="gnss",
    )  # fmt: skip
    return ScanStore.create(store / drone.name / drone.name / "scan.db", header)


def _shown(store: Path, drones: Sequence[Drone]) -> dict[int, Shown]:
    """Where the portal has each drone, by its number."""
    path, at = store / FILE, {d.name: k for k, d in enumerate(drones)}
    found = msgspec.json.decode(path.read_bytes(), type=list[Shown]) if path.is_file() else []
    return {at[one.drone]: one for one in found}


def _apart_m(shown: dict[int, Shown], drones: Sequence[Drone]) -> float:
    """The most, along any axis, that the mean errors of two drones' tracks differ."""
    off = []
    for k, one in shown.items():
        moved = np.reshape(one.moved, (4, 4)) @ np.reshape(one.T_site_scan, (4, 4))
        had = drones[k].poses[:, :3, 3] + drones[k].errors_m
        off.append((se3.transform(moved, had) - drones[k].poses[:, :3, 3]).mean(axis=0))
    return float(np.ptp(off, axis=0).max())


def _first_overlap_s(one: Drone, two: Drone) -> float:
    """When a keyframe of one first shows OVERLAP of a view of the other; inf for never."""
    for k in range(len(one.views)):
        pairs = [(one.views[k], v) for v in two.views[: k + 1]]
        pairs += [(two.views[k], v) for v in one.views[:k]]
        for a, b in pairs:
            area, _ = cv2.intersectConvexConvex(a.astype(np.float32), b.astype(np.float32))
            if area >= OVERLAP * cv2.contourArea(a.astype(np.float32)):
                return k * KEYFRAME_S
    return float("inf")


def _live_results(live: Live, apart_m: float, drones: Sequence[Drone]) -> list[BenchResult]:
    pairs = list(combinations(range(len(drones)), 2))
    late_s = [
        live.together_s.get(p, np.inf) - _first_overlap_s(*(drones[k] for k in p)) for p in pairs
    ]
    had = float(np.ptp([d.errors_m.mean(axis=0) for d in drones], axis=0).max())
    path_m = len(drones) * drones[0].poses.shape[0] * KEYFRAME_S * SPEED_M_S
    note = f"{len(live.together_s)} of {len(pairs)} pairs, {path_m:.0f} m of path; goal 5 s"
    busy = f"{live.busy_s:.0f} s in all, of a flight of {len(drones[0].poses) * KEYFRAME_S:.0f} s"
    return [
        BenchResult("four drones: shown together, after the first overlap", max(late_s),
                    "s", note=note),
        BenchResult("four drones: longest turn", live.longest_s, "s", note=busy),
        BenchResult("four drones: shown apart at the end", apart_m, "m", peer="by fixes",
                    peer_value=had),
    ]  # fmt: skip


# ---- afterwards ------------------------------------------------------------------------------


def _site_results(
    document: dict[str, Any], drones: Sequence[Drone], folder: Path
) -> list[BenchResult]:
    """The site of the four scans against the truth."""
    here, there, means = [], [], []
    with ScanStore.open(folder / "site" / "scan.db", read_only=True) as site:
        for scan, drone in zip(document["scans"], drones, strict=True):
            seqs = range(scan["keyframes"][0], scan["keyframes"][1] + 1)
            found = [site.repose(seq) for seq in seqs]
            at = np.array([one.T_world_camera[:3, 3] for one in found if one is not None])
            here.append(at)
            there.append(drone.poses[:, :3, 3])
            means.append((at - drone.poses[:, :3, 3]).mean(axis=0))
    ends = [np.concatenate(x) - np.concatenate(x).mean(axis=0) for x in (here, there)]
    wide = float(np.sqrt(np.sum(ends[0][:, :2] ** 2) / np.sum(ends[1][:, :2] ** 2)))
    scales = [scan["scale"] for scan in document["scans"]]
    pairs, tied = document["pairs"], len({scan["placed"] for scan in document["scans"]}) == 1
    ties = sum(p["ties"] for p in pairs)
    return [
        BenchResult("four drones: site too small by", 100.0 * (1.0 - wide), "%",
                    note=f"scales {min(scales):.3f} to {max(scales):.3f}"),
        BenchResult("four drones: middles apart in the site",
                    float(np.ptp(means, axis=0).max()), "m",
                    note=f"{'one site' if tied else 'not one site'}, {len(pairs)} pairs, "
                    f"{ties} ties"),
    ]  # fmt: skip
