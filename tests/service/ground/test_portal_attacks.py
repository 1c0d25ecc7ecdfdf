"""Odd requests to the portal and odd files in its store: the list always works."""

from __future__ import annotations

import logging
import os
import socket
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from loopback import until
from portal_client import ONE, TOKEN, Client, client, store

from service.ground.portal import Portal, PortalConfig

if TYPE_CHECKING:
    from house_flight import HouseFlight

__all__ = ["client", "store"]  # the fixtures


@pytest.mark.parametrize(
    ("path", "method", "body"),
    [
        (f"{ONE}/keyframes/{'9' * 23}.jpg", "GET", None),
        (f"{ONE}/keyframes/{'9' * 5000}.jpg", "GET", None),
        (f"{ONE}/keyframes/%C2%B2.jpg", "GET", None),
        (f"{ONE}/tiles/{'a/' * 3000}tileset.json", "GET", None),
        (f"{ONE}/files/{'a' * 5000}", "GET", None),
        (f"/api/scans/{'a' * 5000}/b", "GET", None),
        (f"/assets/{'a' * 5000}", "GET", None),
        (f"/{'a' * 5000}?token={'x' * 5000}", "GET", None),
        ("/api/import", "POST", {"folder": "/" + "a" * 5000}),
        ("/api/import", "POST", {"folder": "/" + "a/" * 5000}),
        ("/api/import", "POST", {"folder": "/" + "a" * 5000 + ".mcap"}),
        ("/api/import", "POST", {"folder": "\ud800"}),
        ("/api/import", "POST", {"folder": "\ud800.mcap"}),
        ("/api/import", "POST", {"folder": "/dev/zero"}),
        (ONE, "PATCH", {"title": "\ud800"}),
        (ONE, "PATCH", {"tags": ["\udfff"]}),
        (ONE, "PATCH", {"edition": 10**400}),
        ("/api/vehicle", "POST", {"action": "baseline", "metres": 10**400}),
        ("/api/vehicle", "POST", {"action": "baseline", "metres": float("nan")}),
        (f"{ONE}/exports", "POST", {"kind": "\ud800"}),
        (f"{ONE}/exports", "POST", {"kind": {}}),
        ("/api/bin/%ED%A0%80/restore", "POST", {}),
    ],
)
def test_odd_requests_are_refused_in_one_line(
    client: Client, path: str, method: str, body: Any
) -> None:
    status, answer, _ = client.ask(path, method, body)
    assert 400 <= status < 500
    assert not isinstance(answer, dict) or "\n" not in answer["error"]
    assert client.ask(ONE)[1]["title"] == "test-1"


@pytest.mark.parametrize("body", [b"[" * 60_000, b"\xff", b"", b'{"title": "\\ud800"}'])
def test_odd_bodies_are_refused(client: Client, body: bytes) -> None:
    request = urllib.request.Request(client.base + ONE, body, method="PATCH")
    request.add_header("Authorization", f"Bearer {TOKEN}")
    with pytest.raises(urllib.error.HTTPError) as answer:
        urllib.request.urlopen(request, timeout=20)
    assert answer.value.code == 400


@pytest.mark.parametrize("points", ["%C2%B2", "-1", "1e9", "9" * 5000, ""])
def test_odd_live_views_open_with_the_usual_points(client: Client, points: str) -> None:
    from websockets.sync.client import connect as open_socket

    url = client.base.replace("http", "ws") + f"{ONE}/live?layer={points}"
    with open_socket(url) as one:
        assert isinstance(one.recv(timeout=20), bytes)


@pytest.mark.parametrize(
    "header", ["Host: [", "Content-Length: \xb2", "Cookie: skyrelief=a.b.\xff"]
)
def test_odd_headers_are_refused(store: Path, header: str) -> None:
    portal = Portal(PortalConfig(store, host="0.0.0.0", port=0, token=TOKEN))
    portal.start()
    try:
        port = int(portal.url.rsplit(":", 1)[1].split("/")[0])
        with socket.create_connection(("127.0.0.1", port), timeout=20) as one:
            host = "" if header.startswith("Host") else "Host: a\r\n"
            request = f"GET /api/scans HTTP/1.1\r\n{host}{header}\r\n\r\n"
            one.sendall(request.encode("latin-1"))
            assert one.recv(100).split()[1] in (b"400", b"401", b"413", b"421")
    finally:
        portal.close()


