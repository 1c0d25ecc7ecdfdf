"""A video whose clock differs from the log's: the scan begins again at the time that fits."""

from __future__ import annotations

import json
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any, cast

import av
import numpy as np
import pytest
from command_line import skyrelief

from mavlink.telemetry.history import VehicleHistory
from mavlink.telemetry.logs import TelemetryLog
from service.cameras.source import CameraSource
from service.commands import missing_metadata, replay
from service.commands.missing_metadata import (
    HOUR_NS,
    at_another_time,
    local_zone_ns,
    start_of,
)
from service.flight.scan import ScanInputs
from service.progress import Progress
from service.stream.store import ScanStore

EPOCH_S = 1_777_629_600.0  # of the simulated video, 2026-05-01 10:00 UTC
EARLY_S = 30.0  # of the time that the video states


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated flight of two legs."""
    return simulated(
        tmp_path_factory.mktemp("sim") / "flight", "--size", "320x180", "--fps", "6",
        "--duration-s", "14", "--height-m", "40", "--pattern", "legs", "--legs", "2",
        "--spacing-m", "8", "--wobble-deg", "3",
    )  # fmt: skip


@pytest.fixture(scope="module")
def brief(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A second of a flight, for what does not look at the images."""
    short = ("--size", "64x64", "--fps", "2", "--duration-s", "1", "--density", "0")
    return simulated(tmp_path_factory.mktemp("sim") / "flight", *short)


def simulated(folder: Path, *arguments: str) -> Path:
    """A simulated flight whose video states a time that is too early."""
    made = skyrelief("simulate", "--out", folder, *arguments)
    assert made.returncode == 0, made.stderr
    with av.open(str(folder / "flight.mp4")) as right, av.open(folder / "early.mp4", "w") as early:
        early.metadata["creation_time"] = "2026-05-01T11:59:30.000000Z"  # Swiss summer
        stream = early.add_stream_from_template(right.streams.video[0])
        for packet in right.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                early.mux(packet)
    return folder


def upside_down(video: Path, out: Path) -> None:
    """The video as of a camera that hangs upside down."""
    with av.open(str(video)) as upright, av.open(out, "w") as turned:
        turned.metadata["creation_time"] = upright.metadata["creation_time"]
        source = upright.streams.video[0]
        stream = turned.add_stream("libx264", source.average_rate, options={"crf": "16"})
        stream.width, stream.height, stream.pix_fmt = source.width, source.height, "yuv420p"
        for frame in upright.decode(source):
            image = np.ascontiguousarray(frame.to_ndarray(format="bgr24")[::-1, ::-1])
            again = av.VideoFrame.from_ndarray(image, format="bgr24")
            again.pts, again.time_base = frame.pts, frame.time_base
            turned.mux(stream.encode(again))
        turned.mux(stream.encode(None))


