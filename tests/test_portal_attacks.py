"""The portal against hostile clients, cards and files: nothing stops it, nothing leaks."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import resource
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from loopback import free_port, until

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")
pytest.importorskip("websockets")

from test_listener import Clock
from test_portal import TOKEN, Client, FakeOperator

from service.daemon.health import HealthServer
from service.errors import InputError, OutsideError
from service.ground import limits
from service.ground.audit import AuditLog, Pace
from service.ground.folder_import import copy_files
from service.ground.library import ConflictError, Library
from service.ground.portal import Portal, PortalConfig, open_portal
from service.ground.tokens import KEPT, Tokens, kept_token, parse_tokens
from service.ground.vehicle import Vehicle
from service.scans.folder import write_deliverables
from service.stream.session import SessionConfig, open_session
from service.workers import Workers

if TYPE_CHECKING:
    from conftest import HouseFlight

ONE = "/api/scans/drone-1/test-1"


@pytest.fixture
def store(tmp_path: Path, house: HouseFlight) -> Path:
    root = tmp_path / "scans"
    folder = root / "drone-1" / "test-1"
    with house.flown(folder) as scan:
        write_deliverables(folder, scan, {})
    return root


@pytest.fixture
def client(store: Path) -> Iterator[Client]:
    portal = Portal(PortalConfig(store, port=0, token=TOKEN))
    portal.start()
    yield Client(portal)
    portal.close()


def address_of(client: Client) -> tuple[str, int]:
    host, _, port = client.base.removeprefix("http://").rpartition(":")
    return host, int(port)


# ---- connections


def test_1100_half_open_requests_stop_neither_portal_nor_datalink(tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 3000:
        pytest.skip("this test needs 3000 descriptors")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 3000), hard))
    link, page = free_port(socket.SOCK_STREAM), free_port(socket.SOCK_STREAM)
    command = f"ground --listen tcp/127.0.0.1:{link} --store {tmp_path} --portal 127.0.0.1:{page}"
    process = subprocess.Popen(
        [sys.executable, "-m", "service.cli", *command.split()],
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (1024, 1024)),
    )
    held: list[socket.socket] = []
    try:
        assert process.stderr is not None
        next(line for line in process.stderr if line.startswith("portal: "))
        threading.Thread(target=process.stderr.read, daemon=True).start()
        for _ in range(1100):
            with contextlib.suppress(OSError):
                one = socket.create_connection(("127.0.0.1", page), timeout=5)
                held.append(one)
                one.sendall(b"GET /api/scans HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Half: ")
        assert len(held) > 1000
        with urllib.request.urlopen(f"http://127.0.0.1:{page}/api/scans", timeout=20) as answer:
            assert json.load(answer) == []
        assert len(os.listdir(f"/proc/{process.pid}/fd")) < 700
        with open_session(
            SessionConfig(mode="client", connect=(f"tcp/127.0.0.1:{link}",))
        ) as drone:
            assert until(lambda: list(drone.info.routers_zid()))
    finally:
        for one in held:
            one.close()
        process.terminate()
        process.communicate(timeout=60)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def answer_to(client: Client, head: str, body: bytes = b"") -> bytes:
    """All that the portal answers until it closes the connection."""
    with socket.create_connection(address_of(client), timeout=30) as one:
        text = f"{head}\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {TOKEN}\r\n"
        with contextlib.suppress(OSError):
            one.sendall(text.encode() + b"Transfer-Encoding: chunked\r\n\r\n" + body)
        out = b""
        with contextlib.suppress(ConnectionResetError):
            while block := one.recv(65536):
                out += block
        return out


def test_a_body_is_bounded_by_what_is_read(client: Client) -> None:
    """Chunks have no length in the header; 128 kB of them are refused, whatever comes behind."""
    chunk = b"2000\r\n" + b" " * 8192 + b"\r\n"
    answer = answer_to(client, f"PATCH {ONE} HTTP/1.1", chunk * 16)
    assert answer.startswith(b"HTTP/1.1 413 ")
    body = json.dumps({"title": "in chunks"}).encode()
    good = f"{len(body):x}\r\n".encode() + body + b"\r\n0\r\n\r\n"
    assert b"200 OK" in answer_to(client, f"PATCH {ONE} HTTP/1.1\r\nConnection: close", good)
    assert client.ask(ONE)[1]["title"] == "in chunks"


def test_a_body_that_does_not_come_is_given_up(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "BODY_S", 0.2)
    answer = answer_to(client, f"PATCH {ONE} HTTP/1.1", b"2\r\n{}\r\n")
    assert answer.startswith(b"HTTP/1.1 408 ")


def test_a_reader_that_stops_reading_is_dropped(
    client: Client, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "STALL_S", 0.2)
    with open(store / "drone-1/test-1/cloud.ply", "wb") as file:
        file.truncate(200_000_000)
    with socket.create_connection(address_of(client)) as one:
        one.sendall(f"GET {ONE}/files/cloud.ply HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
        time.sleep(1.0)  # nothing is read: the portal gives up
        received = 0
        with contextlib.suppress(ConnectionResetError):
            while block := one.recv(1 << 20):
                received += len(block)
    assert 0 < received < 200_000_000
    assert client.ask("/api/scans")[0] == 200


def test_views_without_a_token_do_not_lock_the_operator_out(client: Client) -> None:
    from websockets.exceptions import ConnectionClosed, InvalidStatus
    from websockets.sync.client import connect as open_socket

    url = client.base.replace("http", "ws") + ONE + "/live"
    with contextlib.ExitStack() as stack:
        opened = 0
        for _ in range(16):
            with contextlib.suppress(ConnectionClosed, InvalidStatus):
                stack.enter_context(open_socket(url)).recv(timeout=20)
                opened += 1
        assert opened == 8
        bearer = {"Authorization": f"Bearer {TOKEN}"}
        one = stack.enter_context(open_socket(url, additional_headers=bearer))
        assert one.recv(timeout=20)


# ---- requests


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

    url = client.base.replace("http", "ws") + f"{ONE}/live?points={points}"
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


# ---- files


HOSTILE_SUMMARIES = {
    "list": "[]",
    "null": "null",
    "times a list": '{"schema": 1, "times": []}',
    "nan": '{"schema": 1, "times": {"started_unix_s": NaN}}',
    "nan elsewhere": '{"schema": 1, "quality": {"sigma_median_m": NaN}}',
    "huge": '{"schema": 1, "times": {"started_unix_s": 1e999}}',
    "late": '{"schema": 1, "times": {"started_unix_s": 1e300}}',
    "digits": '{"schema": 1, "times": {"started_unix_s": ' + "9" * 5000 + "}}",
    "half a letter": '{"schema": 1, "notes": ["\\ud800"]}',
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
    """SQLite quotes the damaged place in its message, which then is no UTF-8."""
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
def card(tmp_path: Path, house: HouseFlight) -> Path:
    """A stranger's card: a sound scan with traps around it."""
    card = tmp_path / "card"
    house.flown(card).close()
    (card / "scan.json").write_text("{}")
    (card / "report.html").symlink_to("/etc/passwd")
    (card / "cloud.laz").symlink_to("/dev/zero")
    os.mkfifo(card / "preview.jpg")
    (card / "3dtiles").symlink_to("/etc")
    (card / "run.sh").write_text("#!/bin/sh\n")
    (card / "mesh.glb").mkdir()
    return card


