"""The portal's buttons and settings in a real browser; skipped without one.

One browser and one portal serve all tests of this file.
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from loopback import free_port, until
from person import Browser, Page
from portal_client import NEEDS, TOKEN, VEHICLE_SHOWN, browser
from rehearsal import RehearsalVehicle

from mavlink.component.control import Answer, Result
from recon.types import U8, Bool
from service.ground.portal import Portal, PortalConfig
from service.ground.vehicle import Vehicle
from service.scans.folder import write_deliverables

if TYPE_CHECKING:
    from house_flight import HouseFlight

pytestmark = NEEDS
__all__ = ["browser"]  # the fixture

FAKE_HEADSET = """
window.headset = { asked: [], frames: 0, ended: null };
delete window.XRWebGLBinding;
window.XRWebGLLayer = class {
  framebuffer = null; framebufferWidth = 640; framebufferHeight = 480; fixedFoveation = 0;
  getViewport() { return { x: 0, y: 0, width: 640, height: 480 }; }
};
WebGL2RenderingContext.prototype.makeXRCompatible = async () => undefined;
const view = {
  eye: 'left',
  transform: { matrix: [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,1.6,0,1] },
  projectionMatrix: [1,0,0,0, 0,1.33,0,0, 0,0,-1,-1, 0,0,-0.2,0],
};
class Session extends EventTarget {
  renderState = {}; inputSources = []; enabledFeatures = []; environmentBlendMode = 'opaque';
  updateRenderState(state) { Object.assign(this.renderState, state); }
  async requestReferenceSpace() { return {}; }
  requestAnimationFrame(call) {
    return setTimeout(() => {
      headset.frames++;
      call(performance.now(), { session: this, getViewerPose: () => ({ views: [view] }) });
    }, 16);
  }
  cancelAnimationFrame(id) { clearTimeout(id); }
  async end() { this.dispatchEvent(Object.assign(new Event('end'), { session: this })); }
}
Object.defineProperty(navigator, 'xr', { configurable: true, value: {
  addEventListener() {},
  isSessionSupported: async (mode) => mode === 'immersive-vr',
  requestSession: async (mode) => {
    headset.asked.push(mode);
    return headset.session = new Session();
  },
} });
"""
CHANGED = " field.dispatchEvent(new Event('input', { bubbles: true }))"
CANVAS = "document.querySelector('.stage canvas')"
IMAGE = f"{CANVAS}.toDataURL('image/png').split(',')[1]"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory, house: HouseFlight) -> Path:
    root = tmp_path_factory.mktemp("scans")
    folder = root / "drone-1" / "test-1"
    with house.flown(folder) as scan:
        scan.finish({"scale": {"from": "gnss", "sigma": 0.0065}})
        write_deliverables(folder, scan)
    return root


@pytest.fixture(scope="module")
def portal(store: Path) -> Iterator[Portal]:
    one = Portal(PortalConfig(store, port=0, token=TOKEN))
    one.start()
    yield one
    one.close()


def open_scan(page: Page, portal: Portal) -> None:
    """Show the scan as points, all of them drawn."""
    page.open(portal.url)
    page.wait("document.querySelectorAll('article').length === 1")
    page.open(f"{portal.url.split('/?')[0]}/#/view/drone-1/test-1")
    page.wait("Number(document.body.dataset.points) > 1000")
    page.click("Points")
    page.wait("document.body.dataset.image === '4'")
    follow = "[...document.querySelectorAll('button')].find(b => b.textContent === 'Follow')"
    page.wait(f"{follow}.ariaPressed === 'false'")  # the end is known, and with it the first view
    page.wait("document.body.dataset.drawn === document.body.dataset.points")
    page.wait("document.body.dataset.still === 'yes'")


def drawn(page: Page) -> U8:
    """The image on the stage, once it stands still."""
    image = page.wait(f"document.body.dataset.still === 'yes' && {IMAGE}")
    data = np.frombuffer(base64.b64decode(image), np.uint8)
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def setting(page: Page, name: str, act: str) -> None:
    """Do ``act`` with the input or list of a setting, as an operator would."""
    page.run(
        "(() => { const label = [...document.querySelectorAll('.settings label')]"
        f".find(l => l.textContent.startsWith('{name}'));"
        f" const field = label.querySelector('input, select'); {act} }})()"
    )


def colour_by(page: Page, name: str) -> None:
    """Choose what the colours show."""
    page.page.select_option('[aria-label="colour by"]', name)


def difference(a: U8, b: U8) -> float:
    """Share of the pixels that are not the same."""
    return float((cv2.absdiff(a, b).max(axis=2) > 4).mean())


def test_settings_change_the_image_and_go_back(browser: Browser, portal: Portal) -> None:
    open_scan(browser, portal)
    # Slices, as large as the machine is fast, decide which of two points in one place is in front.
    setting(browser, "Full detail", "field.click()")
    plain = drawn(browser)
    sky = np.broadcast_to(plain[:, :1], plain.shape).copy()
    assert difference(plain, sky) > 0.05  # the site is there
    assert difference(plain, drawn(browser)) == 0.0
    setting(browser, "Bloom", "field.click(); field.click()")  # off before its code is here
    browser.wait("performance.getEntriesByType('resource').some(e => e.name.includes('/look-'))")
    browser.wait("document.body.dataset.effects === 'no'")
    assert difference(plain, drawn(browser)) == 0.0
    assert browser.run("document.body.dataset.effects") == "no"
    colour_by(browser, "height")  # what is high shines
    bright = drawn(browser)
    for name in ("Bloom", "Depth of field"):
        setting(browser, name, "field.click()")
        browser.wait("document.body.dataset.effects === 'yes'")
        assert difference(bright, drawn(browser)) > 0.01, name
        setting(browser, name, "field.click()")
        browser.wait("document.body.dataset.effects === 'no'")
        assert difference(bright, drawn(browser)) == 0.0
    colour_by(browser, "colour")
    assert difference(plain, drawn(browser)) == 0.0
    setting(browser, "Light scene", "field.click()")
    light = drawn(browser)
    setting(browser, "Bloom", "field.click()")
    browser.wait("document.body.dataset.effects === 'yes'")
    both = drawn(browser)
    site = is_site(plain)
    assert both[site].mean() < light[site].mean() + 25.0  # a bright sky does not shine over all
    setting(browser, "Bloom", "field.click()")
    browser.wait("document.body.dataset.effects === 'no'")
    setting(browser, "Light scene", "field.click()")
    setting(browser, "Field of view", "field.value = 25;" + CHANGED)
    narrow = drawn(browser)
    assert difference(plain, narrow) > 0.1
    assert is_site(narrow).mean() > 1.5 * is_site(plain).mean()  # nearer, so larger
    setting(browser, "Field of view", "field.value = 60;" + CHANGED)
    assert difference(plain, drawn(browser)) == 0.0


def is_site(image: U8, sky_of: U8 | None = None) -> Bool:
    """Pixels that show more than the sky, which the left border of ``sky_of`` (the image itself)
    shows alone."""
    border = (image if sky_of is None else sky_of)[:, :1]
    sky = np.broadcast_to(border, image.shape).copy()
    return np.asarray(cv2.absdiff(image, sky).max(axis=2) > 6)


def solid_share(image: U8, sky_of: U8 | None = None) -> float:
    """Share of the site's area, without its rim that fades, where no background shows through."""
    shown = is_site(image, sky_of).astype(np.uint8)
    closed = cv2.morphologyEx(shown, cv2.MORPH_CLOSE, np.ones((31, 31)))
    inner = cv2.erode(closed, np.ones((41, 41))).astype(bool)
    assert inner.mean() > 0.02
    return float(shown[inner].mean())


