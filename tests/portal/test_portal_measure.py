"""The ruler of the portal, by clicks in a real browser, against the exact house of the flight."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from house_flight import HouseFlight
from person import Browser
from portal_client import NEEDS, TOKEN, browser, flown_store, listing
from site_scans import FRAME, Errors, leg, write_scan

from recon.similarity import Similarity
from recon.types import F64, Keyframe
from service.georeference import LocalFrame
from service.ground.library import LABELS
from service.ground.portal import Portal, PortalConfig

pytestmark = NEEDS
__all__ = ["browser"]  # the fixture

GRID = [
    (x, y)
    for x in range(350, 951, 75)
    for y in (290, 430, 460, 490, 520)
    if y > 400 or abs(x - 645) > 140
]
GRID += [(x, 285) for x in (580, 610, 640, 670, 700)]
"""Places on the screen that the cloud covers: no wall of the house, which has no points."""


class WalledFlight(HouseFlight):
    """The flight, without the rays that would reach the ground through the walls of the house.

    Next to the walls a few points stand too high, as stereo has them.
    """

    def keyframe(self, seq: int, east_m: float, sigma_m: float = 0.05) -> Keyframe:
        one = super().keyframe(seq, east_m, sigma_m)
        depth = one.depth.depth_m
        v, u = np.indices(depth.shape)
        x = east_m + (u - self.K[0, 2]) / self.K[0, 0] * depth
        y = -(v - self.K[1, 2]) / self.K[1, 1] * depth
        through = (depth > self.height_m - 1.0) & (self.roof_m(x, y) > 0.0)
        beside = cv2.dilate(through.astype(np.uint8), np.ones((3, 3))) > 0
        depth[beside & ~through & (depth > self.height_m - 1.0) & ((u + v) % 4 == 0)] -= 2.5
        return replace(one, fresh=~through)


class Ruler:
    """The page with the ruler switched on, over the cloud at rest."""

    def __init__(self, page: Browser, frame: LocalFrame) -> None:
        self.page, self.frame = page, frame

    @property
    def spots(self) -> F64:
        """(N, 2) where the page draws the places picked, CSS pixels."""
        script = (
            "[...document.querySelectorAll('.overlay circle')].map(c => {"
            " const r = c.getBoundingClientRect();"
            " return [r.x + r.width / 2, r.y + r.height / 2]; })"
        )
        return np.asarray(self.page.run(script), np.float64).reshape(-1, 2)

    def pick(self, x: float, y: float) -> F64:
        """(3,) local metres of the place that a click picks, from the coordinates it shows."""
        before = len(self.spots)
        self.page.mouse(x, y)
        self.page.wait(f"document.querySelectorAll('.overlay circle').length === {before + 1}", 10)
        text = self.page.run("document.querySelector('.cursor').textContent")
        local = re.fullmatch(r"(\S+) m east · (\S+) m north · (\S+) m up", text)
        if local is not None:  # without georeference
            return np.array([float(v) for v in local.groups()])
        found = re.fullmatch(r"(\S+), (\S+) · UTM 32N (\S+) (\S+) · (\S+) m AMSL", text)
        assert found is not None, text
        lat, lon, east, north, height = map(float, found.groups())
        enu = self.frame.from_utm(np.array([[east, north, height]]))[0]
        other = self.frame.to_enu(np.array([[lat, lon, height]]))[0]
        assert np.abs(enu - other).max() < 0.03  # 7 decimals are about a centimetre
        return np.asarray(enu)

    @property
    def figures(self) -> dict[str, str]:
        """The text of the panel."""
        script = (
            "Object.fromEntries([...document.querySelectorAll('.measure dt')]"
            ".map(t => [t.textContent, t.nextSibling.textContent]))"
        )
        return dict(self.page.run(script))

    def number(self, name: str) -> float:
        """The number that begins a figure."""
        found = re.match(r"[+-]?[\d.]+", self.figures[name].replace(",", ""))
        assert found is not None
        return float(found.group())


@pytest.fixture
def ruler(browser: Browser, tmp_path: Path, house: HouseFlight) -> Iterator[Ruler]:
    portal = Portal(PortalConfig(flown_store(tmp_path, WalledFlight()), port=0, token=TOKEN))
    portal.start()
    browser.screen(1280, 800)
    browser.open("about:blank")
    browser.open(f"{portal.url.split('/?')[0]}/#/view/drone-1/test-1")
    browser.wait("document.body.dataset.points > 71000")  # all five keyframes
    browser.click("Whole site")
    browser.wait("document.body.dataset.still === 'yes'")
    browser.click("Measure")
    yield Ruler(browser, LocalFrame(*house.origin))
    portal.close()


def at_level(house: HouseFlight, places: F64, level_m: float) -> np.ndarray:
    """True for the places at this height of the truth, with nothing else half a metre around."""
    near = [
        house.roof_m(places[:, 0] + dx, places[:, 1] + dy)
        for dx in (-0.5, 0.5)
        for dy in (-0.5, 0.5)
    ]
    return np.asarray(np.all(np.abs(np.array(near) - level_m) < 1e-9, axis=0))


def test_clicks_measure_the_house(ruler: Ruler, house: HouseFlight) -> None:
    picked = np.array([ruler.pick(x, y) for x, y in GRID])  # each click finds a point
    ground, roof = at_level(house, picked, 0.0), at_level(house, picked, 6.0)
    assert roof.sum() >= 3 and ground.sum() >= 20
    assert np.abs(picked[ground, 2]).max() < 0.05
    assert np.abs(picked[roof, 2] - 6.0).max() < 0.05
    # From where the page draws the picked places, where any place of the ground is seen.
    to_page, _ = cv2.findHomography(picked[ground, :2], ruler.spots[ground])
    assert to_page is not None

    def seen(x: float, y: float) -> tuple[float, float]:
        u, v, w = to_page @ np.array([x, y, 1.0])
        return float(u / w), float(v / w)

    ruler.page.key("Escape")
    assert len(ruler.spots) == 0

    first, last = ruler.pick(*seen(-5.0, -8.0)), ruler.pick(*seen(25.0, -8.0))
    assert np.abs(first - (-5.0, -8.0, 0.0)).max() < 0.4  # a point every 0.29 m
    assert abs(ruler.number("Distance") - float(np.linalg.norm(last - first))) < 0.02
    label = ruler.page.run("document.querySelector('.overlay text').textContent")
    assert label == ruler.figures["Distance"]  # written at the line
    roof_place = picked[roof][0]
    x, y = np.asarray(GRID)[roof][0]
    up = ruler.pick(float(x), float(y))
    assert np.abs(up - roof_place).max() < 0.01  # the same click, the same point
    assert abs(ruler.number("Height") - 6.0) < 0.05
    slope = np.degrees(np.arctan2(up[2] - last[2], np.hypot(*(up - last)[:2])))
    assert abs(ruler.number("Slope") - slope) < 0.1
    ruler.page.key("Backspace")
    assert len(ruler.spots) == 2
    ruler.page.mouse(600, 400, to=(640, 400))  # turns the view
    assert len(ruler.spots) == 2
    figures = ruler.figures
    ruler.page.click("Measure")  # left: what is measured stays
    assert len(ruler.spots) == 2 and ruler.figures == figures
    ruler.page.click("Measure")
    ruler.page.key("Escape")
    ruler.page.key("Escape")
    assert ruler.page.run("document.querySelector('.measure').hidden")


IN_FRONT = """(b => {{ b.scrollIntoView(); const r = b.getBoundingClientRect();
  return document.elementFromPoint(r.x + r.width / 2, r.y + r.height / 2) === b; }})(
  [...document.querySelectorAll('button')].find(b => b.textContent === '{}'))"""
"""Whether a click on a button reaches it."""


def test_measurements_are_named_kept_and_leave_as_csv_geojson_and_print(
    ruler: Ruler, house: HouseFlight, tmp_path: Path
) -> None:
    page = ruler.page
    first, last = ruler.pick(*GRID[-1]), ruler.pick(*GRID[-3])
    ticks = "[...document.querySelectorAll('.profile .up')].map(t => parseFloat(t.textContent))"
    assert all(abs(v - house.origin[2]) < 7.0 for v in page.run(ticks)) and page.run(ticks)
    page.open(page.page.url.replace("#/", f"?token={TOKEN}#/"))  # to save needs the token
    page.wait("document.body.dataset.points > 71000")
    page.click("Measure")
    page.click("Whole site")
    page.wait("document.body.dataset.still === 'yes'")
    first, last = ruler.pick(*GRID[-1]), ruler.pick(*GRID[-3])
    page.page.fill("[aria-label='name of this measurement']", 'edge, "north"')
    page.click("Save")
    page.wait("document.querySelectorAll('.measure li').length === 1")
    page.key("Escape")
    assert len(ruler.spots) == 0
    page.run("document.querySelector('.measure .note-text').click()")
    length = float(np.linalg.norm(last - first))
    assert abs(ruler.number("Distance") - length) < 0.02
    page.wait("!!document.body.dataset.image")  # which lies below the panel
    assert page.run(IN_FRONT.format("All as CSV"))
    with page.page.expect_download() as download:
        page.click("All as CSV")
    rows = list(csv.DictReader(io.StringIO(download.value.path().read_text())))
    assert [row["name"] for row in rows] == ['edge, "north"']
    assert abs(float(rows[0]["length_m"]) - length) < 0.01
    assert rows[0]["places"].startswith(f"LINESTRING Z ({house.origin[1]:.2f}")
    with page.page.expect_download() as download:
        page.click("All as GeoJSON")
    feature = json.loads(download.value.path().read_text())["features"][0]
    assert feature["properties"]["name"] == 'edge, "north"'
    page.run("window.print = () => undefined")
    page.click("Print or PDF")
    page.call("Emulation.setEmulatedMedia", media="print")
    assert "Distance" in page.run("document.querySelector('.sheet').innerText")
    assert page.run("document.querySelector('#app').checkVisibility()") is False
    page.image(tmp_path / "print.png")  # to look at
    page.call("Emulation.setEmulatedMedia", media="")
    page.run("location.hash = '#/map/drone-1/test-1'")  # they are on the map, too
    page.wait("document.body.dataset.map === 'shown'")
    page.click("Measure")
    page.wait("document.querySelectorAll('.measure li').length === 1")
    page.run("document.querySelector('.measure .note-text').click()")
    assert abs(ruler.number("Distance") - length) < 0.02
    page.run("document.querySelector('.measure li [aria-label]').click()")
    page.wait("document.querySelectorAll('.measure li').length === 0")


def test_the_volume_of_the_house_its_profile_and_the_way_out(
    ruler: Ruler, house: HouseFlight, tmp_path: Path
) -> None:
    picked = np.array([ruler.pick(x, y) for x, y in GRID])
    ground = at_level(house, picked, 0.0) & (np.abs(picked[:, 2]) < 0.05)
    to_page, _ = cv2.findHomography(picked[ground, :2], ruler.spots[ground])
    ruler.page.key("Escape")
    corners = np.array([(0.0, -4.0), (20.0, -4.0), (20.0, 12.0), (0.0, 12.0)])
    spots = cv2.perspectiveTransform(corners[None], to_page)[0]
    found = np.array([ruler.pick(float(x), float(y)) for x, y in spots])
    assert np.abs(found[:, 2]).max() < 0.05
    x, y = found[:, 0], found[:, 1]
    plan_m2 = abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2.0
    assert abs(ruler.number("Area") - plan_m2) < 0.2
    assert abs(ruler.number("Volume above") / (12.0 * 8.0 * 6.0) - 1.0) < 0.014
    assert ruler.number("Volume below") < 3.0

    with ruler.page.page.expect_download() as download:
        ruler.page.click("GeoJSON")
    assert download.value.suggested_filename == "measurement.geojson"
    feature = json.loads(download.value.path().read_text())["features"][0]
    ring = np.array(feature["geometry"]["coordinates"][0])
    assert np.array_equal(ring[0], ring[-1])
    back = ruler.frame.to_enu(ring[:-1][:, [1, 0, 2]])
    assert np.abs(back - found).max() < 0.03
    assert abs(feature["properties"]["volume_above_m3"] - ruler.number("Volume above")) < 0.6

    ruler.page.page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    ruler.page.page.bring_to_front()
    ruler.page.click("Copy")
    ruler.page.wait("[...document.querySelectorAll('.note')].some(n => n.textContent === 'copied')")
    assert json.loads(ruler.page.run("navigator.clipboard.readText()"))["features"][0] == feature

    ruler.page.key("Escape")
    ends = cv2.perspectiveTransform(np.array([[(-2.0, 2.0), (22.0, 2.0)]]), to_page)[0]
    for u, v in ends:
        ruler.pick(float(u), float(v))
    caption = ruler.page.run("document.querySelector('.profile figcaption').textContent")
    low, high, length = map(float, re.findall(r"\d+\.\d+", caption))
    datum = house.origin[2]
    assert abs(low - datum) < 0.05 and abs(high - datum - 6.0) < 0.05
    assert abs(length - 24.0) < 0.6
    ruler.page.image(tmp_path / "profile.png")  # to look at


BOXES = """[...document.querySelectorAll('.overlay text')].map(t => {
  const b = t.getBoundingClientRect(); return [b.left, b.top, b.right, b.bottom]; })"""


def test_labels_of_a_small_area_on_a_phone_cover_no_other(ruler: Ruler) -> None:
    ruler.page.screen(390, 844, mobile=True)
    settled = "document.body.dataset.still === 'yes'"
    ruler.page.run("new Promise(r => setTimeout(r, 300))")
    stage = ruler.page.wait(
        f"{settled} && document.querySelector('.stage').getBoundingClientRect().toJSON()"
    )
    ruler.page.click("Whole site")
    ruler.page.run("new Promise(r => setTimeout(r, 300))")
    ruler.page.wait(settled)
    x, y = stage["x"] + stage["width"] / 2, stage["y"] + 0.45 * stage["height"]
    places = [(x, y), (x + 25, y), (x + 25, y + 12), (x, y + 12)]
    for count, place in enumerate(places, 1):
        ruler.pick(*place)
        boxes = np.array(ruler.page.run(BOXES)).reshape(-1, 4)
        assert len(boxes) == max(0, count - 1) + (count > 2)  # a label a step, and the area
        for i, a in enumerate(boxes):
            assert a[0] >= stage["left"] and a[2] <= stage["right"]
            for b in boxes[:i]:
                assert a[0] >= b[2] or b[0] >= a[2] or a[1] >= b[3] or b[1] >= a[3]
    ruler.page.screen(1280, 800)


SPOTS = np.array([[-8.0, -6.0], [9.0, -4.0], [1.0, 8.0]])
"""Of the place of the scans, ENU m."""


def test_a_scan_without_georeference_is_placed_by_clicks_in_two_scans(
    browser: Browser, tmp_path: Path
) -> None:
    wrong = Errors((310.0, -120.0, 35.0), (0.05, -0.02, 2.0), 0.4)  # where vision alone has it
    write_scan(tmp_path / "drone-1/placed", leg(0.0))
    write_scan(tmp_path / "drone-1/nowhere", leg(np.pi / 2), wrong, frame=None)
    (tmp_path / "drone-1/nowhere" / LABELS).write_text('{"title": "North field"}')
    with listing(browser, tmp_path, 2) as base:
        ruler = Ruler(browser, FRAME)
        browser.open(f"{base}/#/view/drone-1/nowhere")
        clicked = click_spots(ruler, wrong.as_similarity(), "Measure")
        assert np.abs(clicked[:, :2] - SPOTS).max() < 1.0
        assert browser.run("document.querySelectorAll('.measure select option').length") == 1
        browser.click("Place")
        browser.wait("location.hash.endsWith('/placed')")
        panel = "document.querySelector('.measure')"
        browser.wait(f"{panel}.textContent.includes('point 1 of 3 of North field')")
        browser.image(tmp_path / "placing.png")  # to look at
        assert browser.run(f"{panel}.querySelector('.acts + .acts button').disabled")  # Align
        click_spots(ruler, Errors().as_similarity(), None)
        browser.click("Align")
        ended = "document.querySelector('.jobs li.done, .jobs li.failed')?.textContent"
        words = browser.wait(ended, 120)
        assert "done" in words and words.startswith("Alignment of North field")
    document = json.loads((tmp_path / "site/drone-1-nowhere/site.json").read_text())
    assert [(s["name"], s["placed"]) for s in document["scans"]] == [
        ("placed", "aligned"), ("nowhere", "aligned"),
    ]  # fmt: skip
    assert document["scans"][1]["scale"] == pytest.approx(2.5, rel=0.01)
    T = np.array(document["scans"][1]["T_site_scan"])
    there = wrong.as_similarity().points(np.column_stack([SPOTS, np.zeros(3)]))
    found = 2.5 * there @ T[:3, :3].T + T[:3, 3]
    assert np.linalg.norm(found[:, :2] - SPOTS, axis=1).max() < 0.5


def click_spots(ruler: Ruler, errors: Similarity, button: str | None) -> F64:
    """Click SPOTS in the scan on the page, which has them off by ``errors``; (3, 3) m of the place
    that the clicks picked."""
    page = ruler.page
    page.wait("document.body.dataset.points > 10000")
    page.click("Whole site")
    page.wait("document.body.dataset.still === 'yes'")
    if button:
        page.click(button)
    grid = np.array([(x, y) for x in (520, 640, 760) for y in (340, 400, 460)], np.float64)
    true = picked_there(ruler, errors, grid)
    to_page, _ = cv2.findHomography(true[:, :2], ruler.spots)
    spots = drawn = cv2.perspectiveTransform(SPOTS[None], to_page)[0]
    for _ in range(2):  # the ground is not level
        for _ in ruler.spots:
            page.key("Backspace")
        page.wait("document.querySelectorAll('.overlay circle').length === 0")
        true = picked_there(ruler, errors, spots)
        spots = spots + drawn - cv2.perspectiveTransform(true[None, :, :2].copy(), to_page)[0]
    return true


def picked_there(ruler: Ruler, errors: Similarity, spots: F64) -> F64:
    """(N, 3) true places of what clicks at (N, 2) spots pick."""
    return inverse(errors, np.array([ruler.pick(float(x), float(y)) for x, y in spots]))


def inverse(errors: Similarity, points: F64) -> F64:
    """(N, 3) true places of the points of a scan that is off by ``errors``."""
    return np.asarray((points - errors.t) @ errors.R / errors.scale)
