"""The map page in a real browser: layers, moving, growing, phone; nothing from outside."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from basemaps import TILES, mbtiles
from house_flight import HouseFlight
from person import Browser, Page
from portal_client import NEEDS, TOKEN, browser, flown_store

from service.georeference import LocalFrame
from service.ground.portal import Portal, PortalConfig
from service.offline.refine.refly import WAYPOINT
from service.stream.codec import encode
from service.stream.store import ScanStore

pytestmark = NEEDS

PHONE = (390, 844)
__all__ = ["browser"]  # the fixture

SHOWN = "document.body.dataset.map === 'shown'"
BOX = "[...document.querySelectorAll('.layers label')].find(l => l.textContent.includes('{}'))"
COLOURS = """(async () => {
  const map = document.querySelector('.map').getBoundingClientRect();
  const c = document.createElement('canvas'); [c.width, c.height] = [map.width, map.height];
  const g = c.getContext('2d');
  for (const i of document.querySelectorAll('.layer:not([hidden]) img')) {
    const b = i.getBoundingClientRect();
    g.drawImage(i, b.x - map.x, b.y - map.y, b.width, b.height); }
  const d = g.getImageData(0, 0, c.width, c.height).data;
  let known = 0, red = 0, left = 1e9, right = 0;
  for (let p = 0; p < d.length; p += 4) { if (!d[p + 3]) continue; known++;
    if (d[p] > 150 && d[p + 1] < 90) { red++; const x = (p / 4) % c.width;
      left = Math.min(left, x); right = Math.max(right, x); } }
  return { known, red, left, right };
})()"""
"""Pixels of the map with content, and those of the red roof."""
PAINTED = (
    "[...document.querySelectorAll('.layer canvas[data-state=shown]')].some(c =>"
    " c.getContext('2d').getImageData(0, 0, c.width, c.height).data.some(v => v))"
)
"""Whether a tile of heights has colours."""


@pytest.fixture
def scans(tmp_path: Path, house: HouseFlight) -> Path:
    return flown_store(tmp_path / "scans", house)


@pytest.fixture
def page(browser: Browser, tmp_path: Path, scans: Path) -> Iterator[Browser]:
    below = mbtiles(tmp_path / "below.mbtiles", TILES)
    portal = Portal(PortalConfig(scans, port=0, token=TOKEN, basemap=below))
    portal.start()
    browser.screen(1280, 800)
    browser.open("about:blank")
    browser.requests.clear()
    browser.open(f"{portal.url.split('/?')[0]}/#/map/drone-1/test-1")
    browser.wait(SHOWN)
    yield browser
    portal.close()


def layer(page: Page, name: str) -> None:
    page.run(f"{BOX.format(name)}.querySelector('input').click()")
    page.run("new Promise(r => setTimeout(r, 100))")
    page.wait(SHOWN)


SLOW = """(() => {
  const [whole, asked] = [fetch, { now: 0, most: 0, ended: 0 }];
  Object.assign(window, { asked, fetch: async (path, init) => {
    if (!path.endsWith('/annotations')) return whole(path, init);
    asked.most = Math.max(asked.most, ++asked.now);
    await new Promise(r => setTimeout(r, 2500));
    asked.now--; asked.ended++;
    return whole(path, init);
  } });
})()"""
"""A station that answers later than the page asks again."""


def test_a_slow_station_is_not_asked_again_before_it_has_answered(page: Browser) -> None:
    page.run(SLOW)
    page.wait("asked.ended >= 3")
    assert page.run("asked.most") == 1


def test_the_page_that_is_left_takes_no_clicks(page: Browser) -> None:
    left = "document.querySelector('#app > *').inert"
    fades = "getComputedStyle(document.querySelector('#app > *')).transitionDuration === '0.3s'"
    page.run(f"addEventListener('hashchange', () => {{ window.left = {left} && {fades} }})")
    page.run("location.hash = '#/view/drone-1/test-1'")
    page.wait("document.body.dataset.points > 0")
    assert page.run("window.left") is True
    assert page.run(left) is False


def steady(page: Browser) -> dict[str, float]:
    """The map's colours once two looks in a row find the same."""
    seen: list[dict[str, float]] = []
    while len(seen) < 2 or seen[-1] != seen[-2]:
        assert len(seen) < 40, seen
        page.wait(SHOWN)
        seen.append(page.run(COLOURS))
        page.run("new Promise(r => setTimeout(r, 500))")
    return seen[-1]