def test_ground_looks_like_ground_at_the_first_look(browser: Browser, portal: Portal) -> None:
    browser.screen(1280, 800, pixel_ratio=1.0)  # points and their shade are small
    open_scan(browser, portal)
    browser.click("Whole site")
    plain = drawn(browser)
    assert solid_share(plain) > 0.97
    setting(browser, "Shading", "field.value = 0;" + CHANGED)
    flat = drawn(browser)
    darker = flat.astype(int).sum(axis=2) - plain.astype(int).sum(axis=2)
    assert 150 < (darker > 60).sum() < 0.02 * darker.size  # along the steps of the house alone
    setting(browser, "Point size", "field.value = 0.3;" + CHANGED)
    assert solid_share(drawn(browser)) < solid_share(plain) - 0.02
    browser.screen(1280, 800)


def test_the_surface_is_closed_also_while_it_moves(browser: Browser, portal: Portal) -> None:
    browser.screen(1280, 800, pixel_ratio=1.0)
    open_scan(browser, portal)
    browser.click("Surface")
    browser.click("Whole site")
    until(lambda: solid_share(drawn(browser)) > 0.999)  # the ground below follows in its time
    closed = drawn(browser)
    red = closed[closed[..., 2] > 2.0 * closed[..., 1]]  # the roof, in the colour of its images
    assert len(red) > 100 and np.abs(np.median(red, axis=0) - (47, 47, 230)).max() < 25
    browser.click("Measured only")
    only = drawn(browser)
    assert difference(closed, only) > 0.001  # below the roof's edges and around the site
    browser.click("Measured only")
    colour_by(browser, "height")
    heights = drawn(browser)
    assert solid_share(heights, closed) > 0.99
    blue, green, _ = np.moveaxis(heights[cv2.absdiff(closed, only).max(axis=2) > 20], -1, 0)
    assert (green > blue).mean() < 0.5  # no grass where nothing was seen, but the colour of the low
    colour_by(browser, "colour")
    assert difference(closed, drawn(browser)) == 0.0
    browser.page.mouse.move(600, 400)
    browser.page.mouse.down()
    for k in range(1, 9):
        browser.page.mouse.move(600 + 10 * k, 400)
        data = np.frombuffer(base64.b64decode(browser.run(IMAGE)), np.uint8)
        moving = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
        moving = np.asarray(cv2.resize(moving, closed.shape[1::-1]), np.uint8)
        assert solid_share(moving, closed) > 0.99
    browser.page.mouse.up()
    browser.screen(1280, 800)


