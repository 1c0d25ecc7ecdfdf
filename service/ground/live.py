"""Live data of a growing scan for a browser: depth images, corrections, the track.

A message is either JSON text or a layer of a keyframe in binary (little-endian):

======  =======================================================================
bytes   content
======  =======================================================================
4       length J of the JSON
J       JSON: ``seq``, ``layer``, ``time_unix_s``; ``size`` w, h of the layer's grid and its
        ``K`` fx, fy, cx, cy; ``box``, ``low`` and ``step`` as in docs/wire.md; ``T`` (16, column
        by column) and ``scale`` in force; ``bytes`` of the sections
..      sections: mask, depth (prediction), sigma, views, colour, image
======  =======================================================================

Mask, depth, colour and the small image of the whole keyframe (empty where there is none) are the
bytes of docs/wire.md, as they are stored; sigma and views are their codes under zlib in place of
JPEG-LS, which browsers do not decode. Depth stays in the camera's frame, so a correction is a new
matrix and scale. JSON texts have a ``type``: ``repose``, ``track``, ``state``, ``site`` (where this
scan and those tied to it are shown), and once a second ``link``.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import math
import struct
import time
import zlib
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from starlette.concurrency import iterate_in_threadpool, run_in_threadpool
from starlette.websockets import WebSocket, WebSocketDisconnect

from service.errors import SkyreliefError
from service.ground.live_site import SiteNews, columns
from service.stream import codec, planes
from service.stream.ranges import RangeSet
from service.stream.records import PoseRecord
from service.stream.store import ScanStore

log = logging.getLogger(__name__)

TRACK_POINTS = 2000
MAX_REASON_BYTES = 123  # of a WebSocket's close frame


def chunk_message(store: ScanStore, seq: int, layer: int) -> bytes | None:
    """A layer of a keyframe as a binary message; None when there is nothing to decode. What does
    not decode, tiles of the narrow radio, and depth in JPEG-LS are coded again."""
    data = store.chunk(seq, layer) or b""
    opened = codec.unpack(data)
    if (
        opened is None
        or opened[0].method != planes.METHOD_PREDICTION
        or opened[0].seq != seq
        or codec.decode([data]) is None
    ):
        sent = store.keyframe_as_sent(seq)
        opened = None if sent is None else codec.unpack(codec.encode(sent, sent.time_ns)[-1])
    if opened is None:
        return None
    head, (mask, depth, sigma, views, colour) = opened
    sections = mask, depth, _codes(sigma), _codes(views), colour, store.image(seq) or b""
    repose = store.repose(seq)
    K = head.grid_K
    text = json.dumps(
        {
            "type": "chunk",
            "seq": seq,
            "layer": layer,
            "time_unix_s": head.time_unix_ns / 1e9,
            "size": head.grid_px,
            "K": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
            "box": head.box,
            "low": head.inverse_min,
            "step": head.inverse_step,
            "T": columns(head.T_world_camera if repose is None else repose.T_world_camera),
            "scale": 1.0 if repose is None else repose.scale,
            "bytes": [len(section) for section in sections],
        }
    ).encode()
    return b"".join([struct.pack("<I", len(text)), text, *sections])


def emptied(message: bytes) -> bytes:
    (size,) = struct.unpack_from("<I", message)
    head = json.loads(message[4 : 4 + size]) | {"box": [0] * 4, "bytes": [0] * 6}
    text = json.dumps(head).encode()
    return struct.pack("<I", len(text)) + text


def _codes(section: bytes) -> bytes:
    """The codes of a JPEG-LS section under zlib; empty when it is."""
    size = planes.image_size(section)
    codes = None if size is None else planes.open_jpeg_ls(section, *size)
    return b"" if codes is None else zlib.compress(codes.astype(np.uint8).tobytes(), 1)


@dataclass(slots=True, eq=False)
class FlightPath:
    """The flight path of a growing scan; a pose is read once."""

    store: ScanStore
    last: PoseRecord | None = None
    _known: RangeSet = field(default_factory=RangeSet)
    _at: dict[int, tuple[int, list[float]]] = field(default_factory=dict)
    """By time: number of the newest pose, and its place (3,) m in the scan's frame."""
    _count: int = -1

    def grown(self) -> bool:
        """Read the poses that are new; False without any. True at the first call."""
        if not self._known:
            self._at, self.last = {}, None  # those of the narrow radio
        new = list(self.store.poses_beside(self._known))
        for number, pose in new if self._known else ((-1, p) for p in self.store.poses()):
            time_ns = pose.time_unix_ns
            if number >= self._at.get(time_ns, (-1,))[0]:
                place = [round(float(v), 3) for v in pose.T_world_camera[:3, 3]]
                self._at[time_ns] = number, place
                if self.last is None or time_ns >= self.last.time_unix_ns:
                    self.last = pose
        before, self._count = self._count, len(self._at)
        return bool(new) or self._count != before

    def places(self) -> list[list[float]]:
        """(N, 3) places in order of time, thinned to about TRACK_POINTS."""
        times = sorted(self._at)
        step = max(1, math.ceil(len(times) / TRACK_POINTS))
        thinned = times[::step] + (times[-1:] if times and (len(times) - 1) % step else [])
        return [self._at[time_ns][1] for time_ns in thinned]


