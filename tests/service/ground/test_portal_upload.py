"""Scans uploaded to the portal: archives, stores and recordings, and what is none of these."""

from __future__ import annotations

import http.client
import io
import json
import socket
import time
import zipfile
from contextlib import redirect_stderr
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from loopback import until
from person import Browser
from portal_client import NEEDS, ONE, TOKEN, Client, browser, client, store

from service.commands import speaking
from service.errors import InputError, OutsideError
from service.ground import upload
from service.ground.guard import MAX_UPLOAD_BYTES
from service.ground.library import Library
from service.ground.upload import MAX_LISTING_BYTES, Upload, unpack
from service.progress import Progress
from service.stream.store import ScanStore

if TYPE_CHECKING:
    from house_flight import HouseFlight

__all__ = ["browser", "client", "store"]  # the fixtures


def send(client: Client, name: str, data: bytes, token: str = TOKEN) -> tuple[int, Any]:
    """Upload ``data``; status and answer."""
    connection = http.client.HTTPConnection(client.base.removeprefix("http://"), timeout=60)
    headers = {"Authorization": f"Bearer {token}"}
    connection.request("POST", f"/api/upload?name={name}&bytes={len(data)}", data, headers)
    answer = connection.getresponse()
    found = answer.status, json.loads(answer.read())
    connection.close()
    return found


@pytest.fixture
def flown(tmp_path: Path, house: HouseFlight) -> Path:
    """A scan folder that the library does not have."""
    folder = tmp_path / "flown"
    house.flown(folder).close()
    (folder / "report.html").write_text("<p>a report")
    return folder


def zipped(path: Path, *members: tuple[str, Path | bytes], **how: Any) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, **how) as archive:
        for name, content in members:
            data = content if isinstance(content, bytes) else content.read_bytes()
            archive.writestr(name, data)
    return path


def nothing_left(store: Path) -> bool:
    return not list(store.glob(".taking-*"))


def test_an_archive_becomes_a_scan_and_no_path_in_it_is_used(
    client: Client, store: Path, flown: Path, tmp_path: Path
) -> None:
    client.ask(ONE, "DELETE")
    archive = zipped(
        tmp_path / "a.zip",
        ("../../escaped", b"x"),
        ("/tmp/skyrelief-escaped", b"x"),
        ("flight 7/scan.db", flown / "scan.db"),
        ("flight 7/report.html", flown / "report.html"),
        ("flight 7/run.sh", b"#!/bin/sh"),
        ("flight 7/deeper/preview.jpg", b"not of this scan"),
    )
    status, answer = send(client, "a.zip", archive.read_bytes())
    assert (status, answer) == (201, {"drone": "drone-1", "scan": "test-1"})
    assert {p.name for p in (store / "drones/drone-1/test-1").iterdir()} == {
        "scan.db",
        "report.html",
    }
    with (
        ScanStore.open(flown / "scan.db") as a,
        ScanStore.open(store / "drones/drone-1/test-1/scan.db") as b,
    ):
        assert a.seqs() == b.seqs() and a.header == b.header
    assert not (tmp_path / "escaped").exists() and not Path("/tmp/skyrelief-escaped").exists()
    assert nothing_left(store)
    log = [json.loads(line) for line in (store / "audit.jsonl").read_text().splitlines()]
    assert log[-1]["action"] == "upload" and log[-1]["scan"] == "drone-1/test-1"


