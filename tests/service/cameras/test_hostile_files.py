"""Files that were flipped, cut or made to hurt: said in one line, and the rest goes on."""

from __future__ import annotations

import logging
import os
import random
import struct
import subprocess
import sys
import zlib
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from mavlink.telemetry.logs import load_telemetry
from service.cameras import open_camera
from service.cameras import source as source_module
from service.cameras.camera_file import load_camera
from service.config import load_config
from service.errors import InputError
from service.offline.refine.survey_file import read_survey


@pytest.fixture(scope="module")
def mp4(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A short H.264 recording."""
    path = tmp_path_factory.mktemp("video") / "v.mp4"
    with av.open(str(path), "w") as out:
        out.metadata["comment"] = "abcdefghijklmnop"
        stream = out.add_stream("libx264", rate=Fraction(10))
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        for k in range(8):
            image = np.random.default_rng(k).integers(0, 255, (64, 96, 3), np.uint8)
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        out.mux(stream.encode(None))
    return path.read_bytes()


def frames(path: Path) -> int:
    """How many images come out; -1 when the file is refused in one line."""
    try:
        source = open_camera(str(path))
    except InputError as error:
        assert "\n" not in str(error)
        return -1
    try:
        return sum(1 for _ in source)
    finally:
        source.close()


@pytest.mark.parametrize("name", ["GS010001.360", "VID_1.insv"])
def test_a_recording_of_all_around_is_refused(tmp_path: Path, mp4: bytes, name: str) -> None:
    (tmp_path / name).write_bytes(mp4)
    with pytest.raises(InputError, match="export a flat video of one direction"):
        open_camera(str(tmp_path / name))


def test_flipped_recordings_never_end_in_a_traceback(
    tmp_path: Path, mp4: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.CRITICAL)
    path = tmp_path / "v.mp4"
    index = mp4.rindex(b"moov")
    outcomes = set()
    for seed in range(150):
        rng = random.Random(seed)
        data = bytearray(mp4)
        for _ in range(rng.choice([1, 4, 16, 64])):
            at = rng.randrange(index if seed % 3 else 0, len(data))
            data[at] ^= 1 << rng.randrange(8)
        path.write_bytes(data if seed % 10 else data[: rng.randrange(len(data))])
        outcomes.add(frames(path) >= 0)
    assert outcomes == {True, False}


@pytest.mark.parametrize(("old", "new"), [
    (b"avc1\0\0\0\0", b"xyz1\0\0\0\0"),  # no decoder has that name
    (b"abcdefghijklmnop", b"abc\xb0\xff\xfe\xb0\xb0jklmnop"),  # a comment that is not UTF-8
    (struct.pack(">HH", 96, 64), b"\xff\xff\xff\xff"),
])  # fmt: skip
def test_a_recording_with_an_odd_index(tmp_path: Path, mp4: bytes, old: bytes, new: bytes) -> None:
    assert old in mp4
    path = tmp_path / "v.mp4"
    path.write_bytes(mp4.replace(old, new))
    assert frames(path) in (-1, 8)


def test_a_image_of_more_pixels_than_allowed_is_not_decoded(
    tmp_path: Path, mp4: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "v.mp4").write_bytes(mp4)
    assert frames(tmp_path / "v.mp4") == 8
    monkeypatch.setattr(source_module, "MAX_PIXELS", 96 * 64 - 1)
    assert frames(tmp_path / "v.mp4") == -1


def png(width: int, height: int) -> bytes:
    """A PNG that claims a size and has one row."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        crc = zlib.crc32(kind + body)
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", crc)

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    row = chunk(b"IDAT", zlib.compress(b"\0" * (1 + 3 * 64)))
    return b"\x89PNG\r\n\x1a\n" + head + row + chunk(b"IEND", b"")


def test_a_decompression_bomb_costs_itself_only(tmp_path: Path) -> None:
    for k in range(3):
        image = np.full((48, 64, 3), 60 * k, np.uint8)
        Image.fromarray(image).save(tmp_path / f"{k}.png")
    (tmp_path / "bomb.png").write_bytes(png(60_000, 60_000))
    (tmp_path / "½²bomb3.png").write_bytes(png(2**31 - 1, 2**31 - 1))
    source = open_camera(str(tmp_path))
    assert [frame.name for frame in source] == ["0.png", "1.png", "2.png"]
    said = " ".join(source.warnings)
    assert "bomb.png is not a readable image" in said and "½²bomb3.png" in said


def test_flipped_stills_cost_themselves_only(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[306] = "2024:01:02 03:04:05"
    exif.get_ifd(0x8825)[2] = (47.0, 30.0, 0.0)
    path = tmp_path / "good.jpg"
    Image.fromarray(np.full((48, 64, 3), 90, np.uint8)).save(path, exif=exif)
    good = path.read_bytes()
    for seed in range(200):
        rng = random.Random(seed)
        data = bytearray(good)
        for _ in range(rng.choice([1, 4, 16])):
            data[rng.randrange(len(data) if seed % 2 else 200)] ^= 1 << rng.randrange(8)
        (tmp_path / f"flipped{seed}.jpg").write_bytes(data)
    names = [frame.name for frame in open_camera(f"images:{tmp_path}")]
    assert "good.jpg" in names


@pytest.mark.parametrize("what", ["/dev/zero", "fifo", "folder", "large", "missing"])
def test_small_files_are_regular_and_small(tmp_path: Path, what: str) -> None:
    path = Path(what) if what.startswith("/") else tmp_path / what
    if what == "fifo":
        os.mkfifo(path)
    elif what == "folder":
        path.mkdir()
    elif what == "large":
        with open(path, "wb") as file:
            file.truncate(1 << 36)
    for read in (load_config, read_survey, load_camera):
        with pytest.raises(InputError, match=path.name):
            read(path)


def test_toml_of_ten_thousand_brackets_is_refused(tmp_path: Path) -> None:
    deep = "[" * 10_000 + "]" * 10_000
    path = tmp_path / "deep.toml"
    path.write_text(f"a = {deep}")
    with pytest.raises(InputError, match=r"deep\.toml is not a valid configuration"):
        load_config(path)
    with pytest.raises(InputError, match="--set"):
        load_config(None, [f"scan.resolution_m={deep}"])


@pytest.mark.parametrize("shape", ["a = %s", "%sb = 1", "[%sb]"])
def test_one_line_of_toml_takes_no_memory_beyond_its_own(tmp_path: Path, shape: str) -> None:
    """A dotted key of 30,000 parts would take 4 GiB."""
    path = tmp_path / "long.toml"
    path.write_text(shape % ("a." * 30_000))
    with pytest.raises(InputError, match=r"a line of over 4096 bytes"):
        load_config(path)


@pytest.mark.parametrize(
    "text", ["\0" * 200_000, 'name,"' + "x" * 200_000, 'name,lat\n"' + "x" * 200_000]
)
def test_a_survey_with_an_endless_cell_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "points.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=r"points\.csv line 1"):
        read_survey(path)


def test_a_dataflash_log_of_formats_that_do_not_exist_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "flight.bin"
    path.write_bytes(b"\xa3\x95\x80" + b"\xff" * 86)
    with pytest.raises(ValueError, match=r"flight\.bin"):
        load_telemetry(path)


def test_an_endless_device_is_no_recording() -> None:
    command = [sys.executable, "-m", "service.cli", "replay", "file:/dev/zero"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert ended.returncode == 2 and "not a regular file" in ended.stderr
