"""The page in a headless Chromium, drawn in software.

Page load on loopback, from the list to the first points of a scan, from a keyframe in the
receiver's store to its surface on the screen and to the tiles of the map, and ten million points:
frame times while flying, and how long all of them take, slice by slice. SwiftShader draws on the
processor: a graphics card is one to two orders of magnitude faster.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from person import Browser, chromium
from playwright.sync_api import sync_playwright

from service.bench import BenchOptions, BenchResult
from service.bench.keyframes import make_keyframe
from service.errors import OutsideError
from service.ground.http import PAGE
from service.ground.portal import Portal, PortalConfig
from service.stream.codec import encode
from service.stream.records import ScanHeader
from service.stream.store import ScanStore

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
POINTS = "[...document.querySelectorAll('button')].find(b => b.textContent === 'Points').click()"
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
            first = _first_points(browser, base, max(3, options.rounds // 5))
            arrivals, on_screen = _arrivals(browser, base, growing)
            tiles = _tiles_arrive(browser, base, growing)
            surface, flying, whole, stops = _frame_times(browser, base)
    return [
        _result("page load, cold cache, list drawn", load),
        _result("from the list to the first points of 10.1 M", first),
        _result("keyframe in the store to points in the browser", arrivals),
        _result("keyframe in the store to its surface on the screen", on_screen),
        _result("keyframe in the store to all tiles of the map", tiles),
        _result("frame while flying over surfaces of 10.1 M points, coarser to keep up", surface),
        _result("frame while flying over 10.1 M points, thinned to keep up", flying),
        _result("all 10.1 M points drawn after a movement, slice by slice", whole),
        _result("longest stop of the page meanwhile", stops),
    ]


def _result(what: str, times_ms: list[float]) -> BenchResult:
    tenths = statistics.quantiles(times_ms, n=10) if len(times_ms) > 1 else [0.0, 0.0]
    note = f"{NOTE}; worst {max(times_ms):.0f} ms"
    middle = statistics.median(times_ms)
    return BenchResult(what, middle, "ms", tenths[-1] - tenths[0], note=note)


def _header(scan: str) -> ScanHeader:
    return ScanHeader(scan, "bench", 1_700_000_000_000_000_000, 47.39, 8.54, 408.0)


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
    try:
        with sync_playwright() as driver:
            yield Browser(driver), portal.url.split("/?")[0]
    finally:
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


def _first_points(browser: Browser, base: str, rounds: int) -> list[float]:
    """Milliseconds from a click on the large scan in the list to points in the scene."""
    times = []
    for _ in range(rounds):
        browser.open(base)
        browser.wait("document.querySelectorAll('article').length === 2")
        browser.run("delete document.body.dataset.chunk")
        started = browser.run(
            "(document.querySelector('article h2 a[href$=\"/large\"]').click(), Date.now())"
        )
        at = browser.wait("document.body.dataset.chunk")
        times.append(float(at.split()[1]) - started)
        browser.open("about:blank")
        browser.wait("location.href === 'about:blank'")
    return times


ON_SCREEN = """new Promise(done => {
  const gl = document.querySelector('.stage canvas').getContext('webgl2');
  const drawn = () => {
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    done(Date.now());
  };
  const look = () => {
    if (!document.body.dataset.chunk?.startsWith('%d ')) return requestAnimationFrame(look);
    requestAnimationFrame(() => requestAnimationFrame(drawn));  // which is drawn meanwhile
  };
  look();
})"""
"""The time when the frame after a keyframe's coming is drawn."""


def _arrivals(browser: Browser, base: str, store: ScanStore) -> tuple[list[float], list[float]]:
    """Milliseconds from a keyframe's commit until it is in the scene, and on the screen."""
    browser.open(f"{base}/#/view/bench/live")
    browser.wait("!document.querySelector('.state').classList.contains('cut')")
    came, shown = [], []
    for seq in range(ARRIVALS):
        layers = encode(make_keyframe(seq), seq)
        browser.run(f"(() => {{ window.onScreen = {ON_SCREEN % seq}; }})()")
        committed = 1e3 * time.time()
        store.add_keyframe(seq, layers)
        shown.append(float(browser.wait("window.onScreen", 60)) - committed)
        came.append(float(browser.run("document.body.dataset.chunk").split()[1]) - committed)
        time.sleep(0.07 * (seq % 5))  # every phase of the portal's own beat
    return came, shown


MAP_SHOWN = "document.body.dataset.map === 'shown'"
TILES = "[...document.querySelectorAll('.layer img')].map(i => i.src.split('?v=')[1])"


def _tiles_arrive(browser: Browser, base: str, store: ScanStore) -> list[float]:
    """Milliseconds from a keyframe's commit until the map shows it, no tile missing."""
    browser.open(f"{base}/#/map/bench/live")
    browser.wait(MAP_SHOWN)
    times = []
    for seq in range(ARRIVALS, 2 * ARRIVALS):
        layers, before = encode(make_keyframe(seq), seq), browser.run(TILES)
        started = time.perf_counter()
        store.add_keyframe(seq, layers)
        browser.wait(f"{MAP_SHOWN} && {TILES}.some(v => !{before}.includes(v))", 30)
        times.append(1e3 * (time.perf_counter() - started))
        time.sleep(0.13 * (seq % 15))  # every phase of the page's own round
    return times


def _frame_times(
    browser: Browser, base: str
) -> tuple[list[float], list[float], list[float], list[float]]:
    """Milliseconds of frames while flying over surfaces and over points, until all points are
    drawn, of stops."""
    points = KEYFRAMES * LARGE_PX[0] * LARGE_PX[1]
    browser.open(f"{base}/#/view/bench/large")
    browser.wait(f"Number(document.body.dataset.points) >= {0.99 * points}", 120)
    browser.run(FRAME_TIMES % SETTLING)
    surface = [float(t) for t in browser.run(FRAME_TIMES % FRAMES)]
    browser.run(POINTS)
    browser.run(BUDGET)
    browser.run(FRAME_TIMES % SETTLING)  # until the page knows what this machine can draw
    flying = [float(t) for t in browser.run(FRAME_TIMES % FRAMES)]
    whole, stops = [], []
    for _ in range(WHOLE_IMAGES):
        total, *ticks = browser.run(ALL_DRAWN % {"points": round(0.99 * points)})
        whole.append(float(total))
        stops.append(max(float(t) for t in ticks))
    return surface, flying, whole, stops
