"""Age and sigma of telemetry, frame by frame, next to the scan."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from mavlink.telemetry.samples import VehicleState
from service.flight.recorder import TAGS_FILE, FrameTags

STATE = VehicleState(
    0,
    q_ned_body_wxyz=np.array([1.0, 0.0, 0.0, 0.0]),
    sigma_attitude_rad=0.01,
    sigma_yaw_rad=0.05,
    sigma_h_m=1.25,
    sigma_agl_m=0.5,
    age_ms={"attitude": 7.25, "gimbal": 7.25, "gnss": 40.0, "terrain": 210.0},
    sources=("attitude", "gimbal", "gnss", "terrain"),
)


def test_each_frame_has_a_line_and_what_is_unknown_stays_empty(tmp_path: Path) -> None:
    tags = FrameTags(tmp_path / TAGS_FILE)
    tags.write(1_700_000_000_123_456_789, STATE)
    tags.write(1_700_000_001_000_000_000, None)  # telemetry knows nothing of this one
    tags.close()
    tags.write(1_700_000_002_000_000_000, STATE)  # closed
    tags.close()
    lines = (tmp_path / TAGS_FILE).read_text().splitlines()
    assert lines[0].startswith("time_unix_s,sources,age_attitude_ms,age_gimbal_ms,age_gnss_ms,")
    (row,) = csv.DictReader(lines)
    assert row["time_unix_s"] == "1700000000.123456789"
    assert row["sources"] == "attitude gimbal gnss terrain"
    ages = [row[f"age_{name}_ms"] for name in ("attitude", "gimbal", "gnss", "agl")]
    assert ages == ["7.2", "7.2", "40.0", "210.0"]
    assert float(row["sigma_attitude_deg"]) == pytest.approx(0.573, abs=1e-3)
    assert (row["sigma_gimbal_deg"], row["sigma_vertical_m"]) == ("", "")
    assert (row["sigma_horizontal_m"], row["sigma_agl_m"]) == ("1.250", "0.500")


def test_a_full_disk_is_reported_once_and_costs_nothing_else(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    FrameTags(tmp_path / "missing" / TAGS_FILE).write(0, STATE)
    full = Path("/dev/full")
    if full.exists():
        tags = FrameTags(full)
        for k in range(3000):
            tags.write(k, STATE)
        tags.close()
    assert caplog.text.count("ends here") == 1 + full.exists()
