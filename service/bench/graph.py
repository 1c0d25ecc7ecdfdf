"""The pose graph over a long flight: what each keyframe costs, and how long tracking stops."""

from __future__ import annotations

import statistics
import threading
import time
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from recon import se3
from recon.graph.pose_graph import PoseGraph
from recon.graph.trajectory import Trajectory
from recon.types import F64, PosePrior
from service.bench import BenchOptions, BenchResult
from service.onboard.graph_aside import GraphAside

KEYFRAMES = 5000
STEP_M = 6.0
LEG = 100
"""Keyframes of one leg; neighbouring legs see each other."""

LOOP_EVERY = 25
PART = 1000
HEIGHT_M = 60.0
MOST_BEHIND = 10
"""Keyframes that wait for the graph, at most: those of some seconds in flight."""

PAUSE_S = 1e-3
"""Between keyframes, so that tracking gets its turn; in flight it is a second."""

LOOP_SPREAD = np.diag([5e-4**2] * 3 + [0.03**2] * 3)


@dataclass(frozen=True, slots=True, eq=False)
class _Flight:
    truth: list[F64]  # T_world_camera
    odometry: list[F64]
    covariance: F64
    priors: list[PosePrior]


def run(options: BenchOptions) -> list[BenchResult]:
    """Milliseconds per keyframe, of the graph itself and of a flight that has it aside, and the
    longest that tracking had to wait for either."""
    del options  # one flight is one round
    flight = _flight()
    taken, stops, worst_m = _fly(flight, PoseGraph())
    first, last = taken[:PART], taken[-PART:]
    rows = [
        _result(f"keyframes 1 to {PART}, median", statistics.median(first),
                f"all sensors, a loop every {LOOP_EVERY}; goal 2 ms"),
        _result(f"keyframes {KEYFRAMES - PART + 1} to {KEYFRAMES}, median",
                statistics.median(last), f"{statistics.median(last) / statistics.median(first):.2f}"
                " of the first; goal: flat"),
        _result(f"keyframes 1 to {PART}, mean", statistics.fmean(first), ""),
        _result(f"keyframes {KEYFRAMES - PART + 1} to {KEYFRAMES}, mean", statistics.fmean(last),
                f"longest {max(taken):.0f} ms"),
        _result("longest stop of tracking, graph in the same process", max(stops), ""),
        BenchResult("graph", "rms place of all keyframes", worst_m, "m", note="GNSS of 1 m"),
    ]  # fmt: skip
    with closing(GraphAside()) as graph:
        taken, stops, worst_m = _fly(flight, graph)
    return [
        *rows,
        _result("aside, keyframe, median", statistics.median(taken),
                "graph in its own process, as in flight; goal 2 ms"),
        _result("aside, keyframe, longest", max(taken), "with its place, loops and corrections"),
        _result("aside, longest stop of tracking", max(stops),
                f"{KEYFRAMES} keyframes; asked every ms; goal 100 ms"),
        BenchResult("graph", "aside, rms place of all keyframes", worst_m, "m", note="the same"),
    ]  # fmt: skip


def _result(what: str, value: float, note: str) -> BenchResult:
    return BenchResult("graph", what, value, "ms", note=note)


class _Tracking:
    """Asks for the newest keyframe's place every millisecond, as tracking does with each frame."""

    def __init__(self, trajectory: Trajectory, lock: threading.Lock) -> None:
        self.stops: list[float] = []  # ms more than the pause, until the answer was there
        self._trajectory, self._lock = trajectory, lock
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
            begun = time.perf_counter()
            time.sleep(1e-3)
            with self._lock:
                newest = len(self._trajectory.graph) - 1
                if newest >= 0:
                    self._trajectory.ride(newest, np.eye(4))
            self.stops.append(1e3 * (time.perf_counter() - begun) - 1.0)


def _fly(flight: _Flight, graph: PoseGraph | GraphAside) -> tuple[list[float], list[float], float]:
    """Milliseconds of each keyframe (entered, placed, loops, corrections) and of each time that
    tracking waited; rms in metres. Keyframes come as fast as the graph follows."""
    trajectory, lock = Trajectory(graph=graph), threading.Lock()
    taken = []
    with _Tracking(trajectory, lock) as tracking:
        for i in range(KEYFRAMES):
            time.sleep(PAUSE_S)
            while isinstance(graph, GraphAside) and graph.behind > MOST_BEHIND:
                time.sleep(PAUSE_S)
            begun = time.perf_counter()
            _keyframe(flight, i, trajectory, lock)
            taken.append(1e3 * (time.perf_counter() - begun))
    graph.solve()
    apart = graph.pose_array()[:, :3, 3] - np.array(flight.truth)[:, :3, 3]
    return taken, tracking.stops, float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))


def _keyframe(flight: _Flight, i: int, trajectory: Trajectory, lock: threading.Lock) -> None:
    """One keyframe with all that a flight asks of the graph for it."""
    T, prior = flight.odometry[i], flight.priors[i]
    with lock:
        trajectory.add(i, 0, T, prior, (HEIGHT_M / 1.3, 0.0), i * 1_000_000_000, flight.covariance)
    partner = _opposite(i)
    if i % LOOP_EVERY == 0 and partner is not None:
        T_a_b = se3.inverse(flight.truth[partner]) @ flight.truth[i]
        with lock:
            trajectory.graph.add_loop(partner, i, T_a_b, LOOP_SPREAD)
    with lock:
        trajectory.tell(trajectory.place(i))
    with lock:
        for placed in trajectory.moved():
            trajectory.tell(placed)


def _opposite(i: int) -> int | None:
    """The keyframe beside ``i`` on the leg before; None on the first leg and near the turns."""
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


def _flight() -> _Flight:
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
    return _Flight(truth, odometry, covariance / np.outer(units, units), priors)


def _wander(rng: np.random.Generator, sigma: F64) -> F64:
    """(KEYFRAMES, 6) first-order Gauss-Markov errors with a time constant of 60 s."""
    keep = np.exp(-1.0 / 60.0)
    out = rng.normal(size=(KEYFRAMES, 6))
    for k in range(1, KEYFRAMES):
        out[k] = keep * out[k - 1] + np.sqrt(1 - keep**2) * out[k]
    return np.asarray(out * sigma)
