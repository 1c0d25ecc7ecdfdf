"""The portal on a telephone, by keyboard and for a screen reader; in a real browser."""

from __future__ import annotations

import json
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pytest
from person import Browser
from portal_client import NEEDS, ONE, TOKEN, Client, browser, flown_store

from service.ground.http import PAGE
from service.ground.portal import Portal, PortalConfig
from service.ground.state import Job
from service.stream.records import ScanHeader
from service.stream.store import ScanStore

if TYPE_CHECKING:
    from house_flight import HouseFlight

pytestmark = NEEDS
__all__ = ["browser"]  # the fixture

AXE = PAGE.parent / "node_modules/axe-core/axe.min.js"
ALL = """axe.run().then(found => found.violations
  .map(v => v.id + ': ' + v.nodes.map(n => n.html).join(' ').slice(0, 300)))"""
SERIOUS = """axe.run().then(found => found.violations
  .filter(v => v.impact === 'serious' || v.impact === 'critical')
  .map(v => v.id + ': ' + v.nodes.map(n => n.html).join(' ').slice(0, 300)))"""
PHONE = (390, 844)


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory, house: HouseFlight) -> Iterator[str]:
    portal = Portal(
        PortalConfig(flown_store(tmp_path_factory.mktemp("scans"), house), port=0, token=TOKEN)
    )
    portal.start()
    yield portal.url.split("/?")[0]
    portal.close()


def show(browser: Browser, address: str, size: tuple[int, int]) -> None:
    browser.screen(*size, mobile=size == PHONE)
    browser.open("about:blank")
    browser.open(address)
    browser.wait("!!document.querySelector('h1')")
    if address.endswith(("/view/drone-1/test-1", "/site-1")):
        browser.wait("document.body.dataset.points === '72000'")
        browser.wait("document.body.dataset.image === '4'")


def box(browser: Browser, selector: str) -> dict[str, float]:
    """Where an element is seen, CSS pixels."""
    found: Any = browser.run(
        f"document.querySelector('{selector}').getBoundingClientRect().toJSON()"
    )
    return dict(found)


def test_on_a_telephone_nothing_is_out_of_reach(browser: Browser, base: str) -> None:
    show(browser, base, PHONE)
    browser.wait("document.querySelectorAll('article').length === 1")
    browser.run("document.querySelectorAll('details').forEach(d => d.open = true)")
    for selector in (".import input", ".import button", "article .acts", ".overview .map"):
        assert 0 <= box(browser, selector)["left"] < box(browser, selector)["right"] <= PHONE[0]
    acts = browser.run(
        "[...document.querySelectorAll('article .acts :is(a, button, summary)')]"
        ".map(e => e.getBoundingClientRect().right)"
    )
    card = box(browser, "article")
    assert len(acts) >= 7 and max(acts) < card["right"]  # what lies outside is cut off
    assert browser.run("document.documentElement.scrollWidth") <= PHONE[0]
    show(browser, f"{base}/#/view/drone-1/test-1", PHONE)
    middles = browser.run(
        "(() => { const state = document.querySelector('header > .state');"
        " state.textContent = 'finished'; state.className = 'state finished';"
        " for (const a of document.querySelectorAll('header > a'))"
        " a.hidden = a.matches('.newer') || a.href.endsWith('change.html');"
        " return [...document.querySelectorAll('header > :is(a, h1, .menu, .state)')]"
        ".filter(e => e.checkVisibility()).map(e => e.getBoundingClientRect())"
        ".map(b => (b.top + b.bottom) / 2).sort((a, b) => a - b) })()"
    )
    upper, lower = middles[:3], middles[3:]  # way back, name, menu; state, map, report
    assert len(lower) == 3 and max(np.ptp(upper), np.ptp(lower)) < 10
    name = "document.querySelector('h1')"
    assert browser.run(f"{name}.scrollHeight <= {name}.clientHeight")  # the whole name is read
    browser.click("Measure")
    assert browser.run("document.documentElement.scrollWidth") <= PHONE[0]
    assert browser.run("document.documentElement.scrollHeight") <= PHONE[1]
    stage, side = box(browser, ".stage"), box(browser, ".side")
    assert stage["width"] == PHONE[0] and stage["height"] > 0.4 * PHONE[1]
    panels = [box(browser, f".side .{name}") for name in ("measure", "figures", "latest")]
    for upper, lower in zip([stage, *panels], panels, strict=False):
        assert upper["bottom"] <= lower["top"]  # no panel lies over another, or over the cloud
        assert lower["right"] <= PHONE[0] and side["bottom"] <= PHONE[1]
    show(browser, f"{base}/api/scans/drone-1/test-1/files/report.html", PHONE)
    assert browser.run("document.documentElement.scrollWidth") <= PHONE[0]


