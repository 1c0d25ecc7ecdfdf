"""A recording decoded ahead gives the same images, and stops when no caller wants more."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recon.backends.cpu import CpuBackend
from recon.pipeline.mapper import FramePosed
from recon.tracking.frame import NO_IMAGE, Frame, Tracking
from recon.types import U8, Camera
from service.cameras.source import CameraFrame, CameraSource, ahead
from service.config import load_config
from service.flight.scan import Scan, ScanInputs, create_store


class Recording(CameraSource):
    """Counts what was taken from it; breaks at ``fault_at``."""

    size_px, fps = (4, 4), 30.0

    def __init__(self, count: int, fault_at: int | None = None) -> None:
        super().__init__("test")
        self.count, self.fault_at, self.taken = count, fault_at, 0

    def __iter__(self) -> Iterator[CameraFrame]:
        for i in range(self.count):
            if i == self.fault_at:
                raise OSError("the disk is gone")
            self.taken += 1
            yield CameraFrame(np.full((4, 4, 3), i, np.uint8), i, i, None, f"frame {i}")


def test_every_image_comes_in_order() -> None:
    assert [f.seq for f in ahead(Recording(50))] == list(range(50))


def test_a_fault_of_the_source_reaches_the_reader_after_the_images_before_it() -> None:
    seen = []
    with pytest.raises(OSError, match="disk is gone"):
        for frame in ahead(Recording(50, fault_at=7)):
            seen.append(frame.seq)
    assert seen == list(range(7))


def test_no_more_than_a_few_are_decoded_ahead_and_a_stop_ends_the_thread() -> None:
    recording = Recording(1000)
    frames = ahead(recording, kept=3)
    assert next(frames).seq == 0
    time.sleep(0.2)
    assert recording.taken <= 1 + 3 + 1
    frames.close()
    assert not any(t.name == "decoder" for t in threading.enumerate())


class Unseen:
    """An image that nothing may look at."""

    shape = (90, 160, 3)

    def __call__(self) -> U8:
        raise AssertionError("looked at")


def test_a_frame_that_tracking_skips_is_not_looked_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    K = np.array([[140.0, 0.0, 79.5], [0.0, 140.0, 44.5], [0.0, 0.0, 1.0]])
    inputs = ScanInputs(
        Recording(0), Camera(K, np.zeros(5), (160, 90)), load_config(None, []), CpuBackend(),
        tmp_path, "scan", 0,
    )  # fmt: skip
    with create_store(inputs) as store:
        scan = Scan(inputs, store)
        unseen: Any = Unseen()
        frame = CameraFrame(unseen, 0, 0, None, "frame 0")
        with pytest.raises(AssertionError, match="looked at"):
            scan.feed(frame)
        skipped = FramePosed(Frame(NO_IMAGE, 0, 0))
        monkeypatch.setattr(scan.mapper, "skip", lambda seq, time_ns, prior: (skipped,))
        assert scan.feed(frame) is skipped
        assert scan.recorder.states[Tracking.SKIPPED] == 1
        scan.mapper.finish()
