"""Parts for the tests of the portal: a client, a store with a scan, a vehicle's other end.

A test that imports it is skipped where the portal's packages are missing.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import tempfile
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")
pytest.importorskip("websockets")

from person import Browser, chromium

from service.ground.http import PAGE
from service.ground.portal import Portal, PortalConfig
from service.scans.folder import write_deliverables

if TYPE_CHECKING:
    from house_flight import HouseFlight

TOKEN = "a-token-of-enough-letters"
ONE = "/api/scans/drone-1/test-1"
"""The scan of :func:`flown_store`."""
NEEDS = [
    pytest.mark.skipif(not chromium(), reason="needs Chromium"),
    pytest.mark.skipif(not (PAGE / "index.html").is_file(), reason="needs the built page"),
]
"""Marks of a test in a real browser."""
VEHICLE_SHOWN = "document.querySelector('.vehicle:not([hidden]) .state:not([hidden])') !== null"
"""The page shows a connected vehicle: before its first answer the strip alone is hidden."""


class Client:
    """Requests to a portal on this machine."""

    def __init__(self, portal: Portal) -> None:
        self.base = portal.url.split("/?")[0]

    def ask(
        self,
        path: str,
        method: str = "GET",
        body: Any = None,
        token: str | None = TOKEN,
        headers: dict[str, str] | None = None,
    ) -> tuple[int, Any, dict[str, str]]:
        """Status, JSON (or bytes) and headers."""
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self.base + path, data, method=method)
        for name, value in (headers or {}).items():
            request.add_header(name, value)
        if token is not None:
            request.add_header("Authorization", f"Bearer {token}")
        try:
            with urllib.request.urlopen(request, timeout=10) as answer:
                content, status, found = answer.read(), answer.status, dict(answer.headers)
        except urllib.error.HTTPError as error:
            content, status, found = error.read(), error.code, dict(error.headers)
        found = {name.lower(): value for name, value in found.items()}
        if found.get("content-type", "").startswith("application/json"):
            return status, json.loads(content), found
        return status, content, found


def flown_store(root: Path, house: HouseFlight) -> Path:
    """``root`` with the scan drone-1/test-1 and its files in it."""
    shutil.copytree(_finished(house).name, root / "drone-1" / "test-1")
    return root


@cache
def _finished(house: HouseFlight) -> tempfile.TemporaryDirectory[str]:
    """The scan and its files, made once."""
    folder = tempfile.TemporaryDirectory()
    with house.flown(Path(folder.name)) as scan:
        write_deliverables(Path(folder.name), scan)
    return folder


@contextlib.contextmanager
def serving(store: Path, **limits: float) -> Iterator[Client]:
    """A client of a portal on ``store``; ``limits`` are fields of its configuration."""
    portal = Portal(PortalConfig(store, port=0, token=TOKEN, **limits))  # type: ignore[arg-type]
    portal.start()
    try:
        yield Client(portal)
    finally:
        portal.close()


@contextlib.contextmanager
def listing(browser: Browser, store: Path, scans: int) -> Iterator[str]:
    """The address of a portal on ``store``, whose list of that many scans the browser shows."""
    with serving(store) as client:
        browser.screen(1280, 800)
        browser.open("about:blank")
        browser.open(f"{client.base}/?token={TOKEN}")
        browser.wait(f"document.querySelectorAll('article').length === {scans}")
        yield client.base


class FakeOperator:
    """Stands in for mavsdk: answers orders and lets a test say what the vehicle sends."""

    system = 7

    def __init__(self, result: int = 0) -> None:
        self.result, self.closed = result, False
        self.commands: list[tuple[int, int, tuple[float, ...]]] = []
        self.callbacks: dict[str, Any] = {}

    def subscribe(self, name: str, callback: Any) -> Callable[[], None]:
        self.callbacks[name] = callback
        return lambda: None

    def command(self, number: int, component: int, params: tuple[float, ...] = ()) -> Any:
        from service.ground.operator import Ack

        self.commands.append((number, component, params))
        return Ack(7, component, self.result)

    def __exit__(self, *_: object) -> None:
        self.closed = True


@pytest.fixture
def store(tmp_path: Path, house: HouseFlight) -> Path:
    """A library with one scan."""
    return flown_store(tmp_path / "scans", house)


@pytest.fixture
def client(store: Path) -> Iterator[Client]:
    """Of a portal on ``store``."""
    with serving(store) as client:
        yield client


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """One Chromium for all tests of a file. It draws in software, so its pixels are coarse."""
    api = pytest.importorskip("playwright.sync_api")
    with api.sync_playwright() as driver:
        yield Browser(driver, "--force-device-scale-factor=0.5", "--disable-gpu-rasterization")
