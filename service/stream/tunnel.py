"""The narrow radio, both ends: coarse tiles and poses by TUNNEL.

Without an IP link the drone sends small messages over the telemetry radio, each independently
decodable, within a share of the radio's rate, and slower when RADIO_STATUS reports that its buffer
fills. Sent messages are repeated while there is nothing new.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from service.errors import InputError
from service.stream import codec, radio_messages, records
from service.stream.budget import TokenBucket
from service.stream.radio_messages import RadioTile, tag_of
from service.stream.radio_tiles import tiles_of
from service.stream.records import PoseRecord, Repose, ScanHeader
from service.stream.store import ScanStore
from service.workers import Worker, Workers

HEARTBEAT_S = 1.0
ANNOUNCE_EVERY_S = 10.0
POSE_EVERY_S = 1.0
REPEATS = 2
MAX_WAITING = 2000
MAX_ANNOUNCED = 64  # scans that the ground knows by announcement; beyond it the oldest is dropped
MOVED_M, TURNED, RESCALED = 0.5, 0.01, 0.01
"""A correction beyond any of these is worth resending a keyframe's tiles."""
LOW_BUFFER_PERCENT = 50  # RADIO_STATUS.txbuf below which sending slows down
MAVLINK_OVERHEAD_BYTES = 17  # header, checksum and TUNNEL's own fields around each payload


@dataclass(slots=True, eq=False)
class _Waiting:
    tile: RadioTile
    repeats: int = REPEATS
    payload: bytes = b""  # as last offered


class TunnelSender:
    """The drone's sender over the radio. The caller supplies times: seconds, monotonic."""

    def __init__(self, store: ScanStore, rate_bytes_s: float, now: float) -> None:
        """Raises ValueError when the names of drone and scan are too long for the radio."""
        self._store = store
        self._rate_bytes_s = rate_bytes_s  # that may be used
        self._announcement = radio_messages.pack_announce(store.header)
        self._tiles: deque[RadioTile] = deque(maxlen=MAX_WAITING)  # all tiles of the scan
        self._moved: dict[int, Repose] = {}  # keyframe to the correction last sent
        self._tag = tag_of(store.header.drone, store.header.name)
        self._factor = 1.0
        self._bucket = TokenBucket(rate_bytes_s, now)
        self._announce_at = now
        self._pose_at = now
        self._pose: tuple[int, PoseRecord] | None = None
        self._fresh: deque[_Waiting] = deque(maxlen=MAX_WAITING)
        self._again: deque[_Waiting] = deque(maxlen=MAX_WAITING)

    def on_item(self, kind: str, number: int) -> None:
        if kind == "header":
            self._announcement = radio_messages.pack_announce(self._store.header)
            self._announce_at = -math.inf
            return
        data = self._store.record(kind, number) if kind in ("k0", "pose", "repose") else None
        if data is None:
            return
        if kind == "pose":
            pose = records.unpack_pose(data)
            self._pose = None if pose is None else (number, pose)
        elif kind == "repose":
            repose = records.unpack_repose(data)
            if repose is not None:
                self._correct(repose)
        else:
            coarse = codec.decode([data])
            tiles = tiles_of(coarse) if coarse is not None else []
            self._tiles.extend(tiles)
            self._fresh.extend(_Waiting(tile) for tile in tiles)

    def _correct(self, repose: Repose) -> None:
        """Resend a keyframe's tiles when it moved by more than their resolution."""
        before = self._moved.get(repose.seq)
        tiles = [tile for tile in self._tiles if tile.seq == repose.seq]
        if not tiles:
            return
        T = tiles[0].T_world_camera if before is None else before.T_world_camera
        scale = 1.0 if before is None else before.scale
        moved_m = float(np.linalg.norm(repose.T_world_camera[:3, 3] - T[:3, 3]))
        turned = float(np.linalg.norm(repose.T_world_camera[:3, :3] - T[:3, :3]))
        if moved_m < MOVED_M and turned < TURNED and abs(repose.scale / scale - 1) < RESCALED:
            return
        self._moved[repose.seq] = repose
        waiting = {id(entry.tile) for entry in self._fresh}
        self._fresh.extendleft(_Waiting(tile) for tile in tiles if id(tile) not in waiting)

    def _pack(self, tile: RadioTile) -> bytes:
        """The tile at its keyframe's newest pose."""
        repose = self._store.repose(tile.seq)
        if repose is not None:
            tile = replace(
                tile,
                T_world_camera=repose.T_world_camera,
                depth_m=tile.depth_m * np.float32(repose.scale),
                sigma_m=tile.sigma_m * repose.scale,
            )
        return radio_messages.pack_tile(self._tag, tile)

    def radio_status(self, free_percent: int, now: float) -> None:
        """The radio reports the free share of its buffer (RADIO_STATUS.txbuf)."""
        if free_percent < LOW_BUFFER_PERCENT // 2:
            self._factor = max(0.05, self._factor * 0.5)
        elif free_percent < LOW_BUFFER_PERCENT:
            self._factor = max(0.05, self._factor * 0.85)
        elif free_percent > 90:
            self._factor = min(1.0, self._factor * 1.1)
        self._bucket.set_rate(self._rate_bytes_s * self._factor, now)

    def next(self, now: float) -> bytes | float:
        """The TUNNEL payload to send now, or the seconds to wait."""
        chosen = self._choose(now)
        if chosen is None:
            return 0.2
        size = len(chosen) + MAVLINK_OVERHEAD_BYTES
        wait = self._bucket.ready_in(size, now)
        if wait > 0:
            return wait
        self._bucket.take(size, now)
        self._sent(chosen, now)
        return chosen

    @property
    def all_sent(self) -> bool:
        """Whether every tile has been sent at least once."""
        return not self._fresh

    def _choose(self, now: float) -> bytes | None:
        if now >= self._announce_at:
            return self._announcement
        if self._pose is not None and now >= self._pose_at:
            return radio_messages.pack_pose(self._tag, *self._pose)
        queue = self._fresh or self._again
        if not queue:
            return None
        if not queue[-1].payload:
            queue[-1].payload = self._pack(queue[-1].tile)
        return queue[-1].payload

    def _sent(self, payload: bytes, now: float) -> None:
        if payload is self._announcement:
            self._announce_at = now + ANNOUNCE_EVERY_S
        elif self._pose is not None and now >= self._pose_at:
            self._pose, self._pose_at = None, now + POSE_EVERY_S
        else:
            queue = self._fresh or self._again
            waiting = queue.pop()
            waiting.repeats -= queue is self._again
            waiting.payload = b""
            if waiting.repeats > 0:
                self._again.appendleft(waiting)


