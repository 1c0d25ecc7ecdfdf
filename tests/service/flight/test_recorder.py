"""What the recorder writes, and in how many transactions."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import MagicMock, Mock

import numpy as np
import pytest
from onboard import real_scan
from some_views import view_at

from mavlink.telemetry.history import VehicleHistory
from mavlink.telemetry.samples import PositionSample
from recon import se3
from recon.backends.cpu import CpuBackend
from recon.camera_model import scaled_K
from recon.pipeline.keyframe_map import FramePoses, KeyframeMap
from recon.pipeline.mapper import FramePosed, KeyframeReady, PosesChanged
from recon.pipeline.stages import untimed
from recon.posegraph.alignment import Scale
from recon.posegraph.alignment_readings import Alignment
from recon.posegraph.pose_graph import PoseGraph
from recon.posegraph.segments import Segments
from recon.posegraph.trajectory import Trajectory
from recon.tracking.frame import NO_IMAGE, Frame, Tracking
from recon.types import DepthMap, Keyframe, Pose, PosePrior
from service.cameras.rig import Rig
from service.cameras.source import CameraFrame
from service.errors import OutsideError
from service.flight.recorder import REPLAYED, Recorder
from service.scans.drawing import debug_path, load_debug
from service.scans.folder import write_deliverables
from service.stream.codec import IMAGE_SHARE
from service.stream.records import PoseRecord, ScanHeader, pack_pose
from service.stream.store import ScanStore

if TYPE_CHECKING:
    from house_flight import HouseFlight


def pose(seq: int, of_m: float) -> Pose:
    """A pose of this sigma in all three directions together."""
    T = se3.compose(np.diag([1.0, -1.0, -1.0]), np.array([0.5 * seq, 0.0, 50.0]))
    return Pose(T, se3.about(-T[:3, 3], np.eye(6) * of_m**2 / 3.0))


def posed(seq: int, of_m: float = 0.1) -> FramePosed:
    frame = Frame(NO_IMAGE, 1_000_000 * seq, seq, segment=0, state=Tracking.TRACKED)
    return FramePosed(replace(frame, T_keyframe_camera=np.eye(4)), pose(seq, of_m))


def lost(seq: int) -> FramePosed:
    return FramePosed(Frame(NO_IMAGE, 1_000_000 * seq, seq, state=Tracking.LOST))


class CountingStore(ScanStore):
    """Knows how many poses each transaction had."""

    transactions: tuple[int, ...] = ()

    def add_poses(self, poses: Sequence[PoseRecord]) -> int:
        self.transactions += (len(poses),)
        return super().add_poses(poses)


def recorder_of(store: ScanStore, batch: int, of_m: float, graph: object = None) -> Recorder:
    """A recorder of frames that do not move, and whose sigma is ``of_m`` in the end."""

    def place(frame: Frame) -> Pose:
        assert np.array_equal(frame.T_odom_camera, np.eye(4))
        return pose(frame.seq, of_m)

    pipeline = MagicMock()
    pipeline.mapper.keyframe_map.graph = graph
    pipeline.mapper.frame_poses.place = place
    pipeline.mapper.is_settled.return_value = False
    return Recorder(store, pipeline, Mock(Rig, local_frame=None, georeference="none"), batch=batch)


@pytest.mark.parametrize(("batch", "transactions"), [(1, 20), (REPLAYED, 2)])
def test_poses_of_a_recording_share_transactions(
    tmp_path: Path, batch: int, transactions: int
) -> None:
    header = ScanHeader("recorded", "drone", 0)
    with CountingStore.create(tmp_path / "scan.db", header) as store:
        assert isinstance(store, CountingStore)
        recorder = recorder_of(store, batch, 0.1)
        for seq in range(20):
            recorder.write([posed(seq)])
        recorder.flush()
        assert [pose.time_unix_ns for pose in store.poses()] == [1_000_000 * n for n in range(20)]
        assert len(store.transactions) == transactions and sum(store.transactions) == 20


def test_a_still_that_the_next_one_places_is_no_longer_lost(tmp_path: Path) -> None:
    with ScanStore.create(tmp_path / "scan.db", ScanHeader("stills", "drone", 0)) as store:
        recorder = recorder_of(store, 1, 0.1)
        recorder.write([lost(1)], 30.0)
        assert recorder.states == {Tracking.LOST: 1}
        recorder.write([posed(1), posed(2)], 31.0)
        recorder.flush()
        assert [(p.time_unix_ns, p.agl_m) for p in store.poses()] == [
            (1_000_000, 30.0),
            (2_000_000, 31.0),
        ]
        assert recorder.frames == 2 and +recorder.states == {Tracking.TRACKED: 2}


def test_poses_published_before_the_scan_was_placed_get_their_sigma(tmp_path: Path) -> None:
    with ScanStore.create(tmp_path / "scan.db", ScanHeader("rtk", "drone", 0)) as store:
        recorder = recorder_of(store, 1, 0.02)
        for seq, sigma_m in enumerate([np.sqrt(3.0), np.sqrt(3.0), 0.021, 0.02]):
            recorder.write([posed(seq, sigma_m)])
        recorder.flush()
        found = [pose.sigma_m for pose in store.poses()]
        assert found == pytest.approx([0.02, 0.02, 0.02, 0.02], abs=1e-4)


def test_a_frame_that_turned_in_its_place_is_written_again(tmp_path: Path) -> None:
    with ScanStore.create(tmp_path / "scan.db", ScanHeader("scan", "drone", 0)) as store:
        recorder = recorder_of(store, 1, 0.1)
        for seq, yaw_rad in enumerate([0.0, 0.0009, 0.2]):
            turned = posed(seq)
            assert turned.pose is not None
            T = turned.pose.T_world_camera.copy()
            T[:3, :3] = se3.so3_exp(np.array([0.0, 0.0, yaw_rad])) @ T[:3, :3]
            recorder.write([replace(turned, pose=replace(turned.pose, T_world_camera=T))])
        recorder.flush()
        yaws = [pose.yaw_rad for pose in store.poses()]
        assert yaws[0] == yaws[1] == yaws[2]


def stored_by(folder: Path, delay: int) -> list[PoseRecord]:
    """Poses of a flight whose keyframes are done so many frames late; the seventh one is lost."""
    keyframes = KeyframeMap(Trajectory(), None, CpuBackend(), Counter(), untimed)
    frames = FramePoses(keyframes, lambda frame: True)
    pipeline = MagicMock()
    pipeline.mapper.frame_poses = frames
    turn = se3.so3_exp(np.array([np.pi, 0.0, 0.3]))
    done = deque[tuple[int, Frame, Pose]]()
    with ScanStore.create(folder / "scan.db", ScanHeader("scan", "drone", 0)) as store:
        rig = Mock(Rig, local_frame=None, georeference="none")
        recorder = Recorder(store, pipeline, rig)
        for seq in range(10):
            T = se3.compose(turn, np.array([5.0 * seq, 0.1 * seq**2, 50.0]))
            fix = T[:3, 3] + 0.02 * np.sin([seq, 2.0 * seq, 3.0 * seq])
            prior = PosePrior(turn, 0.01, 0.02, fix, np.full(3, 1.0), agl_m=50.0)
            view = view_at(seq, T, prior=prior)
            is_lost = seq == 6
            if not is_lost:
                done.append((seq + delay, view.frame, keyframes.add(view, None)))
            while done and done[0][0] < seq:
                frames.add_view(*done.popleft()[1:])
            state = Tracking.LOST if is_lost else Tracking.TRACKED
            T_odom = None if is_lost else T
            frame = replace(view.frame, time_ns=seq * 10**9, state=state, T_keyframe_camera=T_odom)
            recorder.write([FramePosed(frame, frames.place(frame))])
        for _, late, its_pose in done:
            frames.add_view(late, its_pose)

        def finish() -> tuple[()]:
            keyframes.trajectory.moved(final=True)
            frames.finish()
            return ()

        pipeline.mapper.finish.side_effect = finish
        recorder.flush()
        return store.poses()


def test_a_slow_computer_stores_the_same_poses_as_a_fast_one(tmp_path: Path) -> None:
    """All that it publishes later is within some cm of what a fast one publishes."""
    (tmp_path / "slow").mkdir()
    fast, slow = stored_by(tmp_path, 0), stored_by(tmp_path / "slow", 5)
    assert len(fast) == 10 and fast[6].sources == ("attitude", "gnss", "dead reckoning")
    assert "vision" in fast[1].sources
    assert list(map(pack_pose, slow)) == list(map(pack_pose, fast))


def test_a_pose_has_the_speed_and_the_turn_since_the_one_before(tmp_path: Path) -> None:
    """A camera that looks ahead and down flies 2.5 m in 0.5 s, and turns right by 0.1 rad."""
    flown = dict[int, Pose]()
    look = se3.so3_exp(np.array([2.2, 0.0, 0.0]))
    for seq in range(4):
        right = se3.so3_exp(np.array([0.0, 0.0, -0.1 * seq]))
        T = se3.compose(right @ look, np.array([1.5 * seq, 2.0 * seq, 50.0]))
        flown[seq] = Pose(T, np.eye(6))
    with ScanStore.create(tmp_path / "scan.db", ScanHeader("scan", "drone", 0)) as store:
        recorder = recorder_of(store, 1, 0.1)
        recorder.mapper.frame_poses.place = lambda frame: flown[frame.seq]  # type: ignore[method-assign]
        for seq, one in flown.items():
            frame = replace(posed(seq).frame, time_ns=500_000_000 * max(seq, 1))
            recorder.write([FramePosed(frame, one)])
            assert recorder.last is not None
            assert recorder.speed_m_s == recorder.last.speed_m_s
            assert recorder.turn_rate_rad_s == recorder.last.turn_rate_rad_s
            at_once = seq < 2  # the first two have one time: no speed is known
            assert recorder.speed_m_s == pytest.approx(0.0 if at_once else 5.0)
            assert recorder.turn_rate_rad_s == pytest.approx(0.0 if at_once else 0.2)
            assert recorder.distance_m == pytest.approx(2.5 * max(seq - 1, 0))
        recorder.flush()
        speeds = [(p.speed_m_s, p.turn_rate_rad_s, p.distance_m) for p in store.poses()]
    assert speeds == [
        pytest.approx((0.0, 0.0, 0.0)),
        pytest.approx((5.0, 0.2, 2.5)),
        pytest.approx((5.0, 0.2, 5.0)),
    ]


def test_frames_that_no_keyframe_carries_stay_as_published(tmp_path: Path) -> None:
    with CountingStore.create(tmp_path / "scan.db", ScanHeader("stills", "drone", 0)) as store:
        recorder = recorder_of(store, 1, 5.0)
        for seq in range(4):
            recorder.write([posed(seq, 5.0)])
        recorder.flush()
        assert isinstance(store, CountingStore) and store.transactions == (1, 1, 1, 1)
        assert [pose.sigma_m for pose in store.poses()] == pytest.approx([5.0] * 4)


@pytest.mark.parametrize(
    ("sources", "sigma", "by"),
    [
        (("attitude", "gnss"), 0.01, "attitude, gnss"),
        (("attitude",), 0.5, "an assumed height"),
        (("attitude",), 0.02, "velocity"),
        ((), 0.5, "an assumed height"),
    ],
)
def test_the_scale_names_what_measured_it(
    sources: tuple[str, ...], sigma: float, by: str, tmp_path: Path
) -> None:
    covariance = np.diag([0.0] * 6 + [sigma**2])
    found = Alignment(1.0, np.eye(3), np.zeros(3), covariance, sources)
    graph = Mock(PoseGraph, segments=Mock(Segments))
    graph.segments.largest.return_value.to_world = found
    with ScanStore.create(tmp_path / "scan.db", ScanHeader("s", "drone", 0)) as store:
        recorder = recorder_of(store, 1, 0.1, graph)

        def scale(growth: float, *by_sensor: Scale | None) -> dict[str, Any]:
            graph.largest_growth.return_value = growth
            graph.segments.largest_scales.return_value = by_sensor
            said: dict[str, Any] = recorder.summary()["scale"]
            return said

        assert scale(-2.0 * sigma, None, None) == {"from": by, "sigma": sigma}
        apart = scale(-2.0 * sigma, (1.2, 0.01), (1.0, 0.03))
        assert apart["gnss_over_heights"] == pytest.approx(1.2)
        alike = scale(-2.0 * sigma, (1.2, 0.01), (1.0, 0.1))
        assert "gnss_over_heights" not in alike
        grown = scale(-0.1 - 3.0 * sigma, None, None)
        assert grown["sigma"] == pytest.approx(0.1 + 3.0 * sigma)


def test_each_keyframe_has_its_image_within_the_flights_budget(
    tmp_path: Path, house: HouseFlight
) -> None:
    """Where little is new the image of what is known still travels, at what the flight saved.

    A grainy image at its best is more than one keyframe leaves for it.
    """
    rng = np.random.default_rng(3)
    with ScanStore.create(tmp_path / "scan.db", ScanHeader("scan", "drone", 0)) as store:
        recorder = recorder_of(store, 1, 0.1)
        for seq in range(8):
            one = larger(house.keyframe(seq, 5.0 * seq), 3, rng)
            grain = rng.integers(0, 190, one.bgr.shape)
            one = replace(one, bgr=np.minimum(one.bgr // 2 + grain, 255).astype(np.uint8))
            one = replace(one, fresh=one.fresh & (seq % 2 == 0))
            recorder.write([KeyframeReady(one), posed(seq)])
        images = [store.image(k) or b"" for k in range(8)]
    assert all(images) and sum(map(len, images)) == recorder.image_bytes
    assert recorder.image_bytes <= IMAGE_SHARE * recorder.chunk_bytes


def test_corrections_of_a_keyframe_are_numbered_and_grow_from_its_first_scale(
    tmp_path: Path, house: HouseFlight
) -> None:
    with ScanStore.create(tmp_path / "scan.db", ScanHeader("scan", "drone", 0)) as store:
        recorder = recorder_of(store, 1, 0.1)
        one = house.keyframe(7, 0.0)
        one = replace(one, pose=replace(one.pose, scale=2.0))
        recorder.write([KeyframeReady(one), posed(7)])
        for scale in (3.0, 4.0):
            recorder.write([PosesChanged({7: replace(one.pose, scale=scale)}), posed(8)])
        found = [store.repose(7, below) for below in (2, 3)]
    assert [(r.revision, r.scale) for r in found if r is not None] == [(1, 1.5), (2, 2.0)]


class FullStore(ScanStore):
    """Its disk is full for keyframes."""

    def add_keyframe(self, *_: object) -> int:
        raise OutsideError("the disk is full")


def test_corrections_of_a_keyframe_that_a_full_disk_refused_are_left_out(
    tmp_path: Path, house: HouseFlight
) -> None:
    with FullStore.create(tmp_path / "scan.db", ScanHeader("scan", "drone", 0)) as store:
        recorder = recorder_of(store, 1, 0.1)
        one = house.keyframe(7, 0.0)
        with pytest.raises(OutsideError):
            recorder.write([KeyframeReady(one), posed(7)])
        recorder.write([PosesChanged({7: one.pose}), posed(8)])  # as at the end of the scan
        assert store.repose(7, 2) is None


def test_a_first_depth_is_offered_and_neither_stored_nor_counted(
    tmp_path: Path, house: HouseFlight
) -> None:
    with ScanStore.create(tmp_path / "scan.db", ScanHeader("scan", "drone", 0)) as store:
        news = list[tuple[str, int]]()
        store.listen(lambda kind, number: news.append((kind, number)))
        recorder = recorder_of(store, 1, 0.1)
        one = house.keyframe(7, 0.0)
        recorder.write([KeyframeReady(one, is_first_depth=True), posed(7)])
        assert [kind for kind, _ in news] == ["pose", "first"]  # the pose waits for no depth
        assert news[1] == ("first", 7) and store.record("first", 7) is not None
        assert store.seqs() == [] and recorder.keyframes == recorder.points == 0
        recorder.write([KeyframeReady(one), posed(8)])
        assert store.record("first", 7) is None and store.seqs() == [7]


def test_keyframes_that_come_at_once_keep_their_own_stages(
    tmp_path: Path, house: HouseFlight
) -> None:
    with ScanStore.create(tmp_path / "scan.db", ScanHeader("scan", "drone", 0)) as store:
        recorder = recorder_of(store, 1, 0.1)
        ready = [
            KeyframeReady(house.keyframe(seq, 0.0), stages={"depth_m": np.full((2, 2), float(seq))})
            for seq in (1, 2)
        ]
        recorder.write([*ready, KeyframeReady(house.keyframe(3, 0.0)), posed(3)])
    found = [load_debug(debug_path(tmp_path, seq)) for seq in (1, 2, 3)]
    assert [None if one is None else one["depth_m"][0, 0] for one in found] == [1.0, 2.0, None]


def larger(one: Keyframe, factor: int, rng: np.random.Generator) -> Keyframe:
    """The keyframe with this many times the pixels a side, and noise in its depth."""

    def enlarged(plane: Any) -> Any:
        return plane.repeat(factor, axis=0).repeat(factor, axis=1)

    depth = one.depth
    rough = enlarged(depth.depth_m) + rng.normal(0, 0.5, enlarged(one.fresh).shape)
    large = DepthMap(
        rough.astype(np.float32), enlarged(depth.sigma_m), enlarged(depth.views),
        scaled_K(depth.K, factor, factor), depth.T_world_camera,
    )  # fmt: skip
    return replace(one, depth=large, bgr=enlarged(one.bgr), fresh=enlarged(one.fresh))


def test_the_datum_of_a_logs_altitudes_is_the_scans(tmp_path: Path) -> None:
    """Else heights above the ellipsoid, as a GoPro has them, are called above sea level."""
    history = VehicleHistory()
    history.vertical_datum = "ellipsoid"
    for k in range(3):
        history.add(PositionSample(None, 33.127, -117.327, -23.0, None, None), k * 100_000_000)
    scan = real_scan(tmp_path / "scan", history=history)
    image = np.random.default_rng(0).integers(0, 256, (90, 160, 3), np.uint8)
    for k in range(2):
        scan.feed(CameraFrame(image, k * 100_000_000, k, None, f"frame {k}"))
    scan.mapper.finish()
    header = scan.store.header
    scan.store.close()
    assert (header.vertical_datum, header.origin_alt_amsl_m) == ("ellipsoid", -23.0)


def test_a_scan_whose_positions_have_no_altitude_says_so(tmp_path: Path) -> None:
    """As subtitles of some drones: its heights would be called above sea level."""
    history = VehicleHistory()
    for k in range(3):
        history.add(PositionSample(None, 53.36, 6.46, None, 50.0, None), k * 100_000_000)
    scan = real_scan(tmp_path / "scan", history=history)
    scan.feed(CameraFrame(np.zeros((90, 160, 3), np.uint8), 0, 0, None, "frame 0"))
    assert "no altitude" in scan.close()["assumed"]
    document = write_deliverables(tmp_path / "scan", scan.store)
    scan.store.close()
    assert document["georeference"] == "gnss"
    assert document["heights"] == "metres above the scan's origin"


def test_a_scan_of_one_image_says_how_many_are_needed(tmp_path: Path) -> None:
    scan = real_scan(tmp_path / "scan")
    scan.feed(CameraFrame(np.zeros((90, 160, 3), np.uint8), 0, 0, None, "frame 0"))
    warnings = scan.close()["warnings"]
    scan.store.close()
    assert any("1 image, three that overlap are needed" in line for line in warnings)


@pytest.mark.parametrize("is_pressure", [False, True])
def test_a_scan_says_which_altitudes_are_those_of_air_pressure(
    tmp_path: Path, is_pressure: bool
) -> None:
    history = VehicleHistory()
    history.is_pressure_altitude = is_pressure
    for k in range(3):
        history.add(PositionSample(None, 53.36, 6.46, -125.0, 5.0, None), k * 100_000_000)
    scan = real_scan(tmp_path / "scan", history=history)
    scan.feed(CameraFrame(np.zeros((90, 160, 3), np.uint8), 0, 0, None, "frame 0"))
    summary = scan.close()
    scan.store.close()
    assert "altitude" in summary["assumed"]
    assert ("pressure" in summary["assumed"]) == is_pressure