def replayed(flight: Path, out: Path, *more: str, video: str = "early.mp4") -> dict[str, Any]:
    done = skyrelief(
        "replay", flight / video, "--telemetry", flight / "flight.tlog", "--camera-model",
        flight / "camera.yaml", "--out", out, "--json", "--set", "compute.stereo_width=160", *more,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


@pytest.mark.slow
def test_a_video_goes_where_its_images_turn_with_the_log(flight: Path, tmp_path: Path) -> None:
    found = replayed(flight, tmp_path / "scan")
    (note,) = (text for text in found["warnings"] if "the time that it states" in text)
    assert note.startswith(f"the video begins {EARLY_S:.2f} s after")
    assert "the camera's clock is +2 h off the log's: taken as local time" in found["warnings"]
    assert found["quality"]["trust"]["level"] == "georeferenced"
    assert abs(found["camera_latency"]["estimate_ms"]) < 20.0
    with ScanStore.open(tmp_path / "scan" / "scan.db") as store:
        assert store.header.started_unix_ns == pytest.approx(EPOCH_S * 1e9, abs=20e6)


@pytest.mark.slow
def test_a_camera_that_hangs_upside_down_is_found_by_its_images(
    flight: Path, tmp_path: Path
) -> None:
    upside_down(flight / "early.mp4", flight / "turned.mp4")
    found = replayed(flight, tmp_path / "scan", video="turned.mp4")
    (note,) = (text for text in found["warnings"] if "turned clockwise" in text)
    assert note.endswith("set camera.image_roll_deg = 180")
    assert found["quality"]["trust"]["level"] == "georeferenced"
    with ScanStore.open(tmp_path / "scan" / "scan.db") as store:
        assert store.header.configuration["camera"]["image_roll_deg"] == 180.0


@pytest.mark.parametrize(
    ("options", "unsure"),
    [
        ([], {"readout", "mount", "roll", "clock", "clock's rate"}),
        (["--video-epoch", str(EPOCH_S - 2.5)], {"readout", "mount", "roll"}),
        (["--set", "camera.latency_ms=40"], {"readout", "mount", "roll"}),
        (["--realtime"], set()),
    ],
)
def test_a_time_that_the_operator_gives_stays(
    brief: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    options: list[str],
    unsure: set[str],
) -> None:
    asked = []

    def fly(
        inputs: ScanInputs, stop: Event, progress: Progress, unsure: set[str]
    ) -> dict[str, Any]:
        asked.append(set(unsure))
        return {}

    monkeypatch.setattr("service.commands.replay.fly", fly)
    assert replayed(brief, tmp_path / "scan", *options).keys() == {"scan_folder"}
    assert asked == [unsure]


def test_a_date_for_a_log_without_one_leaves_its_clock_open(
    brief: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = TelemetryLog(VehicleHistory(), "boot", round(80e9), round(120e9), (), {})
    asked: list[tuple[int, set[str]]] = []

    def fly(
        inputs: ScanInputs, stop: Event, progress: Progress, unsure: set[str]
    ) -> dict[str, Any]:
        asked.append((inputs.epoch_ns, set(unsure)))
        return {}

    monkeypatch.setattr(missing_metadata, "load_log", lambda path, config: log)
    monkeypatch.setattr(replay, "fly", fly)
    replayed(brief, tmp_path / "scan", "--video-epoch", str(EPOCH_S))
    assert asked == [(round(80e9), {"readout", "mount", "roll", "clock", "clock's rate"})]


@pytest.mark.parametrize(
    ("offset_s", "assumed", "starts_s", "said"),
    [
        (0.0, (), EPOCH_S - 3.0, "3.00 s before the time that it states"),
        (0.0, ("start",), EPOCH_S - 3.0, "3.00 s before the start that was assumed"),
        (EPOCH_S - 80.0, ("start",), EPOCH_S, "3.00 s before the start that was assumed"),
    ],
)
def test_a_video_keeps_its_date_where_the_log_has_none(
    offset_s: float, assumed: tuple[str, ...], starts_s: float, said: str
) -> None:
    inputs = SimpleNamespace(
        epoch_ns=round((EPOCH_S - offset_s) * 1e9),
        unix_offset_ns=round(offset_s * 1e9),
        assumed=assumed,
        notes=(),
    )
    found = at_another_time(cast(ScanInputs, inputs), 3000.0)
    assert found["epoch_ns"] == inputs.epoch_ns - round(3e9)
    assert found["epoch_ns"] + found["unix_offset_ns"] == round(starts_s * 1e9)
    assert said in found["notes"][0]


@pytest.mark.parametrize(
    ("video_h", "minutes", "ahead_h"),
    [
        (12.1, 15.0, 0.0),  # in the log, which begins at 12:00
        (14.1, 15.0, 2.0),
        (17.6, 15.0, 5.5),  # India
        (1.1, 15.0, -11.0),
        (12.75, 15.0, 0.0),  # fits no zone
        (13.6, 15.0, 0.0),  # another flight: there is no zone of +1.5 h
        (14.1, 180.0, 0.0),  # in the log as it is
        (16.1, 180.0, 0.0),  # fits several
        (40.1, 15.0, 0.0),  # another day
    ],
)
def test_local_time_is_taken_where_one_zone_fits(
    video_h: float, minutes: float, ahead_h: float
) -> None:
    noon_ns = 12 * HOUR_NS
    last_ns = noon_ns + round(minutes * 60e9)
    log = TelemetryLog(VehicleHistory(), "unix", noon_ns, last_ns, (), {})
    notes: list[str] = []
    assert local_zone_ns(round(video_h * HOUR_NS), log, notes) == ahead_h * HOUR_NS
    assert len(notes) == (ahead_h != 0)


@pytest.mark.parametrize(
    ("clock", "given_s", "container_s", "zero_s", "unix_s", "is_assumed"),
    [
        ("video", None, EPOCH_S, 0.0, EPOCH_S, False),
        ("video", EPOCH_S, None, 0.0, EPOCH_S, False),
        ("boot", None, EPOCH_S, 80.0, EPOCH_S, True),
        ("boot", EPOCH_S, EPOCH_S + 9.0, 80.0, EPOCH_S, True),
        ("boot", 95.0, EPOCH_S, 95.0, 95.0, False),  # a time of the log's own clock
        ("boot", 0.0, EPOCH_S, 0.0, 0.0, False),
        ("unix", None, 100.0, 100.0, 100.0, False),
        ("unix", None, None, 80.0, 80.0, True),
    ],
)
def test_a_log_without_a_date_takes_that_of_its_video(
    clock: str,
    given_s: float | None,
    container_s: float | None,
    zero_s: float,
    unix_s: float,
    is_assumed: bool,
) -> None:
    log = TelemetryLog(VehicleHistory(), clock, round(80e9), round(120e9), (), {})
    epoch_ns = None if container_s is None else round(container_s * 1e9)
    source = cast(CameraSource, SimpleNamespace(epoch_unix_ns=epoch_ns))
    zero_ns, offset_ns, found = start_of(source, log, given_s, [])
    assert (zero_ns, zero_ns + offset_ns) == (round(zero_s * 1e9), round(unix_s * 1e9))
    assert found == is_assumed


@pytest.mark.parametrize("stated_ns", [1000 * 2**64, -400 * 86_400 * 10**9])
def test_an_impossible_date_of_the_telemetry_in_a_video_is_none(stated_ns: int) -> None:
    log = TelemetryLog(VehicleHistory(), "video", 0, 40, (), {}, start_unix_ns=stated_ns)
    source = cast(CameraSource, SimpleNamespace(epoch_unix_ns=round(EPOCH_S * 1e9)))
    assert start_of(source, log, None, [])[:2] == (0, round(EPOCH_S * 1e9))


@pytest.mark.parametrize("given_s", [None, EPOCH_S + 9.0])
def test_a_date_of_the_telemetry_in_a_video_is_that_of_the_video(given_s: float | None) -> None:
    """The container's may be local time; one that is given counts before both."""
    log = TelemetryLog(
        VehicleHistory(), "video", 0, round(40e9), (), {}, start_unix_ns=round(EPOCH_S * 1e9)
    )
    source = cast(CameraSource, SimpleNamespace(epoch_unix_ns=round((EPOCH_S - 7200) * 1e9)))
    notes = list[str]()
    zero_ns, offset_ns, is_assumed = start_of(source, log, given_s, notes)
    assert zero_ns == 0 and offset_ns == round((given_s or EPOCH_S) * 1e9)
    assert not is_assumed and not notes