HOSTILE_SUMMARIES = {
    "list": "[]",
    "null": "null",
    "times a list": '{"schema": 1, "times": []}',
    "nan": '{"schema": 1, "times": {"started_unix_s": NaN}}',
    "nan elsewhere": '{"schema": 1, "quality": {"sigma_median_m": NaN}}',
    "huge": '{"schema": 1, "times": {"started_unix_s": 1e999}}',
    "late": '{"schema": 1, "times": {"started_unix_s": 1e300}}',
    "digits": '{"schema": 1, "times": {"started_unix_s": ' + "9" * 5000 + "}}",
    "a lone surrogate": '{"schema": 1, "notes": ["\\ud800"]}',
    "deep": '{"schema": 1, "x": ' + "[" * 500_000 + "]" * 500_000 + "}",
    "deep origin": '{"schema": 1, "origin": ' + '{"a":' * 100_000 + "1" + "}" * 100_001,
    "nothing": "",
    "no text": "\udcff\udcfe",
}


def test_the_list_works_whatever_one_scan_holds(
    client: Client, store: Path, house: HouseFlight
) -> None:
    for number, text in enumerate(HOSTILE_SUMMARIES.values()):
        house.flown(store / "drone-2" / f"s{number}").close()
        path = store / "drone-2" / f"s{number}" / "scan.json"
        path.write_bytes(text.encode(errors="surrogateescape"))
    labels = ['{"title": "\\ud800", "tags": []}', "[" * 100_000, "[]", '{"title": 1}']
    labels += ['{"title": "x", "tags": [], "edition": ' + "9" * 400 + "}"]
    for number, text in enumerate(labels):
        house.flown(store / "drone-3" / f"s{number}").close()
        (store / "drone-3" / f"s{number}" / "library.json").write_text(text)
    for name in ("library.json", "scan.json"):
        house.flown(store / "drone-4" / name).close()
        os.mkfifo(store / "drone-4" / name / name)
    status, entries, _ = client.ask("/api/scans")
    assert status == 200
    found = {(e["drone"], e["scan"]): e for e in entries}
    assert len(found) == 1 + len(HOSTILE_SUMMARIES) + len(labels) + 2
    assert found["drone-1", "test-1"]["trouble"] is None
    for number, name in enumerate(HOSTILE_SUMMARIES):
        assert found["drone-2", f"s{number}"]["trouble"], name
    for number in range(len(labels)):
        entry = found["drone-3", f"s{number}"]
        assert (entry["title"], entry["trouble"]) == (f"s{number}", None)
    assert found["drone-4", "scan.json"]["trouble"]


def test_a_damaged_schema_is_said(client: Client, store: Path) -> None:
    """SQLite quotes the damaged place in its message, which then is not UTF-8."""
    path = store / "drone-1/test-1/scan.db"
    data = path.read_bytes()
    assert data.count(b"CREATE TABLE chunks") == 1
    path.write_bytes(data.replace(b"CREATE TABLE chunks", b"CREATE TABL\xf4 chunks"))
    for name in ("keyframes/2.jpg", "coverage.json"):
        status, answer, _ = client.ask(f"{ONE}/{name}")
        assert status in (200, 400), answer
    assert client.ask("/api/scans")[0] == 200


def test_a_file_that_became_a_link_is_not_served(client: Client, store: Path) -> None:
    folder = store / "drone-1/test-1"
    (folder / "report.html").unlink()
    (folder / "report.html").symlink_to("/etc/passwd")
    (folder / "3dtiles").mkdir()
    (folder / "3dtiles/tileset.json").symlink_to("/etc/passwd")
    for path in ("files/report.html", "tiles/tileset.json"):
        assert client.ask(f"{ONE}/{path}")[0] == 404
    entry = client.ask(ONE)[1]
    assert "report.html" not in {f["name"] for f in entry["files"]} and not entry["tiles"]


@pytest.fixture
def server_log() -> Iterator[list[str]]:
    """What the web server logs."""
    said: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: said.append(record.getMessage())  # type: ignore[method-assign]
    log = logging.getLogger("uvicorn.error")
    log.addHandler(handler)
    yield said
    log.removeHandler(handler)


def test_malformed_requests_do_not_flood_the_log(client: Client, server_log: list[str]) -> None:
    port = int(client.base.rpartition(":")[2])
    for _ in range(40):
        with socket.create_connection(("127.0.0.1", port), timeout=20) as one:
            one.sendall(b"\x00\x01 no request\r\n\r\n")
            assert one.recv(100).split()[1] == b"400"
    assert 1 <= len(server_log) < 30


def test_a_client_that_leaves_during_a_body_leaves_no_traceback(
    client: Client, store: Path, server_log: list[str]
) -> None:
    port = int(client.base.rpartition(":")[2])
    request = f"PATCH {ONE} HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {TOKEN}\r\n"
    with socket.create_connection(("127.0.0.1", port), timeout=20) as one:
        one.sendall(f"{request}Content-Length: 100\r\n\r\n{{".encode())
    log = store / "audit.jsonl"
    until(lambda: log.exists() and "rename" in log.read_text())
    assert client.ask(ONE)[0] == 200
    assert not server_log
