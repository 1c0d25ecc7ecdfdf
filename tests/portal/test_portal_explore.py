"""Time, clip box, images of keyframes, links and units of the view, in a real browser."""

from __future__ import annotations

import base64
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
from portal_client import NEEDS, TOKEN, browser, flown_store

from recon.types import F64
from service.ground.portal import Portal, PortalConfig
from service.stream.codec import encode
from service.stream.records import ScanHeader
from service.stream.store import ScanStore

pytestmark = NEEDS
__all__ = ["browser"]  # the fixture

SET = "(() => {{ const f = document.querySelector({!r}); f.value = {!r};"
SET += " f.dispatchEvent(new Event('input', {{ bubbles: true }})); }})()"
CANVAS = "document.querySelector('.stage canvas')"
COLOURED = f"""(() => {{
  const c = document.createElement('canvas'), s = {CANVAS};
  [c.width, c.height] = [s.width, s.height];
  const g = c.getContext('2d');
  g.drawImage(s, 0, 0);
  const d = g.getImageData(0, 0, c.width, c.height).data;
  let n = 0;
  const isSky = i => {{  // as the left border in the same row
    const s = i - i % (4 * c.width);
    return [0, 1, 2].every(k => Math.abs(d[i + k] - d[s + k]) < 4);
  }};
  for (let i = 0; i < d.length; i += 4) n += !isSky(i) && Math.abs(d[i + 1] - d[i + 2]) > 20;
  return n / (d.length / 4);
}})()"""
"""Share of the scene's pixels that are neither gray nor background."""
SELECT = "(() => {{ const f = document.querySelector('[aria-label=\"colour by\"]'); f.value = {!r};"
SELECT += " f.dispatchEvent(new Event('change', {{ bubbles: true }})); }})()"
LIKE = (
    COLOURED.replace("{", "{{")
    .replace("}", "}}")
    .replace("Math.abs(d[i + 1] - d[i + 2]) > 20", "like([d[i], d[i + 1], d[i + 2]], [{}, {}, {}])")
    .replace(
        "let n = 0;",
        """let n = 0;
  const like = (a, b) => {{
    const of = v => Math.hypot(...v), dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    return dot > 0.98 * of(a) * of(b);
  }};""",
    )
)
"""Share of the scene's pixels of the hue of a colour."""


@pytest.fixture
def base(browser: Browser, tmp_path: Path, house: HouseFlight) -> Iterator[str]:
    """The address of a portal with the scan drone-1/test-1, which no page shows yet."""
    portal = Portal(PortalConfig(flown_store(tmp_path, house), port=0, token=TOKEN))
    portal.start()
    browser.screen(1280, 800)
    browser.open("about:blank")
    yield portal.url.split("/?")[0] + "/"
    browser.run("localStorage.clear()")
    portal.close()


@pytest.fixture
def page(browser: Browser, base: str) -> Browser:
    """The scan, whole and at rest."""
    browser.open(f"{base}#/view/drone-1/test-1")
    browser.wait("document.body.dataset.points > 71000")  # all five keyframes
    browser.click("Points")
    browser.click("Whole site")
    settle(browser)
    return browser


def settle(page: Browser) -> None:
    """Wait until the page shows what was asked for."""
    page.run("new Promise(r => setTimeout(r, 100))")
    page.wait("document.body.dataset.still === 'yes'")


def again(page: Browser) -> None:
    """Open the same page again."""
    address = page.run("location.href")
    page.open("about:blank")
    page.open(address)


def drawn(page: Browser) -> int:
    """Points of the whole frame: the figure that stands while nothing is left to draw."""
    figure = "[document.body.dataset.still, Number(document.body.dataset.drawn)]"
    seen: list[list[object]] = []
    while len(seen) < 2 or seen[-1] != seen[-2] or seen[-1][0] != "yes":
        assert len(seen) < 40, seen
        settle(page)
        page.run("new Promise(r => setTimeout(r, 700))")  # the figures follow within 0.3 s
        seen.append(page.run(figure))
    return int(str(seen[-1][1]))


