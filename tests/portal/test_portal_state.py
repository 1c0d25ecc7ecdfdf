"""The portal says how things stand: live state, unknown scans, the list; in a real browser."""

from __future__ import annotations

import contextlib
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from person import Browser
from portal_client import NEEDS, TOKEN, browser, flown_store

from service.ground.live import LiveFeed
from service.ground.portal import Portal, PortalConfig
from service.scans.folder import write_deliverables
from service.stream.codec import encode
from service.stream.records import ScanHeader
from service.stream.store import ScanStore

if TYPE_CHECKING:
    from house_flight import HouseFlight

pytestmark = NEEDS
__all__ = ["browser"]  # the fixture

STATE = "document.querySelector('.state').textContent"


@contextlib.contextmanager
def page_of(browser: Browser, store: Path, entries: list[dict[str, Any]]) -> Iterator[str]:
    """The address of a portal whose receiver says ``entries``."""
    portal = Portal(PortalConfig(store, port=0, token=TOKEN), lambda: entries)
    portal.start()
    browser.open("about:blank")
    try:
        browser.open(portal.url)
        browser.wait("document.querySelector('h1').textContent === 'skyrelief'")
        yield portal.url.split("/?")[0]
    finally:
        browser.open("about:blank")
        portal.close()


@pytest.fixture
def scans(tmp_path: Path, house: HouseFlight) -> Path:
    return flown_store(tmp_path / "scans", house)


def kind(browser: Browser, wanted: str) -> None:
    browser.wait(f"document.querySelector('.state').classList.contains('{wanted}')", 30)


def test_logging_out_ends_the_session(browser: Browser, scans: Path) -> None:
    may_change = "fetch('/api/upload').then(answer => String(answer.status))"
    with page_of(browser, scans, []):
        browser.wait(f"await {may_change} !== '401'")
        shown = "[...document.querySelectorAll('header button')].filter(b => b.checkVisibility())"
        browser.wait(f"{shown}.some(b => b.textContent === 'Log out')")
        browser.click("Log out")
        browser.wait(f"await {may_change} === '401'")
        browser.wait("document.querySelectorAll('article').length === 1")  # this machine may read
        assert "Log out" not in browser.run(f"{shown}.map(b => b.textContent)")


def test_the_state_says_when_the_drone_was_heard(browser: Browser, scans: Path) -> None:
    entry = {
        "drone": "drone-1", "scan": "test-1", "heard_unix_s": time.time() - 25.0, "open": True,
        "received_bytes": 1000, "lag_s": {"k0": 0.4}, "missing": {"k1": 2, "pose": 1},
    }  # fmt: skip
    with page_of(browser, scans, [entry]) as base:
        browser.open(f"{base}/#/view/drone-1/test-1")
        kind(browser, "silent")
        said = browser.run(STATE)
        found = re.fullmatch(r"silent · last heard (\d+) s ago · backlog 3", said)
        assert found is not None and 25 <= int(found.group(1)) < 100
        entry["heard_unix_s"] = time.time() + 60.0  # it is back, for a while
        browser.wait("document.querySelector('.state').textContent.includes('0 B/s')", 30)
        entry["received_bytes"] = 500_000
        kind(browser, "receiving")
        browser.wait(
            f"/receiving · last heard 0 s ago · [1-9][0-9]* kB.s · lag 0.4 s/.test({STATE})"
        )
        assert "no keyframe" not in browser.run(STATE)
        browser.run(
            "{ const now = performance.now.bind(performance);"
            " performance.now = () => now() + 6e4; }; 0"
        )  # a minute later, and no chunk came
        browser.wait(f"/receiving · .* · no keyframe for [67][0-9] s/.test({STATE})")


def test_a_drone_that_is_back_with_a_new_scan_is_linked(
    browser: Browser, scans: Path, house: HouseFlight
) -> None:
    silent = {"drone": "drone-1", "scan": "test-1", "heard_unix_s": time.time() - 25.0}
    entries = [silent]
    with page_of(browser, scans, entries) as base:
        browser.open(f"{base}/#/view/drone-1/test-1")
        kind(browser, "silent")
        browser.wait("document.querySelector('.figures').classList.contains('old')")
        header = ScanHeader("test-2", "drone-1", house.start_ns + 10**12)
        with ScanStore.create(scans / "drone-1/test-2/scan.db", header) as scan:
            one = house.keyframe(0, 0.0)
            scan.add_keyframe(0, encode(one, one.time_ns))
            entries.append(silent | {"scan": "test-2", "heard_unix_s": time.time() + 60.0})
            back = "document.querySelector('a.newer')"
            browser.wait(f"{back}?.textContent.startsWith('back as scan drone-1, ')", 30)
            browser.run(f"{back}.click()")
            browser.wait("location.hash.endsWith('/drone-1/test-2')")


def test_the_report_is_linked_when_the_scan_has_finished(
    browser: Browser, scans: Path, house: HouseFlight
) -> None:
    folder = scans / "drone-1/test-1"
    (folder / "report.html").rename(folder / "later.html")
    with page_of(browser, scans, []) as base:
        browser.open(f"{base}/#/view/drone-1/test-1")
        browser.wait("document.body.dataset.points === '72000'")
        kind(browser, "silent")
        report = (
            "[...document.querySelectorAll('.view header a')].find(a => a.textContent === 'Report')"
        )
        assert browser.run(f"{report}.hidden") and " days ago" in browser.run(STATE)
        with ScanStore.open(folder / "scan.db") as store:
            one = house.keyframe(5, 30.0)
            store.add_keyframe(5, encode(one, one.time_ns))
        kind(browser, "receiving")
        with ScanStore.open(folder / "scan.db") as store:
            store.finish({})
        kind(browser, "finished")
        (folder / "later.html").rename(folder / "report.html")
        browser.wait(f"!{report}.hidden", 30)


