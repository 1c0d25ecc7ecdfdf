"""The readout of the sensor, as a DJI camera states it in its video.

Track "DJI meta" (tag ``djmd``) holds protocol buffers; its first sample describes the clip. Fields
by the definitions in Gyroflow's telemetry-parser (``src/dji/dvtm_wm169.proto``, ``dvtm_oq101``,
``dvtm_eagle4_wa530``, ``dvtm_library``): 1 clip; in it 1 header with 1 the name of the definition,
4 readout time with 1 in ns, 5 direction of the readout with 1 the corner where it begins.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import av

from recon.types import Shutter
from service.cameras import open_container

HANDLER = "DJI meta"
MAX_BYTES = 1 << 16  # of a sample, that are read; the clip comes first
MAX_PACKETS = 500  # packets of all tracks in which the first sample must lie

MAX_FIELDS = 256
MAX_READOUT_NS = 50_000_000
DIRECTIONS = ("down", "down", "up", "up", "right", "left", "left", "right")
"""By the number of the corner: top left, top right, bottom right, bottom left, left top, ..."""


def stated_shutter(path: str) -> Shutter | None:
    """The shutter that a DJI video states; None where it states none that can be."""
    try:
        with open_container(path) as container:
            tracks = [s for s in container.streams if s.metadata.get("handler_name") == HANDLER]
            for packet in islice(container.demux(), MAX_PACKETS) if tracks else ():
                if packet.stream in tracks and packet.size:
                    return shutter_of_sample(bytes(memoryview(packet)[:MAX_BYTES]))
    except (av.error.FFmpegError, OSError, ValueError, IndexError):
        pass
    return None


def shutter_of_sample(sample: bytes) -> Shutter | None:
    """The shutter in the first sample of the track; None for any other bytes."""
    clip = _message(_message(sample).get(1))
    name = _message(clip.get(1)).get(1)
    readout_ns = _message(clip.get(4)).get(1)
    corner = _message(clip.get(5)).get(1, 0)
    if not (isinstance(name, bytes) and name.startswith(b"dvtm_")):
        return None
    if not (isinstance(readout_ns, int) and 0 < readout_ns <= MAX_READOUT_NS):
        return None
    if not (isinstance(corner, int) and corner < len(DIRECTIONS)):
        return None
    return Shutter(1e-9 * readout_ns, DIRECTIONS[corner])


def _message(data: int | bytes | None) -> dict[int, int | bytes]:
    """Fields of a protocol buffer by number, the last of each; those before an error."""
    if not isinstance(data, bytes):
        return {}
    return dict(islice(_fields(data), MAX_FIELDS))


def _fields(data: bytes) -> Iterator[tuple[int, int | bytes]]:
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        if key is None:
            return
        wire = key & 7
        if wire == 0:
            number, at = _varint(data, at)
            if number is None:
                return
            yield key >> 3, number
            continue
        size: int | None = {1: 8, 5: 4}.get(wire)
        if wire == 2:
            size, at = _varint(data, at)
        if size is None or at + size > len(data):
            return
        yield key >> 3, data[at : at + size]
        at += size


def _varint(data: bytes, at: int) -> tuple[int | None, int]:
    """The number at a place and the place after it; None where it does not end."""
    value = 0
    for shift, byte in enumerate(data[at : at + 10]):
        value |= (byte & 0x7F) << (7 * shift)
        if byte < 0x80:
            return value, at + shift + 1
    return None, at
