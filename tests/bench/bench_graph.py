"""The pose graph over a long flight: what each keyframe costs, and how long tracking stops."""

from __future__ import annotations

import statistics
import subprocess
import sys
import threading
import time
from dataclasses import dataclass

import numpy as np

from recon import se3
from recon.posegraph.pose_graph import PoseGraph
from recon.posegraph.records import Loop, Node
from recon.posegraph.trajectory import Trajectory, carried
from recon.types import F64, Pose, PosePrior
from service.bench import BenchOptions, BenchResult
from service.config import FusionConfig
from service.flight.scan import short_collections

KEYFRAMES = 5000
STEP_M = 6.0
LEG = 100
"""Keyframes of one leg; neighbouring legs see each other."""

LOOP_EVERY = 10
PART = 1000
HEIGHT_M = 60.0
PAUSE_S = 5e-3
"""Between keyframes; in flight it is a second."""

IDLE = """
import select, sys, time
longest_s = 0.0
while not select.select([sys.stdin], [], [], 0)[0]:
    begun = time.perf_counter()
    time.sleep(1e-3)
    longest_s = max(longest_s, time.perf_counter() - begun - 1e-3)
print(1e3 * longest_s)
"""
"""A process that only sleeps: its longest stop is the machine's."""

LOOP_SPREAD = np.diag([5e-4**2] * 3 + [0.03**2] * 3)


@dataclass(frozen=True, slots=True, eq=False)
class _Course:
    truth: list[F64]  # T_world_camera
    odometry: list[F64]
    covariance: F64
    priors: list[PosePrior]


