"""Messages of a hostile peer on the datalink: every kind, wrong in every way we know.

All of it is made from a seed. ``ATTACKER`` is a name of the peer's own; most records lie under a
scan with a sound header, so that the receiver looks at what follows.
"""

from __future__ import annotations

import json
import random
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from recon import se3
from service.bench.keyframes import make_keyframe
from service.stream import codec, radio_messages
from service.stream.messages import CODES, Part, split, split_in
from service.stream.radio_tiles import tiles_of
from service.stream.records import PoseRecord, Repose, ScanHeader, pack_pose, pack_repose

ATTACKER = "mallory"
BIG = (1 << 32) - 1
NUMBER_OF_BYTES = struct.Struct("<I")
VALUES: list[Any] = [None, -1, 1e308, [], {"a": []}, "\ud800", "/etc/passwd", True, 1 << 70]
HEAD = '{"v":1,"numbers":{%s},"live":{},"finished":true}'


@dataclass(frozen=True, slots=True)
class Put:
    """One message: a name for the table, the key below the root, and its bytes."""

    what: str
    key: str
    payload: bytes


def damaged(data: bytes, rng: random.Random) -> bytes:
    """``data`` with bytes changed, cut, repeated or zeroed: what chance and malice make of it."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4, 16, 64))):
        at = rng.randrange(len(out) + 1)
        size = rng.choice((1, 1, 2, 4, 8, 200))
        kind = rng.randrange(8)
        if kind < 4:
            out[at : at + size] = rng.randbytes(min(size, len(out) - at))
        elif kind == 4:
            out[at : at + size] = rng.choice((b"\0", b"\xff")) * min(size, len(out) - at)
        elif kind == 5:
            out[at:at] = out[rng.randrange(len(out) + 1) :][:size]
        elif kind == 6:
            del out[at : at + size]
        elif rng.randrange(8) == 0:
            del out[at:]
    return bytes(out)


def hostile_json(sound: dict[str, Any]) -> Iterator[tuple[str, bytes]]:
    """JSON texts like ``sound``, which is one object, that are wrong or say what cannot be."""
    text = json.dumps(sound)
    inside = text[1:-1]
    yield "UTF-16", text.encode("utf-16")
    yield "UTF-16 without mark", text.encode("utf-16-le")
    yield "UTF-32", text.encode("utf-32")
    yield "mark of UTF-8", b"\xef\xbb\xbf" + text.encode()
    yield "Latin-1", text.replace("{", '{"caf\xe9": 1,', 1).encode("latin-1")
    yield "nothing", b""
    yield "zeros", bytes(64)
    for what, wrong in (
        ("list", "[]"),
        ("null", "null"),
        ("number", "1e999"),
        ("text", '"\\ud800"'),
        ("deep lists", "[" * 100_000),
        ("deep objects", '{"a":' * 50_000 + "1" + "}" * 50_000),
        ("half", text[: len(text) // 2]),
        ("twice", text + text),
        ("same key twice", f"{{{inside},{inside}}}"),
        ("lone surrogate", f'{{{inside},"notes":["\\ud800"],"title":"\\udfff"}}'),
        ("zero in a text", f'{{{inside},"notes":["a\\u0000b"]}}'),
        ("NaN", f'{{{inside},"figure":NaN,"other":-Infinity}}'),
        ("large text", f'{{{inside},"notes":["{"x" * 250_000}"]}}'),
        ("too large", f'{{{inside},"notes":["{"x" * 300_000}"]}}'),
        ("many keys", f"{{{inside},{','.join(f'{chr(34)}k{i}{chr(34)}:0' for i in range(9999))}}}"),
        ("23 digits", f'{{{inside},"keyframes":{"9" * 23},"points":-{"9" * 23}}}'),
        ("5000 digits", f'{{{inside},"keyframes":{"9" * 5000}}}'),
        ("deep inside", f'{{{inside},"camera":{"[" * 400}{"]" * 400}}}'),
    ):
        yield what, wrong.encode("utf-8", "surrogatepass")
    for key in sound:
        for value in VALUES:
            yield f"{key} {value!r:.14}", json.dumps({**sound, key: value}).encode()


def sound_header(scan: str, drone: str = ATTACKER) -> ScanHeader:
    """A header that any receiver takes."""
    return ScanHeader(
        scan,
        drone,
        1_700_000_000_000_000_000,
        origin_lat_deg=47.39,
        origin_lon_deg=8.54,
        origin_alt_amsl_m=408.0,
        epsg=32632,
        camera={"fx": 256.0, "fy": 256.0, "cx": 159.5, "cy": 89.5, "width": 320, "height": 180},
        georeference="gnss",
    )


def hostile_headers(scan: str) -> Iterator[tuple[str, bytes]]:
    """Texts that come as the header of ``scan``."""
    sound = json.loads(sound_header(scan).to_json())
    yield from hostile_json(sound)
    for place in ((91.0, 8.0), (-90.0, 181.0), (90.0, 0.0), (0.0, -180.0), (1e-320, 1e-320)):
        changed = dict(zip(("origin_lat_deg", "origin_lon_deg"), place, strict=True))
        yield f"origin at {place}", json.dumps({**sound, **changed}).encode()
    for name in ("", "..", ".hidden", "a/b", "a" * 65, "\u202e", "%2e%2e", "CON"):
        yield f"scan called {name!r}", json.dumps({**sound, "scan_id": name}).encode()
        yield f"drone called {name!r}", json.dumps({**sound, "drone": name}).encode()


@cache
def sound_layers() -> tuple[bytes, ...]:
    """The layers of a keyframe as a drone sends it."""
    return tuple(codec.encode(make_keyframe(0, (160, 90)), 1_700_000_000_000_000_000))


def hostile_layers() -> Iterator[tuple[str, bytes]]:
    """Layers with a sound checksum that say what no camera ever saw."""
    opened = codec.unpack(sound_layers()[-1])
    assert opened is not None
    head, sections = opened

    def optics(**changes: float) -> Any:
        K, at = head.K.copy(), {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
        for name, value in changes.items():
            K[at[name]] = value
        return K

    for focal in (0.002, 0.5, 1.5, 9e5, 1e38, -100.0, 0.0, np.nan, np.inf):
        yield f"fx = {focal}", codec.pack(replace(head, K=optics(fx=focal)), sections)
        both = replace(head, K=optics(fx=focal, fy=focal))
        yield f"fx = fy = {focal}", codec.pack(both, sections)
    for centre in (-1e38, 1e38, 1e6, np.nan):
        yield f"cx = {centre}", codec.pack(replace(head, K=optics(cx=centre)), sections)
    for value in (1e-38, 1e-30, 1e-9, 9999.0, 1e38, -1.0, np.nan):
        yield f"inverse_min {value}", codec.pack(replace(head, inverse_min=value), sections)
        yield f"inverse_step {value}", codec.pack(replace(head, inverse_step=value), sections)
        small = replace(head, inverse_min=value, inverse_step=value)
        yield f"inverse_min and step {value}", codec.pack(small, sections)
    for far in (1e5, 1e7, 1e12, 1e300, -1e308, np.nan, np.inf):
        T = head.T_world_camera.copy()
        T[:3, 3] = far
        yield f"camera at {far}", codec.pack(replace(head, T_world_camera=T), sections)
    layer = codec.pack(head, sections)
    body = layer[codec.HEADER_BYTES :]
    for what, at, put in (
        ("no rotation", 24, bytes(32)),
        ("rotation of NaN", 24, np.full(4, np.nan).tobytes()),
        ("huge rotation", 24, np.full(4, 1e300).tobytes()),
        ("negative covariance", 56, np.full(21, -1, np.float32).tobytes()),
        ("huge covariance", 56, np.full(21, 3e38, np.float32).tobytes()),
    ):
        begin = 58 + at  # of position, quaternion and covariance
        sealed = layer[:begin] + put + layer[begin + len(put) : codec.HEADER_BYTES - 4]
        yield what, sealed + struct.pack("<I", zlib.crc32(sealed + body)) + body
    for what, change in (
        ("empty box", {"box": (0, 0, 0, 0)}),
        ("box outside", {"box": (150, 80, 160, 90)}),
        ("largest grid", {"full_px": (4096, 1024), "box": (0, 0, 4096, 1024)}),
        ("largest grid, empty box", {"full_px": (4096, 1024), "box": (0, 0, 0, 0)}),
        ("grid too large", {"full_px": (4096, 4096)}),
        ("factor 0", {"factor": 0}),
        ("factor 255", {"factor": 255, "box": (0, 0, 1, 1)}),
        ("layer 7 of 8", {"layer": 7, "layers": 8}),
        ("layer 9", {"layer": 9, "layers": 9}),
        ("layer 200", {"layer": 200, "layers": 255}),
        ("method 9", {"method": 9}),
        ("method 1", {"method": 1}),
        ("first instant", {"time_unix_ns": -(1 << 63)}),
        ("last instant", {"time_unix_ns": (1 << 63) - 1}),
    ):
        yield what, codec.pack(replace(head, **change), sections)
    bomb = bytes(18) + zlib.compress(bytes(15 << 20), 9)
    wide = np.frombuffer(sections[4], np.uint8).tobytes()
    sof = wide.find(b"\xff\xc0")
    wide = wide[: sof + 5] + b"\xff\xff\xff\xff" + wide[sof + 9 :]
    for index, name in enumerate(("mask", "depth", "sigma", "views", "colour")):
        for what, data in (
            ("empty", b""),
            ("zeros", bytes(5000)),
            ("ones", b"\xff" * 5000),
            ("noise", random.Random(index).randbytes(5000)),
            ("zlib bomb", bomb),
            ("JPEG of 65535 px", wide),
        ):
            changed_sections = (*sections[:index], data, *sections[index + 1 :])
            yield f"{name}: {what}", codec.pack(head, changed_sections)


def hostile_poses() -> Iterator[tuple[str, bytes]]:
    """Pose records with a sound checksum."""
    sound = PoseRecord(1_700_000_000_000_000_000, np.eye(4), np.eye(6) * 1e-4, 47.39, 8.54, 450.0)
    for value in (1e308, -1e308, 91.0, 1e12):
        yield f"pose at latitude {value}", pack_pose(replace(sound, lat_deg=value))
        yield f"pose at longitude {value}", pack_pose(replace(sound, lon_deg=value))
        yield f"pose at altitude {value}", pack_pose(replace(sound, alt_amsl_m=value))
        T = se3.compose(np.eye(3), np.full(3, value))
        yield f"pose at {value} m", pack_pose(replace(sound, T_world_camera=T))
    for name in ("agl_m", "roll_rad", "speed_m_s", "distance_m", "turn_rate_rad_s", "sigma_m"):
        for figure in (3e38, -3e38, float("inf"), float("nan")):
            yield f"pose with {name} {figure}", pack_pose(replace(sound, **{name: figure}))  # type: ignore[arg-type]
    for time_ns in (-(1 << 63), 0, (1 << 63) - 1):
        yield f"pose at time {time_ns}", pack_pose(replace(sound, time_unix_ns=time_ns))


def hostile_reposes() -> Iterator[tuple[str, bytes]]:
    """Re-poses with a sound checksum, of keyframe 0."""
    sound = Repose(0, 1, np.eye(4), 1.0, np.eye(6) * 1e-4)
    for scale in (9e5, 1.1e-6, 3e38, -1.0, 0.0, float("nan"), float("inf")):
        yield f"re-pose of scale {scale}", pack_repose(replace(sound, scale=scale))
    for far in (1e7, 1e300, float("nan"), float("inf")):
        T = se3.compose(np.eye(3), np.full(3, far))
        yield f"re-pose at {far}", pack_repose(replace(sound, T_world_camera=T))
    yield "re-pose, last revision", pack_repose(replace(sound, seq=BIG, revision=BIG))
    yield "re-pose, huge covariance", pack_repose(replace(sound, covariance=np.eye(6) * 3e38))


def hostile_heads() -> Iterator[tuple[str, bytes]]:
    """Heads of a scan, and anything else that may come in their place."""
    ranges = (
        [[0, BIG]],
        [[0, BIG + 1]],
        [[-5, 7]],
        [[7, 3]],
        [[0, 1, 2]],
        [["0", "9"]],
        [[0, 1.5]],
        [[10**30, 10**31]],
        [[2 * n, 2 * n] for n in range(4096)],
        [[2 * n, 2 * n] for n in range(4097)],
        [[n << 20, (n << 20) + 500_000] for n in range(4095)],
        [[0, BIG]] * 4000,
    )
    for kind in ("k0", "k1", "k7", "pose", "repose", "header", "summary", "k8", "\ud800"):
        for k, pairs in enumerate(ranges):
            text = HEAD % f"{json.dumps(kind)}:{json.dumps(pairs)}"
            yield f"head {k} of {kind!r}", text.encode()
    every = ",".join(f'"{kind}":[[0,{BIG}]]' for kind in CODES)
    yield "head of everything", (HEAD % every).encode()
    yield "head of 9999 kinds", (HEAD % ",".join(f'"z{n}":[[0,9]]' for n in range(9999))).encode()
    sound = {"v": 1, "numbers": {"k0": [[0, 9]]}, "live": {"k0": [[0, 9]]}, "finished": True}
    for what, data in hostile_json(sound):
        yield f"head: {what}", data


def hostile_parts() -> Iterator[tuple[str, bytes]]:
    """Messages of parts that do not fit together."""
    record = sound_layers()[-1]
    many = split_in("k1", 1, bytes(1 << 20), 65_535)
    for what, parts in (
        ("count 0", [Part("k1", 2, 0, 0, 10, 0, b"")]),
        ("index beyond", [Part("k1", 2, 9, 3, 10, 0, b"")]),
        ("16 MiB announced", [Part("k1", n, 0, 65_535, 1 << 24, 0, b"x") for n in range(500)]),
        ("beyond 16 MiB", [Part("k1", 2, 0, 2, BIG, 0, b"x")]),
        ("empty parts", [Part("k1", 3, k, 65_535, 0, 0, b"") for k in range(20_000)]),
        ("last part alone", [many[-1]]),
        ("changing counts", [p for n in (2, 3, 4, 5) * 40 for p in split_in("k0", 4, record, n)]),
        ("wrong checksum", [replace(p, crc=1) for p in split("k1", 5, record, 1000)]),
        ("another number", split("k1", 77, record, 1000)),
        ("another layer", split("k0", 0, record, 1000)),
        ("another kind", split("pose", 1, record, 1000)),
        ("pieces of 600 records", [split("k1", n, record, 1000)[0] for n in range(600)]),
    ):
        yield f"parts: {what}", b"".join(p.pack() for p in parts)
    sound = b"".join(p.pack() for p in split("k1", 6, record, 1000))
    yield "parts: size beyond the message", sound[:20] + NUMBER_OF_BYTES.pack(BIG) + sound[24:]
    yield "parts: unknown kind", sound[:3] + b"\xfe" + sound[4:]


def item(kind: str, number: int, record: bytes) -> bytes:
    """``record`` as a message of parts."""
    return b"".join(p.pack() for p in split(kind, number, record, 60_000))


def _under(scan: str, drone: str = ATTACKER) -> list[Put]:
    """A sound header and head, so that a receiver knows the scan."""
    header = sound_header(scan, drone).to_json()
    number, key = zlib.crc32(header), f"{drone}/{scan}"
    head = HEAD % f'"header":[[{number},{number}]],"k0":[[0,50]],"k1":[[0,50]]'
    return [
        Put("sound head", f"{key}/head", head.encode()),
        Put("sound header", f"{key}/item/header/{number}", item("header", number, header)),
    ]


def _texts(kind: str, texts: Iterator[tuple[str, bytes]], scan: str) -> Iterator[Put]:
    for what, text in texts:
        number = zlib.crc32(text)
        key = f"{ATTACKER}/{scan}/item/{kind}/{number}"
        yield Put(f"{kind}: {what}", key, item(kind, number, text))


def hostile_puts() -> Iterator[Put]:
    """Every hostile message that we know, each once."""
    for k, (what, data) in enumerate(hostile_heads()):
        yield Put(what, f"{ATTACKER}/heads-{k % 7}/head", data)
    yield from _under("texts")
    yield from _texts("header", hostile_headers("texts"), "texts")
    yield from _texts("summary", hostile_json({"keyframes": 3, "points": 9}), "texts")
    yield from _under("records")
    # Each keyframe is of a scan with few others, so that what one asks for is not all they ask.
    for k, (what, data) in enumerate(hostile_layers()):
        scan, kind = f"frames-{k % 9}", f"k{min(data[5], 7)}"
        if k < 9:
            yield from _under(scan)
            sound = item("k0", 0, sound_layers()[0])
            yield Put("sound layer", f"{ATTACKER}/{scan}/item/k0/0", sound)
        yield Put(what, f"{ATTACKER}/{scan}/item/{kind}/0", item(kind, 0, data))
        numbered = data[:8] + NUMBER_OF_BYTES.pack(1 + k) + data[12:218]
        seal = zlib.crc32(data[222:], zlib.crc32(numbered))
        data = numbered + NUMBER_OF_BYTES.pack(seal) + data[222:]
        key = f"{ATTACKER}/{scan}/item/{kind}/{1 + k}"
        yield Put(f"{what}, numbered", key, item(kind, 1 + k, data))
    small = (("pose", hostile_poses()), ("repose", hostile_reposes()))
    for kind, records in small:
        for k, (what, data) in enumerate(records):
            for scan in ("records", "frames-0"):
                key = f"{ATTACKER}/{scan}/item/{kind}/{k + 1}"
                yield Put(what, key, item(kind, k + 1, data))
    for what, data in hostile_parts():
        yield Put(what, f"{ATTACKER}/records/item/k1/0", data)
    sound = item("k0", 0, sound_layers()[0])
    for name in ("..", ".x", "a" * 64, "a" * 65, "%2e", "scan.db", "-", "é", "a b", "~", "x;y"):
        yield Put(f"scan called {name}", f"{ATTACKER}/{name}/item/k0/0", sound)
        yield Put(f"drone called {name}", f"{name}/scan/item/k0/0", sound)
        yield Put(f"kind called {name}", f"{ATTACKER}/records/item/{name}/{name}", sound)
    for number in (-1, BIG + 1, 10**30, "0-4294967295"):
        yield Put(f"item {number}", f"{ATTACKER}/records/item/k0/{number}", sound)


def hostile_reports(station: str) -> Iterator[tuple[str, bytes]]:
    """A ``held`` message to a drone; ``station`` makes each differ."""
    sound = {"v": 1, "numbers": {"k0": [[0, 9]]}, "received_bytes": 5, "from": station}
    yield from hostile_json(sound)
    for value in (-1, 1 << 62, 1 << 70, 1e300):
        yield f"received {value}", json.dumps({**sound, "received_bytes": value}).encode()


def hostile_tunnels(seed: int, count: int) -> Iterator[bytes]:
    """``count`` payloads of the narrow radio: sound ones, their fields at the ends of their
    types, invented announcements, damaged ones."""
    rng = random.Random(seed)
    header = sound_header("radio")
    tag = radio_messages.tag_of(ATTACKER, header.name)
    tiles = [radio_messages.pack_tile(tag, t) for t in tiles_of(make_keyframe(0, (160, 90)))]
    pose = PoseRecord(1_700_000_000_000_000_000, np.eye(4), np.eye(6), 47.39, 8.54, 450.0)
    sound = [radio_messages.pack_announce(header), radio_messages.pack_pose(tag, 1, pose), *tiles]
    ends = [sound[k][:at] + end * size + sound[k][at + size :]
        for k, fields in ((0, ((5, 8), (13, 8), (21, 8), (29, 4), (33, 2), (35, 1))),
            (1, ((5, 4), (9, 8), (17, 12), (29, 8), (37, 8), (45, 4), (49, 2))),
            (2, ((5, 2), (7, 4), (11, 1), (12, 1), (13, 1), (14, 12), (26, 8), (34, 2), (36, 4),
                (40, 2), (42, 2), (44, 1), (45, 2), (47, 80))))
        for at, size in fields
        for end in (b"\0", b"\xff", b"\x7f", b"\x80")
    ]  # fmt: skip
    yield from (sound + ends)[:count]
    for number in range(count - len(sound) - len(ends)):
        if number % 10 == 0:
            scan = sound_header(f"radio-{rng.randrange(1 << 30):x}", f"ghost-{number}")
            yield radio_messages.pack_announce(scan)
        else:
            yield damaged(rng.choice(sound), rng)[:128]


def endless_puts(seed: int) -> Iterator[Put]:
    """The known ones damaged, junk scans and flooding heads, for as long as one likes."""
    rng = random.Random(seed)
    known = [put for put in hostile_puts() if len(put.payload) < 60_000]
    while True:
        put = rng.choice(known)
        turn = rng.randrange(8)
        if turn == 0:
            yield put
        elif turn == 1:
            scan = f"junk-{rng.randrange(1 << 30):x}"
            yield replace(put, key="/".join([ATTACKER, scan, *put.key.split("/")[2:]]))
        else:
            yield replace(put, payload=damaged(put.payload, rng))
