"""Every decoder that bytes of radio, autopilot, camera or disk can reach, by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect  # type: ignore[import-untyped]

from mavlink.component.ftp import parse_request
from mavlink.telemetry.decode import decode as decode_message
from mavlink.telemetry.logs import load_telemetry
from mavlink.wire.dialect import dialect as our_dialect
from mavlink.wire.framing import Framer
from recon.types import DepthMap, Keyframe, Pose
from service.cameras.camera_file import load_camera
from service.config import load_config
from service.errors import SkyreliefError
from service.stream import codec, messages, plane_coders, planes, radio_messages
from service.stream.messages import Assembler, parse, split
from service.stream.records import PoseRecord, Repose, pack_pose, pack_repose, unpack_pose
from service.stream.records import unpack_repose as unpack_corrected
from service.stream.tunnel import TunnelIntake

Decoder = Callable[[bytes], object]


def _framing(_: Path) -> Decoder:
    reader = our_dialect.MAVLink(None)
    reader.robust_parsing = True

    def decode(data: bytes) -> None:
        for packet in Framer().feed(data):
            for message in reader.parse_buffer(packet.data) or []:
                decode_message(message)

    return decode


def _parts(_: Path) -> Decoder:
    def decode(data: bytes) -> None:
        assembler = Assembler()
        for part in parse(data):
            assembler.add(part, 0.0)

    return decode


def _records(_: Path) -> Decoder:
    def decode(data: bytes) -> None:
        unpack_pose(data)
        unpack_corrected(data)
        messages.unpack(data, messages.Head)
        messages.unpack(data, messages.Held)
        messages.unpack(data, messages.Ask)

    return decode


def _radio(_: Path) -> Decoder:
    def decode(data: bytes) -> None:
        TunnelIntake().receive(data[:128])
        radio_messages.unpack_announce(data)
        radio_messages.unpack_pose(data)
        radio_messages.unpack_tile(data)

    return decode


def _keyframe(_: Path) -> Decoder:
    def decode(data: bytes) -> None:
        codec.unpack(data)
        codec.decode([data])

    return decode


def _planes(_: Path) -> Decoder:
    known = np.ones((9, 13), np.bool_)

    def decode(data: bytes) -> None:
        plane_coders.decode_mask(data, 13, 9)
        planes.decode_sigma(data, 13, 9)
        planes.decode_views(data, 13, 9)
        planes.decode_colour(data, 13, 9)
        plane_coders.decode_codes(data, known)

    return decode


def _file(name: str, read: Callable[[Path], object]) -> Callable[[Path], Decoder]:
    """A reader of files: it may refuse one in words, with ValueError or an error of ours."""

    def at(folder: Path) -> Decoder:
        path = folder / name

        def decode(data: bytes) -> None:
            path.write_bytes(data)
            try:
                read(path)
            except (SkyreliefError, ValueError):
                return

        return decode

    return at


DECODERS: dict[str, Callable[[Path], Decoder]] = {
    "MAVLink": _framing,
    "MAVLink FTP": lambda _: parse_request,
    "datalink parts": _parts,
    "datalink records": _records,
    "keyframe layers": _keyframe,
    "keyframe planes": _planes,
    "telemetry radio": _radio,
    "configuration": _file("skyrelief.toml", load_config),
    "camera model": _file("camera.yaml", load_camera),
    "log .tlog": _file("flight.tlog", load_telemetry),
    "log .BIN": _file("flight.BIN", load_telemetry),
    "log .ulg": _file("flight.ulg", load_telemetry),
    "log .SRT": _file("flight.SRT", load_telemetry),
}


def seeds(name: str) -> list[bytes]:
    """A few sound inputs of a decoder, from which damaged ones are made."""
    return _SEEDS[name]() if name in _SEEDS else []


def _packets() -> bytes:
    link = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    out = [
        dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3),
        dialect.MAVLink_attitude_message(1000, 0.1, 0.0, 0.5, 0.0, 0.0, 0.0),
        dialect.MAVLink_global_position_int_message(1000, 473977000, 85456000, *[500] * 6),
    ]
    return b"".join(bytes(message.pack(link)) for message in out)


def _layers() -> list[bytes]:
    rng = np.random.default_rng(0)
    depth = DepthMap(
        rng.uniform(40, 60, (18, 32)).astype(np.float32),
        np.full((18, 32), 0.1, np.float32),
        np.full((18, 32), 3, np.uint8),
        np.array([[30.0, 0, 15.5], [0, 30.0, 8.5], [0, 0, 1]]),
        np.eye(4),
    )
    colour = rng.integers(0, 255, (18, 32, 3), np.uint8)
    pose, fresh = Pose(np.eye(4), np.eye(6)), np.ones((18, 32), np.bool_)
    return list(codec.encode(Keyframe(7, 0, depth, colour, pose, fresh), 1))


def _tlog() -> bytes:
    return (1_700_000_000_000_000).to_bytes(8, "big") + _packets()


_SEEDS: dict[str, Callable[[], list[bytes]]] = {
    "MAVLink": lambda: [_packets()],
    "datalink parts": lambda: [
        b"".join(p.pack() for p in split("pose", 3, bytes(range(256)), 100))
    ],
    "datalink records": lambda: [
        pack_pose(PoseRecord(5, np.eye(4), np.eye(6), keyframe_seq=5)),
        pack_repose(Repose(5, 1, np.eye(4), 1.0, np.eye(6))),
        b'{"scan":"a","drone":"b"}',
    ],
    "keyframe layers": _layers,
    "configuration": lambda: [b'[scan]\nbaseline = "2/10"\n[camera]\nsource = "x"\n'],
    "camera model": lambda: [b"image_width: 640\nimage_height: 480\ncamera_matrix:\n  data: [1]\n"],
    "log .tlog": lambda: [_tlog()],
    "log .BIN": lambda: [b"\xa3\x95\x80\x80\x59FMT\0BBnNZ\0Type,Length,Name,Format,Columns"],
    "log .ulg": lambda: [b"ULog\x01\x12\x35\x01" + bytes(8) + b"\x28\0B" + bytes(40)],
    "log .SRT": lambda: [
        b"1\n00:00:00,000 --> 00:00:00,033\n[latitude: 47.1] [longitude: 8.5] [rel_alt: 60.0 "
        b"abs_alt: 460.0]\n2023-01-01 00:00:00.000\n\n"
    ],
}
