"""``skyrelief bench portal``: the page in a headless Chromium, drawn in software.

Page load on loopback, from a keyframe in the receiver's store to its points in the browser,
and ten million points: frame times while flying, and how long all of them take, slice by
slice. SwiftShader draws on the processor: a graphics card is one to two orders of magnitude
faster. The browser is driven over its DevTools protocol.
"""

from __future__ import annotations

import json
import shutil
import statistics
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from service.bench import BenchOptions, BenchResult
from service.bench.keyframes import make_keyframe
from service.errors import OutsideError
from service.ground.http import PAGE
from service.ground.portal import Portal, PortalConfig
from service.stream.codec import encode
from service.stream.records import ScanHeader
from service.stream.store import ScanStore

FLAGS = (
    "--headless=new --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader"
    " --remote-debugging-port=0 --window-size=1280,800 --disable-extensions --no-first-run"
    " --disable-background-networking --disable-dev-shm-usage"
)
ANSWER_S = 180.0


def chromium() -> str:
    """The path of a Chromium on this machine; empty when there is none."""
    names = ("chromium", "chromium-browser", "google-chrome")
    return next(filter(None, map(shutil.which, names)), "")


class Page:
    """One page of a browser."""

    def __init__(
        self,
        process: subprocess.Popen[bytes],
        address: str,
        domains: tuple[str, ...] = ("Page", "Runtime", "Network"),
    ) -> None:
        """Take over the page whose DevTools answer at the WebSocket ``address``."""
        from websockets.sync.client import connect

        self.process = process
        self._socket = connect(address, max_size=None)
        self._number = 0
        for domain in domains:
            self.call(f"{domain}.enable")

    def leave(self) -> None:
        """Close the page."""
        self._socket.close()

    def call(self, method: str, **params: Any) -> Any:
        """The result of a DevTools method; RuntimeError when it fails."""
        wanted = self._send(method, params)
        while True:
            message = json.loads(self._socket.recv(timeout=ANSWER_S))
            if message.get("id") == wanted:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error']}")
                return message["result"]
            self._note(message)

    def _send(self, method: str, params: dict[str, Any]) -> int:
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": params}))
        return self._number

    def _note(self, event: dict[str, Any]) -> None:
        """Called with each event of the page."""

    def run(self, script: str) -> Any:
        """The value of ``script``, awaited; RuntimeError when it throws."""
        found = self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        if "exceptionDetails" in found:
            raise RuntimeError(str(found["exceptionDetails"])[:300])
        return found["result"].get("value")

    def open(self, url: str) -> None:
        """Go to ``url``; does not wait."""
        self.call("Page.navigate", url=url)

    def wait(self, script: str, timeout_s: float = 60.0) -> Any:
        """The first true value of ``script``; a page that is still loading has none."""
        quiet = f"(() => {{ try {{ return {script} }} catch {{ return null }} }})()"
        return self.until(lambda: self.run(quiet), timeout_s)

    def until(self, true: Callable[[], Any], timeout_s: float = 60.0) -> Any:
        """The first true value of ``true()``; RuntimeError after ``timeout_s``."""
        deadline = time.monotonic() + timeout_s
        while not (value := true()):
            if time.monotonic() >= deadline:
                raise RuntimeError("the page did not get there")
            if self.process.poll() is not None:
                raise RuntimeError("the browser ended")
            time.sleep(0.05)
        return value


