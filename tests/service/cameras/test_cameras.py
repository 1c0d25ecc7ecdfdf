"""Recorded cameras: every image and its time come out, and bad input is reported in one line."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from paths import SHARED

from service.cameras import (
    CAMERAS,
    CameraFrame,
    CameraSource,
    lenient,
    open_camera,
    parse_source,
    video,
)
from service.cameras.source import Decoded, decoded_frames
from service.cameras.video import (
    PipeReader,
    VideoSource,
    index_at_end,
    parse_time_unix_ns,
)
from service.errors import InputError

SIZE_PX = (160, 96)
TIMES_MS = (0, 40, 80, 200, 240, 1000, 1033, 1066)
"""Irregular on purpose: a source that counts frames instead of reading times is found out."""

needs_ffmpeg = pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs the ffmpeg command")


def image(i: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Flat BGR colour that tells image ``i`` from the others after lossy coding."""
    image = np.zeros((SIZE_PX[1], SIZE_PX[0], 3), np.uint8)
    image[:, :, 0] = 20 + 25 * i
    image[:, :, 2] = 230 - 25 * i
    noise = np.random.default_rng(i).integers(0, 256, (SIZE_PX[1], 32, 3), np.uint8)
    image[:, -32:] = noise  # every image costs bytes, so that a cut file loses some
    return image


def write_video(
    target: Any,
    container_format: str,
    options: dict[str, str] | None = None,
    creation_time: str | None = None,
    codec: str = "libx264",
    coder: str = "",
    earlier_ms: int = 0,
) -> None:
    """Code the images at ``TIMES_MS`` into ``target`` (path or stream)."""
    with av.open(target, "w", format=container_format, options=options or {}) as out:
        if creation_time:
            out.metadata["creation_time"] = creation_time
        stream: Any = out.add_stream(codec, rate=30)
        stream.width, stream.height = SIZE_PX
        stream.pix_fmt = "yuv420p" if codec == "libx264" else "yuvj420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        if codec == "libx264":
            stream.options = {"bf": "0", "crf": "12", "x264-params": coder}
        for i, ms in enumerate(TIMES_MS):
            frame = av.VideoFrame.from_ndarray(image(i), format="bgr24")
            frame.pts, frame.time_base = ms - earlier_ms, Fraction(1, 1000)
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))


def check_images(frames: list[CameraFrame]) -> None:
    """Assert that ``frames`` are the images of :func:`write_video`, in order, in colour."""
    assert [f.seq for f in frames] == list(range(len(TIMES_MS)))
    for i, frame in enumerate(frames):
        assert frame.image.shape == (SIZE_PX[1], SIZE_PX[0], 3)
        assert frame.image.dtype == np.uint8
        middle = frame.image[20:70, 20:120].reshape(-1, 3).mean(axis=0)
        np.testing.assert_allclose(middle, image(i)[0, 0], atol=8)


@pytest.mark.parametrize(
    ("name", "container_format"), [("v.mp4", "mp4"), ("v.mkv", "matroska"), ("v.ts", "mpegts")]
)
def test_file_keeps_images_and_times(tmp_path: Path, name: str, container_format: str) -> None:
    path = tmp_path / name
    write_video(str(path), container_format)
    source = open_camera(str(path))
    assert isinstance(source, CameraSource)
    assert source.size_px == SIZE_PX
    assert not source.is_live
    frames = list(source)
    check_images(frames)
    tolerance_ns = 12_000 if container_format == "mpegts" else 0  # its clock ticks at 90 kHz
    for frame, ms in zip(frames, TIMES_MS, strict=True):
        assert abs(frame.time_ns - ms * 1_000_000) <= tolerance_ns
    assert source.warnings == []
    assert list(source) == []