def test_an_import_takes_regular_files_of_known_names_only(
    client: Client, store: Path, card: Path
) -> None:
    client.ask(ONE, "DELETE")
    before = sorted(path.name for path in card.iterdir())
    assert client.ask("/api/import", "POST", {"folder": str(card)})[0] == 201
    assert {p.name for p in (store / "drone-1/test-1").iterdir()} == {"scan.db", "scan.json"}
    assert sorted(path.name for path in card.iterdir()) == before
    assert not list(store.glob(".importing-*"))


@pytest.mark.parametrize("what", ["link", "link to a folder", "fifo", "nothing", "junk"])
def test_a_card_without_a_sound_scan_is_refused(
    client: Client, store: Path, card: Path, what: str
) -> None:
    client.ask(ONE, "DELETE")
    folder = card
    if what == "link to a folder":
        folder = card.with_name("linked")
        folder.symlink_to(card)
    else:
        (card / "scan.db").rename(card / "real.db")
    if what == "link":
        (card / "scan.db").symlink_to(card / "real.db")
    elif what == "fifo":
        os.mkfifo(card / "scan.db")
    elif what == "junk":
        (card / "scan.db").write_bytes(b"no database" * 1000)
    status, answer, _ = client.ask("/api/import", "POST", {"folder": str(folder)})
    assert status == 400 and "\n" not in answer["error"]
    assert client.ask("/api/scans")[1] == [] and not list(store.glob(".importing-*"))


def test_a_recording_that_is_a_link_or_a_pipe_is_refused(client: Client, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "b.mcap")
    for name in ("a.mcap", "b.mcap"):
        status, answer, _ = client.ask("/api/import", "POST", {"folder": str(tmp_path / name)})
        assert status == 400 and name in answer["error"]