def test_a_scene_at_rest_asks_for_no_frames(browser: Browser, portal: Portal) -> None:
    open_scan(browser, portal)
    drawn(browser)
    count = "window.requestAnimationFrame = f => (asked++, ask.call(window, f));"
    browser.run(f"window.asked = 0; window.ask = requestAnimationFrame; {count} 0")
    # None for longer than a turn of the figures, once all that comes late has come.
    browser.wait("(asked = 0, new Promise(r => setTimeout(() => r(asked === 0), 400)))")
    before = drawn(browser)
    browser.page.keyboard.press("d", delay=200)  # flies
    assert difference(before, drawn(browser)) > 0.01
    assert browser.run("asked") > 0


@pytest.mark.parametrize("screen", [(1440, 900), (390, 844)])
def test_the_whole_site_fills_the_scene_above_the_time_slider(
    browser: Browser, portal: Portal, screen: tuple[int, int]
) -> None:
    browser.screen(*screen)
    open_scan(browser, portal)
    browser.click("Whole site")
    seen = is_site(drawn(browser))
    browser.screen(1440, 900)
    bottom = np.flatnonzero(seen.any(axis=1))[-1]
    cols = np.flatnonzero(seen.any(axis=0))
    height, width = seen.shape
    assert bottom < height - (100 if width < 700 else 56)  # above the slider
    assert cols[0] > 0 and cols[-1] < width - 1 and np.ptp(cols) > 0.84 * width


def test_the_whole_site_stays_in_sight_beside_a_panel(browser: Browser, portal: Portal) -> None:
    browser.screen(390, 1400)
    open_scan(browser, portal)
    browser.click("Whole site")
    browser.click("Coverage")
    browser.wait("document.querySelector('.coverage img').naturalHeight > 0")
    shown = drawn(browser)
    browser.click("Whole site")
    again = drawn(browser)
    browser.screen(1280, 800)
    assert shown.shape == again.shape
    assert np.abs(shown.astype(int) - again).mean() < 1.0


