"""Live cameras: one time axis through every loss; stalls, frozen images and misfits found."""

from __future__ import annotations

import contextlib
import gc
import io
import itertools
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from live_stream import RealTime, clip, opener
from loopback import free_port, until

from service.cameras import CameraFrame, CameraSource, live, open_camera
from service.cameras.access_units import LONGEST_HEAD, SURE, access_units, headed
from service.cameras.live import LiveConfig, LiveSource, StampFilter
from service.cameras.source import QueuedSource, decoded_frames, video_stream
from service.errors import InputError, NoSenderError, OutsideError
from service.workers import PROCESS, Worker

needs_ffmpeg = pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs the ffmpeg command")
QUICK = LiveConfig(stall_s=1.0, frozen_s=0.3, first_retry_s=0.01, longest_retry_s=0.05)


class Waiting:
    """A stream that sends no more for now."""

    def __init__(self, data: bytes) -> None:
        self._data = io.BytesIO(data)
        self.end = threading.Event()

    def read(self, size: int) -> bytes:
        found = self._data.read(size)
        if not found:
            self.end.wait(60.0)
        return found


def h264(n: int, container: str) -> bytes:
    """``n`` images of noise, a second's tenth apart; each in a packet of its own."""
    data = io.BytesIO()
    options = {"omit_video_pes_length": "0"} if container == "mpegts" else {}
    with av.open(data, "w", format=container, options=options) as out:
        stream: Any = out.add_stream("libx264", rate=10, options={"tune": "zerolatency"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for i in range(n):
            noise = np.random.default_rng(i).integers(0, 256, (48, 64, 3), np.uint8)
            out.mux(stream.encode(av.VideoFrame.from_ndarray(noise, format="bgr24")))
        out.mux(stream.encode(None))
    return data.getvalue()


def test_an_image_is_not_held_back_until_later_ones_come() -> None:
    """Threads that decode an image each held back two on two cores, eight on eight; FFmpeg's parser
    one."""
    data = h264(12, "mpegts")
    with av.open(io.BytesIO(data)) as recording:
        last = [frame.pts for frame in recording.decode(video=0)][-1]
    sender, got = Waiting(data), list[av.VideoFrame]()

    def receive() -> None:
        with av.open(sender, options=dict(live.TS_OPTIONS)) as container:
            stream = video_stream(container, is_live=True)
            assert stream is not None
            units = access_units(container.demux(stream), stream)
            for frame in decoded_frames(units, stream, print, print):
                got.append(frame)

    receiver = threading.Thread(target=receive)
    receiver.start()
    try:
        until(lambda: bool(got) and got[-1].pts == last)
    finally:
        sender.end.set()
        receiver.join(60.0)


def test_no_image_comes_earlier_after_its_exposure_than_those_before_it() -> None:
    """Else the images of a stream's start would be dated later than the others."""
    with av.open(io.BytesIO(h264(12, "mpegts")), options={"fflags": "noparse"}) as container:
        stream, came = container.streams.video[0], list[int]()

        def counted() -> Iterator[av.Packet[Any]]:
            for packet in container.demux(stream):
                came.append(packet.size)
                yield packet

        seen = [len(came) for _ in access_units(counted(), stream)]
    assert seen == [SURE + 1] * SURE + [*range(SURE + 1, 13)]


def cut_out(
    container: av.container.InputContainer, chunks: Iterable[bytes]
) -> Iterator[av.Packet[Any]]:
    """The images of a stream whose packets are ``chunks``, a second's tenth apart."""
    stream = container.streams.video[0]

    def packets() -> Iterator[av.Packet[Any]]:
        for number, chunk in enumerate(itertools.chain(chunks, (b"",))):
            packet = av.Packet(chunk)
            packet.stream, packet.pts, packet.time_base = stream, number, Fraction(1, 10)
            yield packet

    return access_units(packets(), stream)


@contextlib.contextmanager
def twenty_images() -> Iterator[tuple[av.container.InputContainer, list[bytes]]]:
    """A stream, and each of its images."""
    with av.open(io.BytesIO(h264(20, "h264")), options={"fflags": "noparse"}) as container:
        data = b"".join(bytes(packet) for packet in container.demux(video=0))
        parser = av.CodecContext.create("h264", "r")
        yield container, [bytes(unit) for unit in (*parser.parse(data), *parser.parse(None))]


@pytest.mark.parametrize("whole", [0, 9])
def test_images_that_lie_anywhere_in_their_packets_are_cut_out(whole: int) -> None:
    """Also after a stream whose first packets were images."""
    with twenty_images() as (container, images):
        rest = b"".join(images[whole:])
        chunks = [rest[at : at + 700] for at in range(0, len(rest), 700)]
        units = list(cut_out(container, (*images[:whole], *chunks)))
    found = [bytes(unit) for unit in units if bytes(unit) in images]
    # Only the chunk after it shows that the first one was no image.
    assert found == images[:whole] + images[whole + bool(whole) :]
    assert len(units) - len(found) == bool(whole)
    starts = np.cumsum([0, *(len(image) for image in images[whole:])])
    assert [unit.pts for unit in units[-5:]] == [whole + start // 700 for start in starts[-6:-1]]


@pytest.mark.parametrize("whole", [0, 8])
def test_images_that_share_a_packet_are_parted(whole: int) -> None:
    """The first one of each packet came twice, the second only with it."""
    with twenty_images() as (container, images):
        pairs = [a + b for a, b in zip(images[whole::2], images[whole + 1 :: 2], strict=True)]
        units = list(cut_out(container, (*images[:whole], *pairs)))
    assert [bytes(unit) for unit in units] == images


def test_a_sender_that_parts_its_large_images_spoils_no_more_than_the_first() -> None:
    """Each of them was taken for whole again, and its second part dropped."""
    with twenty_images() as (container, images):
        parted = [
            part
            for k, image in enumerate(images)
            for part in ((image[:600], image[600:]) if k in (7, 14) else (image,))
        ]
        units = list(cut_out(container, parted))
    assert [k for k, image in enumerate(images) if image not in map(bytes, units)] == [7]


@pytest.mark.parametrize("first", [0, 3])
@pytest.mark.parametrize("codec", ["libx264", "libx265"])
def test_parameter_sets_in_packets_of_their_own_cost_no_key_frame(codec: str, first: int) -> None:
    """They were passed on as an image, and what follows them, the key frame, was dropped."""
    data, kind = io.BytesIO(), {"libx264": "h264", "libx265": "hevc"}[codec]
    with av.open(data, "w", format=kind) as out:
        options = {"tune": "zerolatency", "preset": "ultrafast", "g": "5"}
        options |= (
            {"x265-params": "keyint=5:repeat-headers=1:log-level=0"} if kind == "hevc" else {}
        )
        stream: Any = out.add_stream(codec, rate=10, options=options)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for i in range(20):
            gray = np.full((48, 64, 3), 10 * i, np.uint8)
            out.mux(stream.encode(av.VideoFrame.from_ndarray(gray, format="bgr24")))
        out.mux(stream.encode(None))
    parser, whole = av.CodecContext.create(kind, "r"), data.getvalue()
    images = [bytes(unit) for unit in (*parser.parse(whole), *parser.parse(None))]
    chunks, is_key = list[bytes](), rb"\x00\x00\x01[\x65\x26\x28\x2a]"
    for image in images[first:]:
        at = [found.start() for found in re.finditer(is_key, image)]
        chunks += [image[: at[0]], image[at[0] :]] if at else [image]
    assert len(chunks) > len(images[first:])
    came = list[int]()

    def counted() -> Iterator[bytes]:
        for number, chunk in enumerate(chunks):
            came.append(number)
            yield chunk

    with av.open(io.BytesIO(whole), options={"fflags": "noparse"}) as container:
        units = [(bytes(unit), len(came)) for unit in cut_out(container, counted())]
    assert b"".join(unit for unit, _ in units) == b"".join(images[first:])
    assert len(units) == len(images[first:])
    assert [seen for _, seen in units[-3:]] == [len(chunks) - k for k in (2, 1, 0)]  # none waits


def test_a_stream_may_end_with_a_packet_without_a_picture() -> None:
    """It came in place of the empty packet that empties the parser: the last image was lost."""
    with twenty_images() as (container, images):
        rest = b"".join(images)
        chunks = [rest[at : at + 700] for at in range(0, len(rest), 700)]
        end_of_sequence = b"\0\0\1\x0a"
        units = [bytes(unit) for unit in cut_out(container, (*chunks, end_of_sequence))]
    assert units == images


def test_packets_without_pictures_are_not_gathered_without_end() -> None:
    parts = [b"\0\0\1\x06" + bytes([k]) * 1500 for k in range(1, 9)]
    with twenty_images() as (container, _):
        packets = [av.Packet(part) for part in parts]
        for packet in packets:
            packet.stream, packet.time_base = container.streams.video[0], Fraction(1, 10)
        passed = [bytes(packet) for packet in headed(iter(packets), "h264")]
    assert max(map(len, passed)) <= 2 * LONGEST_HEAD
    assert b"".join(parts).startswith(b"".join(passed)) and len(passed) == 2


@pytest.mark.parametrize("container", ["mpegts", "h264", "matroska"])
def test_all_images_of_any_format_are_passed_on(container: str) -> None:
    """Of Matroska, whose H.264 has no start codes, all came as one image at the end."""
    data = io.BytesIO(h264(20, container))
    with av.open(data, options={"fflags": "noparse"}) as stream:
        video = stream.streams.video[0]
        units = access_units(stream.demux(video), video)
        assert len(list(decoded_frames(units, video, print, print))) == 20


def test_a_stream_that_appears_late_only_ends_the_connection() -> None:
    """PyAV raises IndexError when what it demuxes ends; nothing is lost by that."""
    said = list[str]()
    with twenty_images() as (container, images):
        stream = container.streams.video[0]

        def packets() -> Iterator[av.Packet[Any]]:
            packet = av.Packet(images[0])
            packet.stream = stream
            yield packet
            raise IndexError("list index out of range")

        frames = list(decoded_frames(packets(), stream, said.append, print))
    assert len(frames) == 1 and said == []


def test_no_image_comes_earlier_where_the_first_packets_were_parts() -> None:
    """Each comes with the packet after it, as at first."""
    came = list[bytes]()

    def counted(chunks: Iterable[bytes]) -> Iterator[bytes]:
        for chunk in chunks:
            came.append(chunk)
            yield chunk

    with twenty_images() as (container, images):
        chunks = (images[0][:1000], images[0][1000:], *images[1:])
        seen = [len(came) for _ in cut_out(container, counted(chunks))]
    assert seen[5:-1] == [*range(8, 22)]


def test_a_stream_without_an_image_ends() -> None:
    """The parser kept its bytes for ever."""
    chunks = itertools.repeat(b"\x55" * (1 << 20), 100)
    with twenty_images() as (container, _), pytest.raises(OSError, match="no image in 17 MiB"):
        list(cut_out(container, chunks))


def test_an_image_larger_than_the_demuxers_packets_is_whole() -> None:
    """FFmpeg's demuxer of MPEG-TS cuts at 200 KiB: each large key frame was lost."""
    data = io.BytesIO()
    with av.open(data, "w", format="mpegts") as out:
        options = {"tune": "zerolatency", "qp": "0", "g": "7", "preset": "ultrafast"}
        stream: Any = out.add_stream("libx264", rate=10, options=options)
        stream.width, stream.height, stream.pix_fmt = 480, 360, "yuv420p"
        noise = np.random.default_rng(0).integers(0, 256, (360, 480, 3), np.uint8)
        for i in range(10):
            shown = noise if i % 7 == 0 else np.full_like(noise, i)
            out.mux(stream.encode(av.VideoFrame.from_ndarray(shown, format="bgr24")))
        out.mux(stream.encode(None))
    with av.open(io.BytesIO(data.getvalue())) as recording:
        images = [bytes(packet) for packet in recording.demux(video=0) if packet.size]
    with av.open(io.BytesIO(data.getvalue()), options=dict(live.TS_OPTIONS)) as container:
        stream = container.streams.video[0]
        units = [bytes(unit) for unit in access_units(container.demux(stream), stream)]
    assert len(images[7]) > 210_000
    assert units == images


def take(source: CameraSource, n: int) -> list[CameraFrame]:
    frames = []
    for frame in source:
        frames.append(frame)
        if len(frames) == n:
            source.close()
    return frames


def test_stamps_shed_jitter_and_follow_drift() -> None:
    rng = np.random.default_rng(7)
    pts = (np.arange(3000) * 33_333_333).astype(np.int64)
    true = 5_000_000_000 + (pts * (1 + 50e-6)).astype(np.int64)  # crystals 50 ppm apart
    arrival = true + (rng.exponential(0.020, pts.size) * 1e9).astype(np.int64)
    stamps = StampFilter()
    found = [stamps.time_ns(int(p), int(a)) for p, a in zip(pts, arrival, strict=True)]
    assert None not in found[300:]
    settled = np.array(found[300:], dtype=np.int64)
    assert (settled <= arrival[300:]).all()
    late_ms = (settled - true[300:]) / 1e6
    assert abs(late_ms).max() < 10.0
    assert late_ms.std() < 0.2 * ((arrival - true)[300:] / 1e6).std()


def test_what_a_new_connection_had_gathered_is_not_stamped() -> None:
    """Two seconds of images come at once, then the rest as they are taken."""
    pts = [i * 40_000_000 for i in range(100)]
    arrival = [max(p, 2_000_000_000 + i * 1_000_000) for i, p in enumerate(pts)]
    stamps = StampFilter()
    found = [stamps.time_ns(p, a) for p, a in zip(pts, arrival, strict=True)]
    assert found[:50] == [None] * 50
    assert found[54:] == arrival[54:] == pts[54:]


def test_stamps_begin_again_on_a_new_time_line() -> None:
    stamps = StampFilter()
    assert stamps.time_ns(1_000, 500_000_000) is None
    assert stamps.time_ns(20_001_000, 520_000_000) == 520_000_000
    assert stamps.time_ns(0, 900_000_000) is None  # presentation time went back
    assert stamps.time_ns(20_000_000, 920_000_000) == 920_000_000
    assert stamps.time_ns(10**15, 950_000_000) is None  # or jumped far ahead


def test_a_image_that_lost_its_time_is_dropped_where_others_have_one() -> None:
    """A decoder gives up its last images when the stream has broken off, seconds late."""
    source = LiveSource(opener(clip(50)), "test", QUICK)

    def images(*stamps: int | None) -> Iterator[Any]:
        for pts in stamps:
            frame = av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), format="bgr24")
            frame.pts, frame.time_base = pts, Fraction(1, 50)
            time.sleep(0.02)
            yield frame

    assert len(list(source.stamped(images(0, 1, 2, None, None)))) == 2  # the first sets the clock
    assert len(list(source.stamped(images(*[None] * 5)))) == 5
    source.close()


def test_one_time_axis_through_losses() -> None:
    source = LiveSource(opener(clip(6), OSError("gone"), OSError("gone"), clip(6)), "test", QUICK)
    assert source.is_live
    assert source.size_px == (64, 48)
    frames = take(source, 12)
    assert [f.seq for f in frames] == list(range(12))
    times = [f.time_ns for f in frames]
    assert all(b > a for a, b in itertools.pairwise(times))
    assert source.losses >= 3
    assert any("cannot be opened" in w for w in source.warnings)


def test_absent_camera_is_reported_at_once() -> None:
    with pytest.raises(OutsideError, match="gives no image"):
        LiveSource(opener(OSError("no route")), "test", QUICK)


def test_images_of_another_size_are_scaled_and_of_another_shape_dropped() -> None:
    parts = clip(3), clip(5, (96, 64)), clip(5, (128, 96)), clip(50)
    source = LiveSource(opener(*parts), "test", QUICK)
    frames = take(source, 12)
    assert all(f.image.shape == (48, 64, 3) for f in frames)
    assert 0 < source.misfits <= 4  # the first of a connection has no time
    assert any("96x64" in w and "dropped" in w for w in source.warnings)
    assert any("128x96" in w and "scaled" in w for w in source.warnings)
    assert source.following() is None


def test_a_shape_that_stays_is_another_sources() -> None:
    """The connection stays: a sender that is cut off may not come again."""
    config = replace(QUICK, changed_s=0.2)
    source = LiveSource(opener(clip(10), clip(200, (96, 64))), "test", config)
    queued = QueuedSource(source)
    assert {frame.image.shape for frame in queued} == {(48, 64, 3)}
    began_ns, losses = source.start_monotonic_ns, source.losses
    following = queued.following()
    assert following is not None and following.is_live and following.is_reshaped
    queued.close()
    assert (following.size_px, following.warnings) == ((96, 64), [])
    assert following.start_monotonic_ns is not None and began_ns is not None
    assert following.start_monotonic_ns > began_ns
    frames = take(following, 10)
    assert {frame.image.shape for frame in frames} == {(64, 96, 3)}
    assert frames[0].time_ns == 0 and frames[0].seq == 0
    assert 0 < frames[-1].time_ns < 2_000_000_000
    assert source.losses == losses


def test_a_stream_that_flips_between_two_shapes_is_not_many_scans() -> None:
    clips = [clip(15), clip(15, (96, 64))] * 20  # 0.3 s each
    source = LiveSource(opener(*clips), "test", replace(QUICK, changed_s=0.1))
    for size_px in ((64, 48), (96, 64)):
        assert source.size_px == size_px and len(list(source)) > 0
        assert source.following() is source
    assert len(take(source, 60)) == 60 and source.misfits > 30
    assert source.following() is None and source.size_px == (64, 48)
    source.close()


def test_a_source_that_nothing_follows_is_closed() -> None:
    opened = list[RealTime]()

    def open_container(stall_s: float) -> Any:
        opened.append(RealTime(av.open(io.BytesIO(clip(5, (96, 64) if opened else (64, 48))))))
        return opened[-1]

    queued = QueuedSource(LiveSource(open_container, "test", replace(QUICK, changed_s=0.0)))
    assert len(list(queued)) > 0
    assert [one.is_open for one in opened] == [False, True]
    queued.close()
    assert not opened[-1].is_open
    assert queued.following() is None


def test_frozen_image_is_found_out() -> None:
    source = LiveSource(opener(clip(200, moving=False), clip(200)), "test", QUICK)
    frames = take(source, 40)
    assert source.losses == 1
    assert any("frozen" in w for w in source.warnings)
    assert len({f.image.tobytes() for f in frames}) > 10


def test_live_images_are_not_held_back() -> None:
    """A live source that was opened an hour before it is read gives its images at once."""
    source = LiveSource(opener(clip(5)), "test", QUICK)
    source._first = (source._first[0], 3600 * 10**9)
    queued = QueuedSource(source)
    frame = next(iter(queued))
    queued.close()
    assert frame.time_ns == 3600 * 10**9


def test_waiting_for_a_dead_camera_can_be_ended() -> None:
    source = LiveSource(opener(clip(6), OSError("gone")), "test", QUICK)
    queued = QueuedSource(source)
    frames = iter(queued)
    next(frames)
    threading.Timer(0.5, queued.close).start()
    assert len(list(frames)) < 6
    queued.close()


@pytest.mark.parametrize("taken", [0, 1, 5])
@pytest.mark.parametrize("wrap", [QueuedSource, lambda source: source], ids=["queued", "direct"])
def test_an_ended_stream_is_released_at_once(
    wrap: Callable[[CameraSource], CameraSource], taken: int, no_collector: None
) -> None:
    """Its port or device must be free for the next scan, not when the collector comes round."""
    opened: list[RealTime] = []

    def open_container(stall_s: float) -> Any:
        opened.append(opener(clip(500))(stall_s))
        return opened[-1]

    source = wrap(LiveSource(open_container, "test", QUICK))
    for _ in itertools.islice(source, taken):
        pass
    assert len(opened) == 1
    source.close()
    until(lambda: not opened[0].is_open)


@pytest.fixture
def no_collector() -> Iterator[None]:
    """Switch off the collector, so that cycles are not freed meanwhile."""
    gc.disable()
    yield
    gc.enable()


def test_a_paced_recording_can_be_ended(tmp_path: Path) -> None:
    """Its images are hours apart; closing does not wait for the next one."""
    path = tmp_path / "v.mkv"
    path.write_bytes(clip(3, step_s=Fraction(3600)))
    queued = QueuedSource(open_camera(str(path)))
    threading.Timer(0.3, queued.close).start()
    assert [frame.time_ns for frame in queued] == [0]


def test_a_recording_is_not_closed_while_an_image_is_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = PROCESS.start

    def start_and_wait(*args: Any) -> Worker:
        worker = start(*args)
        decoding.wait(10.0)  # the image is decoded before the caller knows its reader
        time.sleep(0.05)
        return worker

    monkeypatch.setattr(PROCESS, "start", start_and_wait)
    path = tmp_path / "v.mkv"
    path.write_bytes(clip(3))
    recording = open_camera(str(path))
    events: list[str] = []
    decoding, close = threading.Event(), recording.close

    def slow(first_ns: int, last_ns: int) -> bool:
        decoding.set()
        time.sleep(0.3)
        events.append("decoded")
        return True

    def closed() -> None:
        events.append("closed")
        close()

    recording._is_wanted = slow  # type: ignore[attr-defined]
    recording.close = closed  # type: ignore[method-assign]
    queued = QueuedSource(recording)
    reading = threading.Thread(target=lambda: list(queued))
    reading.start()
    assert decoding.wait(10.0)
    queued.close()
    assert events[:2] == ["decoded", "closed"]
    reading.join(10.0)
    assert not reading.is_alive()


def test_wrong_live_sources_are_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with pytest.raises(OutsideError, match="no such camera device"):
        open_camera(f"v4l2:{tmp_path / 'video7'}")
    with pytest.raises(InputError, match="no option 'fps'"):
        open_camera("v4l2:/dev/video0?fps=3")
    with pytest.raises(InputError, match="is not like"):
        open_camera("stream:10.0.0.2")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(OutsideError, match="gst-launch"):
        open_camera("gst:videotestsrc")


def send_udp(port: int) -> subprocess.Popen[bytes]:
    """A moving test image in H.264 over MPEG-TS, 20 a second, for ever."""
    return subprocess.Popen(
        shlex.split(
            "ffmpeg -v error -re -f lavfi -i testsrc2=size=160x120:rate=20 -c:v libx264 "
            "-preset ultrafast -tune zerolatency -g 5 "
            f"-f mpegts udp://127.0.0.1:{port}?pkt_size=1316"
        ),
        stdin=subprocess.DEVNULL,
    )


@needs_ffmpeg
def test_stream_survives_the_death_of_its_sender() -> None:
    port = free_port()
    senders = [send_udp(port)]
    source_lost: list[bool] = []
    frames: list[CameraFrame] = []

    def open_container(stall_s: float) -> Any:
        if source_lost:
            senders.append(send_udp(port))
        source_lost.append(True)
        return av.open(f"udp://127.0.0.1:{port}", timeout=(10.0, stall_s))

    try:
        source = LiveSource(open_container, "udp", QUICK)
        for frame in source:
            frames.append(frame)
            if len(frames) == 20:
                senders[0].kill()
            if len(frames) == 40:
                source.close()
    finally:
        for sender in senders:
            sender.kill()
            sender.wait()
    assert source.losses >= 1
    times = np.array([f.time_ns for f in frames])
    assert (np.diff(times) > 0).all()
    # Twenty a second: evenly stamped although they arrive in bursts.
    assert np.median(np.diff(times)) == pytest.approx(50e6, rel=0.1)


@needs_ffmpeg
def test_gstreamer_pipeline_is_run_and_ended(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The launcher is stood in for by a script that does what gst-launch's y4menc does."""
    launcher = tmp_path / "gst-launch-1.0"
    launcher.write_text(
        f'#!/bin/sh\necho $$ > {tmp_path}/pid\necho "$@" > {tmp_path}/arguments\n'
        "exec ffmpeg -v error -re -f lavfi -i testsrc2=size=160x120:rate=30 "
        "-pix_fmt yuv420p -f yuv4mpegpipe -\n"
    )
    launcher.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    source = open_camera("gst:nvarguscamerasrc ! nvvidconv")
    frames = iter(source)
    assert [next(frames).image.shape for _ in range(3)] == [(120, 160, 3)] * 3
    assert "nvarguscamerasrc ! nvvidconv ! videoconvert" in (tmp_path / "arguments").read_text()
    source.close()
    pid = int((tmp_path / "pid").read_text())
    until(lambda: not Path(f"/proc/{pid}").exists())


def has_gstreamer(*elements: str) -> bool:
    """True when the system's GStreamer has all these elements."""
    inspect = shutil.which("gst-inspect-1.0")
    return inspect is not None and all(
        subprocess.run([inspect, "--exists", name], check=False).returncode == 0
        for name in ("y4menc", "videoconvert", *elements)
    )


@needs_ffmpeg
@pytest.mark.skipif(
    not has_gstreamer("qtdemux", "h264parse", "avdec_h264"), reason="needs GStreamer's decoders"
)
def test_a_gstreamer_decoder_with_padded_images_is_read(tmp_path: Path) -> None:
    """A height that is not a multiple of sixteen: the decoder's buffers are larger than images."""
    clip, made = tmp_path / "clip.mp4", "testsrc2=size=80x70:rate=20:duration=2"
    command = f"ffmpeg -v error -f lavfi -i {made} -pix_fmt yuv420p -c:v libx264 {clip}"
    subprocess.run(shlex.split(command), check=True)
    pipeline = f"filesrc location={clip} ! qtdemux ! h264parse ! avdec_h264 ! identity sync=true"
    source = open_camera(f"gst:{pipeline}")
    frames = iter(source)
    shown = [next(frames).image for _ in range(5)]
    source.close()
    with av.open(str(clip)) as container:
        sent = [frame.to_ndarray(format="bgr24") for frame in container.decode(video=0)]
    assert shown[0].shape == (70, 80, 3)
    apart = [np.abs(image.astype(int) - one).mean() for image in shown for one in sent]
    assert min(apart) < 12.0  # chroma apart; another stride would shear the image


@pytest.mark.skipif(not has_gstreamer(), reason="needs GStreamer")
def test_what_gstreamer_complains_about_is_reported() -> None:
    with pytest.raises(OutsideError, match='no element "nosuchsource"'):
        open_camera("gst:nosuchsource ! queue")


class Sender:
    """What a controller or OBS does: send a moving test image to ``url``, and try again."""

    def __init__(self, url: str, container: str) -> None:
        send = (
            "ffmpeg -v error -re -f lavfi -i testsrc2=size=160x120:rate=20 -c:v libx264 "
            f"-preset ultrafast -tune zerolatency -g 20 -pix_fmt yuv420p -f {container} {url}"
        )
        again = f"until {send}; do sleep 0.2; done"
        self._process = subprocess.Popen(
            ["sh", "-c", again],
            stdin=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )

    def kill(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()


LISTENING = {
    "rtmp": ("rtmp-listen:127.0.0.1:{port}/live", "rtmp://127.0.0.1:{port}/live/key", "flv"),
    "srt": ("srt://:{port}", "srt://127.0.0.1:{port}", "mpegts"),
}


@needs_ffmpeg
@pytest.mark.slow
@pytest.mark.parametrize("kind", LISTENING)
def test_who_sends_is_waited_for_again(kind: str) -> None:
    """The sender comes late, ends, and comes again: one time axis, and no long pause."""
    if kind == "srt" and not has_gstreamer("srtsrc"):
        pytest.skip("needs GStreamer's srtsrc")
    port = free_port()
    source, url, container = (text.format(port=port) for text in LISTENING[kind])
    word, _, rest = source.partition(":")
    opened = {"rtmp-listen": live.open_rtmp_listen, "srt": live.open_srt}[word]
    with pytest.raises(NoSenderError, match="waits for a sender; none came in 1 s"):
        opened(rest, {}, LiveConfig(open_s=1.0))  # ends before anyone sends
    sender = Sender(url, container)
    frames = []
    try:
        camera = open_camera(source)
        for frame in camera:
            frames.append(frame)
            if len(frames) == 20:
                sender.kill()
                sender = Sender(url, container)
            if len(frames) == 40:
                camera.close()
    finally:
        sender.kill()
    assert [f.seq for f in frames] == list(range(len(frames)))
    times = np.array([f.time_ns for f in frames])
    assert (np.diff(times) > 0).all()
    assert np.diff(times).argmax() in (19, 20, 21)  # the loss


def test_an_attempt_that_waited_for_a_sender_is_followed_by_the_next_at_once() -> None:
    """Otherwise the port is closed to a sender that comes meanwhile."""
    config = LiveConfig(first_retry_s=0.2, longest_retry_s=0.3)
    opened, attempts = opener(clip(20), OSError("no sender came"), clip(20)), itertools.count()

    def late(stall_s: float) -> Any:
        if next(attempts):
            time.sleep(0.5)  # longer than the pause between attempts that fail at once
        return opened(stall_s)

    source = LiveSource(late, "test", config)
    waits: list[float] = []

    class Watched(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            waits.append(timeout or 0.0)
            return super().wait(timeout)

    source._closed = Watched()
    for _ in source:
        if len(waits) >= 3:
            source.close()
    assert waits[1:3] == [0.0, 0.0]


def test_a_sender_that_comes_late_while_it_is_waited_for_is_heard_out() -> None:
    """The wait ended in the midst of its handshake, and the sender was cut off."""
    port, soon = free_port(), LiveConfig(open_s=2.0)
    with pytest.raises(NoSenderError):
        live.open_rtmp_listen(f"127.0.0.1:{port}/live", {}, soon)

    def wait() -> None:
        with pytest.raises(OutsideError):
            live.open_rtmp_listen(f"127.0.0.1:{port}/live", {}, soon)

    waiting = threading.Thread(target=wait)
    waiting.start()
    time.sleep(1.0)
    with socket.create_connection(("127.0.0.1", port)) as sender:
        sender.settimeout(30.0)
        came_s = time.monotonic()
        sender.sendall(b"\x03")  # the first byte of a handshake
        with contextlib.suppress(ConnectionError):
            while sender.recv(4096):
                pass
        assert time.monotonic() - came_s > 1.5  # it was 1.0
    waiting.join(30.0)


@pytest.mark.parametrize("source", ["rtmp-listen:live", "rtmp-listen:0/live", "srt://", "srt:9000"])
def test_a_place_to_listen_at_has_a_port(source: str) -> None:
    with pytest.raises(InputError, match="is not like"):
        open_camera(source)


def test_a_command_that_falls_silent_is_ended(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """FFmpeg's own pipe would wait for it for ever."""
    launcher = tmp_path / "gst-launch-1.0"
    (tmp_path / "clip").write_bytes(clip(20))
    launcher.write_text(f"#!/bin/sh\ncat {tmp_path}/clip\nexec sleep 60\n")
    launcher.chmod(0o755)
    opened = live.open_command([str(launcher)], 0.2, {})
    with pytest.raises(TimeoutError, match=r"no data for 0\.2 s"):
        list(opened.demux(opened.streams.video[0]))
    opened.close()


def test_a_pipeline_is_asked_to_close_its_sockets(tmp_path: Path) -> None:
    """By SIGINT: at SIGTERM it ends at once, and who sends to it waits 5 s for an answer.

    A shell in its place could not trap SIGINT where the tests themselves run with it ignored.
    """
    launcher, asked = tmp_path / "gst-launch-1.0", tmp_path / "asked"
    (tmp_path / "clip").write_bytes(clip(5))
    launcher.write_text(
        f"#!{sys.executable}\nimport pathlib, shutil, signal, sys, time\n"
        f"signal.signal(signal.SIGINT, lambda *_: [pathlib.Path({str(asked)!r}).touch(), exit()])\n"
        f"shutil.copyfileobj(open({str(tmp_path / 'clip')!r}, 'rb'), sys.stdout.buffer)\n"
        "sys.stdout.flush()\nwhile True: time.sleep(0.05)\n"
    )
    launcher.chmod(0o755)
    live.open_command([str(launcher)], 5.0, {}).close()
    assert asked.exists()


@needs_ffmpeg
def test_rtsp_camera_is_read(tmp_path: Path) -> None:
    """A small RTSP server of our own serves one H.264 stream over TCP to FFmpeg's client."""
    source_clip = tmp_path / "v.h264"
    subprocess.run(
        shlex.split(
            "ffmpeg -v error -f lavfi -i testsrc2=size=160x120:rate=25:duration=2 -c:v libx264 "
            f"-preset ultrafast -g 5 -bf 0 -x264-params slices=1 {source_clip}"
        ),
        check=True,
    )
    with RtspServer(source_clip.read_bytes()) as server:
        source = open_camera(f"rtsp://127.0.0.1:{server.port}/main?x=1")
        frames: Iterator[CameraFrame] = iter(source)
        first = next(frames)
        assert first.image.shape == (120, 160, 3)
        assert source.is_live
        assert source.epoch_unix_ns is not None
        source.close()
    assert server.asked == "/main?x=1"


class RtspServer:
    """The least of RFC 2326 and RFC 6184 that an interleaved H.264 client needs."""

    def __init__(self, annex_b: bytes) -> None:
        self._units = [u.rstrip(b"\0") for u in annex_b.split(b"\0\0\1")[1:]]
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.port = self._socket.getsockname()[1]
        self.asked = ""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self) -> RtspServer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._socket.close()
        self._thread.join(10.0)

    def _serve(self) -> None:
        try:
            client, _ = self._socket.accept()
            with client:
                self._talk(client)
        except OSError:
            return

    def _talk(self, client: socket.socket) -> None:
        requests = client.makefile("rb")
        while line := requests.readline().decode():
            method, url, _ = line.split()
            headers = {}
            while (header := requests.readline().decode().strip()) != "":
                key, _, value = header.partition(":")
                headers[key.lower()] = value.strip()
            self.asked = self.asked or "/" + url.split("/", 3)[3]
            body, more = "", ""
            if method == "DESCRIBE":
                body = "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=t\r\nt=0 0\r\nm=video 0 RTP/AVP 96\r\n"
                body += "a=rtpmap:96 H264/90000\r\na=fmtp:96 packetization-mode=1\r\n"
                more = f"Content-Type: application/sdp\r\nContent-Length: {len(body)}\r\n"
            elif method == "SETUP":
                more = "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 7\r\n"
            elif method == "PLAY":
                more = "Session: 7\r\n"
            answer = f"RTSP/1.0 200 OK\r\nCSeq: {headers['cseq']}\r\n{more}\r\n{body}"
            client.sendall(answer.encode())
            if method == "PLAY":
                self._play(client)
                return

    def _play(self, client: socket.socket) -> None:
        seq, stamp = 0, 0
        for unit in self._units:
            image = unit[0] & 31 in (1, 5)
            pieces = [unit] if len(unit) < 1200 else self._fragments(unit)
            for i, piece in enumerate(pieces):
                marker = 0x80 if image and i == len(pieces) - 1 else 0
                packet = bytes((0x80, 96 | marker)) + seq.to_bytes(2, "big")
                packet += stamp.to_bytes(4, "big") + b"\0\0\0\1" + piece
                client.sendall(b"$\0" + len(packet).to_bytes(2, "big") + packet)
                seq += 1
            if image:
                stamp += 3600
                if self._ended.wait(0.04):
                    return

    @staticmethod
    def _fragments(unit: bytes) -> list[bytes]:
        """FU-A pieces of one NAL unit (RFC 6184 section 5.8)."""
        head, body = unit[0], unit[1:]
        pieces = [body[i : i + 1200] for i in range(0, len(body), 1200)]
        out = []
        for i, piece in enumerate(pieces):
            flags = (0x80 if i == 0 else 0) | (0x40 if i == len(pieces) - 1 else 0)
            out.append(bytes(((head & 0xE0) | 28, flags | (head & 31))) + piece)
        return out
