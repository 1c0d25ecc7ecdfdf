"""Videos, logs and settings files that are damaged, or made to harm."""

from __future__ import annotations

import os
import random
import struct
import zlib
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path

import numpy as np
from hostile_records import damaged
from paths import DATA
from PIL import Image
from trial_decoders import DECODERS, seeds

from service.cameras import open_camera
from service.errors import SkyreliefError
from service.ground.mcap_import import header_in, store_from_mcap
from service.offline.refine.survey_file import read_survey

FRAMES = DATA.parents[1] / "demo" / "caliterra" / "frames"
SURVEY = (
    "name,keyframe_seq,u_px,v_px,lat,lon,alt_amsl_m,sigma_h_m,sigma_v_m,role\n"
    "A,0,100.5,90,47.39,8.54,408.0,0.02,0.03,control\nA,1,90,80,47.39,8.54,408.0,,,control\n"
    "B,2,10,20,47.391,8.541,409.5,,,check\n"
)


def _camera(path: Path) -> None:
    try:
        source = open_camera(str(path))
        try:
            for frame in source:
                assert frame.image.ndim == 3
        finally:
            source.close()
    except SkyreliefError:
        return


def _mcap(path: Path) -> None:
    try:
        header_in(path)
        out = path.with_suffix(".db")
        out.unlink(missing_ok=True)
        store_from_mcap(path, out).close()
    except SkyreliefError:
        return


def _survey(path: Path) -> None:
    try:
        read_survey(path)
    except SkyreliefError:
        return


def _decoded(name: str) -> Callable[[Path], None]:
    def read(path: Path) -> None:
        DECODERS[name](path.parent)(path.read_bytes())

    return read


READERS: dict[str, Callable[[Path], None]] = {
    "video .mp4": _camera,
    "video .ts": _camera,
    "images .jpg": _camera,
    "recording .mcap": _mcap,
    "survey .csv": _survey,
    **{
        name: _decoded(name)
        for name in DECODERS
        if name.startswith("log ") or name in ("configuration", "camera model")
    },
}
"""Name to what reads a file, or a folder of images; it may refuse one in words."""


def sound_video(path: Path) -> bytes:
    """Ten small images as a video."""
    import av

    rng = np.random.default_rng(5)
    wall = rng.integers(0, 255, (140, 200, 3), np.uint8)
    with av.open(str(path), "w") as out:
        stream = out.add_stream("mpeg4" if path.suffix == ".ts" else "libx264", Fraction(10))
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        for k in range(10):
            image = np.ascontiguousarray(wall[k : k + 120, 2 * k : 2 * k + 160])
            for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")):
                out.mux(packet)
        for packet in stream.encode():
            out.mux(packet)
    return path.read_bytes()


def sound_files(folder: Path, mcap: bytes) -> dict[str, bytes]:
    """A sound file for each reader but the images; ``mcap`` is an exported flight."""
    first = seeds
    logs = {name: first(name)[0] for name in READERS if name in DECODERS and first(name)}
    model = (FRAMES.parent / "camera.yaml").read_bytes()
    return {
        **logs,
        "log .tlog": (DATA / "mavlink" / "arducopter_turn.tlog").read_bytes()[:60_000],
        "camera model": model,
        "video .mp4": sound_video(folder / "sound.mp4"),
        "video .ts": sound_video(folder / "sound.ts"),
        "survey .csv": SURVEY.encode(),
        "recording .mcap": mcap,
    }