class Carrier(Protocol):
    """Carries tunnelled payloads to the ground."""

    def open(self, on_status: Callable[[int], None]) -> None:
        """Begin; ``on_status`` gets the free share of the radio's buffer in percent."""

    def beat(self) -> None:
        """Send a heartbeat; called every second."""

    def send(self, payload: bytes) -> None:
        pass

    def close(self) -> None:
        pass


class RadioSender:
    """Sends a scan's coarse tiles and poses over the radio while ``needed`` returns True."""

    def __init__(
        self,
        store: ScanStore,
        rate_bytes_s: float,
        carrier: Carrier,
        needed: Callable[[], bool] = lambda: True,
        workers: Workers | None = None,
    ) -> None:
        try:
            self._tunnel = TunnelSender(store, rate_bytes_s, time.monotonic())
        except ValueError as error:
            raise InputError(str(error)) from error
        self._events: deque[Callable[[float], None]] = deque(maxlen=10_000)
        self._store = store
        self._needed = needed
        self._carrier = carrier
        store.listen(self._on_item)
        carrier.open(self._status)
        self._worker = (workers or Workers()).start("radio", self._run)

    @property
    def all_sent(self) -> bool:
        """Whether everything has been sent at least once; the radio has no acknowledgement."""
        return not self._events and self._tunnel.all_sent

    def close(self) -> None:
        self._worker.join(5.0)
        self._store.unlisten(self._on_item)
        self._carrier.close()

    def _on_item(self, kind: str, number: int) -> None:
        self._events.append(lambda _: self._tunnel.on_item(kind, number))

    def _status(self, free_percent: int) -> None:
        self._events.append(lambda now: self._tunnel.radio_status(free_percent, now))

    def _run(self, worker: Worker) -> None:
        beat_at = 0.0
        while not worker.stop.is_set():
            now = time.monotonic()
            while self._events:
                self._events.popleft()(now)
            if now >= beat_at:
                self._carrier.beat()
                beat_at = now + HEARTBEAT_S
            todo = self._tunnel.next(now) if self._needed() else 0.5
            if isinstance(todo, bytes):
                self._carrier.send(todo)
            else:
                worker.stop.wait(min(todo, 0.1))


@dataclass(slots=True, eq=False)
class TunnelIntake:
    """Decodes the radio's messages on the ground: (header, kind, number, part, bytes).

    The kind is "header" for an announcement, otherwise "tile" or "pose".
    Messages that arrive before their scan's announcement are kept, up to MAX_WAITING.
    """

    headers: dict[int, ScanHeader] = field(default_factory=dict)
    waiting: deque[tuple[int, str, int, int, bytes]] = field(
        default_factory=lambda: deque(maxlen=MAX_WAITING)
    )
    dropped: int = 0

    def receive(self, payload: bytes) -> list[tuple[ScanHeader, str, int, int, bytes]]:
        """Records to store from ``payload``; empty for invalid bytes."""
        header = radio_messages.unpack_announce(payload)
        if header is not None:
            tag = tag_of(header.drone, header.name)
            self.headers.pop(tag, None)
            self.headers[tag] = header
            while len(self.headers) > MAX_ANNOUNCED:
                del self.headers[next(iter(self.headers))]
            ready = [item for item in self.waiting if item[0] == tag]
            for item in ready:
                self.waiting.remove(item)
            return [(header, "header", 0, 0, payload), *((header, *item[1:]) for item in ready)]
        found = _item(payload)
        if found is None:
            self.dropped += 1
            return []
        known = self.headers.get(found[0])
        if known is None:
            self.waiting.append(found)
            return []
        return [(known, *found[1:])]


def _item(payload: bytes) -> tuple[int, str, int, int, bytes] | None:
    tile = radio_messages.unpack_tile(payload)
    if tile is not None:
        return tile[0], "tile", tile[1].seq, tile[1].index, payload
    pose = radio_messages.unpack_pose(payload)
    if pose is not None:
        return pose[0], "pose", pose[1], 0, payload
    return None