LINES_OF_TOOLS = """
[...document.querySelectorAll('.tools button, .tools summary')].forEach(b => b.hidden = false),
[...document.querySelectorAll('.tools .group > :is(button, summary)')]
  .map(b => Math.round(b.getBoundingClientRect().top / 10))
  .filter((y, k, all) => all.indexOf(y) === k)
"""
"""Heights at which tools lie, also those of a scan that grows, and of one with all products."""


@pytest.mark.parametrize("screen", [(1440, 900), (390, 844)])
def test_a_long_name_leaves_the_view_its_width(
    browser: Browser, portal: Portal, store: Path, screen: tuple[int, int]
) -> None:
    labels = store / "drone-1/test-1/library.json"
    labels.write_text(json.dumps({"title": 200 * "W"}))
    browser.screen(*screen)
    open_scan(browser, portal)
    labels.unlink()
    wide = browser.run("document.documentElement.scrollWidth")
    lines = browser.run(LINES_OF_TOOLS)
    browser.screen(1280, 800)
    assert wide == screen[0] and (len(lines) == 1 or screen[0] < 1440)


SLOW_CARD = """
window.since = Infinity;
const late = new WeakSet(), gl = WebGL2RenderingContext.prototype;
const { fenceSync, clientWaitSync } = gl;
gl.fenceSync = function (...a) {
  const sync = fenceSync.apply(this, a);
  if (performance.now() > window.since) late.add(sync);
  return sync;
};
gl.clientWaitSync = function (sync, ...a) {
  const busy = window.since < Infinity && late.has(sync);
  return busy ? this.TIMEOUT_EXPIRED : clientWaitSync.call(this, sync, ...a);
};
"""
"""A graphics card that ends no work given to it after ``since``, until that is infinite again."""


COUNTED = """
window.frames_given = 0;
const counted = WebGL2RenderingContext.prototype.fenceSync;
WebGL2RenderingContext.prototype.fenceSync = function (...a) {
  window.frames_given++;
  return counted.apply(this, a);
};
"""
FRAMES_LATER = """(async () => {
  for (let k = 0; k < 5; k++) await new Promise(r => requestAnimationFrame(r));
})()"""


LATE_CARD = """
const given = new WeakMap(), gl = WebGL2RenderingContext.prototype;
const { fenceSync, clientWaitSync } = gl;
gl.fenceSync = function (...a) {
  const sync = fenceSync.apply(this, a);
  given.set(sync, performance.now());
  return sync;
};
gl.clientWaitSync = function (sync, ...a) {
  const busy = performance.now() - given.get(sync) < 250;
  return busy ? this.TIMEOUT_EXPIRED : clientWaitSync.call(this, sync, ...a);
};
"""
"""A graphics card that takes 250 ms or more for each frame."""


def test_a_slow_card_draws_fewer_pixels_while_the_view_moves(
    browser: Browser, portal: Portal
) -> None:
    open_scan(browser, portal)
    browser.click("Surface")
    drawn(browser)
    whole = browser.run(f"{CANVAS}.width")
    browser.run(LATE_CARD + ";0")
    browser.page.mouse.move(600, 400)
    browser.page.mouse.down()
    widths = []
    for k in range(1, 25):
        browser.page.mouse.move(600 + 5 * k, 400)
        browser.run("new Promise(r => setTimeout(r, 100))")
        widths.append(browser.run(f"{CANVAS}.width"))
    browser.page.mouse.up()
    assert min(widths) == pytest.approx(whole / 2, abs=1)
    drawn(browser)
    assert browser.run(f"{CANVAS}.width") == whole
    browser.click("Add view")
    browser.mouse(600, 400, to=(700, 400))
    browser.click("Add view")
    drawn(browser)
    with browser.page.expect_download(timeout=60_000):  # but a film is sharp
        browser.click("Record")
        for _ in range(20):
            browser.run("new Promise(r => setTimeout(r, 100))")
            assert browser.run(f"{CANVAS}.width") == whole


def test_what_changes_while_the_graphics_card_is_busy_is_drawn(
    browser: Browser, portal: Portal
) -> None:
    browser.screen(1280, 800)
    open_scan(browser, portal)
    setting(browser, "Full detail", "field.click()")  # a frame holds all points, none follows it
    drawn(browser)
    browser.run(SLOW_CARD + ";0")
    browser.run("since = performance.now(); dispatchEvent(new Event('input')); 0")
    browser.run(FRAMES_LATER)  # a frame is being drawn
    browser.screen(1000, 700)  # clears the canvas
    browser.run(FRAMES_LATER)
    browser.run("since = Infinity; 0")
    corner = drawn(browser)[2, 2]
    browser.screen(1280, 800)
    assert corner.min() > 0x1B  # the sky, not black