def made_to_harm() -> Iterator[tuple[str, str, bytes]]:
    """(reader, what it is, bytes) of files that mean something else than they weigh."""
    deep = 100_000
    yield "configuration", "deep TOML", b"a = " + b"[" * deep + b"]" * deep
    yield "configuration", "deep table", b"[" + b".".join([b"a"] * deep) + b"]\n"
    yield "configuration", "dotted key", b".".join([b"a"] * deep) + b" = 1\n"
    yield "configuration", "NUL", b'[scan]\nfolder = "a\\u0000b"\n'
    yield "configuration", "infinite", b"[datalink]\nbudget_kbit_s = inf\n"
    yield "configuration", "long number", b"[health]\nport = " + b"9" * 5000
    yield "camera model", "deep YAML", b"a: " + b"[" * deep
    aliases = b"a0: &a0 [x,x,x,x,x,x,x,x,x]\n" + b"".join(
        b"a%d: &a%d [%s]\n" % (k, k, b",".join([b"*a%d" % (k - 1)] * 9)) for k in range(1, 12)
    )
    yield "camera model", "billion laughs", aliases
    yield "camera model", "object", b"!!python/object/apply:os.system ['touch /tmp/harmed']"
    yield "camera model", "itself", b"a: &a [*a]\nimage_width: *a\n"
    yield "camera model", "long number", b"image_width: " + b"9" * 5000
    yield "camera model", "1e308", b"image_width: 1e308\nimage_height: .inf\n"
    yield "survey .csv", "one long field", b'name,lat\n"' + b"x" * 9_000_000
    yield "survey .csv", "many columns", b",".join([b"name"] * 100_000) + b"\n"
    yield "survey .csv", "zeros", bytes(1_000_000)
    yield "survey .csv", "infinite", SURVEY.replace("47.39,", "inf,").encode()
    yield "survey .csv", "1e308", SURVEY.replace("47.39,", "1e308,").encode()
    yield "survey .csv", "deep", SURVEY.replace("A,0", "A," + "9" * 5000).encode()
    head = b"ULog\x01\x12\x35\x01" + bytes(8)
    yield "log .ulg", "long message", head + b"\xff\xff\x46" + b"x" * 65_535
    nested = b"".join(
        struct.pack("<HB", len(t), 0x46) + t
        for t in (b"t%d:t%d[99] a;t%d b;" % (k, k + 1, k) for k in range(200))
    )
    yield "log .ulg", "nested formats", head + nested
    yield "log .BIN", "formats of 255", b"\xa3\x95\x80" + b"\xff" * 86
    yield "log .SRT", "long time", b"1\n" + b"9" * 100_000 + b":00:00,000 --> 00:00:01,000\nx\n\n"
    yield "log .SRT", "far place", b"1\n00:00:00,000 --> 00:00:01,000\n[latitude: 1e308]\n\n"
    yield "log .tlog", "last instant", b"\xff" * 8 + bytes(300)


def hostile_images(folder: Path, rng: random.Random, name: str) -> Path:
    """A folder of stills of which some are damaged, bombs, of another size, or no files."""
    here = folder / name
    here.mkdir()
    stills = [path.read_bytes() for path in sorted(FRAMES.glob("*.jpg"))[:3]]
    for k, data in enumerate(stills):
        (here / f"{k}.jpg").write_bytes(data if rng.randrange(3) == 0 else damaged(data, rng))
    kind = rng.randrange(8)
    if kind == 0:
        (here / "9.png").write_bytes(_bomb(30_000))
    elif kind == 1:
        (here / "9.jpg").symlink_to("/dev/zero")
    elif kind == 2:
        os.mkfifo(here / "9.jpg")
    elif kind == 3:
        (here / "9.jpg").mkdir()
    elif kind == 4:
        Image.new("RGB", (64, 48)).save(here / "0a.jpg")
    elif kind == 5:
        (here / "9.jpg").symlink_to(here)
    elif kind == 6:
        (here / "9.tif").write_bytes(b"II*\0" + rng.randbytes(400))
    return here


def _bomb(side_px: int) -> bytes:
    """A PNG of one colour: some hundred kilobytes that stand for gigabytes."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        body = kind + data
        return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))

    packer = zlib.compressobj(9)
    row = bytes(1 + 3 * side_px)
    data = b"".join(packer.compress(row) for _ in range(side_px // 10)) + packer.flush()
    size = struct.pack(">IIBBBBB", side_px, side_px, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", size), (b"IDAT", data), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(kind, body) for kind, body in chunks)


def hostile_media(folder: Path, mcap: bytes, seed: int) -> Iterator[tuple[str, str, Path]]:
    """(reader, what it is, path), the kinds in turn, without end; each overwrites the last."""
    rng = random.Random(seed)
    sound = sound_files(folder, mcap)
    for reader, what, data in made_to_harm():
        yield reader, what, _file(folder, reader, data)
    for number in range(1 << 30):
        for reader, data in sound.items():
            yield reader, f"damaged {number}", _file(folder, reader, damaged(data, rng))
        what = f"images {number}"
        yield "images .jpg", what, hostile_images(folder, rng, f"images-{number}")


def _file(folder: Path, reader: str, data: bytes) -> Path:
    suffix = {"configuration": ".toml", "camera model": ".yaml"}.get(reader, reader.split()[-1])
    path = folder / f"hostile{suffix}"
    path.write_bytes(data)
    return path
