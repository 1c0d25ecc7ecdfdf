"""Results of the pipeline, written into the scan's store and summed up; telemetry of each frame."""

from __future__ import annotations

import logging
import math
import os
import pickle
import tempfile
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from mavlink.telemetry.samples import VehicleState
from recon.pipeline.mapper import Event, FramePosed, KeyframeReady, PosesChanged
from recon.posegraph.ground import GUESSED_SHARE
from recon.posegraph.trajectory import sigma_m
from recon.tracking.frame import NO_IMAGE, Frame, Tracking
from recon.types import F64, Keyframe, Pose
from service.cameras.rig import Rig, attitude_of
from service.errors import OutsideError
from service.flight.pipeline import Pipeline
from service.flight.reports import FOUND, gnss_over_heights, graph_figures, sigma_of_scale
from service.scans.drawing import save_debug
from service.scans.track import cell, seconds_text
from service.scans.trust import FIRST_TELEMETRY
from service.stream.codec import IMAGE_SHARE, encode, encode_image
from service.stream.records import PoseRecord, Repose, pack_pose
from service.stream.store import ScanStore

BATCH, REPLAYED = 256, 16
"""Poses in one transaction, which takes a synchronised write of the disk: those written again in
the end, and those of a recording, which can be replayed."""


class PublishedFrames:
    """Frames whose poses were published, in order, each with what places it again in the end and
    what was written of it. On the disk but for the newest. The file has no name and is gone with
    the process."""

    def __init__(self, folder: Path) -> None:
        self._fresh: deque[tuple[Frame, Any]] = deque()
        self._file = tempfile.TemporaryFile(dir=folder, buffering=1 << 16)  # noqa: SIM115

    def add(self, frame: Frame, written: Any, is_settled: Callable[[Frame], bool]) -> None:
        """Take the next frame, instead of the last one where that is the same, lost until now;
        those whose keyframes no longer change go to the disk.

        Raises OutsideError when the disk takes no more.
        """
        if self._fresh and self._fresh[-1][0].seq == frame.seq:
            self._fresh.pop()
        self._fresh.append((frame, written))
        while len(self._fresh) > 1 and is_settled(self._fresh[0][0]):
            try:
                settled, own = self._fresh.popleft()
                pickle.dump((_known(settled), own), self._file)
            except OSError as error:
                why = f"poses cannot be stored for the scan: {error.strerror}"
                raise OutsideError(why) from error

    def all(self) -> Iterator[tuple[Frame, Any]]:
        """Each frame with what was ``written``."""
        end = self._file.seek(0, os.SEEK_END)
        self._file.seek(0)
        while self._file.tell() < end:
            known, written = pickle.load(self._file)
            yield Frame(NO_IMAGE, **known), written
        yield from self._fresh

    def close(self) -> None:
        self._file.close()


def _known(frame: Frame) -> dict[str, Any]:
    """What places a frame that no longer changes."""
    return {
        "time_ns": frame.time_ns,
        "seq": frame.seq,
        "prior": frame.prior,
        "state": frame.state,
        "segment": frame.segment,
        "T_keyframe_camera": frame.T_odom_camera if frame.is_placed else None,
    }


def _crc(record: PoseRecord) -> int:
    """The record's own, its last four bytes."""
    return int.from_bytes(pack_pose(record)[-4:], "little")


