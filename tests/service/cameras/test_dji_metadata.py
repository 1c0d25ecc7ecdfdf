"""The readout in the metadata track of a DJI video; samples and the file are built by hand."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.types import Camera, Shutter
from service.cameras import open_camera
from service.cameras.dji_metadata import shutter_of_sample, stated_shutter
from service.commands.missing_metadata import with_stated_readout
from service.config import Config, change


def varint(value: int) -> bytes:
    out = b""
    while value >= 0x80:
        out += bytes([value & 0x7F | 0x80])
        value >>= 7
    return out + bytes([value])


def field(number: int, value: int | bytes) -> bytes:
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    return varint(number << 3 | 2) + varint(len(value)) + value


def sample(readout_ns: int, corner: int | None = None, name: bytes = b"dvtm_wm169.proto") -> bytes:
    clip = field(1, field(1, name) + field(9, 123456)) + field(2, field(1, 1))
    clip += field(4, field(1, readout_ns))
    if corner is not None:
        clip += field(5, field(1, corner))
    return field(1, clip) + field(3, field(1, field(1, 7)) + b"\x1d\0\0\0\0")


@pytest.mark.parametrize(
    ("corner", "way"), [(None, "down"), (1, "down"), (2, "up"), (4, "right"), (6, "left")]
)
def test_readout_and_direction_are_read(corner: int | None, way: str) -> None:
    found = shutter_of_sample(sample(16_480_000, corner))
    assert found is not None and found.direction == way
    assert found.readout_s == pytest.approx(0.01648)


@pytest.mark.parametrize(
    "wrong",
    [
        b"", sample(0), sample(51_000_000), sample(1 << 62), sample(10_000_000, 8),
        sample(10_000_000, name=b"another.proto"), sample(10_000_000)[:30],
        field(1, 4), field(1, field(4, 10_000_000)), b"\xff" * 40,
    ],
)  # fmt: skip
def test_what_cannot_be_is_not_taken(wrong: bytes) -> None:
    assert shutter_of_sample(wrong) is None


@given(st.binary(max_size=300))
def test_any_bytes_are_read_without_an_error(data: bytes) -> None:
    assert isinstance(shutter_of_sample(data), Shutter | None)
    shutter_of_sample(field(1, data))


def write_video(path: Path, data: bytes | None, handler: str = "DJI meta") -> None:
    with av.open(str(path), "w") as container:
        video = container.add_stream("libx264", rate=10)
        video.width, video.height, video.pix_fmt = 128, 96, "yuv420p"
        track = None
        if data is not None:
            track = container.add_data_stream("bin_data")
            track.metadata["handler_name"] = handler
            track.time_base = Fraction(1, 1000)
        for i in range(3):
            image = np.random.default_rng(i).integers(0, 255, (96, 128, 3), np.uint8)
            container.mux(video.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
            if track is not None:
                packet = av.Packet(data)
                packet.stream, packet.time_base = track, Fraction(1, 1000)
                packet.pts = packet.dts = 100 * i
                packet.duration = 100
                container.mux(packet)
        container.mux(video.encode())


def test_a_videos_track_states_its_shutter(tmp_path: Path) -> None:
    path = tmp_path / "flight.mp4"
    write_video(path, sample(16_480_000, 2))
    found = stated_shutter(str(path))
    assert found is not None and found.direction == "up"
    assert found.readout_s == pytest.approx(0.01648)
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(path.read_bytes()[:-400])
    for data, handler in (
        (None, ""),
        (sample(16_480_000), "GoPro MET"),
        (b"\x0a\xff" * 9, "DJI meta"),
    ):
        other = tmp_path / "other.mp4"
        write_video(other, data, handler)
        assert stated_shutter(str(other)) is None
    assert stated_shutter(str(cut)) is None
    assert stated_shutter(str(tmp_path / "none.mp4")) is None


@pytest.mark.parametrize(("readout_ms", "is_taken"), [("model", True), ("auto", False), (0, False)])
def test_replay_starts_with_the_readout_that_the_video_states(
    tmp_path: Path, readout_ms: str | float, is_taken: bool
) -> None:
    path = tmp_path / "flight.mp4"
    write_video(path, sample(16_480_000))
    K = np.array([[100.0, 0, 63.5], [0, 100.0, 47.5], [0, 0, 1]])
    camera = Camera(K, np.zeros(5), (128, 96))
    config = change(Config(), "camera.readout_ms", readout_ms)
    notes: list[str] = []
    with closing(open_camera(str(path))) as source:
        found, then = with_stated_readout(camera, config, str(path), source, notes)
        own = replace(camera, shutter=Shutter(0.02))
        kept, _ = with_stated_readout(own, config, str(path), source, [])
    assert kept is own, "the camera file has the last word"
    if is_taken:
        assert found.shutter.readout_s == pytest.approx(0.01648)
        assert then.camera.readout_ms == "auto" and notes == [
            "the video states a readout of 16.5 ms, down"
        ]
    else:
        assert found is camera and then is config and not notes