@dataclass(slots=True, eq=False)
class LiveFeed:
    """Gives what is new in a store since the last call.

    One feed serves one browser. Keyframes are sent in their finest layer; a finer one that arrives
    later is sent again and replaces it. A first depth is withdrawn when it is void.
    """

    store: ScanStore
    coarse: bool = False  # send coarse layers only
    heard_unix_s: float = 0.0  # when this feed saw the scan grow or change; else its last pose
    _sent: dict[int, int] = field(default_factory=dict)  # keyframe to the layer sent
    _revision: dict[int, int] = field(default_factory=dict)
    _voids: dict[int, bytes] = field(default_factory=dict)  # messages that withdraw first depths
    _track: FlightPath = field(init=False)
    _finished: bool | None = None
    _version: tuple[int, int] = (-1, -1)
    _more: bool = True  # the last call left something for the next

    def __post_init__(self) -> None:
        self._track = FlightPath(self.store)

    def news(self, max_chunks: int = 20) -> Iterator[str | bytes]:
        """Messages for what has changed; at most ``max_chunks`` keyframes at a time."""
        before, self._version = self._version, self.store.database.version()
        if before == self._version and not self._more:
            return
        had_all = self._finished is not None  # of what was there when the feed began
        for message in self._unsent(max_chunks):
            if had_all:
                self.heard_unix_s = time.time()
            yield message

    def _unsent(self, max_chunks: int) -> Iterator[str | bytes]:
        states = self.store.states()
        finest = {
            seq: min(layer, 0) if self.coarse else layer for seq, (layer, _) in states.items()
        }
        for seq in self._voids.keys() - states.keys():
            del self._sent[seq]
            yield self._voids.pop(seq)
        due = [seq for seq, layer in finest.items() if layer > self._sent.get(seq, -3)]
        self._more = len(due) > max_chunks
        for seq in due[:max_chunks]:
            self._sent[seq] = finest[seq]
            repose = self.store.repose(seq)
            message = chunk_message(self.store, seq, finest[seq])
            if message is not None:
                self._revision[seq] = -1 if repose is None else repose.revision
                self._voids.pop(seq, None)
                if finest[seq] < 0:
                    self._voids[seq] = emptied(message)
                yield message
        yield from self._corrections(states)
        if self._track.grown():
            if not self.heard_unix_s and self._track.last is not None:
                self.heard_unix_s = self._track.last.time_unix_ns / 1e9
            yield track_message(self._track)
        state = self.store.finished
        if state != self._finished and not self._more:
            self._finished = state
            keyframes = len(self.store.seqs())
            yield json.dumps({"type": "state", "finished": state, "keyframes": keyframes})

    def _corrections(self, states: dict[int, tuple[int, int]]) -> Iterator[str]:
        """Re-poses newer than the pose that a chunk was sent with."""
        for seq, (_, revision) in states.items():
            had = self._revision.get(seq, revision)
            repose = self.store.repose(seq) if revision > had else None
            if repose is None or repose.revision <= had:
                continue
            self._revision[seq] = repose.revision
            yield json.dumps(
                {
                    "type": "repose",
                    "seq": seq,
                    "scale": repose.scale,
                    "T": columns(repose.T_world_camera),
                }
            )