def test_layers_lie_over_the_basemap_and_nothing_comes_from_outside(page: Browser) -> None:
    with_base = steady(page)
    assert page.run("document.querySelector('.map .blank').hidden")  # "No surface yet."
    assert with_base["known"] == pytest.approx(1280 * (800 - 50), rel=0.03)  # the basemap is below
    layer(page, "Basemap")
    alone = steady(page)
    assert 0.1 < alone["known"] / with_base["known"] < 0.9 and alone["red"] > 1000
    layer(page, "Surface")
    assert steady(page)["red"] == 0  # the shaded surface covers the roof
    layer(page, "Orthophoto")
    layer(page, "Surface")
    layer(page, "Contours")
    assert 0 < steady(page)["known"] < 0.1 * alone["known"]
    words = page.run(BOX.format("Contours") + ".textContent")
    assert re.fullmatch(r" Contours, [\d.]+ m", words)
    keys = "document.querySelector('.layers .keys')"
    assert page.run(f"{keys}.hidden")
    layer(page, "Coverage")
    tops = page.run("[...document.querySelectorAll('.layers label')].map(l => l.textContent)")
    assert tops.index(words) > tops.index(" Coverage")  # drawn above it
    assert not page.run(f"{keys}.hidden") and "seldom seen" in page.run(f"{keys}.textContent")
    assert steady(page)["known"] > 0.5 * alone["known"]
    here = page.run("location.origin")
    assert [u for u in page.requests if not u.startswith((here, "data:", "about:"))] == []


CURSOR = "document.querySelector('.map > .cursor').value"


def test_the_orthophoto_is_as_bright_as_the_3d_view(page: Browser) -> None:
    steady(page)
    seen = np.frombuffer(page.page.locator(".map").screenshot(), np.uint8)
    image = np.asarray(cv2.imdecode(seen, cv2.IMREAD_COLOR), np.uint8)
    red = image[image[..., 2] > 2.0 * image[..., 1]]
    # As the roof in test_the_surface_is_closed_also_while_it_moves; its images have (40, 40, 200).
    assert np.abs(np.median(red, axis=0) - (46, 46, 230)).max() < 12


def height_under(page: Browser, x: float, y: float) -> float:
    """Height above sea level that the cursor states at a place of the page."""
    page.page.mouse.move(x + 1, y)
    page.page.mouse.move(x, y)
    text = page.wait(f"{CURSOR}.includes('AMSL') && {CURSOR}")
    return float(text.rpartition("· ")[2].split()[0])


def roof(page: Browser) -> tuple[float, float, float]:
    """Where the middle of the roof is seen, and pixels a metre: it is 12 m wide."""
    rows = COLOURS.replace("right = 0;", "right = 0, top = 1e9, bottom = 0;").replace(
        "red++;",
        "red++; const y = map.y + p / 4 / c.width;"
        " top = Math.min(top, y); bottom = Math.max(bottom, y);",
    )
    found = page.run(rows.replace("{ known, red", "{ top, bottom, known, red"))
    x, y = (found["left"] + found["right"]) / 2, (found["top"] + found["bottom"]) / 2
    return x, y, (found["right"] - found["left"]) / 12.0


def test_heights_track_and_labels_are_on_the_map_and_it_measures(
    page: Browser, house: HouseFlight, tmp_path: Path
) -> None:
    steady(page)
    x, y, scale = roof(page)
    ground_m = house.origin[2]
    assert height_under(page, x, y) == pytest.approx(ground_m + 6.0, abs=0.1)
    assert height_under(page, x - 300, y) == pytest.approx(ground_m, abs=0.1)
    track = "document.querySelector('.track polyline').getBoundingClientRect().toJSON()"
    flown = page.run(track)
    assert flown["width"] > 5 * scale and flown["height"] < 5  # from west to east
    layer(page, "Flown track")
    assert page.run("document.querySelector('.track polyline')") is None
    layer(page, "Contours")
    page.wait("document.querySelectorAll('.heights text').length > 0")
    labels = page.run("[...document.querySelectorAll('.heights text')].map(t => t.textContent)")
    assert {float(label.split()[0]) for label in labels} <= {ground_m + k for k in range(7)}
    assert not page.run(PAINTED)  # for the cursor and the labels heights are enough
    layer(page, "Height")
    page.wait(PAINTED)
    low, high = page.run("[...document.querySelectorAll('.ramp span')].map(s => s.textContent)")
    assert [float(v.split()[0]) for v in (low, high)] == pytest.approx(
        [ground_m, ground_m + 6.0], abs=0.2
    )
    page.click("Measure")
    for dx, dy in ((-5, -3), (5, -3), (5, 3), (-5, 3)):
        page.mouse(x + dx * scale, y + dy * scale)
    figures = dict(
        page.run(
            "[...document.querySelectorAll('.measure dt')]"
            ".map(t => [t.textContent, t.nextSibling.textContent])"
        )
    )
    assert float(figures["Area"].split()[0]) == pytest.approx(60.0, rel=0.05)
    assert figures["Height"] in ("+0.00 m", "-0.00 m", "+0.01 m", "-0.01 m")
    page.image(tmp_path / "measured.png")  # to look at