def test_no_panel_lies_over_the_time_slider(browser: Browser, base: str) -> None:
    show(browser, f"{base}/#/view/drone-1/test-1", (760, 700))
    time = box(browser, ".time")
    for name in ("figures", "latest"):
        assert box(browser, f".side .{name}")["bottom"] <= time["top"]


def test_a_product_is_made_by_keyboard_once_it_is_asked_for(browser: Browser, base: str) -> None:
    show(browser, f"{base}/?token={TOKEN}", (1440, 900))
    browser.wait("document.querySelectorAll('article').length === 1")
    browser.run("document.querySelector('[aria-label^=\"Export \"]').focus()")
    browser.key("Enter")
    browser.wait("document.querySelectorAll('.product').length > 20")
    jobs = "fetch('/api/scans/drone-1/test-1').then(r => r.json()).then(s => s.jobs.length)"
    assert browser.run(f"new Promise(r => setTimeout(r, 300)).then(() => {jobs})") == 0
    browser.run("document.querySelector('[aria-label=\"Make Track, KML\"]').focus()")
    browser.key("Enter")
    browser.wait("!!document.querySelector('[aria-label=\"Download Track, KML\"]')")
    focused = "document.activeElement.getAttribute('aria-label')"
    assert browser.run(focused) == "Download Track, KML"
    browser.key("Escape")
    browser.wait("!document.querySelector('dialog')")
    assert browser.wait(focused).startswith("Export ")  # back where it was opened


@pytest.fixture(scope="module")
def station(tmp_path_factory: pytest.TempPathFactory, house: HouseFlight) -> Iterator[Portal]:
    """A portal with a scan that is received, a site, a broken scan and a bin."""
    store = flown_store(tmp_path_factory.mktemp("busy"), house)
    scan = store / "drone-1/test-1"
    site = Path(shutil.copytree(scan, store / "drone-1/site-1"))
    parts = [{"name": "west", "keyframes": [0, 1]}, {"name": "east", "keyframes": [2, 4]}]
    (site / "site.json").write_text(json.dumps({"scans": parts}))
    broken = Path(shutil.copytree(scan, store / "drone-2/broken"))
    (broken / "scan.json").write_text("{")
    shutil.copytree(scan, store / ".bin/drone-1~old~1")
    entry = {
        "drone": "drone-1", "scan": "test-1", "heard_unix_s": time.time() + 600.0, "open": True,
        "received_bytes": 1000, "lag_s": {"k0": 0.4}, "missing": {"k1": 2},
    }  # fmt: skip
    portal = Portal(PortalConfig(store, port=0, token=TOKEN), lambda: [entry])
    portal.start()
    yield portal
    portal.close()


@pytest.fixture
def busy(station: Portal) -> Iterator[str]:
    """The address of that portal, with a job that is half done until the test ends."""
    ended = threading.Event()

    def half(job: Job) -> str:
        for n in job.progress.over(range(2), 2):
            if n:
                ended.wait(60.0)
        return "dsm.tif"

    station.jobs.carry_out = half
    client = Client(station)
    assert client.ask(ONE + "/exports", "POST", {"kind": "dsm"})[0] == 202
    yield client.base
    ended.set()


def axe(browser: Browser, page: str, image: Path, findings: str = SERIOUS) -> list[str]:
    """What axe finds on the page that is shown."""
    browser.run(AXE.read_text() + ";0")
    browser.image(image / f"{page}.png")  # to look at
    return [f"{page}: {finding}" for finding in browser.run(findings)]


