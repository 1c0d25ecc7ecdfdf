"""A scan before and after refinement, in one store: nothing is overwritten.

Poses and re-poses are only ever appended. Re-poses of a refinement carry revisions from
:data:`REFINED` on, so they hold against corrections of the flight, and the newest below it is
the unrefined state. Which pose rows belong to refinements is noted in the store's meta table.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from recon import se3
from recon.survey.ground_control import Adjusted
from recon.types import F64, I64, Keyframe
from service.cameras.rig import attitude_of
from service.errors import InputError, OutsideError
from service.georeference import LocalFrame
from service.stream import codec
from service.stream.database import Statement, blob, can_write, json_object
from service.stream.records import (
    PoseRecord,
    Repose,
    ScanHeader,
    header_from_json,
    pack_pose,
    pack_repose,
    unpack_pose,
)
from service.stream.store import ScanStore

REFINED = 1_000_000
"""Revisions of refinements begin here; a flight's own stay far below."""

NEWEST = 1 << 32
"""Above all revisions."""

META = "refinement"
META_HEADER = "unrefined_header"


class _Note(msgspec.Struct):
    """What the store notes of its refinements."""

    revision: int = 0
    pose_rows: list[tuple[int, int]] = []
    figures: dict[str, Any] = {}


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeStates:
    """Where keyframes are, or were before any refinement, in order of time."""

    seqs: list[int]
    times_ns: I64  # (N,)
    poses: F64  # (N, 4, 4) T_world_camera
    covariances: F64  # (N, 6, 6)
    scales: F64  # (N,) that the flight gave their coded depth

    def __len__(self) -> int:
        return len(self.seqs)

    def reposes(self) -> list[Repose]:
        rows = zip(self.seqs, self.poses, self.scales.tolist(), self.covariances, strict=True)
        return [Repose(seq, 0, T, scale, spread) for seq, T, scale, spread in rows]


class Revisions:
    """Reads the unrefined state of a store and appends refinements to it."""

    def __init__(self, store: ScanStore) -> None:
        self._store = store
        self._db = store.database
        try:
            self._note = msgspec.convert(json_object(self._db.get(META)), _Note)
        except msgspec.ValidationError as error:
            raise InputError(f"{store.path}: its refinement record is invalid ({error})") from error

    @property
    def refined(self) -> bool:
        """True once a refinement was written, also when it was undone."""
        return bool(self._note.figures)

    @property
    def header(self) -> ScanHeader:
        """The scan's header before any refinement."""
        text = self._db.get(META_HEADER)
        found = None if text is None else header_from_json(text.encode())
        return found or self._store.header

    def states(self, below: int = REFINED) -> KeyframeStates:
        """The keyframes that can be read, by revisions ``below``: the unrefined ones."""
        found = [s for seq in self._store.seqs() if (s := self._state(seq, below)) is not None]
        found.sort(key=lambda s: s[0])
        rows = [row for _, row in found]
        return KeyframeStates(
            [row.seq for row in rows],
            np.array([time_ns for time_ns, _ in found], np.int64),
            np.array([row.T_world_camera for row in rows]).reshape(-1, 4, 4),
            np.array([row.covariance for row in rows]).reshape(-1, 6, 6),
            np.array([row.scale for row in rows]),
        )

    def _state(self, seq: int, below: int) -> tuple[int, Repose] | None:
        """Time and pose of a keyframe; None when nothing of it can be read."""
        base = self._store.repose(seq, below=below)
        head = codec.peek(self._store.chunk(seq, 0) or self._store.chunk(seq, 1) or b"")
        if head is not None:
            time_ns, T, covariance = head.time_unix_ns, head.T_world_camera, head.covariance
        elif (one := self._store.keyframe(seq)) is not None:
            time_ns, T, covariance = one.time_ns, one.depth.T_world_camera, one.pose.covariance
        else:
            return None
        return time_ns, base or Repose(seq, 0, T, 1.0, covariance)

    def keyframe(self, states: KeyframeStates, k: int) -> Keyframe | None:
        """The keyframe at place ``k`` with its depth in that state."""
        found = self._store.keyframe(states.seqs[k])
        if found is None:
            return None
        now = self._store.repose(found.seq)
        growth = states.scales[k] / (1.0 if now is None else now.scale)
        return replace(found, depth=found.depth.scaled(growth, states.poses[k]))

    def frames(self) -> list[PoseRecord]:
        """All unrefined poses in order of time; of several for one time the newest."""
        ranges = self._note.pose_rows
        newest: dict[int, PoseRecord] = {}
        for number, data in self._db.all("SELECT id, data FROM poses ORDER BY id"):
            if any(a <= number <= b for a, b in ranges):
                continue
            pose = unpack_pose(blob(data))
            if pose is not None:
                newest[pose.time_unix_ns] = pose
        return [newest[t] for t in sorted(newest)]

    def append(
        self,
        reposes: Sequence[Repose],
        poses: Sequence[PoseRecord],
        header: ScanHeader,
        figures: dict[str, Any],
    ) -> bool:
        """Write a refinement in one transaction; False when only its figures were news.

        The revisions of ``reposes`` are set here: one more than the newest refinement's. The
        store must be opened again to see what was written.
        """
        changed = [r for r in reposes if not self._holds(r)]
        statements: list[Statement] = []
        note = msgspec.structs.replace(self._note)
        if changed:
            statements += self._rows(reposes, poses, note)
        note.figures = figures | {"revision": note.revision}
        meta = "INSERT OR REPLACE INTO meta VALUES (?, ?)"
        statements.append((meta, (META, json.dumps(msgspec.structs.asdict(note), sort_keys=True))))
        if self._db.get(META_HEADER) is None:
            statements.append((meta, (META_HEADER, self._store.header.to_json().decode())))
        if header.to_json() != self._store.header.to_json():
            statements.append((meta, ("header", header.to_json().decode())))
        self._db.write(statements)
        self._note = note
        return bool(changed)

    def _rows(
        self, reposes: Sequence[Repose], poses: Sequence[PoseRecord], note: _Note
    ) -> list[Statement]:
        revision = REFINED + note.revision
        note.revision += 1
        out: list[Statement] = []
        first = self._store.next_id("reposes")
        for n, r in enumerate(reposes):
            new = Repose(r.seq, revision, r.T_world_camera, r.scale, r.covariance)
            sql = "INSERT INTO reposes VALUES (?, ?, ?, ?)"
            out.append((sql, (first + n, r.seq, revision, pack_repose(new))))
        first = self._store.next_id("poses")
        for n, p in enumerate(poses):
            sql = "INSERT INTO poses VALUES (?, ?, ?)"
            out.append((sql, (first + n, p.time_unix_ns, pack_pose(p))))
        if poses:
            note.pose_rows = [*note.pose_rows, (first, first + len(poses) - 1)]
        return out

    def _holds(self, wanted: Repose) -> bool:
        """True when the store has a keyframe within a tenth of a millimetre already."""
        now = self._store.repose(wanted.seq)
        return (
            now is not None
            and now.revision >= REFINED
            and bool(np.abs(now.T_world_camera - wanted.T_world_camera).max() < 1e-4)
            and abs(now.scale / wanted.scale - 1.0) < 1e-6
        )