class Recorder:
    """Writes one scan: poses as they come, keyframes as chunks, corrections as re-poses."""

    def __init__(
        self,
        store: ScanStore,
        pipeline: Pipeline,
        rig: Rig,
        clock_offset_ns: int = 0,
        on_keyframe: Callable[[Keyframe], None] | None = None,
        batch: int = 1,
    ) -> None:
        """``clock_offset_ns`` takes the frames' clock to unix time; ``batch`` poses are written
        at once."""
        self._on_keyframe = on_keyframe
        self._batch, self._due = batch, list[PoseRecord]()
        self.store, self.pipeline, self._rig = store, pipeline, rig
        self.mapper = pipeline.mapper
        self._graph = self.mapper.keyframe_map.graph
        self._first_scale: dict[int, float] = {}  # of keyframes, by number
        self._revisions: Counter[int] = Counter()  # poses of each, after the first
        self.points = self.keyframes = self.frames = self.chunk_bytes = self.image_bytes = 0
        self.states: Counter[Tracking] = Counter()
        self.distance_m = self.speed_m_s = self.turn_rate_rad_s = 0.0
        self.last: PoseRecord | None = None
        self._offset_ns = clock_offset_ns
        self._frames = PublishedFrames(store.path.parent)
        self._last: tuple[int, F64] | None = None  # unix ns and T_world_camera of the last pose
        self._origin_written = False
        self._agl_before_m: float | None = None  # of the frame before

    def write(self, events: Iterable[Event], agl_m: float | None = None) -> None:
        """The events of one frame; raises OutsideError when the disk is full."""
        self.frames += 1
        self._write_origin()
        *before, posed = events
        for event in before:
            if isinstance(event, FramePosed):  # the frame before, which was lost until now
                self.states[Tracking.LOST] -= 1
                self._write_pose(event, self._agl_before_m)
        assert isinstance(posed, FramePosed)
        self._write_pose(posed, agl_m)  # first: keyframes take ten times as long to code and store
        self._write_keyframes(before)
        self._agl_before_m = agl_m

    def _write_pose(self, posed: FramePosed, agl_m: float | None) -> None:
        self.states[posed.frame.state] += 1
        pose, frame = posed.pose, posed.frame
        if pose is None:
            return
        self.last = self._record(frame, pose, agl_m, posed.is_view)
        self._frames.add(frame, (posed.is_view, agl_m, _crc(self.last)), self.mapper.is_settled)
        self._due.append(self.last)
        if len(self._due) >= self._batch:
            self._write_due()

    def flush(self) -> None:
        """Write the pipeline's remaining results and correct the trajectory; call it once."""
        try:
            self._write_keyframes(self.mapper.drain())
        finally:
            self._write_keyframes(self.mapper.finish())
        self._correct_trajectory()
        self._frames.close()

    def close(self, extra: dict[str, Any]) -> dict[str, Any]:
        """Finish the scan in the store, after :meth:`flush`; return its summary with ``extra``."""
        summary = self.summary() | {"graph": graph_figures(self._graph)}
        summary["apart"] = [list(ends) for ends in self.mapper.keyframe_map.apart()]
        summary["false"] = [list(ends) for ends in self.mapper.keyframe_map.false()]
        summary |= extra
        self.store.finish(summary)
        return summary

    def _write_due(self) -> None:
        due, self._due = self._due, []
        if due:
            self.store.add_poses(due)

    def _correct_trajectory(self) -> None:
        """Write every pose again that differs from the published one, by however little: that one
        depends on how many keyframes were done when its frame came, and so on how fast the
        computer was; what a scan holds must not. The newest of a time holds."""
        self._write_due()
        self._last, self.distance_m = None, 0.0
        changed = self._changed()
        while batch := list(islice(changed, BATCH)):
            self.store.add_poses(batch)

    def _changed(self) -> Iterator[PoseRecord]:
        for frame, (is_view, agl_m, crc) in self._frames.all():
            pose = self.mapper.frame_poses.place(frame)
            record = None if pose is None else self._record(frame, pose, agl_m, is_view)
            if record is not None and _crc(record) != crc:
                yield record

    def summary(self) -> dict[str, Any]:
        """Figures of the scan so far, fit for JSON."""
        return {
            "frames": self.frames,
            "frames_tracked": sum(self.states[state] for state in FOUND),
            "frames_lost": self.states[Tracking.LOST],
            "segments": self.mapper.segments,
            "pairs": self.mapper.pairs,
            "clouds": self.mapper.pairs,  # one per stereo pair, Eq. 3
            "keyframes": self.keyframes,
            "points": self.points,
            "chunk_bytes": self.chunk_bytes,
            "image_bytes": self.image_bytes,
            "distance_m": round(self.distance_m, 2),
            "georeference": self._rig.georeference,
            **self._of_largest(),
            "stage_ms": {k: round(v, 2) for k, v in self.pipeline.stopwatch.mean_ms().items()},
            "refusals": dict(self.mapper.refusals()),
            "drops": self._drops(),
            "registrations": {v.value: n for v, n in self.mapper.keyframe_map.verdicts.items()},
        }

    def _drops(self) -> dict[str, int]:
        """Unused frames and views, by reason."""
        dropped = self.pipeline.worker.dropped
        late = {"newer views came faster": dropped} if dropped else {}
        return dict(self.mapper.refusals()) | late

    def _of_largest(self) -> dict[str, Any]:
        """Of the largest segment the source of the metric scale, its relative sigma and what
        contradicts it; and the sigma of what is level, None where attitudes show it."""
        graph = self._graph
        found = graph.segments.largest()
        if found is None:
            return {"scale": {"from": FIRST_TELEMETRY, "sigma": None}, "lean_sigma_deg": None}
        by = ", ".join(found.to_world.sources)
        if not {"altitude", "gnss"} & set(found.to_world.sources):
            is_known = found.to_world.sigma_scale < GUESSED_SHARE / 2
            by = "velocity" if is_known else "an assumed height"
        out = {"from": by, "sigma": round(sigma_of_scale(graph), 4)}
        ratio = gnss_over_heights(graph)
        if ratio is not None:
            out["gnss_over_heights"] = round(ratio, 3)
        lean_deg = _degrees(found.to_world.sigma_lean_rad)
        return {"scale": out, "lean_sigma_deg": None if lean_deg is None else round(lean_deg, 2)}

    def _write_origin(self) -> None:
        """The origin goes into the header once the first position is known."""
        frame = self._rig.local_frame
        if frame is None or self._origin_written:
            return
        self.store.update_header(
            origin_lat_deg=frame.lat_deg,
            origin_lon_deg=frame.lon_deg,
            origin_alt_amsl_m=frame.alt_amsl_m,
            epsg=frame.epsg,
            georeference=self._rig.georeference,
            vertical_datum=self._rig.vertical_datum,
        )
        self._origin_written = True

    def _write_keyframes(self, events: Iterable[Event]) -> None:
        ready = [event for event in events if isinstance(event, KeyframeReady)]
        for first in (event.keyframe for event in ready if event.is_first_depth):
            (coarse,) = encode(first, first.time_ns + self._offset_ns, is_coarse_enough=True)
            self.store.offer_first(first.seq, coarse)
        whole = [event for event in ready if not event.is_first_depth]
        if whole:
            self._write_due()
        for event in whole:
            self._write_keyframe(event.keyframe)
            if event.stages:
                save_debug(self.store.path.parent, event.keyframe.seq, event.stages)
        reposes = [
            self._repose(seq, pose)
            for event in events
            if isinstance(event, PosesChanged)
            for seq, pose in event.poses.items()
            if seq in self._first_scale  # a full disk may have refused the keyframe
        ]
        if reposes:
            self.store.add_reposes(reposes)

    def _write_keyframe(self, keyframe: Keyframe) -> None:
        with self.pipeline.stopwatch("encode"):
            layers = encode(keyframe, keyframe.time_ns + self._offset_ns)
            self.chunk_bytes += sum(map(len, layers))
            room = IMAGE_SHARE * self.chunk_bytes - self.image_bytes
            image = encode_image(keyframe.bgr, room)
            self.image_bytes += len(image)
        with self.pipeline.stopwatch("store"):
            self.store.add_keyframe(keyframe.seq, layers, image)
        self._first_scale[keyframe.seq] = keyframe.pose.scale
        self.keyframes += 1
        self.points += int((keyframe.fresh & np.isfinite(keyframe.depth.depth_m)).sum())
        if self._on_keyframe is not None:
            self._on_keyframe(keyframe)

    def _repose(self, seq: int, pose: Pose) -> Repose:
        self._revisions[seq] += 1
        growth = pose.scale / self._first_scale[seq]
        return Repose(seq, self._revisions[seq], pose.T_world_camera, growth, pose.covariance)

    def _record(self, frame: Frame, pose: Pose, agl_m: float | None, is_view: bool) -> PoseRecord:
        """The pose record of a frame, with speed and turn from the one before it."""
        time_ns, T = frame.time_ns + self._offset_ns, pose.T_world_camera
        roll, pitch, yaw = attitude_of(T)
        speed = turn = 0.0
        if self._last is not None and time_ns > self._last[0]:
            dt = (time_ns - self._last[0]) * 1e-9
            step = float(np.linalg.norm(T[:3, 3] - self._last[1][:3, 3]))
            self.distance_m += step
            R = T[:3, :3] @ self._last[1][:3, :3].T
            # About the vertical, positive to the right (clockwise).
            speed, turn = step / dt, -math.atan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1]) / dt
        self._last = (time_ns, T)
        self.speed_m_s, self.turn_rate_rad_s = speed, turn
        lat = lon = alt = None
        local = self._rig.local_frame
        if local is not None:
            lat, lon, alt = local.place(T[:3, 3])
        return PoseRecord(
            time_unix_ns=time_ns,
            T_world_camera=T,
            covariance=pose.covariance,
            lat_deg=lat,
            lon_deg=lon,
            alt_amsl_m=alt,
            agl_m=agl_m,
            roll_rad=roll,
            pitch_rad=pitch,
            yaw_rad=yaw,
            speed_m_s=speed,
            distance_m=self.distance_m,
            turn_rate_rad_s=turn,
            sources=pose.sources,
            sigma_m=sigma_m(pose),
            keyframe_seq=frame.seq if is_view else None,
        )