def test_the_time_slider_shows_the_cloud_as_it_was(
    page: Browser, tmp_path: Path, house: HouseFlight
) -> None:
    whole = drawn(page)
    page.run(SET.format(".time input", "2"))
    assert drawn(page) == pytest.approx(whole * 2 / 5, rel=0.05)
    assert page.run("document.querySelector('.time output').textContent") == "1 s"
    page.wait("document.body.dataset.image === '1'")  # the image and the figures go along
    images = "document.querySelector('.figures').innerText.match(/Images\\n(\\d+)/)?.[1]"
    flown = "document.querySelector('.figures').innerText.includes('Flown')"
    caption = "document.querySelector('.latest figcaption').textContent"
    page.wait(f"{images} === '2' && !{flown} && {caption} === 'keyframe 1'")
    page.run(SET.format(".time input", "5"))
    assert drawn(page) == whole
    page.wait(f"document.body.dataset.image === '4' && {images} === '5' && {flown}")
    page.wait(f"{caption} === 'latest keyframe, 4'")
    page.run(
        "Object.defineProperty(document, 'hidden', { value: true })"
    )  # asks for nothing by itself
    page.run(SET.format(".time input", "3"))
    page.wait(f"{caption} === 'keyframe 2'")
    page.run(SET.format(".time input", "5"))
    page.wait(f"{caption} === 'latest keyframe, 4'")
    one = house.keyframe(5, 25.0)
    with ScanStore.open(tmp_path / "drone-1/test-1/scan.db") as scan:
        scan.add_keyframe(5, encode(one, one.time_ns))
    page.wait("document.querySelector('.time input').value === '6'")  # it follows the flight
    settle(page)
    assert page.run(caption) == "latest keyframe, 4"


def test_the_slider_of_several_dates_states_dates_in_their_order(
    page: Browser, tmp_path: Path, house: HouseFlight
) -> None:
    with ScanStore.open(tmp_path / "drone-1/test-1/scan.db") as scan:
        for seq, days in ((5, 70), (6, -70)):
            one = house.keyframe(seq, 5.0 * seq)
            scan.add_keyframe(seq, encode(one, one.time_ns + days * 86_400 * 10**9))
    page.wait("document.querySelector('.time input').max === '7'")
    said = []
    for k in ("1", "2", "7"):
        page.run(SET.format(".time input", k))
        said.append(page.run("document.querySelector('.time output').textContent"))
    assert all(re.fullmatch(r"20\d\d-\d\d-\d\d \d\d:\d\d", one) for one in said), said
    assert said == sorted(set(said))


def test_the_flight_plays_at_its_speed_and_is_dated(page: Browser) -> None:
    page.run("document.querySelector('.time select').value = '1'")
    page.run("document.querySelector('.time button').click()")  # from the beginning
    seen = [page.run("document.querySelector('.time input').value")]
    page.wait("document.querySelector('.time button').title === 'pause'")
    page.wait("document.querySelector('.time input').value === '3'", 20)
    assert seen == ["1"] and "2023" in page.run("document.querySelector('.time .day').textContent")
    page.wait("document.querySelector('.time button').title === 'play the flight'", 20)
    assert page.run("document.querySelector('.time input').value") == "5"


def test_a_path_of_the_camera_is_saved_as_video(page: Browser, tmp_path: Path) -> None:
    record = "[...document.querySelectorAll('button')].find(b => b.textContent === 'Record')"
    assert page.run(f"{record}.disabled")
    page.run(SET.format("input[type=number]", "8"))  # a loaded machine draws few frames a second
    page.click("Add view")
    page.mouse(600, 400, to=(760, 400))  # turned
    page.click("Add view")
    with page.page.expect_download(timeout=60_000) as download:
        page.run(f"{record}.click()")
    path = tmp_path / download.value.suggested_filename
    download.value.save_as(path)
    assert path.stem == "test-1" and path.suffix in (".webm", ".mp4")
    video = cv2.VideoCapture(str(path))
    frames = []
    while (frame := video.read())[0]:
        frames.append(frame[1])
    assert len(frames) > 2
    moved = np.abs(frames[0].astype(int) - frames[-1]).mean()
    assert moved > 1.0  # the camera has gone round


