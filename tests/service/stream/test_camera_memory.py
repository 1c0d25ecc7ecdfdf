"""What a scan starts with: the camera's latency and readout as earlier scans measured them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from recon.types import Shutter
from service.daemon.camera_memory import Measured, measured
from service.stream.records import ScanHeader
from service.stream.store import ScanStore

SOURCE, SIZE = "rtsp://pilot:secret@10.0.0.2/live", (640, 360)
SHOWN = "rtsp://***@10.0.0.2/live"
LATENCY = {"estimate_ms": 72.5, "is_settled": True}
READOUT = {"is_sure": True}


def scanned(
    folder: Path, name: str, run: dict[str, Any] | None, readout_ms: float = 0.0, width: int = 640
) -> None:
    """A scan of the camera with these figures; None: it is still open."""
    camera: dict[str, Any] = {
        "width": width, "height": 360, "K": [500.0, 0, 320, 0, 500, 180, 0, 0, 1],
        "distortion": [0.0] * 5, "readout_ms": readout_ms, "readout_direction": "up",
    }  # fmt: skip
    header = ScanHeader(name, "drone", 1_000, camera=camera)
    with ScanStore.create(folder / name / "scan.db", header) as store:
        if run is not None:
            store.finish({"source": SHOWN} | run)


def test_the_latest_sure_figures_count(tmp_path: Path) -> None:
    scanned(tmp_path, "1", {"camera_latency": LATENCY, "camera_readout": READOUT}, 20.0)
    scanned(tmp_path, "2", {"camera_latency": LATENCY | {"estimate_ms": 80}})
    scanned(tmp_path, "3", {"camera_latency": LATENCY | {"is_settled": False, "estimate_ms": 9.0},
                            "camera_readout": {"is_sure": False}}, 11.0)  # fmt: skip
    scanned(tmp_path, "4", None)
    assert measured(tmp_path, SOURCE, SIZE) == Measured(80.0, Shutter(0.02, "up"))


@pytest.mark.parametrize("run", [
    {"source": "rtsp://***@10.0.0.3/live"}, {"camera_latency": None, "camera_readout": "30"},
    {"camera_latency": LATENCY | {"estimate_ms": "72"}, "camera_readout": None},
])  # fmt: skip
def test_other_cameras_and_odd_figures_say_nothing(tmp_path: Path, run: dict[str, Any]) -> None:
    scanned(tmp_path, "1", {"camera_latency": LATENCY, "camera_readout": READOUT} | run, 20.0)
    assert measured(tmp_path, SOURCE, SIZE) == Measured()


def test_another_image_size_says_nothing(tmp_path: Path) -> None:
    scanned(tmp_path, "1", {"camera_latency": LATENCY, "camera_readout": READOUT}, 20.0, 1280)
    assert measured(tmp_path, SOURCE, SIZE) == Measured()


def test_what_is_no_scan_says_nothing(tmp_path: Path) -> None:
    (tmp_path / "2").mkdir()
    (tmp_path / "2" / "scan.db").write_bytes(b"no database")
    assert measured(tmp_path, SOURCE, SIZE) == Measured()
    assert measured(tmp_path / "missing", SOURCE, SIZE) == Measured()