def test_an_image_that_is_not_looked_at_is_not_converted(tmp_path: Path) -> None:
    path = tmp_path / "v.mp4"
    write_video(str(path), "mp4")
    frames = list(open_camera(str(path)))
    assert [f.size_px for f in frames] == [SIZE_PX] * len(TIMES_MS)
    assert all(isinstance(f.pixels, Decoded) for f in frames)
    assert frames[2].image.shape == (*SIZE_PX[::-1], 3)


def test_images_that_are_not_wanted_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "v.mp4"
    write_video(str(path), "mp4")
    source = open_camera(str(path))
    assert isinstance(source, VideoSource)
    source.only_near([1_000_000_000, 80_000_000], 0)
    assert [(f.seq, f.time_ns) for f in source] == [(2, 80_000_000), (5, 1_000_000_000)]
    assert source.warnings == []


@pytest.mark.parametrize("container_format", ["mp4", "matroska"])
def test_images_behind_the_last_wanted_one_are_not_decoded(
    tmp_path: Path, container_format: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "v"
    noise = np.random.default_rng(4).integers(0, 256, (60, 96, 128, 3), np.uint8)
    with av.open(str(path), "w", format=container_format) as out:
        stream: Any = out.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 128, 96, "yuv420p"
        stream.options = {"bf": "2", "g": "12", "sc_threshold": "0", "threads": "1"}
        for pixels in noise:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="bgr24")))
        out.mux(stream.encode(None))
    everything = {f.time_ns: f.image for f in open_camera(str(path))}
    wanted = [list(everything)[n] for n in (0, 13, 47)]
    decoded: list[int | None] = []

    def counted(*arguments: Any) -> Iterator[av.VideoFrame]:
        for frame in decoded_frames(*arguments):
            decoded.append(frame.pts)
            yield frame

    monkeypatch.setattr(video, "decoded_frames", counted)
    source = open_camera(str(path))
    assert isinstance(source, VideoSource)
    source.only_near(wanted, 5_000_000)
    found = {f.time_ns: f.image for f in source}
    assert list(found) == wanted and source.warnings == []
    for time_ns in wanted:
        np.testing.assert_array_equal(found[time_ns], everything[time_ns])
    if container_format == "mp4":  # its index says where the keyframes are: every twelfth
        assert 30 <= source.passed <= 60 - 1 - 2 - 12
    else:
        assert not source.passed
    assert len(decoded) <= 49


def test_file_epoch_is_the_creation_time(tmp_path: Path) -> None:
    for name, container_format in (("v.mkv", "matroska"), ("v.mp4", "mp4")):
        path = tmp_path / name
        write_video(str(path), container_format, creation_time="2024-05-06T07:08:09.000000Z")
        source = open_camera(f"file:{path}")
        assert source.epoch_unix_ns == 1_714_979_289_000_000_000
        source.close()
        source.close()


@pytest.mark.parametrize(
    ("text", "unix_ns"),
    [
        ("2024-05-06T07:08:09.250000Z", 1_714_979_289_250_000_000),
        ("2024-05-06T09:08:09+02:00", 1_714_979_289_000_000_000),
        ("2024-05-06 07:08:09", 1_714_979_289_000_000_000),
        ("2024-05-06T09:08:09+0200", 1_714_979_289_000_000_000),
        ("1904-01-01T00:00:00.000000Z", None),
        ("1970-01-01T00:00:00Z", None),
        ("", None),
        ("yesterday", None),
    ],
)
def test_creation_times(text: str, unix_ns: int | None) -> None:
    assert parse_time_unix_ns(text) == unix_ns


