"""A photo is an image with its tag, whatever the camera does; without one, the reason is given."""

from __future__ import annotations

import os
import threading
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onboard import Onboard, real_scan
from paths import FULL_DISK
from spied import spied

from mavlink.component.camera import KeyframeReport
from mavlink.component.control import Result
from mavlink.telemetry.history import VehicleHistory
from mavlink.telemetry.samples import VehicleState
from recon.tracking.frame import Frame
from recon.types import PosePrior
from service.cameras.exif import read_tags
from service.cameras.source import CameraFrame
from service.daemon.load_shedding import Level
from service.daemon.scanning import PHOTOS, ScanRun
from service.daemon.stored_image import image_name, store_image
from service.flight.scan import Scan

S = 1_000_000_000
START_NS = 1_790_000_000 * S
IMAGE = np.full((90, 160, 3), (200, 100, 50), np.uint8)
HOVER = VehicleState(
    time_ns=S,
    q_ned_body_wxyz=np.array([1.0, 0.0, 0.0, 0.0]),
    lat_deg=-33.8567844,
    lon_deg=151.2152967,
    alt_amsl_m=62.25,
    alt_agl_m=50.0,
    sources=("attitude", "gnss", "relative"),
)


class OperatorEnd:
    """The operator's end of a vehicle link."""

    def __init__(self) -> None:
        self.reports: list[KeyframeReport] = []
        self.texts: list[str] = []

    def report_keyframe(self, report: KeyframeReport) -> None:
        self.reports.append(report)

    def statustext(self, text: str, *_: object, **__: object) -> None:
        self.texts.append(text)


class Hovering(VehicleHistory):
    """The vehicle hovers, without a gap."""

    def state_at(self, *_: object, **__: object) -> VehicleState:
        return HOVER

    def gap_s(self, *_: object) -> float:
        return 0.1


def photos_in(folder: Path) -> tuple[Scan, OperatorEnd]:
    """A scan whose photos reach the operator."""
    operator: Any = OperatorEnd()
    run = ScanRun(is_asked=True)
    scan = run.scan = real_scan(
        folder / "scan", history=Hovering(), unix_offset_ns=START_NS,
        on_photo=partial(run.report_photo, operator),
    )  # fmt: skip
    return scan, operator


def test_a_photo_in_a_steady_hover_is_an_image_with_its_tag(tmp_path: Path) -> None:
    scan, operator = photos_in(tmp_path)
    for k in range(6):
        if k == 3:
            scan.take_photo()
            scan.take_photo()  # by another ground station: a photo each
        scan.feed(CameraFrame(IMAGE, k * S, k, None, f"frame {k}"))
    assert len(operator.reports) == 2 and operator.texts == []
    scan.mapper.finish()
    scan.store.close()
    for k, report in zip((3, 4), operator.reports, strict=True):
        assert report.ok and report.unix_us == (START_NS + k * S) // 1000
        assert (report.lat_deg, report.lon_deg) == pytest.approx((-33.8567844, 151.2152967))
        assert report.alt_amsl_m == pytest.approx(62.25) and report.alt_agl_m == 50.0
        assert report.q_ned_camera_wxyz is not None
        stored = tmp_path / report.file
        tags = read_tags(stored)
        assert tags.size_px == (160, 90) and tags.name_unix_ns == START_NS + k * S
        assert tags.geotag is not None and tags.geotag.lat_deg is not None
        assert tags.geotag.lat_deg == pytest.approx(-33.8567844, abs=1e-7)
        assert tags.geotag.lon_deg == pytest.approx(151.2152967, abs=1e-7)
        assert tags.geotag.alt_amsl_m == pytest.approx(62.25, abs=0.01)


def test_a_photo_without_telemetry_has_the_place_by_vision_or_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    syncs = spied(monkeypatch, os, "fsync")
    store_image(tmp_path / image_name(START_NS), IMAGE, KeyframeReport())
    assert syncs.called  # it outlasts a power cut
    assert read_tags(tmp_path / image_name(START_NS)).geotag is None
    below = KeyframeReport(lat_deg=31.5, lon_deg=-35.5, alt_amsl_m=-430.0)
    store_image(tmp_path / "dead_sea.jpg", IMAGE, below)
    tag = read_tags(tmp_path / "dead_sea.jpg").geotag
    assert tag is not None and (tag.lat_deg, tag.lon_deg) == pytest.approx((31.5, -35.5))
    assert tag.alt_amsl_m == pytest.approx(-430.0)


def test_a_photo_that_cannot_be_stored_says_why(tmp_path: Path) -> None:
    scan, operator = photos_in(tmp_path)
    (tmp_path / "scan" / PHOTOS).symlink_to(FULL_DISK)
    scan.inputs.on_photo(Frame(IMAGE, S, 0, PosePrior()))  # type: ignore[misc]
    assert operator.texts == ["photo failed: the disk is nearly full"]
    assert operator.reports == [KeyframeReport(ok=False)]
    scan.mapper.finish()
    scan.store.close()


def test_a_photo_while_images_are_only_stored_is_refused_with_the_reason(tmp_path: Path) -> None:
    end = threading.Event()
    daemon = Onboard(tmp_path, script=lambda _: end.wait(60.0))
    daemon.scanning.start()
    assert daemon.scanning.run is not None
    scan = daemon.scanning.run.scan = real_scan(tmp_path / "scan")
    daemon.scanning.level = Level.RECORD_ONLY
    answer: Any = daemon.actions.capture_keyframe()
    assert answer.result is Result.TEMPORARILY_REJECTED and "only stored" in answer.text
    end.set()
    daemon.scanning.end()
    scan.mapper.finish()
    scan.store.close()