def test_an_import_fits_the_room_or_is_refused(tmp_path: Path, card: Path) -> None:
    names = ("scan.db", "cloud.ply")
    with open(card / "cloud.ply", "wb") as file:
        file.truncate(10**12)  # a sparse file costs its maker nothing
    out = tmp_path / "out"
    out.mkdir()
    with pytest.raises(OutsideError, match="room for"):
        copy_files(card, out, names)
    assert not list(out.iterdir())
    (card / "cloud.ply").unlink()
    size = (card / "scan.db").stat().st_size
    with pytest.raises(OutsideError, match="room for"):
        copy_files(card, out, names, size - 1)
    assert copy_files(card, out, names, size) == {"scan.db"}


def test_an_import_holds_no_lock_of_the_library(
    store: Path, card: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = Library(store)
    library.delete("drone-1", "test-1")
    begun, go_on = threading.Event(), threading.Event()

    def slow(source: Path, target: Path, names: Iterable[str]) -> set[str]:
        begun.set()
        assert go_on.wait(60)
        return copy_files(source, target, names)

    monkeypatch.setattr("service.ground.library.copy_files", slow)
    importing = threading.Thread(target=library.bring_in, args=(card,))
    importing.start()
    try:
        assert begun.wait(60)
        with pytest.raises(ConflictError, match="another import"):
            library.bring_in(card)
        name = library.bin()[0]
        library.restore(name)
        library.label("drone-1", "test-1", "meanwhile", None)
        library.delete("drone-1", "test-1")
    finally:
        go_on.set()
        importing.join()
    assert [e["scan"] for e in library.scans()] == ["test-1"]


def test_what_a_killed_import_left_goes_at_the_next_start(store: Path) -> None:
    (store / ".importing-x").mkdir()
    (store / ".importing-x/scan.db").write_bytes(b"half")
    Library(store)
    assert not (store / ".importing-x").exists()


# ---- who may, and who did


def lines_of(store: Path) -> list[dict[str, Any]]:
    path = store / "audit.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def test_every_change_leaves_a_line_in_the_audit_log(
    client: Client, store: Path, card: Path
) -> None:
    client.ask(ONE, "PATCH", {"title": "new name", "tags": ["a"]})
    client.ask(ONE, "PATCH", {"title": 3})
    client.ask(ONE + "/exports", "POST", {"kind": "kml"})
    until(lambda: client.ask(ONE)[1]["jobs"][-1]["state"] == "done")
    name = client.ask(ONE, "DELETE")[1]["bin"]
    client.ask(f"/api/bin/{name}/restore", "POST", {})
    client.ask("/api/import", "POST", {"folder": str(card)})
    client.ask("/api/vehicle", "POST", {"action": "start"})
    client.ask(ONE, "DELETE", token="wrong")
    client.ask("/api/scans")
    entries = lines_of(store)
    assert [(e["action"], e["status"]) for e in entries] == [
        ("rename", 200),
        ("rename", 400),
        ("export", 202),
        ("delete", 200),
        ("restore", 200),
        ("import", 400),
        ("start", 404),
        (f"DELETE {ONE}", 401),
    ]
    assert {e["from"] for e in entries} == {"127.0.0.1"}
    assert [e["who"] for e in entries] == ["operator"] * 7 + [""]
    assert entries[0]["title"] == "new name" and entries[0]["scan"] == "drone-1/test-1"
    assert entries[5]["folder"] == str(card)
    assert all(e["time"].endswith("+00:00") for e in entries)
    assert (store / "audit.jsonl").stat().st_mode & 0o777 == 0o600