def track_message(track: FlightPath) -> str:
    message: dict[str, Any] = {"type": "track", "track": track.places()}
    last = track.last
    if last is not None:
        message["last"] = {
            "time_unix_s": last.time_unix_ns / 1e9,
            "T": columns(last.T_world_camera),
            "lat_deg": last.lat_deg,
            "lon_deg": last.lon_deg,
            "alt_amsl_m": last.alt_amsl_m,
            "agl_m": last.agl_m,
            "speed_m_s": round(last.speed_m_s, 2),
            "distance_m": round(last.distance_m, 1),
            "roll_deg": round(math.degrees(last.roll_rad), 1),
            "pitch_deg": round(math.degrees(last.pitch_rad), 1),
            "yaw_deg": round(math.degrees(last.yaw_rad), 1),
            "sigma_h_v_m": [round(sigma_m, 2) for sigma_m in last.sigma_h_v_m],
            "sources": list(last.sources),
        }
    return json.dumps(message)


def link_message(entry: dict[str, Any], heard_unix_s: float) -> str:
    """Reception of a scan: seconds of silence, bytes, lag and missing items.

    ``entry`` is the receiver's; it is empty for a scan that another process writes, which was
    heard at ``heard_unix_s``.
    """
    return json.dumps(
        {
            "type": "link",
            "silent_s": round(max(0.0, time.time() - entry.get("heard_unix_s", heard_unix_s)), 1),
            "received_bytes": entry.get("received_bytes"),
            "lag_s": entry.get("lag_s", {}).get("k0"),
            "backlog": sum(entry.get("missing", {}).values()),
            "trouble": entry.get("trouble"),
        }
    )


POLL_S = 0.25
LINK_S = 1.0


def _news(feed: LiveFeed, site: SiteNews) -> Iterator[str | bytes | None]:
    """What is new, again and again; None where there is no more for now."""
    while True:
        yield from feed.news()
        yield site.message()


async def serve_live(
    socket: WebSocket, library: Path, folder: Path, receiving: Callable[[str, str], dict[str, Any]]
) -> None:
    """Send what is new in the scan of ``folder`` over an accepted socket; close it at the end."""
    store = None
    reason = ""
    try:
        store = await run_in_threadpool(ScanStore.open, folder / "scan.db")
        feed = LiveFeed(store, socket.query_params.get("layer") == "0")
        gone = asyncio.create_task(_until_gone(socket))
        link_at = 0.0
        async for message in iterate_in_threadpool(_news(feed, SiteNews(library, folder))):
            if message is not None:
                await _send(socket, message)  # before the next one is made
            elif not gone.done():
                await asyncio.wait({gone}, timeout=POLL_S)
            if time.monotonic() >= link_at and not gone.done():
                link_at = time.monotonic() + LINK_S
                entry = receiving(folder.parent.name, folder.name)
                await _send(socket, link_message(entry, feed.heard_unix_s))
            if gone.done():
                break
    except (SkyreliefError, WebSocketDisconnect, RuntimeError) as error:
        log.debug("live view of %s ended: %s", folder, error)
        if isinstance(error, SkyreliefError):
            reason = str(error).replace(f"{folder}/", "")
    finally:
        if store is not None:
            await run_in_threadpool(store.close)
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):
            await socket.close(reason=reason.encode()[:MAX_REASON_BYTES].decode(errors="ignore"))


def _send(socket: WebSocket, message: str | bytes) -> Awaitable[None]:
    return socket.send_text(message) if isinstance(message, str) else socket.send_bytes(message)


async def _until_gone(socket: WebSocket) -> None:
    """Return when the browser closed the connection; what it sends is not read."""
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        while (await socket.receive())["type"] != "websocket.disconnect":
            pass
