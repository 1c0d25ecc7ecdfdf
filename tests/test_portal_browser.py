"""The portal's pages in a real browser (Chromium by its DevTools protocol); skipped without one."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")
pytest.importorskip("websockets")

from service.ground.http import PAGE, Portal, PortalConfig
from service.scan_folder import write_deliverables
from service.stream.codec import encode
from service.stream.records import Repose
from service.stream.store import ScanStore

if TYPE_CHECKING:
    from conftest import HouseFlight

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), ""
)
pytestmark = [
    pytest.mark.skipif(not CHROMIUM, reason="needs Chromium"),
    pytest.mark.skipif(not (PAGE / "index.html").is_file(), reason="needs the built page"),
]
TOKEN = "a-token-of-enough-letters"


class Browser:
    """One page of a headless Chromium."""

    def __init__(self, profile: Path) -> None:
        from websockets.sync.client import connect

        flags = "--headless=new --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader"
        flags += " --remote-debugging-port=0 --window-size=1280,800 --disable-extensions"
        flags += " --no-first-run --disable-background-networking --disable-dev-shm-usage"
        self.process = subprocess.Popen(
            [CHROMIUM, *flags.split(), f"--user-data-dir={profile}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        port_file = profile / "DevToolsActivePort"
        self._until(lambda: port_file.is_file() and port_file.read_text().count("\n") > 0)
        port = port_file.read_text().split()[0]
        pages = json.load(urllib.request.urlopen(f"http://127.0.0.1:{port}/json"))
        page = next(p for p in pages if p["type"] == "page")
        self._socket = connect(page["webSocketDebuggerUrl"], max_size=None)
        self._number = 0
        self.requests: list[str] = []
        self.dialog = ""  # what the next prompt is answered with
        for domain in ("Page", "Runtime", "Network"):
            self.call(f"{domain}.enable")

    def close(self) -> None:
        self._socket.close()
        self.process.terminate()
        self.process.wait(timeout=10)

    def call(self, method: str, **params: Any) -> Any:
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": params}))
        wanted = self._number
        while True:
            message = json.loads(self._socket.recv(timeout=30))
            if message.get("id") == wanted:
                assert "error" not in message, message
                return message["result"]
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        if message.get("method") == "Network.requestWillBeSent":
            self.requests.append(message["params"]["request"]["url"])
        if message.get("method") == "Page.javascriptDialogOpening":
            self._number += 1
            params = {"accept": True, "promptText": self.dialog}
            answer = {"method": "Page.handleJavaScriptDialog", "params": params}
            self._socket.send(json.dumps({"id": self._number, **answer}))

    def run(self, script: str) -> Any:
        found = self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def open(self, url: str) -> None:
        self.call("Page.navigate", url=url)

    def wait(self, script: str, timeout_s: float = 20.0) -> Any:
        """The first true value of ``script``; a page that is still loading has none."""
        quiet = f"(() => {{ try {{ return {script} }} catch {{ return null }} }})()"
        return self._until(lambda: self.run(quiet), timeout_s)

    def click(self, text: str) -> None:
        """Click the button with this text, as an event of its own."""
        find = f"[...document.querySelectorAll('button')].find(b => b.textContent === '{text}')"
        self.wait(f"!!{find}")
        self.run(f"setTimeout(() => {find}.click(), 0)")
        self.run("new Promise(r => setTimeout(r, 50))")

    def picture(self, path: Path) -> None:
        data = self.call("Page.captureScreenshot", format="png")["data"]
        path.write_bytes(base64.b64decode(data))

    def _until(self, true: Any, timeout_s: float = 20.0) -> Any:
        deadline = time.monotonic() + timeout_s
        while not (value := true()):
            assert time.monotonic() < deadline, "the page did not get there"
            assert self.process.poll() is None, "the browser ended"
            time.sleep(0.05)
        return value


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    one = Browser(tmp_path_factory.mktemp("chromium"))
    yield one
    one.close()


@pytest.fixture
def scans(tmp_path: Path, house: HouseFlight) -> Path:
    folder = tmp_path / "drone-1" / "test-1"
    with house.flown(folder) as scan:
        write_deliverables(folder, scan, {})
    return tmp_path


@pytest.fixture
def portal(scans: Path) -> Iterator[Portal]:
    one = Portal(PortalConfig(scans, port=0, token=TOKEN))
    one.start()
    yield one
    one.close()


def base(portal: Portal) -> str:
    return portal.url.split("/?")[0]


def test_rename_download_delete_and_bring_back(browser: Browser, portal: Portal) -> None:
    browser.open(portal.url)
    browser.wait("document.querySelectorAll('article').length === 1")
    assert browser.run("location.search") == ""  # the token is out of the address
    browser.dialog = "<img src=x onerror=alert(1)> Hof"
    browser.click("Rename")
    browser.wait("document.querySelector('h2').textContent.startsWith('<img')")
    assert browser.run("document.querySelectorAll('article h2 img').length") == 0
    browser.dialog = "roof, spring"
    browser.click("Tags")
    browser.wait("document.querySelectorAll('.tags span').length === 2")
    browser.run("document.querySelector('details').open = true")
    size = browser.run(
        "fetch([...document.querySelectorAll('details a')].find(a => a.textContent ==="
        " 'cloud.laz').href).then(r => r.arrayBuffer()).then(b => b.byteLength)"
    )
    assert size > 10_000
    browser.click("Delete")
    browser.wait("document.querySelectorAll('article').length === 0")
    browser.click("Bring back")
    browser.wait("document.querySelectorAll('article').length === 1")
    assert browser.run("document.querySelector('h2').textContent").startswith("<img")


def test_the_cloud_grows_and_moves_while_one_looks(
    browser: Browser, portal: Portal, scans: Path, house: HouseFlight
) -> None:
    browser.requests.clear()
    browser.open(f"{base(portal)}/#/view/drone-1/test-1")
    before = browser.wait("Number(document.body.dataset.points) || 0")
    with ScanStore.open(scans / "drone-1/test-1/scan.db") as scan:
        one = house.keyframe(5, 30.0)
        scan.add_keyframe(5, encode(one, one.time_ns))
        scan.add_repose(Repose(1, 1, house.pose(7.0), 1.0, np.eye(6)))
        scan.add_pose(house.record(5, 30.0))
    browser.wait(f"Number(document.body.dataset.points) > {before}")
    browser.wait("document.querySelector('.figures').textContent.includes('25 m')")
    browser.wait("Number(document.body.dataset.fps) > 0", 40)
    outside = [u for u in browser.requests if not u.startswith((base(portal), "data:", "ws:"))]
    assert [u for u in outside if not u.startswith(("blob:", "about:", "chrome"))] == []


def test_the_mesh_is_made_and_shown(browser: Browser, portal: Portal) -> None:
    pytest.importorskip("open3d")
    browser.open(portal.url)
    browser.wait("document.querySelectorAll('article').length === 1")
    browser.open(f"{base(portal)}/#/view/drone-1/test-1")
    browser.wait("Number(document.body.dataset.points) || 0")
    browser.click("Mesh")
    browser.wait("document.body.dataset.mesh === 'shown'", 60)