@pytest.mark.skipif(not AXE.is_file(), reason="needs axe-core (npm ci in service/ground/web)")
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [(1440, 900), PHONE])
def test_axe_finds_nothing_serious(
    browser: Browser,
    busy: str,
    size: tuple[int, int],
    scheme: Literal["light", "dark"],
    tmp_path: Path,
) -> None:
    found: list[str] = []
    browser.page.emulate_media(color_scheme=scheme)
    show(browser, busy, size)
    browser.wait("document.querySelectorAll('article').length === 3")
    browser.wait("document.querySelector('.jobs li') !== null")
    browser.run("document.querySelectorAll('details').forEach(d => d.open = true)")
    found += axe(browser, "library", tmp_path)
    browser.click("Export…")
    browser.wait("document.querySelectorAll('.product').length > 20")
    found += axe(browser, "export", tmp_path)
    browser.key("Escape")
    show(browser, f"{busy}/#/view/drone-1/test-1", size)
    browser.wait("document.querySelector('.state').classList.contains('receiving')")
    browser.wait("document.querySelector('.side .jobs progress')?.value === 50")
    for name in ("Measure", "Coverage"):
        browser.click(name)
    found += axe(browser, "live", tmp_path)
    browser.click("Notes")
    browser.run("document.querySelectorAll('details.group').forEach(d => d.open = true)")
    found += axe(browser, "open", tmp_path)
    show(browser, f"{busy}/#/view/drone-1/site-1", size)
    browser.run(
        "(s => { s.value = 'scan'; s.dispatchEvent(new Event('change', { bubbles: true })) })"
        "(document.querySelector('[aria-label=\"colour by\"]'))"
    )
    browser.wait("!document.querySelector('.legend').hidden")
    for _ in range(2):
        with browser.page.expect_response(lambda answer: answer.url.endswith("/api/jobs")):
            pass
    assert browser.run("document.querySelector('.side .jobs li')") is None  # is of another scan
    found += axe(browser, "site", tmp_path)
    show(browser, f"{busy}/#/view/drone-1/nothing", size)
    found += axe(browser, "unknown", tmp_path)
    show(browser, f"{busy}/#/map/drone-1/test-1", size)
    browser.wait("document.body.dataset.map === 'shown'")
    found += axe(browser, "map", tmp_path)
    browser.open((next(tmp_path.parent.glob("busy*")) / "drone-1/test-1/report.html").as_uri())
    browser.wait("!!document.querySelector('h1')")
    found += axe(browser, "report", tmp_path)
    assert found == []


@pytest.mark.skipif(not AXE.is_file(), reason="needs axe-core (npm ci in service/ground/web)")
def test_axe_finds_nothing_while_a_drone_begins_falls_silent_and_the_station_stops(
    browser: Browser, house: HouseFlight, tmp_path: Path
) -> None:
    entry = {"drone": "drone-1", "scan": "begun", "heard_unix_s": time.time() + 600.0}
    header = ScanHeader("begun", "drone-1", house.start_ns, software="0.0")
    with ScanStore.create(tmp_path / "scans/drone-1/begun/scan.db", header) as store:
        store.add_pose(house.record(0, 0.0))
    portal = Portal(PortalConfig(tmp_path / "scans", port=0, token=TOKEN), lambda: [entry])
    portal.start()
    base = portal.url.split("/?")[0]
    browser.open(portal.url)
    show(browser, f"{base}/#/view/drone-1/begun", PHONE)
    browser.wait("document.querySelector('.state').classList.contains('receiving')")
    found = axe(browser, "first poses", tmp_path, ALL)
    entry["heard_unix_s"] = time.time() - 60.0
    browser.wait("document.querySelector('.state').classList.contains('silent')", 30)
    found += axe(browser, "silent", tmp_path, ALL)
    show(browser, f"{base}/#/map/drone-1/begun", PHONE)
    browser.wait("document.querySelector('.state').textContent === 'silent'")
    portal.close()
    browser.wait("document.querySelector('.state').textContent.includes('does not answer')", 30)
    found += axe(browser, "stopped", tmp_path, ALL)
    browser.open("about:blank")
    assert found == []
