"""Recordings uploaded to the portal: a video with its flight log is replayed in a job."""

from __future__ import annotations

import http.client
import json
from pathlib import Path
from typing import Any

import pytest
from command_line import skyrelief
from loopback import until
from portal_client import TOKEN, Client, client, store

from service import workers
from service.stream.store import ScanStore

__all__ = ["client", "store"]  # the fixtures


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated flight of 6 s: video, log and camera model."""
    folder = tmp_path_factory.mktemp("sim") / "flight"
    made = skyrelief(
        "simulate", "--out", folder, "--size", "320x180", "--fps", "5", "--duration-s", "6",
        "--height-m", "40", "--speed-m-s", "6", "--seed", "3",
    )  # fmt: skip
    assert made.returncode == 0, made.stderr
    return folder


def send_recording(client: Client, *files: Path) -> tuple[int, Any]:
    """Upload files as one recording; status and answer."""
    data = [path.read_bytes() for path in files]
    parts = "&".join(f"name={p.name}&bytes={len(d)}" for p, d in zip(files, data, strict=True))
    connection = http.client.HTTPConnection(client.base.removeprefix("http://"), timeout=60)
    headers = {"Authorization": f"Bearer {TOKEN}"}
    connection.request("POST", f"/api/upload?{parts}", b"".join(data), headers)
    answer = connection.getresponse()
    found = answer.status, json.loads(answer.read())
    connection.close()
    return found


def ended(client: Client, number: int, percents: set[int] | None = None) -> dict[str, Any]:
    """A job once it has ended; ``percents`` is what it said to be done meanwhile."""

    def find() -> dict[str, Any] | None:
        jobs = client.ask("/api/jobs")[1]
        found = next(job for job in jobs if job["number"] == number)
        if percents is not None:
            percents.add(found["percent"])
        return found if found["state"] not in ("waiting", "running") else None

    job: dict[str, Any] = until(find, 200.0, lambda: client.ask("/api/jobs")[1])
    return job


@pytest.mark.slow
def test_a_video_with_its_log_becomes_a_scan(
    client: Client, store: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers, "NICE", 0)  # the tests share the machine
    files = [recording / name for name in ("camera.yaml", "flight.mp4", "flight.tlog")]
    status, job = send_recording(client, *files)
    assert (status, job["kind"], job["scan"]) == (202, "scan", "flight.mp4")
    percents: set[int] = set()
    job = ended(client, job["number"], percents)
    assert job["state"] == "done", job["error"]
    assert any(0 < percent < 100 for percent in percents)
    drone, _, scan = job["file"].partition("/")
    with ScanStore.open(store / "drones" / drone / scan / "scan.db") as made:
        assert made.finished and len(made.seqs()) > 2
        camera = made.header.camera
    assert camera is not None and made.header.origin_lat_deg is not None
    assert not list(store.glob(".taking-*"))


@pytest.mark.slow
def test_a_recording_that_fails_or_is_cancelled_leaves_nothing(
    client: Client, store: Path, recording: Path, tmp_path: Path
) -> None:
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(b"no video" * 1000)
    status, first = send_recording(client, broken, recording / "flight.tlog")
    assert status == 202
    files = (recording / "flight.mp4", recording / "flight.tlog")
    second, third = (send_recording(client, *files)[1]["number"] for _ in range(2))
    assert client.ask(f"/api/jobs/{third}", "DELETE")[1]["state"] == "cancelled"  # it waits
    failed = ended(client, first["number"])
    assert failed["state"] == "failed" and ".taking" not in failed["error"]
    assert "upload.mp4" in failed["error"]
    until(lambda: client.ask(f"/api/jobs/{second}", "DELETE")[0] == 200)
    assert ended(client, second)["state"] == "cancelled"
    until(lambda: not list(store.glob(".taking-*")))
    status, alone = send_recording(client, broken)  # it might hold its telemetry
    assert status == 202 and ended(client, alone["number"])["state"] == "failed"
    for wrong in ((*files, broken), (recording / "flight.tlog",)):
        assert send_recording(client, *wrong)[0] == 400
    assert not list(store.glob(".taking-*"))