def test_a_change_that_fails_inside_is_logged_too(
    client: Client, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(Library, "delete", fails)
    assert client.ask(ONE, "DELETE")[0] == 500
    assert [(e["action"], e["status"]) for e in lines_of(store)] == [("delete", 500)]


def test_refusals_do_not_flood_the_audit_log(client: Client, store: Path) -> None:
    for _ in range(100):
        client.ask(ONE, "DELETE", token=None)
    assert 20 <= len(lines_of(store)) < 100


def test_the_audit_log_is_bounded_and_a_full_disk_stops_nothing(tmp_path: Path) -> None:
    log = AuditLog(tmp_path, largest_bytes=1000)
    for number in range(101):
        log.write("a", "b", f"c{number}", 200, text="x" * 9999, odd="\ud800", many=["y" * 999])
    files = sorted(tmp_path.iterdir())
    assert [path.name for path in files] == ["audit.jsonl", "audit.jsonl.1"]
    assert all(path.stat().st_size < 3000 for path in files)
    AuditLog(tmp_path / "none").write("a", "b", "c", 200)


def test_orders_have_a_pace_but_stop_always_passes(store: Path) -> None:
    fake = FakeOperator()
    vehicle = Vehicle("udpin://x", lambda _: fake)  # type: ignore[arg-type, return-value]
    portal = Portal(PortalConfig(store, port=0, token=TOKEN), vehicle=vehicle)
    portal.start()
    vehicle.start()
    try:
        client = Client(portal)
        until(lambda: client.ask("/api/vehicle")[1]["connected"])
        orders = [client.ask("/api/vehicle", "POST", {"action": "start"}) for _ in range(30)]
        assert {status for status, _, _ in orders} == {200, 429}
        assert next(h for s, _, h in orders if s == 429)["retry-after"] == "1"
        for _ in range(5):
            assert client.ask("/api/vehicle", "POST", {"action": "stop"})[0] == 200
        assert len(fake.commands) < 30
    finally:
        portal.close()
        vehicle.close()


def test_the_pace_of_orders() -> None:
    clock = Clock()
    pace = Pace(2.0, 3, clock)
    assert [pace.take() for _ in range(4)] == [True, True, True, False]
    clock.now += 0.5
    assert [pace.take() for _ in range(2)] == [True, False]
    clock.now += 1000
    assert [pace.take() for _ in range(4)] == [True, True, True, False]


def test_a_made_token_is_kept_over_restarts(tmp_path: Path) -> None:
    first = open_portal("127.0.0.1:0", tmp_path)
    first.close()
    second = open_portal("127.0.0.1:0", tmp_path)
    second.close()
    assert first.token == second.token and len(first.token) >= 16
    assert (tmp_path / KEPT).stat().st_mode & 0o777 == 0o600
    assert kept_token(tmp_path).strip() == first.token
    (tmp_path / KEPT).write_text("")
    with pytest.raises(InputError, match="no token"):
        kept_token(tmp_path)


def test_a_token_file_names_its_holders() -> None:
    text = f"# two people\nann {TOKEN}-1\nbob {TOKEN}-2\n"
    tokens = Tokens(parse_tokens(text))
    assert tokens.name_of(f"{TOKEN}-2") == "bob"
    assert tokens.name_of(TOKEN) is None and tokens.name_of("\ud800") is None
    session = tokens.new_session("ann")
    assert TOKEN not in session and session != tokens.new_session("ann")
    assert (tokens.holder_of(session) or "").startswith("ann.")
    name, browser, signature = session.split(".")
    for forged in (f"bob.{browser}.{signature}", f"{name}.{browser}.", "", ".", "x.y.z", "\ud800"):
        assert tokens.holder_of(forged) is None
    other = Tokens(parse_tokens(f"ann {TOKEN}-3"))
    assert other.holder_of(session) is None
    for bad in ("", "# nothing", "a b c", f"ann {TOKEN}\nann {TOKEN}", "ann/x " + TOKEN):
        with pytest.raises(InputError):
            parse_tokens(bad)


def test_a_short_token_among_several_is_refused_on_open_addresses(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="16 letters"):
        PortalConfig(tmp_path, host="0.0.0.0", token=f"ann {TOKEN}\nbob short")


@pytest.mark.parametrize(("scheme", "secure"), [("https", True), ("http", False)])
def test_the_session_cookie_is_secure_under_tls(store: Path, scheme: str, secure: bool) -> None:
    portal = Portal(PortalConfig(store, token=TOKEN))
    sent: list[Any] = []

    async def send(message: Any) -> None:
        sent.append(message)

    async def receive() -> Any:
        return {"type": "http.request"}

    scope = {
        "type": "http",
        "method": "GET",
        "scheme": scheme,
        "path": "/",
        "query_string": f"token={TOKEN}".encode(),
        "headers": [(b"host", b"127.0.0.1")],
        "client": ("127.0.0.1", 5),
    }

    async def answer() -> None:
        await portal._app(scope, receive, send)

    asyncio.run(answer())
    headers = dict(sent[0]["headers"])
    cookie = headers[b"set-cookie"].decode().lower()
    assert ("secure" in cookie.split("; ")) is secure
    assert TOKEN not in cookie
    assert [e["action"] for e in lines_of(store)] == ["login"]


def test_pictures_are_for_this_site_only(client: Client) -> None:
    paths = (f"{ONE}/files/preview.jpg", f"{ONE}/keyframes/2.jpg", "/api/scans", "/nothing")
    for path in paths:
        assert client.ask(path)[2]["cross-origin-resource-policy"] == "same-origin"
    refused = client.ask(ONE, "DELETE", token=None)
    assert refused[0] == 401 and refused[2]["x-content-type-options"] == "nosniff"


# ---- the health page on board


def status_of(server: HealthServer, host: str | None) -> int:
    with socket.create_connection(("127.0.0.1", server.port), timeout=20) as one:
        header = "" if host is None else f"Host: {host}\r\n"
        one.sendall(f"GET /status HTTP/1.0\r\n{header}\r\n".encode())
        return int(one.recv(100).split()[1])


def test_the_health_page_answers_to_its_own_names_only() -> None:
    own = socket.gethostname().partition(".")[0]
    server = HealthServer("127.0.0.1:0", lambda: {"ok": True})
    try:
        for host in (None, "localhost", f"127.0.0.1:{server.port}", "[::1]:9560"):
            assert status_of(server, host) == 200
        for host in ("evil.example", "192.168.1.5", "127.0.0.1.evil.example", ""):
            assert status_of(server, host) == 421
    finally:
        server.close()
    server = HealthServer("0.0.0.0:0", lambda: {"ok": True})
    try:
        for host in ("192.168.1.5:9560", own, f"{own}.fleet.example:9560", "localhost"):
            assert status_of(server, host) == 200
        assert status_of(server, "evil.example") == 421
    finally:
        server.close()


def test_half_open_requests_leave_the_health_page_answering() -> None:
    server = HealthServer("127.0.0.1:0", lambda: {"ok": True})
    held = []
    try:
        for _ in range(100):
            one = socket.create_connection(("127.0.0.1", server.port), timeout=5)
            one.sendall(b"GET /sta")
            held.append(one)
        assert status_of(server, "localhost") == 200
        assert sum(t.name.startswith("Thread-") for t in threading.enumerate()) < 40
    finally:
        for one in held:
            one.close()
        server.close()


def test_a_portal_that_fails_starts_again_at_its_address(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import uvicorn

    serve, failed = uvicorn.Server.serve, threading.Event()

    async def fails_once(server: uvicorn.Server, sockets: Any = None) -> None:
        if failed.is_set():
            await serve(server, sockets)
        failed.set()
        sockets[0].close()
        raise ZeroDivisionError

    monkeypatch.setattr(uvicorn.Server, "serve", fails_once)
    workers = Workers(pause_s=0.0)
    portal = Portal(PortalConfig(store, port=0, token=TOKEN), workers=workers)
    portal.start()
    try:
        client = Client(portal)
        assert failed.wait(20)

        def answers() -> bool:
            with contextlib.suppress(OSError):
                return bool(client.ask("/api/scans")[0] == 200)
            return False

        until(answers)
        assert [(w["name"], w["restarts"]) for w in workers.report()] == [("portal", 1)]
    finally:
        portal.close()


def test_half_open_tls_handshakes_leave_the_portal_answering(store: Path, tmp_path: Path) -> None:
    """A handshake that never comes counts as a connection; the cookie is for TLS only."""
    import http.client
    import ssl

    certificate, key = certificate_for(tmp_path)
    config = PortalConfig(
        store, port=0, token=TOKEN, tls_certificate=str(certificate), tls_key=str(key)
    )
    portal = Portal(config)
    portal.start()
    held = []
    try:
        port = int(portal.url.rsplit(":", 1)[1].split("/")[0])
        before = len(os.listdir("/proc/self/fd"))
        for _ in range(200):
            held.append(socket.create_connection(("127.0.0.1", port), timeout=5))
        context = ssl.create_default_context(cafile=str(certificate))
        connection = http.client.HTTPSConnection("localhost", port, timeout=20, context=context)
        connection.request("GET", f"/?token={TOKEN}")
        answer = connection.getresponse()
        assert answer.status == 303 and "Secure" in (answer.getheader("set-cookie") or "")
        until(lambda: len(os.listdir("/proc/self/fd")) - before - len(held) < 50)
    finally:
        for one in held:
            one.close()
        portal.close()


def certificate_for(folder: Path) -> tuple[Path, Path]:
    """A certificate and key for localhost that signed itself."""
    pytest.importorskip("cryptography")
    from datetime import datetime, timedelta, timezone

    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "localhost")])
    now = datetime.now(timezone.utc)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - timedelta(hours=1))
        .not_valid_after(now + timedelta(hours=1))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), False)
        .sign(key, hashes.SHA256())
    )
    kind = serialization.Encoding.PEM
    (folder / "portal.crt").write_bytes(made.public_bytes(kind))
    (folder / "portal.key").write_bytes(
        key.private_bytes(kind, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    return folder / "portal.crt", folder / "portal.key"