def test_a_finished_scan_is_said_to_be_finished_while_it_loads(
    browser: Browser, scans: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message that ends its loading does not come."""
    news = LiveFeed.news

    def endless(feed: LiveFeed, max_chunks: int = 20) -> Iterator[str | bytes]:
        return (m for m in news(feed, max_chunks) if isinstance(m, bytes) or '"state"' not in m)

    monkeypatch.setattr(LiveFeed, "news", endless)
    folder = scans / "drone-1/test-1"
    with ScanStore.open(folder / "scan.db") as store:
        store.finish({})
        write_deliverables(folder, store)
    with page_of(browser, scans, []) as base:
        browser.open(f"{base}/#/view/drone-1/test-1")
        browser.wait("document.body.dataset.points === '72000'")
        kind(browser, "finished")


def test_an_unknown_scan_is_said_to_be_unknown(browser: Browser, scans: Path) -> None:
    with page_of(browser, scans, []) as base:
        browser.open(f"{base}/#/view/drone-1/nothing")
        browser.wait("document.querySelector('h1').textContent === 'There is no such scan'")
        assert "no scan drone-1/nothing" in browser.run("document.body.textContent")


def test_a_scan_that_cannot_be_read_is_said_with_its_reason(browser: Browser, scans: Path) -> None:
    folder = scans / "drone-1/broken"
    shutil.copytree(scans / "drone-1/test-1", folder)
    (folder / "scan.db").write_bytes(b"no database")
    with page_of(browser, scans, []) as base:
        browser.open(f"{base}/#/view/drone-1/broken")
        browser.wait(f"{STATE}.includes('is not a scan database')")


def test_list_and_map_say_whether_a_scan_is_heard(browser: Browser, scans: Path) -> None:
    entry = {"drone": "drone-1", "scan": "test-1", "heard_unix_s": time.time() - 25.0, "open": True}
    with page_of(browser, scans, [entry]) as base:
        browser.wait("document.querySelector('.badge.silent')?.textContent === 'not finished'")
        browser.open(f"{base}/#/map/drone-1/test-1")
        kind(browser, "silent")
        entry["heard_unix_s"] = time.time() + 600.0
        kind(browser, "receiving")
        browser.open(f"{base}/#/")
        browser.wait("document.querySelector('.badge:not(.silent)')?.textContent === 'growing'")


def test_the_list_shows_a_scan_without_files_from_above(browser: Browser, scans: Path) -> None:
    for name in ("scan.json", "preview.jpg", "thumbnail.webp"):
        (scans / "drone-1/test-1" / name).unlink()
    with page_of(browser, scans, []):
        image = "document.querySelector('.thumbnail img')"
        browser.wait(f"{image}?.src.includes('/test-1/thumbnail.png') && {image}.naturalWidth > 0")


@pytest.mark.parametrize("page", ["", "map/drone-1/test-1"])
def test_a_station_that_stops_is_said_until_it_is_back(
    browser: Browser, scans: Path, page: str
) -> None:
    missing = (
        "[...document.querySelectorAll('.stale, .state')].some(e => e.checkVisibility()"
        " && e.textContent.startsWith('the ground station does not answer'))"
    )
    first = Portal(PortalConfig(scans, port=0, token=TOKEN))
    first.start()
    base = first.url.split("/?")[0]
    browser.open("about:blank")
    browser.open(f"{base}/#/{page}")
    browser.wait("!!document.querySelector('.layer img, article')", 30)
    assert not browser.run(missing)
    first.close()
    browser.wait(missing, 30)
    assert browser.run("!!document.querySelector('.layer img, article')")  # what was there stays
    again = Portal(PortalConfig(scans, port=int(base.rpartition(":")[2]), token=TOKEN))
    again.start()
    try:
        browser.wait(f"!{missing}", 30)
    finally:
        browser.open("about:blank")
        again.close()


def test_the_list_follows_the_server(browser: Browser, scans: Path, house: HouseFlight) -> None:
    folder = scans / "drone-1/test-1"
    with page_of(browser, scans, []):
        browser.wait("document.querySelectorAll('article').length === 1")
        browser.run("document.querySelector('article details').open = true")
        browser.run("document.querySelectorAll('article .more button')[1].focus()")
        shutil.copytree(folder, scans / "drone-2/test-1")
        browser.wait("document.querySelectorAll('article').length === 2", 20)
        with ScanStore.open(folder / "scan.db") as store:
            one = house.keyframe(5, 30.0)
            store.add_keyframe(5, encode(one, one.time_ns))
            store.finish({})
            write_deliverables(folder, store)
        browser.wait("document.querySelectorAll('.badge').length === 1", 20)
        first = (
            "[...document.querySelectorAll('article')].find(a => a.textContent.includes('drone-1'))"
        )
        assert browser.run(f"{first}.querySelector('details').open")
        assert browser.run("document.activeElement.textContent") == "Tags…"
        assert browser.run(f"{first}.contains(document.activeElement)")
