"""One consistent trajectory: vision, attitude, altitude, GNSS and loops in one pose graph.

An incremental smoother (iSAM2, Kaess et al. 2012, doi:10.1177/0278364911430419, by GTSAM)
holds a pose per keyframe. Vision gives the motion between keyframes; its frame is brought to
the world by a similarity fit (Umeyama 1991, doi:10.1109/34.88573) before any position enters,
because a frame with a wrong heading or scale would be sheared by them. Until the track flown
supports that fit, poses stay in the odometry's frame and say so.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from recon import graph_factors, se3
from recon.graph_factors import matrix, pose3
from recon.graph_records import Loop, Node, PoseGraphConfig, leveller, loops_agree
from recon.track_alignment import Similarity, align_track
from recon.types import F64, Pose, PosePrior

__all__ = ["PoseGraph", "PoseGraphConfig"]

_CHI2_LIMIT = 22.5  # 99.9 % of chi-square with six degrees of freedom
_BLOCK = 20  # keyframes that share one scale and one altitude bias


class PoseGraph:
    """Keyframe poses in the world, corrected as evidence comes in.

    Poses, motions and covariances use this package's conventions (left perturbations).
    """

    def __init__(self, config: PoseGraphConfig | None = None) -> None:
        """An empty graph."""
        self.config = config or PoseGraphConfig()
        self.counts: Counter[str] = Counter()  # readings left out, by reason
        self._nodes: dict[int, Node] = {}  # by keyframe number, in order of time
        self._similarity: dict[int, Similarity] = {}  # by segment, once aligned
        self._local: dict[int, Similarity] = {}  # by segment, until then
        self._loops: list[Loop] = []
        self._pending: list[Loop] = []
        self._start()

    @property
    def aligned(self) -> bool:
        """True when the newest segment's frame is the world's, by fixes."""
        if not self._nodes:
            return False
        return self._newest().segment in self._similarity

    @property
    def scale(self) -> float:
        """Metres per unit of the newest segment's odometry."""
        node = self._newest()
        keys, _ = self._drifting.get(("s", node.segment), ([], 0))
        change = self._scalar(keys[-1]) if keys else 0.0
        return self._frame(node).scale * float(np.exp(change))

    def add_keyframe(
        self,
        seq: int,
        time_ns: int,
        segment: int,
        T_odom_camera: F64,
        covariance: F64,
        prior: PosePrior,
        altitude_m: float | None = None,
        sigma_altitude_m: float = 2.0,
    ) -> Pose:
        """The new keyframe's pose after all that is known.

        Args:
            seq: number of the keyframe; greater than those before.
            segment: stretch of unbroken vision; each has an odometry frame of its own.
            T_odom_camera: (4, 4) in the segment's frame.
            covariance: (6, 6) of the motion since the last keyframe, a left perturbation in
                the last camera's frame, in units of the odometry.
            prior: attitude and position of this moment; parts may be missing.
            altitude_m: barometric or other height in world z, up to a constant bias.
        """
        if self._nodes and seq <= next(reversed(self._nodes)):
            raise ValueError(f"keyframe {seq} does not come after {next(reversed(self._nodes))}")
        if T_odom_camera.shape != (4, 4) or covariance.shape != (6, 6):
            raise ValueError("T_odom_camera must be (4, 4) and covariance (6, 6)")
        node = Node(
            len(self._nodes), time_ns, segment, np.array(T_odom_camera, np.float64),
            np.array(covariance, np.float64), self._fresh(prior), altitude_m, sigma_altitude_m,
        )  # fmt: skip
        last = self._newest() if self._nodes else None
        self._nodes[seq] = node
        if segment not in self._similarity and self._try_alignment(segment):
            self.rebuild()
        else:
            self._insert(node, last)
            self._flush()
        return self.pose(seq)

    def add_loop(self, a: int, b: int, T_a_b: F64, covariance: F64) -> bool:
        """True when the loop bent the graph; False while it waits for another that agrees.

        ``T_a_b`` (4, 4) in metres between the cameras of keyframes ``a`` and ``b``, with a
        ``covariance`` (6, 6) as a left perturbation in a's frame. One loop alone is not
        believed: a repeated texture gives perfect matches at the wrong place. A second one
        nearby must close the same circle.
        """
        if a not in self._nodes or b not in self._nodes or a == b:
            raise ValueError(f"keyframes {a} and {b} are not two of the graph")
        if a > b:
            a, b = b, a
            T_a_b, covariance = graph_factors.reversed_motion(T_a_b, covariance)
        loop = Loop(a, b, T_a_b, covariance)
        support = [other for other in self._pending + self._loops if self._agree(loop, other)]
        if not support:
            self._pending.append(loop)
            self.counts["loop waits"] += 1
            return False
        fresh = [loop, *(other for other in support if other in self._pending)]
        self._pending = [other for other in self._pending if other not in support]
        self._loops += fresh
        for item in fresh:
            self._graph.add(self._loop_factor(item))
        self._flush(extra_rounds=20)
        return True

    def pose(self, seq: int) -> Pose:
        """The pose of keyframe ``seq`` with its covariance and sources."""
        node = self._nodes[seq]
        T, covariance = self._state(node.key)
        return Pose(T, covariance, tuple(sorted(self._sources[node.key])))

    def poses(self) -> dict[int, F64]:
        """(4, 4) T_world_camera of every keyframe."""
        values = self._isam.calculateEstimate()
        return {seq: matrix(values.atPose3(n.key)) for seq, n in self._nodes.items()}

    # ---- building ----------------------------------------------------------------------------

    def _start(self) -> None:
        import gtsam

        self._gtsam = gtsam
        parameters = gtsam.ISAM2Params()
        solver = gtsam.ISAM2GaussNewtonParams()
        solver.setWildfireThreshold(0.01)  # rad and m; smaller corrections are not passed on
        parameters.setOptimizationParams(solver)
        parameters.setRelinearizeThreshold(0.3)
        parameters.relinearizeSkip = 10
        self._isam: Any = gtsam.ISAM2(parameters)
        self._graph: Any = gtsam.NonlinearFactorGraph()
        self._values: Any = gtsam.Values()
        self._sources: dict[int, set[str]] = {}
        # Keys of a drifting scalar and the number of keyframes when the last was made.
        self._drifting: dict[tuple[str, int], tuple[list[int], int]] = {}
        # Pose and covariance of the newest keyframe, predicted while it is not in the smoother.
        self._head: tuple[int, F64, F64] | None = None

    def rebuild(self) -> None:
        """Make the whole graph anew from all readings and the segments' present similarities."""
        self._start()
        last: Node | None = None
        for i, node in enumerate(self._nodes.values()):
            self._insert(node, last)
            if i % 50 == 49:
                self._flush()
            last = node
        self._flush()
        for loop in self._loops:
            self._graph.add(self._loop_factor(loop))
        self._flush(extra_rounds=20)

    def _flush(self, extra_rounds: int = 0) -> None:
        self._isam.update(self._graph, self._values)
        for _ in range(extra_rounds):
            self._isam.update()
        self._graph.resize(0)
        self._values.clear()
        self._head = None

    def _state(self, key: int) -> tuple[F64, F64]:
        """Pose and left covariance of a keyframe, predicted if it is not in the smoother yet."""
        if self._head is not None and self._head[0] == key:
            return self._head[1], self._head[2]
        T = self._estimate(key)
        right = np.asarray(self._isam.marginalCovariance(key), np.float64)
        state = (key, T, graph_factors.left_covariance(T, right))
        if key == len(self._nodes) - 1:
            self._head = state
        return state[1], state[2]

    def _insert(self, node: Node, last: Node | None) -> None:
        self._sources[node.key] = set()
        if last is None:
            T, spread = self._first(node)
        else:
            T_last, spread_last = self._state(last.key)
            motion, covariance = self._motion(node, last, T_last)
            T = T_last @ motion
            A = se3.adjoint(T_last)
            spread = np.asarray(spread_last + A @ covariance @ A.T)
            self._connect(node, last, motion, covariance)
        self._values.insert(node.key, pose3(T))
        self._head = (node.key, T, spread)
        self._add_readings(node, last, T, spread)

    def _first(self, node: Node) -> tuple[F64, F64]:
        """Pose and covariance of the first keyframe: loose where readings will tell.

        The gauge that no reading ever fixes is held at the start.
        """
        T = self._frame(node).pose(node.T_odom_camera)
        sigma_t = 50.0 if node.segment in self._similarity else 0.01
        sigma_r = 1.0 if node.prior.R_world_camera is not None else 0.01
        sigma = np.array([sigma_r] * 3 + [sigma_t] * 3)
        noise = self._gtsam.noiseModel.Diagonal.Sigmas(sigma)
        self._graph.add(self._gtsam.PriorFactorPose3(node.key, pose3(T), noise))
        return T, graph_factors.left_covariance(T, np.diag(sigma**2))

    def _connect(self, node: Node, last: Node, motion: F64, covariance: F64) -> None:
        """The motion between two keyframes; of an aligned segment, with its scale left open."""
        gtsam = self._gtsam
        noise = gtsam.noiseModel.Gaussian.Covariance(
            graph_factors.right_covariance(motion, covariance)
        )
        if node.segment != last.segment or node.segment not in self._similarity:
            self._graph.add(gtsam.BetweenFactorPose3(last.key, node.key, pose3(motion), noise))
            return
        scale = self._slow("s", node.segment, self.config.sigma_scale, self.config.sigma_scale_walk)
        keys = [last.key, node.key, scale]
        error = graph_factors.scaled_motion_error(motion)
        self._graph.add(gtsam.CustomFactor(noise, keys, error))

    def _slow(self, letter: str, group: int, sigma: float, walk: float, begin: float = 0.0) -> int:
        """Key of a scalar that drifts, a new one every twenty keyframes; made when missing.

        Blocks keep the smoother incremental: one variable for the whole flight would tie every
        keyframe to the newest reading.
        """
        gtsam = self._gtsam
        keys, since = self._drifting.get((letter, group), ([], 0))
        if keys and len(self._sources) - since < _BLOCK:
            return keys[-1]
        key = int(gtsam.symbol(letter, len(keys) + 1_000_000 * group))
        one = gtsam.noiseModel.Isotropic
        if keys:
            value = self._scalar(keys[-1])
            hold = gtsam.BetweenFactorVector(keys[-1], key, np.zeros(1), one.Sigma(1, walk))
        else:
            value = begin
            hold = gtsam.PriorFactorVector(key, np.zeros(1), one.Sigma(1, sigma))
        self._graph.add(hold)
        self._values.insert(key, np.array([value]))
        self._drifting[letter, group] = ([*keys, key], len(self._sources))
        return key

    def _scalar(self, key: int) -> float:
        if self._values.exists(key):
            return float(self._values.atVector(key)[0])
        return float(self._isam.calculateEstimateVector(key)[0])

    def _frame(self, node: Node) -> Similarity:
        """The segment's similarity; until there is one, its own frame turned to the attitude."""
        if node.segment in self._similarity:
            return self._similarity[node.segment]
        if node.segment not in self._local:
            R = node.prior.R_world_camera
            turn = np.eye(3) if R is None else R @ node.T_odom_camera[:3, :3].T
            self._local[node.segment] = Similarity(1.0, turn, np.zeros(3), 1.0)
        return self._local[node.segment]

    def _motion(self, node: Node, last: Node, T_last: F64) -> tuple[F64, F64]:
        """T_last_node in metres and its (6, 6) covariance, left, in last's frame."""
        if node.segment != last.segment:
            return self._link(node, last, T_last)
        frame = self._frame(node)
        motion = se3.inverse(frame.pose(last.T_odom_camera)) @ frame.pose(node.T_odom_camera)
        units = np.array([1.0] * 3 + [frame.scale] * 3)
        covariance = node.covariance * np.outer(units, units) + np.diag([1e-10] * 3 + [1e-6] * 3)
        covariance[3:, 3:] += self.config.sigma_step**2 * np.outer(motion[:3, 3], motion[:3, 3])
        self._sources[node.key].add("vision")
        return motion, covariance

    def _link(self, node: Node, last: Node, T_last: F64) -> tuple[F64, F64]:
        """Dead reckoning where vision was lost: telemetry's motion, or none, with wide sigmas."""
        self.counts["stretch without vision"] += 1
        T = T_last.copy()
        a, b = last.prior, node.prior
        if b.R_world_camera is not None:
            T[:3, :3] = b.R_world_camera
        if a.position_m is not None and b.position_m is not None:
            T[:3, 3] = T_last[:3, 3] + b.position_m - a.position_m
        elif node.segment in self._similarity:
            T[:3, 3] = self._frame(node).pose(node.T_odom_camera)[:3, 3]
        seconds = max((node.time_ns - last.time_ns) * 1e-9, 1.0)
        sigma = np.array(
            [self.config.sigma_link_rad] * 3 + [self.config.sigma_link_m * seconds + 5.0] * 3
        )
        self._sources[node.key].add("dead reckoning")
        return se3.inverse(T_last) @ T, np.diag(sigma**2)

    # ---- readings ----------------------------------------------------------------------------

    def _add_readings(self, node: Node, last: Node | None, T: F64, spread: F64) -> None:
        seconds = self.config.correlation_s
        gap = 1e9 if last is None else max((node.time_ns - last.time_ns) * 1e-9, 1e-3)
        # Readings that err together count as one per correlation time.
        inflate = float(np.sqrt(max(1.0, seconds / gap)))
        self._add_attitude(node, T, spread, inflate)
        if node.segment not in self._similarity:
            return
        lever = np.hstack([-se3.hat(T[:3, 3]), np.eye(3)])
        place = lever @ spread @ lever.T
        self._add_position(node, T, place, inflate)
        self._add_altitude(node, T, inflate)

    def _add_attitude(self, node: Node, T: F64, spread: F64, inflate: float) -> None:
        prior = node.prior
        if prior.R_world_camera is None:
            return
        sigma = np.array([prior.sigma_tilt_rad, prior.sigma_tilt_rad, prior.sigma_yaw_rad])
        turn = se3.so3_log(prior.R_world_camera @ T[:3, :3].T)
        allowed = self.config.gate_sigmas * np.sqrt(np.diag(spread)[:3] + sigma**2)
        if abs(turn[2]) > allowed[2]:
            self.counts["heading off"] += 1
            sigma[2] = np.pi
        if np.any(np.abs(turn[:2]) > allowed[:2]):
            self.counts["tilt off"] += 1
            return
        R = se3.so3_exp(np.array([turn[0], turn[1], turn[2] if sigma[2] < 3 else 0.0])) @ T[:3, :3]
        covariance = R.T @ np.diag((sigma * inflate) ** 2) @ R
        noise = self._robust(self._gtsam.noiseModel.Gaussian.Covariance(covariance))
        self._graph.add(self._gtsam.PoseRotationPrior3D(node.key, self._gtsam.Rot3(R), noise))
        self._sources[node.key].add("attitude")

    def _add_position(self, node: Node, T: F64, place: F64, inflate: float) -> None:
        prior = node.prior
        if prior.position_m is None or prior.sigma_position_m is None:
            return
        sigma = np.maximum(prior.sigma_position_m, 0.005)
        apart = np.abs(prior.position_m - T[:3, 3])
        if np.any(apart > self.config.gate_sigmas * np.sqrt(np.diag(place) + sigma**2)):
            self.counts["position off"] += 1
            return
        noise = self._robust(self._gtsam.noiseModel.Diagonal.Sigmas(sigma * inflate))
        self._graph.add(self._gtsam.GPSFactor(node.key, prior.position_m, noise))
        self._sources[node.key].add("gnss")

    def _add_altitude(self, node: Node, T: F64, inflate: float) -> None:
        if node.altitude_m is None:
            return
        gtsam = self._gtsam
        begin = node.altitude_m - T[2, 3]
        bias = self._slow(
            "b", 0, self.config.sigma_altitude_bias_m, self.config.sigma_altitude_walk_m, begin
        )
        noise = self._robust(gtsam.noiseModel.Isotropic.Sigma(1, node.sigma_altitude_m * inflate))
        self._graph.add(
            gtsam.CustomFactor(
                noise, [node.key, bias], graph_factors.altitude_error(node.altitude_m)
            )
        )
        self._sources[node.key].add("altitude")

    def _robust(self, noise: Any) -> Any:
        model = self._gtsam.noiseModel
        return model.Robust.Create(model.mEstimator.Huber.Create(self.config.huber_sigmas), noise)

    def _fresh(self, prior: PosePrior) -> PosePrior:
        """The prior without its position when the receiver repeats its last one."""
        if not self._nodes or prior.position_m is None:
            return prior
        before = self._newest().prior.position_m
        if before is None or not np.array_equal(before, prior.position_m):
            return prior
        self.counts["position frozen"] += 1
        return PosePrior(
            prior.R_world_camera, prior.sigma_tilt_rad, prior.sigma_yaw_rad, prior.position_m, None,
            prior.agl_m, prior.sigma_agl_m,
        )  # fmt: skip

    # ---- alignment and loops -----------------------------------------------------------------

    def _try_alignment(self, segment: int) -> bool:
        nodes = [n for n in self._nodes.values() if n.segment == segment]
        fixed = [n for n in nodes if n.prior.sigma_position_m is not None]
        places = [n.prior.position_m for n in fixed if n.prior.position_m is not None]
        sigmas = [n.prior.sigma_position_m for n in fixed if n.prior.sigma_position_m is not None]
        if len(places) < 4 or len(places) != len(sigmas):
            return False
        level = any(n.prior.R_world_camera is not None for n in nodes)
        tilt = leveller(nodes) if level else np.eye(3)
        track = np.array([tilt @ n.T_odom_camera[:3, 3] for n in fixed])
        found = align_track(
            track, np.array(places), np.array(sigmas), level, self.config.max_align_sigma
        )
        if found is None:
            return False
        self._similarity[segment] = Similarity(found.scale, found.R @ tilt, found.t, found.sigma)
        return True

    def _agree(self, one: Loop, other: Loop) -> bool:
        """True when two loops, joined by the track between their ends, close on themselves."""
        window = self.config.loop_window
        near = abs(one.a - other.a) <= window and abs(one.b - other.b) <= window
        if not near or (one.a == other.a and one.b == other.b):
            return False
        ends = (one.a, other.a, other.b, one.b)
        a, a_other, b_other, b = (self._estimate(self._nodes[i].key) for i in ends)
        return loops_agree(
            one, other, se3.inverse(a) @ a_other, se3.inverse(b_other) @ b, _CHI2_LIMIT
        )

    def _loop_factor(self, loop: Loop) -> Any:
        a, b = self._nodes[loop.a].key, self._nodes[loop.b].key
        noise = self._gtsam.noiseModel.Gaussian.Covariance(
            graph_factors.right_covariance(loop.T_a_b, loop.covariance)
        )
        self._sources[b].add("loop")
        return self._gtsam.BetweenFactorPose3(a, b, pose3(loop.T_a_b), self._robust(noise))

    def _newest(self) -> Node:
        return next(reversed(self._nodes.values()))

    def _estimate(self, key: int) -> F64:
        return matrix(self._isam.calculateEstimatePose3(key))