def test_the_view_follows_a_drag_that_lasts(browser: Browser, portal: Portal) -> None:
    open_scan(browser, portal)
    browser.click("Whole site")
    before = drawn(browser)
    browser.page.mouse.move(600, 400)
    browser.page.mouse.down()
    browser.run("new Promise(r => setTimeout(r, 700))")  # the scene rests
    browser.page.mouse.move(700, 420)
    turned = drawn(browser)
    browser.page.mouse.up()
    assert difference(before, turned) > 0.1


def test_a_click_that_measures_does_not_draw_the_scene_again(
    browser: Browser, portal: Portal
) -> None:
    open_scan(browser, portal)
    browser.click("Measure")
    drawn(browser)
    browser.run(COUNTED + ";0")
    browser.mouse(640, 430)
    browser.wait("document.querySelectorAll('.overlay circle').length === 1")
    browser.run(FRAMES_LATER)
    assert browser.run("frames_given") == 0
    browser.click("Cameras")
    drawn(browser)
    assert browser.run("frames_given") > 0


def test_card_and_view_give_the_same_figures(browser: Browser, portal: Portal, store: Path) -> None:
    summary = json.loads((store / "drone-1/test-1/scan.json").read_text())
    points, quality = f"{summary['counts']['points']:,}", summary["quality"]
    browser.open(portal.url)
    browser.wait("document.querySelectorAll('article').length === 1")
    facts = browser.run("document.querySelector('article .facts').innerText")
    assert f"{points} points" in facts
    assert f"relative ±{quality['sigma_median_m']:.2f} m" in facts
    across, up = quality["position_sigma_h_median_m"], quality["sigma_absolute_median_m"]
    assert up > quality["position_sigma_v_median_m"]
    absolute = f"±{across:.2f} m across, ±{up:.2f} m up"
    assert f"absolute {absolute}" in facts
    assert f"Trust\n{quality['trust']['level']}" in facts
    open_scan(browser, portal)
    browser.wait(f"document.querySelector('.figures').innerText.includes('{points}')")
    figures = browser.run("document.querySelector('.figures').innerText")
    assert f"Points\n{points}" in figures
    assert f"Relative\n±{quality['sigma_median_m']:.2f} m" in figures
    assert f"Absolute\n{absolute}" in figures
    assert "Scale\n±0.7 %" in figures
    assert "Speed" not in figures  # it has landed
    follow = "[...document.querySelectorAll('button')].find(b => b.textContent === 'Follow')"
    assert browser.run(f"{follow}.hidden")
    at = "const field = document.querySelector('.time input'); field.value = '{}';"
    figure = "document.querySelector('.figures').innerText.includes('Points')"
    for step, shown in (("2", "!"), ("5", "!!")):  # of a part, what is kept is not counted
        browser.run(f"(() => {{ {at.format(step)}{CHANGED} }})()")
        browser.wait(f"{shown}{figure}")


def test_the_colours_of_sigma_span_what_is_there(browser: Browser, portal: Portal) -> None:
    open_scan(browser, portal)
    colour_by(browser, "sigma")
    words = browser.wait("document.querySelector('.legend:not([hidden])')?.textContent")
    found = re.search(r"([\d.]+) m and more", words)
    assert found is not None and 0.03 < float(found.group(1)) < 0.1  # 0.05 m in the flight