log = logging.getLogger(__name__)

TAGS_FILE = "telemetry.csv"
HEIGHTS = ("rangefinder", "terrain", "relative")


class FrameTags:
    """A CSV with one line per frame that has telemetry; never raises."""

    def __init__(self, path: Path) -> None:
        self._file: TextIO | None = None
        try:
            self._file = path.open("w", encoding="ascii", buffering=1 << 16)
            self._file.write(",".join(_row(0, VehicleState(0))) + "\n")
        except OSError as error:
            self._give_up(error)

    def write(self, time_unix_ns: int, state: VehicleState | None) -> None:
        if self._file is None or state is None:
            return
        try:
            self._file.write(",".join(_row(time_unix_ns, state).values()) + "\n")
        except OSError as error:
            self._give_up(error)

    def close(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            try:
                file.close()
            except OSError as error:
                self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        log.error("%s ends here: %s", TAGS_FILE, error.strerror or error)
        self._file = None


def _row(time_unix_ns: int, state: VehicleState) -> dict[str, str]:
    """The cells of a frame's line by their columns."""
    age = state.age_ms
    return {
        "time_unix_s": seconds_text(time_unix_ns),
        "sources": " ".join(state.sources),
        "age_attitude_ms": cell(age.get("attitude"), 1),
        "age_gimbal_ms": cell(age.get("gimbal"), 1),
        "age_gnss_ms": cell(age.get("gnss"), 1),
        "age_agl_ms": cell(next((age[name] for name in HEIGHTS if name in age), None), 1),
        "sigma_attitude_deg": cell(_degrees(state.sigma_attitude_rad), 3),
        "sigma_yaw_deg": cell(_degrees(state.sigma_yaw_rad), 3),
        "sigma_gimbal_deg": cell(_degrees(state.sigma_gimbal_rad), 3),
        "sigma_horizontal_m": cell(state.sigma_h_m, 3),
        "sigma_vertical_m": cell(state.sigma_v_m, 3),
        "sigma_agl_m": cell(state.sigma_agl_m, 3),
    }


def _degrees(value: float | None) -> float | None:
    return None if value is None else math.degrees(value)