def test_a_store_and_a_recording_become_scans(client: Client, store: Path, flown: Path) -> None:
    pytest.importorskip("foxglove")
    pytest.importorskip("mcap")
    from service.offline.exports.recording import export_mcap

    recording = flown / "flight.mcap"
    with ScanStore.open(flown / "scan.db") as scan:
        export_mcap(scan, recording)
    for name in ("scan.db", "flight.mcap"):
        client.ask(ONE, "DELETE")
        assert send(client, name, (flown / name).read_bytes())[0] == 201
        assert [e["scan"] for e in client.ask("/api/scans")[1]] == ["test-1"]
        status, answer = send(client, name, (flown / name).read_bytes())
        assert status == 400 and "the library holds drone-1/test-1 already" in answer["error"]
    assert nothing_left(store)


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("flight.tlog", b"x", "a video with its flight log"),
        ("a.zip", b"", "not 0 bytes"),
        ("a.zip", b"PK\3\4" + b"x" * 5000, "the ZIP cannot be read"),
        ("scan.db", b"no database" * 1000, "scan"),
        ("a.mcap", b"no recording" * 1000, "MCAP"),
    ],
)
def test_what_is_no_scan_is_refused_in_one_line(
    client: Client, store: Path, name: str, data: bytes, said: str
) -> None:
    before = client.ask("/api/scans")[1]
    status, answer = send(client, name, data)
    assert status == 400 and said in answer["error"] and "\n" not in answer["error"]
    assert ".taking" not in answer["error"]
    assert client.ask("/api/scans")[1] == before and nothing_left(store)
    assert client.ask("/api/import", "POST", {"folder": "/nowhere"})[0] == 400  # and not 409


def test_an_upload_needs_the_token_and_fits(client: Client, store: Path) -> None:
    assert send(client, "scan.db", b"x", "wrong")[0] == 401
    assert client.ask("/api/upload?name=scan.db&bytes=1", token=None)[0] == 401
    for size, status in (
        (1, 200),
        (MAX_UPLOAD_BYTES + 1, 400),
        ("x", 400),
        ("9" * 30, 400),
        ("1&name=b.db&bytes=1", 400),
    ):
        assert client.ask(f"/api/upload?name=scan.db&bytes={size}")[0] == status
    host, _, port = client.base.removeprefix("http://").partition(":")
    with socket.create_connection((host, int(port))) as one:
        head = f"POST /api/upload?name=a.zip&bytes=1 HTTP/1.1\r\nHost: {host}\r\n"
        head += f"Authorization: Bearer {TOKEN}\r\nContent-Length: {MAX_UPLOAD_BYTES + 1}\r\n\r\n"
        one.sendall(head.encode())
        assert one.recv(100).split()[1] == b"413"
    assert client.ask("/api/scans", "POST", {"x": "y" * 70_000})[0] == 413  # others as before


def test_an_upload_that_breaks_off_leaves_nothing(client: Client, store: Path) -> None:
    host, _, port = client.base.removeprefix("http://").partition(":")
    with socket.create_connection((host, int(port))) as one:
        head = f"POST /api/upload?name=scan.db&bytes=1000000 HTTP/1.1\r\nHost: {host}\r\n"
        head += f"Authorization: Bearer {TOKEN}\r\nContent-Length: 1000000\r\n\r\n"
        one.sendall(head.encode() + b"x" * 100_000)
        until(lambda: list(store.glob(".taking-*")))
        status, answer, _ = client.ask("/api/import", "POST", {"folder": "/nowhere"})
        assert status == 409 and "another import" in answer["error"]
    until(lambda: nothing_left(store))
    until(lambda: client.ask("/api/import", "POST", {"folder": "/nowhere"})[0] == 400)


def test_an_upload_is_as_long_as_it_said(store: Path) -> None:
    for data, said in ((b"123", "longer"), (b"1", "1 bytes early")):
        upload = Upload(Library(store), [("scan.db", 2)])
        with pytest.raises(InputError, match=said):
            upload.write(data)
            upload.end()
        upload.close()
    assert nothing_left(store)


def test_an_upload_fits_the_disk(store: Path) -> None:
    with pytest.raises(OutsideError, match="room for 0 MB"):
        Upload(Library(store), [("scan.db", 2)], room_bytes=1)
    assert nothing_left(store)


