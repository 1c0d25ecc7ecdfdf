"""Deliverables asked for in the portal: one that fails does not keep the others waiting."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import pytest
from loopback import until

from service.ground import state
from service.ground.state import Jobs
from service.workers import Workers


def test_a_fault_of_ours_does_not_stop_the_exports_that_wait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    began, go_on = threading.Event(), threading.Event()

    class View:
        def __init__(self, folder: Path) -> None:
            self.name = folder.name

        def __enter__(self) -> View:
            return self

        def __exit__(self, *_: object) -> None:
            pass

    def export(scan: View, *_: Any) -> Path:
        if scan.name == "bad":
            began.set()
            go_on.wait(10.0)
            raise ZeroDivisionError
        return Path("scan.kml")

    monkeypatch.setattr(state, "ScanView", View)
    monkeypatch.setattr(state, "export", export)
    jobs = Jobs(Workers())
    jobs.start(tmp_path / "bad", "kml")
    assert began.wait(10.0)
    jobs.start(tmp_path / "good", "kml")
    go_on.set()
    assert until(lambda: not jobs.busy(tmp_path / "good"))
    assert [job["state"] for job in jobs.of(tmp_path / "good")] == ["done"]
    assert jobs.of(tmp_path / "bad")[0]["error"] == "failed; see the log"