def finished_store(folder: Path, what: str, repairs: bool = False) -> ScanStore:
    """The store of a finished scan, only to be read; InputError where there is none to ``what``.

    With ``repairs`` it is opened to be changed where it can be, which repairs a damaged one.
    """
    path = folder / "scan.db"
    if not path.is_file():
        raise InputError(f"{folder} contains no scan.db; give a scan folder")
    store = ScanStore.open(path, read_only=not (repairs and can_write(path)))
    if store.finished:
        return store
    store.close()
    raise InputError(f"{folder} is not finished; {what} it when the flight is over")


def copy_store(source: Path, target: Path) -> None:
    """A sound copy of a store that may be open elsewhere.

    Raises InputError when ``target`` exists, OutsideError when it cannot be written.
    """
    if target.exists():
        raise InputError(f"{target} exists; choose another folder, nothing was changed")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with closing(sqlite3.connect(source)) as one, closing(sqlite3.connect(target)) as two:
            one.backup(two)
    except (OSError, sqlite3.Error) as error:
        target.unlink(missing_ok=True)
        raise OutsideError(f"cannot copy {source} to {target} ({error}); check the disk") from error


def grown(T: F64, scale: float) -> F64:
    """The motion ``T`` (4, 4) with its length times ``scale``."""
    return se3.compose(T[:3, :3], scale * T[:3, 3])


def moved_frames(
    frames: Sequence[PoseRecord],
    states: KeyframeStates,
    found: Adjusted,
    place: LocalFrame | None,
) -> list[PoseRecord]:
    """Every frame's pose, carried by the keyframes before and after it."""
    keys = states.times_ns
    out: list[PoseRecord] = []
    before: PoseRecord | None = None
    distance = 0.0
    for frame in frames:
        b = int(np.clip(np.searchsorted(keys, frame.time_unix_ns), 1, len(keys) - 1))
        one, two = (_carried(frame, states.poses[k], found, k) for k in (b - 1, b))
        share = (frame.time_unix_ns - keys[b - 1]) / max(int(keys[b] - keys[b - 1]), 1)
        share = float(np.clip(share, 0.0, 1.0))
        T = one @ se3.exp(share * se3.log(se3.inverse(one) @ two))
        near = b - 1 if share < 0.5 else b
        step = 0.0
        if before is not None:
            step = float(np.linalg.norm(T[:3, 3] - before.T_world_camera[:3, 3]))
        distance += step
        moved = _record(frame, T, found.covariances[near], place, distance)
        if before is not None and frame.time_unix_ns > before.time_unix_ns:
            seconds = (frame.time_unix_ns - before.time_unix_ns) * 1e-9
            moved = replace(moved, speed_m_s=step / seconds)
        out.append(moved)
        before = moved
    return out


def _carried(frame: PoseRecord, T_key: F64, found: Adjusted, k: int) -> F64:
    """A frame's pose as one keyframe carries it along."""
    relative = se3.inverse(T_key) @ frame.T_world_camera
    return np.asarray(found.poses[k] @ grown(relative, float(found.scales[k])))


def _record(
    frame: PoseRecord, T: F64, spread: F64, place: LocalFrame | None, distance_m: float
) -> PoseRecord:
    roll, pitch, yaw = attitude_of(T)
    lat = lon = alt = None
    if place is not None:
        lat, lon, alt = place.place(T[:3, 3])
    sigma = se3.sigma_at(T[:3, 3], spread)
    return replace(
        frame, T_world_camera=T, covariance=spread, lat_deg=lat, lon_deg=lon, alt_amsl_m=alt,
        roll_rad=roll, pitch_rad=pitch, yaw_rad=yaw, distance_m=distance_m, sigma_m=sigma,
    )  # fmt: skip