def test_two_dates_lie_side_by_side(page: Browser, scans: Path, tmp_path: Path) -> None:
    passing = shutil.ignore_patterns("*-wal", "*-shm")  # the portal's readers make and remove them
    other = Path(shutil.copytree(scans / "drone-1/test-1", scans / "drone-1/later", ignore=passing))
    summary = json.loads((other / "scan.json").read_text())
    summary["times"]["started_unix_s"] += 30 * 86400.0
    (other / "scan.json").write_text(json.dumps(summary))
    page.run("location.reload()")
    page.wait(SHOWN)
    choose = (
        "(s => { s.selectedIndex = 1; s.dispatchEvent(new Event('change')); return s.value })"
        "(document.querySelector('.compare select'))"
    )
    assert page.wait(f"document.querySelector('.compare select').length === 2 && {choose}")
    tiles = "[...document.querySelectorAll('.layer img')].filter(i => i.src.includes('/later/'))"
    page.wait(f"{tiles}.length > 0 && {SHOWN}")
    clips = f"{tiles}[0].parentElement.style.clipPath"
    assert page.run(clips).startswith("polygon(640px 0")
    page.run(
        "(s => { s.value = 25; s.dispatchEvent(new Event('input')) })"
        "(document.querySelector('.swipe input'))"
    )
    assert page.run(clips).startswith("polygon(320px 0")
    dates = page.run("[...document.querySelectorAll('.swipe span')].map(s => s.textContent)")
    assert len(set(dates)) == 2
    page.image(tmp_path / "swipe.png")  # to look at


def test_drones_that_flew_together_are_told_apart(page: Browser, scans: Path) -> None:
    passing = shutil.ignore_patterns("*-wal", "*-shm")
    shutil.copytree(scans / "drone-1/test-1", scans / "drone-2/test-1", ignore=passing)
    page.run("location.reload()")
    other = "document.querySelector('.compare option:nth-child(2)')?.textContent"
    assert page.wait(other).endswith(", drone-2")


FAILED = "[...document.querySelectorAll('.layer img')].filter(i => i.complete && !i.naturalWidth)"
DRAWN_BROKEN = f"{FAILED}.filter(i => i.getClientRects().length).length"


def test_tiles_that_do_not_come_show_nothing_and_are_asked_for_again(page: Browser) -> None:
    whole = steady(page)
    page.page.route("**/tiles/**", lambda route: route.abort())
    for button in ("nearer", "farther", "farther"):
        page.run(f"document.querySelector('[title={button}]').click()")
    page.wait(f"{FAILED}.length > 0")
    page.wait("document.querySelector('.state').textContent.includes('does not answer')")
    assert page.run(DRAWN_BROKEN) == 0
    page.run("document.querySelector('[title=nearer]').click()")
    page.page.unroute("**/tiles/**")
    page.wait(f"{FAILED}.length === 0", 10)
    assert steady(page) == whole


def colours(page: Browser, when: str) -> dict[str, float]:
    """The map's colours ``s`` once no tile is missing and they are as ``when`` says."""
    found: dict[str, float] = page.wait(f"({COLOURS}).then(s => {SHOWN} && s.red && {when} && s)")
    return found


def test_the_map_moves_and_zooms_about_the_pointer(page: Browser) -> None:
    before = steady(page)
    page.mouse(600, 500, to=(700, 540))
    moved = colours(page, f"Math.abs(s.left - {before['left'] + 100}) <= 2")
    x, y = moved["left"], 400
    page.run(
        "document.querySelector('.map').dispatchEvent(new WheelEvent('wheel', { deltaY: -300,"
        f" clientX: {x}, clientY: {y}, bubbles: true, cancelable: true }}))"
    )
    twice = f"Math.abs(s.right - s.left - {2 * (moved['right'] - moved['left'])}) <= 12"
    near = colours(page, f"{twice} && Math.abs(s.left - {x}) <= 8")
    page.run("document.querySelector('.map').focus()")
    page.key("ArrowRight")
    colours(page, f"Math.abs(s.left - {near['left'] - 80}) <= 2")