class Browser(Page):
    """A Chromium and its first page; close it at the end."""

    def __init__(self, profile: Path, *flags: str) -> None:
        """Start Chromium with a fresh ``profile`` folder."""
        self.process = subprocess.Popen(
            [chromium(), *FLAGS.split(), *flags, f"--user-data-dir={profile}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        port_file = profile / "DevToolsActivePort"
        self.until(lambda: port_file.is_file() and port_file.read_text().count("\n") > 0)
        self.host = f"127.0.0.1:{port_file.read_text().split()[0]}"
        pages = json.load(urllib.request.urlopen(f"http://{self.host}/json"))
        page = next(p for p in pages if p["type"] == "page")
        super().__init__(self.process, page["webSocketDebuggerUrl"])

    def close(self) -> None:
        """End the browser."""
        self.leave()
        self.process.terminate()
        self.process.wait(timeout=10)


NOTE = "software rendering (SwiftShader), 1280x800"
LARGE_PX = (640, 360)
KEYFRAMES = 44  # of 230,400 points: ten million
ARRIVALS = 15
SETTLING, FRAMES, WHOLE_IMAGES = 16, 20, 3
TOKEN = "a-token-for-the-benchmark"
FRAME_TIMES = """new Promise(done => {
  const gl = document.querySelector('.stage canvas').getContext('webgl2');
  const pixel = new Uint8Array(4);
  const press = (kind, key) => dispatchEvent(new KeyboardEvent(kind, { key }));
  const times = []; let last = performance.now(), key = 'd';
  press('keydown', key);
  const tick = () => {
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);  // waits for the drawing
    const now = performance.now();
    times.push(now - last); last = now;
    press('keyup', key);
    key = key === 'd' ? 'a' : 'd';  // to and fro, so that the scan stays in sight
    if (times.length > %d) return done(times.slice(2));
    press('keydown', key);
    requestAnimationFrame(tick);
  };
  requestAnimationFrame(tick);
})"""
BUDGET = """(() => {
  const label = [...document.querySelectorAll('.settings label')]
    .find(l => l.textContent.startsWith('Points drawn'));
  const input = label.querySelector('input'); input.value = '7.1'; input.oninput();
})()"""
ALL_DRAWN = """new Promise(done => {
  const press = (kind) => dispatchEvent(new KeyboardEvent(kind, { key: 'd' }));
  const times = []; let last = performance.now(), begun = false, still = 0;
  press('keydown');
  setTimeout(() => { press('keyup'); still = performance.now(); }, 500);
  const tick = () => {
    const now = performance.now(), drawn = Number(document.body.dataset.drawn);
    times.push(now - last); last = now;
    begun ||= still > 0 && drawn < %(points)d;
    if (begun && drawn >= %(points)d) return done([now - still, ...times]);
    requestAnimationFrame(tick);
  };
  requestAnimationFrame(tick);
})"""


def run(options: BenchOptions) -> list[BenchResult]:
    """The figures; OutsideError without Chromium or without the built page."""
    if not chromium():
        raise OutsideError("bench portal needs Chromium; apt install chromium")
    if not (PAGE / "index.html").is_file():
        raise OutsideError("bench portal needs the portal's page; see CONTRIBUTING.md")
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        store = _large_scan(root / "scans" / "bench" / "large")
        growing = ScanStore.create(root / "scans" / "bench" / "live" / "scan.db", _header("live"))
        with store, growing, _page(root) as (browser, base):
            load = _page_loads(browser, base, max(3, options.rounds // 5))
            arrivals = _arrivals(browser, base, growing)
            flying, whole, stops = _frame_times(browser, base)
    return [
        _result("page load, cold cache, list drawn", load),
        _result("keyframe in the store to points in the browser", arrivals),
        _result("frame while flying over 10.1 M points, thinned to keep up", flying),
        _result("all 10.1 M points drawn after a movement, slice by slice", whole),
        _result("longest stop of the page meanwhile", stops),
    ]


def _result(what: str, times_ms: list[float]) -> BenchResult:
    tenths = statistics.quantiles(times_ms, n=10) if len(times_ms) > 1 else [0.0, 0.0]
    note = f"{NOTE}; worst {max(times_ms):.0f} ms"
    middle = statistics.median(times_ms)
    return BenchResult("portal", what, middle, "ms", tenths[-1] - tenths[0], note=note)


def _header(scan: str) -> ScanHeader:
    return ScanHeader(scan, "bench", 1_700_000_000_000_000_000)


def _large_scan(folder: Path) -> ScanStore:
    """Ten million points in 44 keyframes, finished."""
    store = ScanStore.create(folder / "scan.db", _header("large"))
    for seq in range(KEYFRAMES):
        store.add_keyframe(seq, encode(make_keyframe(seq, LARGE_PX), seq))
    store.finish({})
    return store


@contextmanager
def _page(root: Path) -> Iterator[tuple[Browser, str]]:
    """A browser and the address of a portal on the scans below ``root``."""
    portal = Portal(PortalConfig(root / "scans", port=0, token=TOKEN))
    portal.start()
    browser = Browser(root / "profile")
    try:
        yield browser, portal.url.split("/?")[0]
    finally:
        browser.close()
        portal.close()


def _page_loads(browser: Browser, base: str, rounds: int) -> list[float]:
    """Milliseconds from the request to the list of scans, nothing from the cache."""
    browser.call("Network.setCacheDisabled", cacheDisabled=True)
    times = []
    for _ in range(rounds):
        browser.open("about:blank")
        browser.wait("location.href === 'about:blank'")
        started = time.perf_counter()
        browser.open(base)
        browser.wait("document.querySelectorAll('article').length === 2")
        times.append(1e3 * (time.perf_counter() - started))
    return times


def _arrivals(browser: Browser, base: str, store: ScanStore) -> list[float]:
    """Milliseconds from a keyframe's commit to its points in the scene."""
    browser.open(f"{base}/#/view/bench/live")
    browser.wait("document.querySelector('.state').classList.contains('receiving')")
    times = []
    for seq in range(ARRIVALS):
        layers = encode(make_keyframe(seq), seq)
        committed = 1e3 * time.time()
        store.add_keyframe(seq, layers)
        at = browser.wait(
            f"document.body.dataset.chunk?.startsWith('{seq} ') && document.body.dataset.chunk", 30
        )
        times.append(float(at.split()[1]) - committed)
        time.sleep(0.07 * (seq % 5))  # every phase of the portal's own beat
    return times


def _frame_times(browser: Browser, base: str) -> tuple[list[float], list[float], list[float]]:
    """Milliseconds of frames while flying over the scan, until all of it is drawn, of stops."""
    points = KEYFRAMES * LARGE_PX[0] * LARGE_PX[1]
    browser.open(f"{base}/#/view/bench/large")
    browser.wait(f"Number(document.body.dataset.points) >= {0.99 * points}", 120)
    browser.run(BUDGET)
    browser.run(FRAME_TIMES % SETTLING)  # until the page knows what this machine can draw
    flying = [float(t) for t in browser.run(FRAME_TIMES % FRAMES)]
    whole, stops = [], []
    for _ in range(WHOLE_IMAGES):
        total, *ticks = browser.run(ALL_DRAWN % {"points": round(0.99 * points)})
        whole.append(float(total))
        stops.append(max(float(t) for t in ticks))
    return flying, whole, stops