def test_the_clip_box_cuts_the_scene_and_gives_it_back(page: Browser) -> None:
    before = page.run(COLOURED)
    assert before > 0.05
    page.run(SET.format("[aria-label='East, from']", "50"))
    settle(page)
    half = page.run(COLOURED)
    assert 0.3 * before < half < 0.7 * before
    page.run(SET.format("[aria-label='Height, from']", "50"))
    settle(page)
    assert page.run(COLOURED) < 0.6 * half  # the roof is left
    said = page.run("[...document.querySelectorAll('.clip output')].map(o => o.value)")
    (_, (west, east)), _, (_, (low, high)) = (
        (text, [float(v) for v in re.findall(r"-?[\d.]+(?= m)", text)]) for text in said
    )
    assert west == pytest.approx(10.0, abs=3.0) and east > 30.0
    datum = HouseFlight.origin[2]
    assert (low, high) == pytest.approx((datum + 3.0, datum + 6.0), abs=0.2)
    page.run(
        "[...document.querySelectorAll('.clip button')].find(b => b.offsetParent || 1).click()"
    )
    settle(page)
    assert page.run(COLOURED) == pytest.approx(before, rel=0.02)


def test_the_edge_of_a_mask_hides_nothing_that_is_measured(
    browser: Browser, tmp_path: Path, house: HouseFlight
) -> None:
    """The west is red; another keyframe saw all of it 0.3 m lower, blue, as its noise may be."""
    folder = tmp_path / "drone-1/test-1"
    with ScanStore.create(folder / "scan.db", ScanHeader("test-1", "drone-1", 1)) as store:
        for seq, (bgr, depth_m) in enumerate((((40, 40, 200), 40.0), ((200, 60, 40), 40.3))):
            one = house.keyframe(seq, 0.0)
            depth = replace(one.depth, depth_m=np.full_like(one.depth.depth_m, depth_m))
            fresh = one.fresh & ((np.arange(160) < 80) | (seq == 1))
            colour = np.broadcast_to(np.array(bgr, np.uint8), one.bgr.shape).copy()
            store.add_keyframe(
                seq, encode(replace(one, depth=depth, bgr=colour, fresh=fresh), one.time_ns)
            )
        store.finish({})
    portal = Portal(PortalConfig(tmp_path, port=0, token=TOKEN))
    portal.start()
    browser.open("about:blank")
    browser.open(f"{portal.url.split('/?')[0]}/#/view/drone-1/test-1")
    browser.wait("document.body.dataset.points === '21600'")
    browser.click("Whole site")
    settle(browser)
    data = browser.run(f"{CANVAS}.toDataURL('image/png').split(',')[1]")
    browser.open("about:blank")
    portal.close()
    image = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    row = image[image.shape[0] // 2].astype(int)
    red = np.flatnonzero(row[:, 2] > 2 * row[:, 0])
    blue = np.flatnonzero(row[:, 0] > 2 * row[:, 2])
    left, right = red.min(), blue[blue > red.mean()].max()
    edge = (red.max() - left) / (right - left)
    assert edge == pytest.approx(81 / 163, abs=0.006), edge  # two more pixels hide: 83 / 163


def test_the_scans_of_a_site_have_colours_of_their_own(page: Browser, tmp_path: Path) -> None:
    choices = "document.querySelector('[aria-label=\\'colour by\\']').textContent"
    assert "scan" not in page.run(choices)
    parts = [{"name": "west", "keyframes": [0, 1]}, {"name": "east", "keyframes": [2, 4]}, None]
    site = tmp_path / "drone-1" / "test-1" / "site.json"
    site.write_text(json.dumps({"scans": parts}))
    again(page)
    page.wait("document.body.dataset.points > 71000")
    assert page.run(choices).endswith("scan")
    page.run(SELECT.format("scan"))
    page.click("Whole site")
    settle(page)
    keys = "[...document.querySelectorAll('.legend .keys span')].map(k => k.textContent).join()"
    assert page.run(keys) == "west,east"
    both = [page.run(LIKE.format(*rgb)) for rgb in ((230, 159, 0), (86, 180, 233))]
    page.run(SET.format(".time input", "2"))  # the west alone
    settle(page)
    west, east = (page.run(LIKE.format(*rgb)) for rgb in ((230, 159, 0), (86, 180, 233)))
    assert min(both) > 0.02 and west > 0.02 and east < 0.1 * both[1]
    page.run(SELECT.format("colour"))
    assert page.run("document.querySelector('.legend').hidden")


def test_a_site_with_damaged_facts_is_shown(page: Browser, tmp_path: Path) -> None:
    (tmp_path / "drone-1" / "test-1" / "site.json").write_text('{"scans": 7}')
    again(page)
    page.wait("document.querySelector('[role=alert]')?.textContent.includes('site.json')")
    page.wait("document.body.dataset.points > 71000")


def view(page: Browser) -> F64:
    """(6,) the eye and where it looks, from the link."""
    page.click("Link")
    return np.array(page.run("location.hash").split("/")[4].split(","), np.float64)


def test_a_link_opens_the_same_view(page: Browser) -> None:
    page.run(
        f"{CANVAS}.dispatchEvent(new WheelEvent('wheel',"
        " { deltaY: -400, clientX: 640, clientY: 400, bubbles: true }))"
    )
    settle(page)
    here, address = view(page), page.run("location.href")
    page.open("about:blank")
    page.open(address)
    page.wait("document.body.dataset.points > 71000")
    settle(page)
    assert np.abs(view(page) - here).max() < 0.02


def test_a_link_to_another_place_of_an_open_view_moves_the_camera(page: Browser) -> None:
    page.run(
        f"{{ window.before = {CANVAS}; location.hash = '#/view/drone-1/test-1/1,2,60,3,4,0' }}"
    )
    page.wait("document.body.dataset.still === 'no'")
    settle(page)
    np.testing.assert_allclose(view(page), [1, 2, 60, 3, 4, 0], atol=0.01)
    assert page.run(f"window.before === {CANVAS}")  # nothing is loaded again
    page.run("history.back()")


def test_the_ground_is_not_looked_at_from_below(page: Browser) -> None:
    before = view(page)
    page.page.mouse.move(640, 700)
    page.page.mouse.down()
    page.page.mouse.move(640, 120, steps=6)
    page.page.mouse.up()
    settle(page)
    _, _, eye_m, _, _, target_m = view(page)
    assert before[2] - before[5] > 10.0 and target_m - 0.01 <= eye_m < target_m + 1.0


@pytest.mark.parametrize("broken", ["1,2,3", "1,2,3,4,5,x", "", "NaN,0,0,0,0,0"])
def test_a_link_with_a_broken_view_shows_the_whole_site(
    browser: Browser, base: str, broken: str
) -> None:
    browser.open("about:blank")
    browser.wait("location.href === 'about:blank'")
    browser.open(f"{base}#/view/drone-1/test-1/{broken}")
    browser.wait("document.body.dataset.points > 71000")
    settle(browser)
    assert browser.run(COLOURED) > 0.05


def test_a_click_on_a_camera_shows_its_image(
    browser: Browser, base: str, house: HouseFlight
) -> None:
    browser.open(f"{base}#/view/drone-1/test-1/10,-130,70,10,0,20")
    browser.wait("document.body.dataset.image === '4'")
    browser.click("Cameras")
    settle(browser)
    second = house.pose(5.0)[:3, 3]  # where the second was taken
    browser.mouse(*projected(browser, view(browser), second))
    browser.wait("document.body.dataset.image === '1'")
    caption = "document.querySelector('.latest figcaption').textContent"
    assert browser.run(caption).startswith("keyframe 1")
    assert browser.run("document.querySelector('.latest img').naturalWidth") > 0
    browser.run("document.querySelector('.latest .image').click()")
    large = "document.querySelector('dialog.large img')"
    browser.wait(f"{large}.naturalWidth > 0")
    assert browser.run(f"{large}.clientWidth") > 3 * browser.run(
        "document.querySelector('.latest img').clientWidth"
    )
    browser.key("Escape")
    browser.wait(f"{large} === null")
    browser.click("Latest")
    browser.wait("document.body.dataset.image === '4'")


def test_the_drone_does_not_hide_what_is_seen_from_its_place(
    browser: Browser, base: str, house: HouseFlight
) -> None:
    def from_beside(aside_m: float) -> float:
        x, y, z = house.pose(20.0)[:3, 3] + [0.0, aside_m, 0.9]  # within the drone's body
        browser.open("about:blank")
        browser.open(f"{base}#/view/drone-1/test-1/{x},{y},{z},{x},{y + 0.1},0")
        browser.wait("document.body.dataset.points > 71000")
        settle(browser)
        return float(browser.run(COLOURED))

    assert from_beside(0.0) > 0.8 * from_beside(3.0) > 0.2


def projected(page: Browser, where: F64, point: F64) -> tuple[float, float]:
    """CSS pixels at which the view (6,) shows a point (3,)."""
    left, top, w, h = page.run(
        f"(() => {{ const b = {CANVAS}.getBoundingClientRect();"
        " return [b.x, b.y, b.width, b.height]; })()"
    )
    eye, target = where[:3], where[3:]
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    p = point - eye
    depth = p @ ahead * np.tan(np.radians(30.0)) / (h / 2)
    return left + w / 2 + p @ right / depth, top + h / 2 - p @ np.cross(right, ahead) / depth


def test_lengths_in_feet_when_chosen(page: Browser) -> None:
    figures = "document.querySelector('.figures').textContent"
    metres = re.search(r"AMSL([\d.]+) m", page.wait(f"({figures}).includes(' m') && {figures}"))
    assert metres is not None
    field = "[...document.querySelectorAll('.settings label')]"
    field += ".find(l => l.textContent.startsWith('Imperial')).querySelector('input')"
    page.run(f"{field}.click()")
    feet = re.search(r"AMSL([\d.]+) ft", page.wait(f"({figures}).includes(' ft') && {figures}"))
    assert feet is not None
    assert float(feet[1]) * 0.3048 == pytest.approx(float(metres[1]), abs=0.1)


def test_the_list_follows_a_dark_desktop(browser: Browser, base: str) -> None:
    background = "getComputedStyle(document.documentElement).backgroundColor"
    browser.open(f"{base}#/")
    browser.wait("document.querySelectorAll('article').length === 1")
    light = browser.run(background)
    dark = [{"name": "prefers-color-scheme", "value": "dark"}]
    browser.call("Emulation.setEmulatedMedia", features=dark)
    try:
        shown = [int(v) for v in re.findall(r"\d+", browser.run(background))]
        assert max(shown) < 60 < min(int(v) for v in re.findall(r"\d+", light))
    finally:
        browser.call("Emulation.setEmulatedMedia", features=[])


def test_a_keyframe_whose_first_depth_is_void_is_gone(
    browser: Browser, tmp_path: Path, house: HouseFlight
) -> None:
    """Its points, its step of the time slider, and its camera; its image was never asked for."""
    folder = tmp_path / "drone-1/test-1"
    portal = Portal(PortalConfig(tmp_path, port=0, token=TOKEN))
    with ScanStore.create(folder / "scan.db", ScanHeader("test-1", "drone-1", 1)) as store:
        layers = {k: encode(house.keyframe(k, 5.0 * k), house.start_ns + k) for k in range(4)}
        for seq in (0, 1):
            store.add_keyframe(seq, layers[seq])
        portal.start()
        browser.open("about:blank")
        browser.requests.clear()
        browser.open(f"{portal.url.split('/?')[0]}/#/view/drone-1/test-1")
        browser.wait("document.body.dataset.points === '28800'")
        for seq in (2, 3):
            assert store.put_record("first", seq, layers[seq][0])
            browser.wait(f"document.body.dataset.chunk.startsWith('{seq} ')")
            browser.wait("document.body.dataset.points === '32400'")
            assert browser.run("document.querySelector('.time input').max") == "3"
            browser.wait("document.querySelector('.figures').innerText.includes('Images\\n2')")
        store.finish({})
        browser.wait("document.body.dataset.points === '28800'")
        assert browser.run("document.querySelector('.time input').max") == "2"
        browser.wait("document.body.dataset.image === '1'")
        asked = {url.split("?")[0].rsplit("/", 1)[1] for url in browser.requests}
        assert "1.jpg" in asked and not {"2.jpg", "3.jpg"} & asked  # no whole image is there yet
        browser.open("about:blank")
        portal.close()


class HighFlight(HouseFlight):
    """From three times the height, which no sensor states."""

    height_m = 120.0


def test_a_view_that_follows_looks_at_the_ground_below_the_aircraft_also_after_a_climb(
    browser: Browser, tmp_path: Path, house: HouseFlight
) -> None:
    high = HighFlight()
    portal = Portal(PortalConfig(tmp_path, port=0, token=TOKEN))
    with house.flown(tmp_path / "drone-1/test-1") as store:
        portal.start()
        browser.open("about:blank")
        browser.open(f"{portal.url.split('/?')[0]}/#/view/drone-1/test-1")
        browser.wait("document.body.dataset.points > 71000")
        for flight, seq in ((house, 5), (high, 8)):
            east_m = 5.0 * seq
            if flight is high:
                for k in (5, 6, 7):
                    one = high.keyframe(k, 5.0 * k)
                    store.add_keyframe(k, encode(one, one.time_ns))
                browser.wait("document.body.dataset.points > 114000")
            store.add_pose(flight.record(seq, east_m))
            said = f"'{east_m:.0f} m'"
            browser.wait(f"document.querySelector('.figures').textContent.includes({said})")
            settle(browser)
            east, north, up = view(browser)[3:]
            assert east == pytest.approx(east_m, abs=0.5) and abs(north) < 0.5
            assert abs(up) < 8.0  # the house is 6 m high
        browser.open("about:blank")
    portal.close()


def test_a_first_depth_hides_no_surface_and_closes_what_has_none(
    browser: Browser, tmp_path: Path, house: HouseFlight
) -> None:
    """It is coarse and blurred, and here a metre too high."""
    pink = f"document.body.dataset.still === 'yes' && 1 + {LIKE.format(200, 0, 200)}"
    portal = Portal(PortalConfig(tmp_path, port=0, token=TOKEN))
    header = ScanHeader("test-1", "drone-1", 1)
    with ScanStore.create(tmp_path / "drone-1/test-1/scan.db", header) as store:
        for seq in (0, 1):
            one = house.keyframe(seq, 5.0 * seq)
            store.add_keyframe(seq, encode(one, one.time_ns))
        portal.start()
        browser.open("about:blank")
        browser.open(f"{portal.url.split('/?')[0]}/#/view/drone-1/test-1/20,-0.1,90,20,0,0")
        browser.wait("document.body.dataset.points === '28800'")
        shares = [browser.wait(pink) - 1]
        for seq, east_m in ((2, 2.5), (3, 40.0)):
            one = house.keyframe(seq, east_m)
            near = replace(one.depth, depth_m=one.depth.depth_m - 1)
            bgr = np.full_like(one.bgr, (200, 0, 200))
            first = encode(replace(one, depth=near, bgr=bgr), one.time_ns)[0]
            assert store.put_record("first", seq, first)
            browser.wait(f"document.body.dataset.chunk.startsWith('{seq} ')")
            browser.run("new Promise(r => setTimeout(r, 1000))")
            shares.append(browser.wait(pink) - 1)
    browser.open("about:blank")
    portal.close()
    assert shares[0] == 0.0 and shares[1] < 0.003 and shares[2] > 0.03, shares
