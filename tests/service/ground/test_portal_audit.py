"""Who may change what at the portal, and the log of who did."""

from __future__ import annotations

import asyncio
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from clock import Clock
from loopback import until
from portal_client import ONE, TOKEN, Client, FakeOperator, client, store

from service.errors import InputError
from service.ground.guard import (
    SESSION_S,
    TOKEN_FILE,
    AuditLog,
    Pace,
    Tokens,
    kept_token,
    parse_tokens,
)
from service.ground.library import Library
from service.ground.portal import Portal, PortalConfig, config_of
from service.ground.vehicle import Vehicle

if TYPE_CHECKING:
    pass

__all__ = ["client", "store"]  # the fixtures


def lines_of(store: Path) -> list[dict[str, Any]]:
    path = store / "audit.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def test_every_change_leaves_a_line_in_the_audit_log(
    client: Client, store: Path, tmp_path: Path
) -> None:
    client.ask(ONE, "PATCH", {"title": "new name", "tags": ["a"]})
    client.ask(ONE, "PATCH", {"title": 3})
    client.ask(ONE + "/exports", "POST", {"kind": "kml"})
    until(lambda: client.ask(ONE)[1]["jobs"][-1]["state"] == "done")
    name = client.ask(ONE, "DELETE")[1]["bin"]
    client.ask(f"/api/bin/{name}/restore", "POST", {})
    client.ask("/api/import", "POST", {"folder": str(tmp_path)})
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
    assert entries[5]["folder"] == str(tmp_path)
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
    log = AuditLog(tmp_path, max_bytes=1000)
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
    first, second = (config_of("127.0.0.1:0", tmp_path, None, None) for _ in range(2))
    assert first.token == second.token and len(first.token.strip()) >= 16
    assert (tmp_path / TOKEN_FILE).stat().st_mode & 0o777 == 0o600
    assert kept_token(tmp_path) == first.token
    (tmp_path / TOKEN_FILE).write_text("")
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
    name, browser, end, signature = session.split(".")
    later = f"{name}.{browser}.{end}0.{signature}"
    bob = f"bob.{browser}.{end}.{signature}"
    for forged in (bob, later, f"{name}.{browser}.{end}.", "", ".", "x.y.z", "x.y.z.w", "\ud800"):
        assert tokens.holder_of(forged) is None
    other = Tokens(parse_tokens(f"ann {TOKEN}-3"))
    assert other.holder_of(session) is None
    for bad in ("", "# nothing", "a b c", f"ann {TOKEN}\nann {TOKEN}", "ann/x " + TOKEN):
        with pytest.raises(InputError):
            parse_tokens(bad)


def test_a_session_is_renewed_while_it_is_used_and_then_ends() -> None:
    clock = Clock()
    tokens = Tokens({"ann": TOKEN}, clock)
    first = tokens.new_session("ann")
    holder = tokens.holder_of(first)
    clock.now += 0.4 * SESSION_S
    assert tokens.renewed(first) is None and tokens.holder_of(first) == holder
    clock.now += 0.4 * SESSION_S
    second = tokens.renewed(first)
    assert second is not None and tokens.holder_of(second) == holder
    clock.now += 0.4 * SESSION_S
    assert tokens.holder_of(first) is None and tokens.renewed(first) is None
    other = tokens.new_session("ann")
    tokens.end_session(second)
    assert tokens.holder_of(second) is None and tokens.holder_of(other) is not None


def test_a_browser_logs_out(client: Client, store: Path) -> None:
    tokens = Tokens({"operator": TOKEN})  # as the portal's
    cookies = [f"skyrelief={tokens.new_session('operator')}" for _ in range(2)]

    def rename(cookie: str) -> int:
        return client.ask(ONE, "PATCH", {"title": "new"}, None, {"Cookie": cookie})[0]

    assert [rename(cookie) for cookie in cookies] == [200, 200]
    status, _, headers = client.ask("/api/logout", "POST", {}, None, {"Cookie": cookies[0]})
    assert status == 204 and headers["set-cookie"].startswith('skyrelief=""; ')
    assert "Max-Age=0" in headers["set-cookie"]
    assert [rename(cookie) for cookie in cookies] == [401, 200]
    assert lines_of(store)[2]["action"] == "logout"


def test_a_session_in_use_gets_its_next_cookie(client: Client) -> None:
    half = Tokens({"operator": TOKEN}, lambda: time.time() - 0.7 * SESSION_S)
    value = half.new_session("operator")
    *_, headers = client.ask("/api/scans", token=None, headers={"Cookie": f"skyrelief={value}"})
    following = headers["set-cookie"].partition(";")[0].removeprefix("skyrelief=")
    now = Tokens({"operator": TOKEN})
    assert following != value and now.holder_of(following) == now.holder_of(value) is not None


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
        await portal.app(scope, receive, send)

    asyncio.run(answer())
    headers = dict(sent[0]["headers"])
    cookie = headers[b"set-cookie"].decode().lower()
    assert ("secure" in cookie.split("; ")) is secure
    assert cookie.startswith("__host-skyrelief=" if secure else "skyrelief=")
    assert "max-age=43200" in cookie and "path=/" in cookie and "domain" not in cookie
    policy = headers[b"content-security-policy"].decode()
    assert "connect-src 'self' blob:;" in policy
    assert TOKEN not in cookie
    assert [e["action"] for e in lines_of(store)] == ["login"]


def test_images_are_for_this_site_only(client: Client) -> None:
    paths = (f"{ONE}/files/preview.jpg", f"{ONE}/keyframes/2.jpg", "/api/scans", "/nothing")
    for path in paths:
        assert client.ask(path)[2]["cross-origin-resource-policy"] == "same-origin"
    refused = client.ask(ONE, "DELETE", token=None)
    assert refused[0] == 401 and refused[2]["x-content-type-options"] == "nosniff"