def test_a_replay_tells_its_step_and_share_also_where_a_line_is_said_again() -> None:
    said, lines, progress = io.StringIO(), list[str](), Progress()
    with redirect_stderr(said), speaking(quiet_s=0.02) as say:
        for line in ("replay: reading", "replay: tracking, 35 %"):
            said.truncate(said.seek(0))
            say(line)
            while said.getvalue().count("\n") < 2:
                time.sleep(0.005)
            lines.append(said.getvalue().splitlines()[1])
    seen = []
    for line in lines:
        upload.follow(progress, line)
        seen.append((progress.text, progress.share))
    assert seen == [("replay: reading", 0.0), ("replay: tracking", 0.35)]


def test_hostile_archives(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()

    def refused(archive: Path, said: str, kind: type[Exception] = InputError) -> None:
        with pytest.raises(kind, match=said):
            unpack(archive, out, room_bytes=40_000_000)
        assert not list(out.iterdir())

    none = zipped(tmp_path / "none.zip", ("readme.txt", b"x"))
    refused(none, "holds no scans")
    two = zipped(tmp_path / "two.zip", ("a/scan.db", b"x"), ("b/scan.db", b"x"))
    refused(two, "holds 2 scans")
    members = [(f"{n:06d}" + "x" * 200, b"") for n in range(MAX_LISTING_BYTES // 200)]
    refused(zipped(tmp_path / "long.zip", *members), "table of contents is too large")
    other = tmp_path / "lzma.zip"
    with zipfile.ZipFile(other, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("scan.db", b"x")
    refused(other, "another method")
    bomb = zipped(tmp_path / "bomb.zip", ("scan.db", bytes(50_000_000)))
    assert bomb.stat().st_size < 100_000
    refused(bomb, "room for 40 MB", OutsideError)
    lying = bytearray(bomb.read_bytes())
    at = lying.rindex(b"PK\1\2")
    lying[at + 24 : at + 28] = (1000).to_bytes(4, "little")  # its size in the table of contents
    (tmp_path / "lying.zip").write_bytes(lying)
    with pytest.raises(InputError, match="cannot be read"):
        unpack(tmp_path / "lying.zip", out)
    assert sum(p.stat().st_size for p in out.iterdir()) <= 1000


DROP = """
(() => {
  const bytes = Uint8Array.from(atob(%r), c => c.charCodeAt(0));
  const data = new DataTransfer();
  data.items.add(new File([bytes], %r));
  const drop = { dataTransfer: data, bubbles: true, cancelable: true };
  const send = kind => document.querySelector("main").dispatchEvent(new DragEvent(kind, drop));
  send("dragover");
  const invited = getComputedStyle(document.body, "::after").content;
  return [invited, send("drop"), document.body.className];
})()
"""


@pytest.mark.parametrize("_", [pytest.param(0, marks=NEEDS)])
@pytest.mark.slow
def test_a_file_dropped_on_the_page_becomes_a_card(
    browser: Browser, client: Client, flown: Path, tmp_path: Path, _: int
) -> None:
    import base64

    client.ask(ONE, "DELETE")
    browser.open(f"{client.base}/?token={TOKEN}")
    browser.wait("document.querySelector('.empty h2') !== null")
    archive = zipped(tmp_path / "a.zip", ("flight/scan.db", flown / "scan.db"))
    data = base64.b64encode(archive.read_bytes()).decode()
    invited, opens, after = browser.run(DROP % (data, "flight.tlog"))
    assert "Drop" in invited and opens is False  # the browser does not open it
    assert after == ""
    browser.wait("document.querySelector('[role=alert]')?.textContent.includes('flight log')")
    browser.run(DROP % (data, "flight.zip"))
    browser.wait("document.querySelectorAll('article').length === 1")
    browser.wait("document.body.textContent.includes('flight.zip has arrived')")
    assert browser.run("document.querySelector('.upload').hidden")
    assert [e["scan"] for e in client.ask("/api/scans")[1]] == ["test-1"]