def run(options: BenchOptions) -> list[BenchResult]:
    """Milliseconds per keyframe and per loop, and the longest that tracking had to wait."""
    del options  # one flight is one round
    flight, flown = _flight(), _TimedTrajectory()
    tracking = _Tracking(flown)
    idle = subprocess.Popen(
        [sys.executable, "-c", IDLE], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    with short_collections(), tracking:
        for i in range(KEYFRAMES):
            time.sleep(PAUSE_S)
            _keyframe(flight, i, flown)
    idle_ms = float(idle.communicate()[0])
    flown.correct(final=True)
    apart = flown.trajectory.places(range(KEYFRAMES)) - np.array(flight.truth)
    worst_m = float(np.sqrt(np.mean(np.sum(apart[:, :3, 3] ** 2, axis=1))))
    first, last, graph = flown.taken[:PART], flown.taken[-PART:], flown.trajectory.graph
    return [
        _result(f"keyframes 1 to {PART}, median", statistics.median(first),
                f"all sensors, a loop every {LOOP_EVERY}; goal 2 ms"),
        _result(f"keyframes {KEYFRAMES - PART + 1} to {KEYFRAMES}, median",
                statistics.median(last), f"{statistics.median(last) / statistics.median(first):.2f}"
                " of the first; goal: flat"),
        _result(f"keyframes 1 to {PART}, mean", statistics.fmean(first), ""),
        _result(f"keyframes {KEYFRAMES - PART + 1} to {KEYFRAMES}, mean", statistics.fmean(last),
                f"longest {max(flown.taken):.0f} ms; {len(graph)} of them are nodes"),
        BenchResult("longest stop of tracking", max(tracking.stops), "ms",
                    peer="process that only sleeps", peer_value=idle_ms,
                    note=f"{KEYFRAMES} keyframes; looked every ms"),
        _result("of a stop, in which the graph worked, longest", max(tracking.waits),
                "processor time of its thread meanwhile; goal 15 ms"),
        _result("loop, until the whole map is corrected, longest", max(flown.corrected),
                f"{len(flown.corrected)} loops taken, up to {flown.most} moved; goal 1 s"),
        BenchResult("rms place of all keyframes", worst_m, "m", note="GNSS of 1 m"),
    ]  # fmt: skip


def _result(what: str, value: float, note: str) -> BenchResult:
    return BenchResult(what, value, "ms", note=note)


class _TimedTrajectory:
    """The trajectory as the reconstruction keeps it, and how long that took."""

    def __init__(self) -> None:
        self.trajectory = Trajectory(graph=PoseGraph(FusionConfig().graph_keyframes))
        self.newest: Pose | None = None  # what tracking reads
        self.taken: list[float] = []  # ms of each keyframe: entered, placed, loops, corrections
        self.corrected: list[float] = []  # ms of each taken loop with its corrections
        self.most = 0  # keyframes moved at once

    def correct(self, final: bool = False) -> None:
        """Publish what has moved."""
        self.most = max(self.most, len(self.trajectory.moved(final)))


class _Tracking:
    """Places a frame by the newest keyframe every millisecond, on a separate thread."""

    def __init__(self, flown: _TimedTrajectory) -> None:
        self.stops: list[float] = []  # ms more than the pause, until the frame was placed
        self.waits: list[float] = []  # ms of those in which the graph's thread ran, not others
        self._clock = time.pthread_getcpuclockid(threading.get_ident())  # of the graph's thread
        self._flown = flown
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> _Tracking:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._end.is_set():
            begun, worked = time.perf_counter(), time.clock_gettime(self._clock)
            time.sleep(1e-3)
            if self._flown.newest is not None:
                carried(self._flown.newest, np.eye(4))
            self.stops.append(1e3 * (time.perf_counter() - begun) - 1.0)
            worked_ms = 1e3 * (time.clock_gettime(self._clock) - worked)
            self.waits.append(min(self.stops[-1], worked_ms))


def _keyframe(flight: _Course, i: int, flown: _TimedTrajectory) -> None:
    """One keyframe with all that a flight asks of the graph for it."""
    T, prior, trajectory = flight.odometry[i], flight.priors[i], flown.trajectory
    begun = time.perf_counter()
    trajectory.add(Node(i, i * 10**9, 0, T, flight.covariance, prior, HEIGHT_M / 1.3))
    trajectory.publish(i, trajectory.pose(i))
    partner, is_taken, before = _opposite(i), False, time.perf_counter()
    if i % LOOP_EVERY == 0 and partner is not None:
        T_a_b = se3.inverse(flight.truth[partner]) @ flight.truth[i]
        is_taken = trajectory.add_loop(Loop(partner, i, T_a_b, LOOP_SPREAD))
    flown.correct()
    flown.newest = trajectory.pose(i)
    now = time.perf_counter()
    flown.taken.append(1e3 * (now - begun))
    if is_taken:
        flown.corrected.append(1e3 * (now - before))


def _opposite(i: int) -> int | None:
    """Keyframe ``i``'s neighbour on the leg before; None on the first leg and near the turns."""
    leg, along = divmod(i, LEG)
    if leg == 0 or not 15 < along < LEG - 15:
        return None
    return (leg - 1) * LEG + LEG - 1 - along


def legs(rng: np.random.Generator, count: int, leg_count: int, step_m: float) -> list[F64]:
    """(4, 4) T_world_camera of so many keyframes, ``leg_count`` a leg, flown to and fro at 60 m."""
    truth = []
    for i in range(count):
        leg, along = divmod(i, leg_count)
        x = step_m * (along if leg % 2 == 0 else leg_count - 1 - along)
        turn = se3.so3_exp(np.array([0.0, 0.0, np.pi * (leg % 2)]))
        wobble = se3.so3_exp(rng.normal(size=3) * 0.02)
        place = np.array([x, 20.0 * leg, HEIGHT_M]) + rng.normal(size=3) * 0.2
        truth.append(se3.compose(turn @ np.diag([1.0, -1.0, -1.0]) @ wobble, place))
    return truth


def _flight() -> _Course:
    """Legs to and fro with wandering sensors and an odometry of another scale that drifts."""
    rng = np.random.default_rng(1)
    truth = legs(rng, KEYFRAMES, LEG, STEP_M)
    covariance = np.diag([1e-4**2] * 3 + [0.01**2] * 3)
    noise = rng.multivariate_normal(np.zeros(6), covariance, KEYFRAMES)
    odometry = [np.eye(4)]
    for a, b, error in zip(truth[:-1], truth[1:], noise[1:], strict=True):
        motion = se3.exp(error) @ se3.inverse(a) @ b
        motion[:3, 3] /= 1.3
        odometry.append(odometry[-1] @ motion)
    wander = _wander(rng, np.array([1.0, 1.0, 1.5, 0.005, 0.005, 0.02]))
    priors = [
        PosePrior(
            se3.so3_exp(w[3:]) @ T[:3, :3], 0.02, 0.05, T[:3, 3] + w[:3], np.array([1, 1, 1.5]),
            HEIGHT_M, 3.0, T[2, 3] + 4.0, 0.5,
        )
        for T, w in zip(truth, wander, strict=True)
    ]  # fmt: skip
    units = np.array([1.0] * 3 + [1.3] * 3)
    return _Course(truth, odometry, covariance / np.outer(units, units), priors)


def _wander(rng: np.random.Generator, sigma: F64) -> F64:
    """(KEYFRAMES, 6) first-order Gauss-Markov errors with a time constant of 60 s."""
    keep = np.exp(-1.0 / 60.0)
    out = rng.normal(size=(KEYFRAMES, 6))
    for k in range(1, KEYFRAMES):
        out[k] = keep * out[k - 1] + np.sqrt(1 - keep**2) * out[k]
    return np.asarray(out * sigma)
