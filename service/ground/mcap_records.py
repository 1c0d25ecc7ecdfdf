"""The messages of an MCAP that may come from a stranger, with a bound on every allocation.

The ``mcap`` package takes a chunk whole, whatever size its compressed frame claims, and protobuf
would build whatever classes the recording describes. Here chunks are bounded before they are
opened, and only the fields that are used are decoded, with their published numbers.
"""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import IO, Any, cast

from service.errors import InputError
from service.offline.exports.recording import POINT
from service.packages import needing
from service.stream.codec import MAX_PIXELS
from service.stream.validity import MAX_TIME_NS

SMALL_BYTES = 65_536
MAX_MESSAGE_BYTES = {
    "/points": MAX_PIXELS * POINT.itemsize + SMALL_BYTES,
    "/image": 1 << 24,
    "/camera": SMALL_BYTES,
    "/pose": SMALL_BYTES,
    "/fix": SMALL_BYTES,
    "/log": SMALL_BYTES,
}
"""Topics of a scan, and the maximum size of one message of each."""
MAX_RECORD_BYTES = MAX_MESSAGE_BYTES["/points"] + (1 << 20)
MAX_RATIO, FREE_BYTES = 200, 1 << 20
"""A chunk unpacks to so many times its size, or FREE_BYTES; floats of depth shrink ten times."""
MAX_CHANNELS = 4096

_DOUBLE, _FIXED32, _STRING, _MESSAGE, _BYTES = 1, 7, 9, 11, 12  # FieldDescriptorProto.Type
_FIELDS: dict[str, list[tuple[str, int, int, str]]] = {
    "Vector3": [("x", 1, _DOUBLE, ""), ("y", 2, _DOUBLE, ""), ("z", 3, _DOUBLE, "")],
    "Quaternion": [(axis, n + 1, _DOUBLE, "") for n, axis in enumerate("xyzw")],
    "Pose": [("position", 1, _MESSAGE, "Vector3"), ("orientation", 2, _MESSAGE, "Quaternion")],
    "Log": [("message", 3, _STRING, "")],
    "PoseInFrame": [("pose", 3, _MESSAGE, "Pose")],
    "LocationFix": [
        ("latitude", 1, _DOUBLE, ""),
        ("longitude", 2, _DOUBLE, ""),
        ("altitude", 3, _DOUBLE, ""),
        ("position_covariance", 4, _DOUBLE, "repeated"),
    ],
    "PointCloud": [
        ("pose", 3, _MESSAGE, "Pose"),
        ("point_stride", 4, _FIXED32, ""),
        ("data", 6, _BYTES, ""),
    ],
    "CompressedImage": [("data", 2, _BYTES, "")],
    "CameraCalibration": [
        ("width", 2, _FIXED32, ""),
        ("height", 3, _FIXED32, ""),
        ("K", 6, _DOUBLE, "repeated"),
        ("frame_id", 9, _STRING, ""),
    ],
}
"""The fields of Foxglove's schemas that are read: name, number, type, and content."""


def messages(path: Path, topics: tuple[str, ...]) -> Iterator[tuple[str, int, Any]]:
    """(topic, time, message) in the order of the file; other topics are skipped.

    Raises InputError for a file that is not a valid MCAP or asks for more memory than a scan does,
    OutsideError without the ``mcap`` package.
    """
    with needing("an MCAP"):
        from google.protobuf.message import DecodeError
        from mcap.exceptions import McapError
        from mcap.records import Channel, Message, Schema
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}  # topic and schema of those that are read
    try:
        for record in _records(path):
            if isinstance(record, Schema) and record.encoding == "protobuf":
                schemas[record.id] = record.name.removeprefix("foxglove.")
            elif isinstance(record, Channel) and record.topic in topics:
                name = schemas.get(record.schema_id, "")
                if name in _FIELDS:
                    channels[record.id] = record.topic, name
            elif isinstance(record, Message) and record.channel_id in channels:
                topic, name = channels[record.channel_id]
                if len(record.data) <= MAX_MESSAGE_BYTES[topic] and record.log_time <= MAX_TIME_NS:
                    yield topic, record.log_time, _classes()[name].FromString(record.data)
            if len(schemas) > MAX_CHANNELS or len(channels) > MAX_CHANNELS:
                raise InputError(f"{path} has more channels than a scan's recording")
    except (McapError, DecodeError, struct.error, EOFError, MemoryError, *_BROKEN) as error:
        raise InputError(f"{path} is not a valid MCAP ({type(error).__name__})") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror or error})") from error