def test_truncated_video_gives_what_decodes_and_says_so(tmp_path: Path) -> None:
    whole = tmp_path / "whole.mp4"
    write_video(str(whole), "mp4", {"movflags": "faststart"})
    data = whole.read_bytes()
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(data[: data.index(b"mdat") + (len(data) - data.index(b"mdat")) // 2])
    source = open_camera(str(cut))
    frames = list(source)
    assert 0 < len(frames) < len(TIMES_MS)
    assert any("cut off" in w for w in source.warnings)


def test_images_before_the_start_of_an_edit_list_are_not_missed(tmp_path: Path) -> None:
    """A phone trims like this: the coded images stay, the start moves."""
    path = str(tmp_path / "trimmed.mp4")
    write_video(path, "mp4", {"avoid_negative_ts": "disabled"}, earlier_ms=TIMES_MS[2])
    source = open_camera(path)
    assert isinstance(source, VideoSource)
    times_ns = [frame.time_ns for frame in source]
    assert times_ns == [(ms - TIMES_MS[2]) * 1_000_000 for ms in TIMES_MS[2:]]
    assert source.passed == 2 and source.warnings == []


@pytest.mark.parametrize(
    ("coder", "said"), [("sar=4/3", "1.33 times as wide as high"), ("interlaced=1", "interlaced")]
)
def test_images_that_no_camera_model_explains_are_reported(
    tmp_path: Path, coder: str, said: str
) -> None:
    path = str(tmp_path / "v.mp4")
    write_video(path, "mp4", coder=coder)
    source = open_camera(path)
    assert isinstance(source, VideoSource)
    (warning,) = source.warnings
    assert said in warning and "ffmpeg -vf" in warning


def test_joined_recordings_follow_each_other(tmp_path: Path) -> None:
    """The times of MPEG-TS parts written one behind the other begin again with each."""
    part = tmp_path / "part.ts"
    write_video(str(part), "mpegts")
    path = tmp_path / "joined.ts"
    path.write_bytes(3 * part.read_bytes())
    source = open_camera(str(path))
    times_ms = np.array([frame.time_ns // 1_000_000 for frame in source])
    assert len(times_ms) == 3 * len(TIMES_MS)
    assert np.all(np.diff(times_ms) > 0)
    for first in (0, len(TIMES_MS), 2 * len(TIMES_MS)):
        own = times_ms[first : first + len(TIMES_MS)] - times_ms[first]
        np.testing.assert_allclose(own, TIMES_MS, atol=1)
    assert sum("times begin again" in warning for warning in source.warnings) == 2


def test_times_of_another_century_are_damage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sound = TIMES_MS
    monkeypatch.setitem(globals(), "TIMES_MS", [*sound, sound[-1] + 10**13])
    path = tmp_path / "far.mkv"
    write_video(str(path), "matroska")
    source = open_camera(str(path))
    assert [round(frame.time_ns / 1e6) for frame in source] == list(sound)
    assert any("1 images whose time does not follow" in warning for warning in source.warnings)


def test_damaged_middle_costs_only_itself(tmp_path: Path) -> None:
    path = tmp_path / "v.mp4"
    write_video(str(path), "mp4", {"movflags": "faststart"}, codec="mjpeg")
    data = bytearray(path.read_bytes())
    second = data.index(b"\xff\xd8\xff", data.index(b"\xff\xd8\xff") + 3)
    third = data.index(b"\xff\xd8\xff", second + 3)
    data[second:third] = bytes(third - second)
    path.write_bytes(data)
    source = open_camera(str(path))
    assert len(list(source)) == len(TIMES_MS) - 1
    assert any("damaged" in w for w in source.warnings)


def test_concealed_damage_is_not_passed_on(tmp_path: Path) -> None:
    path = tmp_path / "v.mp4"
    write_video(str(path), "mp4", {"movflags": "faststart"})
    data = bytearray(path.read_bytes())
    with av.open(str(path)) as whole:
        packets = [(p.pos, p.size) for p in whole.demux(video=0) if p.size]
    at, size = packets[4]
    assert at is not None
    data[at + size // 2 : at + size] = bytes(b ^ 0x5A for b in data[at + size // 2 : at + size])
    path.write_bytes(data)
    source = open_camera(str(path))
    frames = list(source)
    assert 240_000_000 not in [f.time_ns for f in frames]
    assert any("damaged" in w for w in source.warnings)


def test_bad_files_are_reported_in_one_line(tmp_path: Path) -> None:
    empty = tmp_path / "empty.mp4"
    empty.touch()
    text = tmp_path / "notes.mp4"
    text.write_text("not a video, a note\n" * 50)
    whole = tmp_path / "whole.mp4"
    write_video(str(whole), "mp4")
    unclosed = tmp_path / "unclosed.mp4"
    data = whole.read_bytes()
    unclosed.write_bytes(data[: data.rindex(b"moov") - 4])
    sound = tmp_path / "sound.wav"
    with av.open(str(sound), "w") as out:
        stream: Any = out.add_stream("pcm_s16le", rate=8000)
        stream.layout = "mono"
        block = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), layout="mono")
        block.rate = 8000
        out.mux(stream.encode(block))
        out.mux(stream.encode(None))
    cases = {
        str(tmp_path / "none.mp4"): "no such file",
        str(empty): "empty",
        str(text): "not a video",
        str(unclosed): "no index",
        str(sound): "no video stream",
        "": "no camera source",
        "imges:/tmp": "did you mean 'images:'",
        "file:" + str(tmp_path): "folder",
        f"file:{whole}?speed=3": "no option 'speed'",
    }
    for source, expected in cases.items():
        with pytest.raises(InputError) as caught:
            open_camera(source)
        assert expected in str(caught.value), source
        assert "\n" not in str(caught.value)


def test_header_without_images_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "v.mkv"
    write_video(str(path), "matroska")
    data = path.read_bytes()
    cluster = data.index(b"\x1f\x43\xb6\x75")
    path.write_bytes(data[:cluster])
    with pytest.raises(InputError, match="cut off"):
        open_camera(str(path))


def test_sources_are_parsed(tmp_path: Path) -> None:
    assert parse_source("-") == ("pipe", "-", {})
    assert parse_source("/dev/video0?framerate=30")[:2] == ("v4l2", "/dev/video0")
    assert parse_source(str(tmp_path)) == ("images", str(tmp_path), {})
    assert parse_source("pipe:-?format=rawvideo&video_size=4x3") == (
        "pipe",
        "-",
        {"format": "rawvideo", "video_size": "4x3"},
    )
    odd = tmp_path / "what?.mp4"
    odd.touch()
    assert parse_source(f"file:{odd}") == ("file", str(odd), {})


def test_every_line_of_the_table_can_be_imported() -> None:
    from importlib import import_module

    for target in CAMERAS.values():
        module, _, function = target.partition(":")
        assert callable(getattr(import_module(module), function))


@contextmanager
def piped(folder: Path, data: bytes) -> Iterator[Path]:
    """A named pipe that these bytes are written into."""
    path = folder / "pipe"
    os.mkfifo(path)

    def write() -> None:
        with contextlib.suppress(BrokenPipeError):
            path.write_bytes(data)

    writing = threading.Thread(target=write)
    writing.start()
    try:
        yield path
    finally:
        writing.join()
        path.unlink()


def test_pipe_of_every_streamable_container(tmp_path: Path) -> None:
    formats = {
        "matroska": {},
        "mpegts": {},
        "mp4": {"movflags": "frag_keyframe+empty_moov"},
    }
    for container_format, options in formats.items():
        data = io.BytesIO()
        write_video(data, container_format, options)
        with piped(tmp_path, data.getvalue()) as path:
            frames = list(open_camera(f"pipe:{path}"))
        check_images(frames)
        for frame, ms in zip(frames, TIMES_MS, strict=True):
            assert abs(frame.time_ns - ms * 1_000_000) <= 12_000, container_format


def test_pipe_of_raw_images(tmp_path: Path) -> None:
    data = b"".join(image(i).tobytes() for i in range(len(TIMES_MS)))
    with piped(tmp_path, data) as path:
        source = open_camera(
            f"pipe:{path}?format=rawvideo&video_size={SIZE_PX[0]}x{SIZE_PX[1]}"
            "&pixel_format=bgr24&framerate=25"
        )
        frames = list(source)
    check_images(frames)
    assert [f.time_ns for f in frames] == [i * 40_000_000 for i in range(len(TIMES_MS))]
    assert all(np.array_equal(f.image, image(i)) for i, f in enumerate(frames))


def test_pipe_refuses_what_cannot_be_piped(tmp_path: Path) -> None:
    path = tmp_path / "v.mp4"
    write_video(str(path), "mp4")
    cases = {
        path.read_bytes(): "cannot be piped",
        b"": "received nothing",
        b"no video at all " * 400: "not a video stream",
    }
    for data, expected in cases.items():
        with piped(tmp_path, data) as pipe, pytest.raises(InputError, match=expected):
            open_camera(f"pipe:{pipe}")
    assert index_at_end(path.read_bytes()[:4096])
    with pytest.raises(InputError, match="no such named pipe"):
        open_camera(f"pipe:{tmp_path / 'none'}")


def test_pipe_reader_loses_no_byte() -> None:
    data = bytes(range(256)) * 40
    reader = PipeReader(io.BytesIO(data))
    assert reader.peek(100) == data[:100]
    assert reader.peek(4096) == data[:4096]
    out = b""
    while piece := reader.read(1000):
        assert len(piece) <= 1000
        out += piece
    assert out == data


@needs_ffmpeg
@pytest.mark.parametrize(
    "ffmpeg_output",
    [
        ["-c", "copy", "-f", "mpegts"],
        ["-c", "copy", "-f", "matroska"],
        ["-f", "yuv4mpegpipe", "-fps_mode", "passthrough"],
    ],
)
def test_ffmpeg_pipe_gives_the_images_of_the_file(tmp_path: Path, ffmpeg_output: list[str]) -> None:
    path = tmp_path / "v.mp4"
    write_video(str(path), "mp4")
    code = (
        "from service.cameras import open_camera\n"
        "for f in open_camera('-'): print(f.seq, f.time_ns, int(f.image[48, 80, 0]))\n"
    )
    with subprocess.Popen(
        ["ffmpeg", "-v", "error", "-i", str(path), *ffmpeg_output, "-"], stdout=subprocess.PIPE
    ) as ffmpeg:
        done = subprocess.run(
            [sys.executable, "-c", code],
            stdin=ffmpeg.stdout,
            capture_output=True,
            text=True,
            timeout=60,
            check=True,
        )
    rows = [[int(x) for x in line.split()] for line in done.stdout.splitlines()]
    assert len(rows) == len(TIMES_MS)
    y4m = "yuv4mpegpipe" in ffmpeg_output  # y4m has a rate and no times
    for (seq, time_ns, blue), ms in zip(rows, TIMES_MS, strict=True):
        assert abs(blue - int(image(seq)[0, 0, 0])) <= 10
        assert y4m or abs(time_ns - ms * 1_000_000) <= 12_000


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.is_dir(), reason="needs ../shared/data")
def test_real_flight_video_has_true_times() -> None:
    source = open_camera(str(SHARED / "caliterra_nadir" / "caliterra_0p5fps.mp4"))
    times_s = [f.time_ns / 1e9 for f in source]
    assert len(times_s) == 75
    gaps = np.diff(times_s)
    assert np.median(gaps) == pytest.approx(2.105, abs=0.05)
    assert gaps.max() == pytest.approx(6.3, abs=0.1)  # the two missing shots


@pytest.mark.parametrize(("version", "asked"), [("18.1.0", True), ("19.0.2", False)])
def test_tags_of_any_bytes_are_asked_for_only_where_pyav_knows_the_option(
    version: str, asked: bool
) -> None:
    """PyAV 19 has no such option: it always reads them."""
    assert lenient(version) == ({"metadata_errors": "replace"} if asked else {})