@pytest.mark.parametrize("name", ["Orthophoto", "Coverage"])
def test_a_keyframe_is_on_the_map_after_its_next_round(
    browser: Browser, scans: Path, house: HouseFlight, name: str
) -> None:
    """The page asks every 2 s, the server looks at the store at most 2 s before: 4 s in all."""
    usual = PortalConfig(scans, port=0, token=TOKEN)
    assert usual.map_age_s <= 2.0 and usual.coverage_age_s <= 2.0
    portal = Portal(replace(usual, map_age_s=0.0, coverage_age_s=0.0))
    portal.start()
    page = browser.other()
    page.page.clock.install()  # time passes for the page as the test says
    page.open(f"{portal.url.split('/?')[0]}/#/map/drone-1/test-1")
    page.wait(SHOWN)
    if name != "Orthophoto":
        layer(page, "Orthophoto")
        layer(page, name)
    page.wait(f"({COLOURS}).then(s => s.known > 1000)")  # it shows the scan, not the world
    page.run("document.querySelector('[title=farther]').click()")  # now the map stays there
    page.wait(SHOWN)
    before = page.wait(f"({COLOURS}).then(s => s.known)")
    with ScanStore.open(scans / "drone-1/test-1/scan.db") as scan:
        one = house.keyframe(5, 35.0)
        scan.add_keyframe(5, encode(one, one.time_ns))
    page.page.clock.run_for(2000)
    page.wait(f"({COLOURS}).then(s => s.known > 1.1 * {before})")
    page.page.context.close()
    portal.close()


DRAWN = "[...document.querySelectorAll('.refly polygon, .refly polyline')].length"
ENDS = """[...document.querySelectorAll('.refly polyline')].flatMap(l =>
  l.getAttribute('points').split(' ').map(p => p.split(',').map(Number)))"""


def test_a_flight_over_weak_places_is_planned_while_the_scan_grows(
    browser: Browser, scans: Path, house: HouseFlight
) -> None:
    (scans / "drone-1/test-1/scan.json").unlink()  # it is in flight
    portal = Portal(PortalConfig(scans, port=0, token=TOKEN, coverage_age_s=0.0))
    portal.start()
    page = browser.other()
    page.page.clock.install()
    page.open(f"{portal.url.split('/?')[0]}/#/map/drone-1/test-1")
    page.wait(f"{SHOWN} && !!{BOX.format('Fly again')}")
    page.run(f"{BOX.format('Fly again')}.querySelector('input').click()")
    page.wait("document.querySelector('.layers').textContent.includes('nothing large enough')")

    def fly(seq: int, east_m: float) -> None:
        """A keyframe, then the page's next round."""
        with ScanStore.open(scans / "drone-1/test-1/scan.db") as scan:
            one = house.keyframe(seq, east_m)
            scan.add_keyframe(seq, encode(one, one.time_ns))
        page.page.clock.run_for(2000)

    fly(5, 90.0)  # leaves a gap
    page.wait(f"{DRAWN} > 0")
    with page.page.expect_download() as download:
        page.run("[...document.querySelectorAll('a')].find(a => a.text === '.plan').click()")
    assert download.value.suggested_filename == "test-1-refly.plan"
    items = json.loads(download.value.path().read_text())["mission"]["items"]
    flown = np.array([i["params"][4:7] for i in items if i["command"] == WAYPOINT])
    assert page.run(DRAWN) == len(flown)  # of each line its strip, and two places
    places = LocalFrame(*house.origin).to_enu(flown)
    assert 30.0 < places[:, 0].mean() < 90.0 and np.abs(places[:, 2] - house.height_m).max() < 0.1
    along_m, along_px = np.diff(places[:, :2], axis=0)[0], np.diff(page.run(ENDS), axis=0)[0]
    scale = np.hypot(*along_px) / np.hypot(*along_m)
    assert np.abs(along_px - scale * along_m * (1, -1)).max() < 0.02 * np.hypot(*along_px)
    fly(6, 60.0)
    fly(7, 40.0)
    page.wait(f"{DRAWN} === 0")
    page.page.context.close()
    portal.close()


@pytest.mark.parametrize("size", [(1440, 900), PHONE])
def test_the_map_is_reached_and_within_reach(
    page: Browser, size: tuple[int, int], tmp_path: Path
) -> None:
    page.screen(*size, mobile=size == PHONE)
    page.run("location.hash = '#/'")
    page.wait("document.querySelectorAll('article').length === 1")
    page.run(
        "[...document.querySelectorAll('article a')].find(a => a.textContent === 'Map').click()"
    )
    page.wait(f"{SHOWN} && !!document.querySelector('.flat .map')")
    wide, high = page.run(
        "[document.documentElement.scrollWidth, document.documentElement.scrollHeight]"
    )
    assert wide <= size[0] and high <= size[1]
    assert page.run("document.querySelector('.flat .map').clientHeight") > 0.5 * size[1]
    page.image(tmp_path / "map.png")  # to look at


def test_a_scan_that_is_not_there_is_said(page: Browser) -> None:
    page.run("location.hash = '#/map/drone-1/none'")
    page.wait("document.body.textContent.includes('no scan drone-1/none')")
