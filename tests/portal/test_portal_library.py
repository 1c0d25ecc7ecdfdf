"""The library's map, cards and export dialog in a real browser."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from house_flight import HouseFlight
from person import Browser
from portal_client import NEEDS, browser, flown_store, listing

from service.stream.codec import encode

if TYPE_CHECKING:
    from playwright.sync_api import Route

pytestmark = NEEDS
__all__ = ["browser"]  # the fixture

CARDS = "document.querySelectorAll('article').length"
NAMES = "[...document.querySelectorAll('article h2')].map(h => h.textContent)"
OUTLINES = """[...document.querySelectorAll('.outlines polygon')].map(p => {
  const box = p.getBoundingClientRect(); return [box.x, box.y, box.width, box.height]; })"""
THUMBNAIL = """(() => { const i = document.querySelector('.thumbnail img');
  if (!i.complete || !i.naturalWidth) return null;
  const c = document.createElement('canvas');
  [c.width, c.height] = [i.naturalWidth, i.naturalHeight];
  const g = c.getContext('2d'); g.drawImage(i, 0, 0);
  const d = g.getImageData(0, 0, c.width, c.height).data;
  let known = 0, red = 0;
  for (let p = 0; p < d.length; p += 4) { if (d[p + 3] < 128) continue; known++;
    if (d[p] > 150 && d[p + 1] < 90) red++; }
  return [c.width, c.height, known, red]; })()"""


@pytest.fixture
def store(tmp_path: Path, house: HouseFlight) -> Path:
    """Two scans of one place, and one of another, a tenth of a degree north."""
    root = flown_store(tmp_path / "scans", house)
    shutil.copytree(root / "drone-1/test-1", root / "drone-2/test-2")
    away = Path(shutil.copytree(root / "drone-1/test-1", root / "drone-3/test-3"))
    summary = json.loads((away / "scan.json").read_text())
    summary["origin"]["lat_deg"] += 0.1
    for corner in summary["coverage"]["corners_lat_lon"]:
        corner[0] += 0.1
    (away / "scan.json").write_text(json.dumps(summary))
    return root


def test_a_card_names_place_and_date_and_shows_the_ground_alone(
    browser: Browser, store: Path, house: HouseFlight
) -> None:
    with listing(browser, store, 3):
        lat, lon, _ = house.origin
        name = browser.run(f"{NAMES}[0]")
        assert name.startswith(f"{lat:.4f}° N, {lon:.4f}° E, ")
        assert name.endswith(":00") or ":" in name
        wide, high, known, red = browser.wait(THUMBNAIL)
        assert max(wide, high) == 480  # cut to what was measured, and of one image only
        assert 0.5 < known / (wide * high) <= 1.0 and red > 0.01 * known  # the roof


@pytest.mark.slow
def test_a_card_shows_the_ground_while_the_scan_grows(
    browser: Browser, tmp_path: Path, house: HouseFlight
) -> None:
    held: list[Route] = []
    with house.flown(tmp_path / "drone-1/test-1") as scan, listing(browser, tmp_path, 1):
        wide, high, known, red = browser.wait(THUMBNAIL)
        assert max(wide, high) > 240 and known / (wide * high) > 0.3 and red > 0.01 * known
        assert browser.run("document.querySelector('.thumbnail img').alt").endswith("so far")
        browser.page.route("**/thumbnail.png*", lambda route: held.append(route))
        for seq, count in ((9, 6), (10, 7)):
            one = house.keyframe(seq, 50.0)
            scan.add_keyframe(seq, encode(one, one.time_ns))
            facts = "document.querySelector('.facts').textContent"
            browser.wait(f"{facts}.includes('{count} keyframes')")
            assert browser.run(THUMBNAIL) == [wide, high, known, red]  # until the next one is here
            for _ in range(1200):
                if len(held) == count - 5:
                    break
                browser.page.wait_for_timeout(50)
        for route, count in zip(held, (6, 7), strict=True):
            route.continue_()
            browser.wait(f"document.querySelector('.thumbnail img').src.endsWith('?v={count}')")
        browser.wait(f"{THUMBNAIL}?.join() !== '{wide},{high},{known},{red}'")
        browser.page.unroute_all(behavior="ignoreErrors")


def test_the_map_outlines_scans_and_lists_those_at_a_place(browser: Browser, store: Path) -> None:
    with listing(browser, store, 3):
        browser.wait("document.querySelectorAll('.outlines circle').length === 2")  # far apart
        words = browser.run(
            "[...document.querySelectorAll('.outlines text')].map(t => t.textContent)"
        )
        assert sorted(words)[0] == "2 scans"
        spots = browser.run(
            "[...document.querySelectorAll('.outlines circle')].map(c => {"
            " const b = c.getBoundingClientRect(); return [b.x + 7, b.y + 7] })"
        )
        browser.mouse(*max(spots, key=lambda spot: spot[1]))  # the southern one
        browser.wait(f"{CARDS} === 2")
        outlines = np.array(browser.wait(f"{OUTLINES}.length === 3 && {OUTLINES}"))
        outlines = outlines[outlines[:, 1] > 0]  # the third is far north
        assert np.ptp(outlines, axis=0).max() < 1.0 and outlines[:, 2].min() > 60
        summary = json.loads((store / "drone-1/test-1/scan.json").read_text())
        west, south, east, north = summary["coverage"]["bounds_m"]
        ratio = outlines[0, 2] / outlines[0, 3]
        assert ratio == pytest.approx((east - west) / (north - south), rel=0.02)
        assert len(outlines) == 2
        browser.wait("document.querySelectorAll('.overview .layer img').length === 3")
        browser.click("Show all")
        browser.wait(f"{CARDS} === 3")
        browser.wait("document.querySelectorAll('.outlines circle').length === 2")
        browser.run("document.querySelector('article a').focus()")
        browser.wait("document.querySelectorAll('.outlines .marked').length === 1")


GONE = """(() => {
  window.gone = 0;
  const look = () => (window.gone += !document.querySelector('article .made li'));
  new MutationObserver(look).observe(document.body, { childList: true, subtree: true });
})()"""
RENAMED = """fetch('/api/scans').then((all) => all.json()).then(([scan]) =>
  fetch('/api/scans/drone-1/test-1', {
    method: 'PATCH', headers: { 'content-type': 'application/json' },
    body: JSON.stringify({ title: 'renamed', edition: scan.edition }),
  })).then((answer) => answer.status)"""


def test_the_export_dialog_says_what_each_product_is_and_makes_it(
    browser: Browser, store: Path
) -> None:
    shutil.rmtree(store / "drone-2")
    shutil.rmtree(store / "drone-3")
    with listing(browser, store, 1):
        browser.click("Export…")
        browser.wait("document.querySelectorAll('.product').length > 20")
        row = (
            "[...document.querySelectorAll('.product')].find(p => p.innerText.includes('GeoTIFF'))"
        )
        words = browser.run(f"{row}.innerText")
        assert "orthophoto" in words and "about " in words and " s" in words
        geojson = (
            "[...document.querySelectorAll('.product')]"
            ".find(p => p.innerText.includes('Track, GeoJSON'))"
        )
        browser.run(f"{geojson}.querySelector('button').click()")
        browser.wait(f"!!{geojson}.querySelector('.jobs li')")  # its progress is in its row
        link = f"{geojson}.querySelector('[aria-label=\"Download Track, GeoJSON\"]')"
        browser.wait(f"!!{link}")
        with browser.page.expect_download() as download:
            browser.run(f"{link}.click()")
        assert download.value.suggested_filename == "test-1-flight.geojson"
        size = (store / "drone-1/test-1/flight.geojson").stat().st_size
        assert f"{size / 1000:.0f} kB" in browser.run(f"{geojson}.innerText")
        browser.key("Escape")
        browser.wait("!document.querySelector('dialog')")
        browser.wait("!!document.querySelector('article .made li')")  # and then on the card

        def an_hour_later(route: Route) -> None:
            jobs = [job | {"ended_s": 3600.0} for job in route.fetch().json()]
            route.fulfill(json=jobs)

        browser.page.route("**/api/jobs", an_hour_later)
        for _ in range(2):
            with browser.page.expect_response("**/api/jobs"):
                pass
        assert browser.run("!!document.querySelector('article .made li')")  # its history
        browser.page.unroute_all(behavior="wait")
        browser.run(GONE)  # also while the card is drawn again
        assert browser.run(RENAMED) == 200
        browser.wait("document.querySelector('article').innerText.includes('renamed')")
        assert browser.run("window.gone") == 0
        browser.click("Export…")
        browser.wait("!!document.querySelector('dialog')")
        browser.run("location.hash = '#/view/drone-1/test-1'")
        browser.wait("!document.querySelector('dialog') && !!document.querySelector('.view')")


def test_an_upload_is_seen_at_work_and_then_on_the_card_of_its_scan(
    browser: Browser, store: Path, tmp_path: Path
) -> None:
    """What is chosen closes the menu, which lay over the job and its button."""
    video = tmp_path / "flight.mp4"
    video.write_bytes(b"a video")
    job = {
        "number": 1, "drone": "upload", "scan": "flight.mp4", "kind": "scan", "title": "Replay",
        "state": "running", "doing": "tracking", "percent": 40, "left_s": 60, "ended_s": None,
        "file": None, "error": None,
    }  # fmt: skip
    menu, bar = "document.querySelector('.import')", "document.querySelector('header ~ .jobs li')"
    with listing(browser, store, 3):
        browser.page.route("**/api/upload*", lambda route: route.fulfill(status=202, json=job))
        browser.page.route("**/api/jobs", lambda route: route.fulfill(json=[job]))
        browser.page.click("summary:text('Add scans')")
        browser.page.click(".import input[size]")
        for letter in "flight":
            browser.key(letter)
        assert browser.page.input_value(".import input[size]") == "flight"
        browser.key("Escape")
        assert not browser.run(f"{menu}.open")
        browser.page.click("summary:text('Add scans')")
        browser.page.set_input_files(".import input[type=file]", video)
        browser.wait(f"!{menu}.open && {bar}?.textContent.includes('40 % · 60 s left')")
        assert "Replay of flight.mp4" in browser.run(f"{bar}.textContent")
        job |= {"state": "done", "percent": 100, "file": "drone-3/test-3", "ended_s": 1.0}
        browser.wait("document.querySelectorAll('article .made li').length === 1")
        made = browser.run(
            "document.querySelector('article .made li').closest('article').innerText"
        )
        assert "drone-3" in made and browser.run(f"{bar} === null")
        assert browser.run("document.querySelector('article .made a').hidden")  # no file of it
        browser.page.unroute_all(behavior="ignoreErrors")


def test_names_on_the_map_stay_within_it_whatever_its_size(browser: Browser, store: Path) -> None:
    outside = """[...document.querySelectorAll('.outlines text, .outlines circle')].filter(t => {
      const map = document.querySelector('.overview .map');
      const [a, b] = [t, map].map(e => e.getBoundingClientRect());
      return a.left < b.left || a.right > b.right || a.top < b.top || a.bottom > b.bottom; })
      .map(t => t.textContent)"""
    with listing(browser, store, 3):
        for size in ((1280, 800), (390, 844), (844, 390)):
            browser.screen(*size)
            browser.run("new Promise(r => setTimeout(r, 300))")
            assert browser.run("document.querySelectorAll('.outlines circle').length") == 2
            assert browser.run(outside) == [], size
        browser.screen(1280, 800)