_BROKEN = (ValueError, LookupError, TypeError, ArithmeticError, AttributeError, RuntimeError)


def _records(path: Path) -> Iterator[Any]:
    """The records of the file and of its chunks, in order."""
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader

    with open(path, "rb") as file:
        size = os.fstat(file.fileno()).st_size
        reader = StreamReader(
            cast(IO[bytes], _AtMost(file, size)),
            emit_chunks=True,
            record_size_limit=MAX_RECORD_BYTES,
        )
        for record in reader.records:
            if isinstance(record, Chunk):
                yield from _in_chunk(record)
            else:
                yield record


class _AtMost:
    """A file that never makes room for more than is left of it."""

    def __init__(self, file: IO[bytes], size: int) -> None:
        self._file, self._left = file, size

    def read(self, size: int = -1) -> bytes:
        """As of a file."""
        data = self._file.read(self._left if size < 0 else min(size, self._left))
        self._left -= len(data)
        return data


def _in_chunk(chunk: Any) -> Iterator[Any]:
    """The records in a chunk, one at a time."""
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.records import Channel, Message, Schema

    data = _unpacked(chunk)
    stream = ReadDataStream(io.BytesIO(data))
    while stream.count < len(data):
        opcode, length = stream.read1(), stream.read8()
        if length > len(data) - stream.count:
            raise ValueError("a record is longer than its chunk")
        if opcode == Opcode.MESSAGE:
            yield Message.read(stream, length)
        elif opcode == Opcode.CHANNEL:
            yield Channel.read(stream)
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(stream)
        else:
            stream.read(length)


def _unpacked(chunk: Any) -> bytes:
    """Contents of a chunk. Raises ValueError when its size is wrong or too large."""
    if not chunk.compression:
        return bytes(chunk.data)
    size = chunk.uncompressed_size
    if size > min(MAX_RECORD_BYTES, FREE_BYTES + MAX_RATIO * len(chunk.data)):
        raise ValueError(f"a chunk of {len(chunk.data)} bytes claims to hold {size}")
    if chunk.compression == "zstd":
        import zstandard

        opened = zstandard.ZstdDecompressor(max_window_size=1 << 27)
        try:
            data = opened.stream_reader(io.BytesIO(chunk.data)).read(size + 1)
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from error
    elif chunk.compression == "lz4":
        import lz4.frame  # type: ignore[import-untyped]

        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    else:
        raise ValueError(f"compression {chunk.compression[:20]!r}")
    if len(data) != size:
        raise ValueError(f"a chunk holds other than the {size} bytes it claims")
    return bytes(data)


@cache
def _classes() -> dict[str, Any]:
    """Message classes of _FIELDS."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    file = descriptor_pb2.FileDescriptorProto(name="scan.proto", package="scan", syntax="proto3")
    for name, fields in _FIELDS.items():
        message = file.message_type.add(name=name)
        for field, number, kind, holds in fields:
            one = message.field.add(name=field, number=number, type=kind)
            one.label = 3 if holds == "repeated" else 1  # LABEL_REPEATED, LABEL_OPTIONAL
            if kind == _MESSAGE:
                one.type_name = f".scan.{holds}"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return {
        name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"scan.{name}"))
        for name in _FIELDS
    }