def test_tone_mapping_and_exposure_change_the_mesh(
    browser: Browser, portal: Portal, store: Path
) -> None:
    pytest.importorskip("open3d", exc_type=ImportError)
    open_scan(browser, portal)
    browser.click("Make mesh")
    browser.wait("document.body.dataset.mesh === 'shown'", 60)
    plain = drawn(browser)
    choose = "field.value = [...field.options].find(o => o.text === 'Reinhard').value;"
    setting(browser, "Tone", choose + CHANGED.replace("input", "change"))
    reinhard = drawn(browser)
    assert difference(plain, reinhard) > 0.05
    setting(browser, "Exposure", "field.value = 1.5;" + CHANGED)
    brighter = drawn(browser)
    assert brighter.mean() > reinhard.mean() + 3.0
    setting(browser, "Tone", "field.selectedIndex = 0;" + CHANGED.replace("input", "change"))
    site = is_site(plain)
    assert drawn(browser)[site].mean() > plain[site].mean() + 20.0
    setting(browser, "Exposure", "field.value = 0;" + CHANGED)
    assert difference(plain, drawn(browser)) == 0.0
    browser.click("Points")


def test_vr_is_offered_entered_and_left(browser: Browser, portal: Portal) -> None:
    """Through a headset that is only pretended: what the page asks of WebXR, and draws for it."""
    script = browser.call("Page.addScriptToEvaluateOnNewDocument", source=FAKE_HEADSET)
    try:
        browser.open("about:blank")
        open_scan(browser, portal)
        browser.wait("document.querySelector('#VRButton').textContent === 'ENTER VR'")
        browser.click("ENTER VR")
        browser.wait("document.querySelector('#VRButton').textContent === 'EXIT VR'")
        assert browser.run("headset.asked") == ["immersive-vr"]
        browser.wait("headset.frames > 5")
        assert browser.run("!!headset.session.renderState.baseLayer")
        browser.click("EXIT VR")
        browser.wait("document.querySelector('#VRButton').textContent === 'ENTER VR'")
        after = browser.run("headset.frames")
        browser.run("new Promise(r => setTimeout(r, 200))")
        assert browser.run("headset.frames") <= after + 1
        drawn(browser)
    finally:
        browser.call("Page.removeScriptToEvaluateOnNewDocument", identifier=script["identifier"])
        browser.open("about:blank")


def test_without_a_headset_there_is_no_vr_button(browser: Browser, portal: Portal) -> None:
    open_scan(browser, portal)
    assert browser.run("document.querySelector('#VRButton')") is None


def test_of_two_people_renaming_at_once_the_second_is_warned(
    browser: Browser, portal: Portal
) -> None:
    other = browser.other()
    for page in (browser, other):
        page.open(portal.url)
        page.wait("document.querySelectorAll('article').length === 1")
    other.click("Rename…")
    other.answer("south roof")
    other.wait("document.querySelector('article h2').textContent === 'south roof'")
    browser.click("Tags…")  # on a list that is no longer so
    browser.answer("garden")
    browser.wait("document.querySelector('.note').textContent.includes('someone else')")
    browser.wait("document.querySelector('article h2').textContent === 'south roof'")
    assert browser.run("document.querySelectorAll('.tags span').length") == 0
    browser.click("Tags…")  # having looked again
    browser.answer("garden")
    browser.wait("document.querySelector('.tags span').textContent === 'garden'")
    assert browser.run("document.querySelector('article h2').textContent") == "south roof"


def test_a_refused_stop_shows_the_companions_own_words(browser: Browser, store: Path) -> None:
    """Over MAVLink between the portal's client and the companion's link, both ours and real."""
    pytest.importorskip("mavsdk")
    port = free_port()
    vehicle = Vehicle(f"udpin://127.0.0.1:{port}")
    one = Portal(PortalConfig(store, port=0, token=TOKEN), vehicle=vehicle)
    one.start()
    try:
        with RehearsalVehicle(f"udpout:127.0.0.1:{port}") as companion:
            companion.control.answers["stop_scan"] = Answer(Result.DENIED, "the disk is in use")
            vehicle.start()
            browser.open(one.url)
            browser.wait(VEHICLE_SHOWN, 30)
            browser.click("Start scan")
            browser.answer()
            browser.wait("document.querySelector('.note').textContent === 'start: accepted'")
            browser.click("Stop scan")
            browser.answer()
            browser.wait(
                "[...document.querySelectorAll('.note')].some(n =>"
                " n.textContent.startsWith('stop denied'))",
                30,
            )
            assert companion.control.asked == ["start_scan", "stop_scan"]
    finally:
        one.close()
