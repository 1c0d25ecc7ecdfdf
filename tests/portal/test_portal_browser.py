"""The portal's pages in a real browser (Chromium); skipped without one."""

from __future__ import annotations

import base64
import json
import os
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from house_flight import HouseFlight
from loopback import free_port, until
from person import Browser
from portal_client import NEEDS, TOKEN, VEHICLE_SHOWN, browser, flown_store, listing
from rehearsal import RehearsalVehicle
from site_scans import Box, Errors, leg, write_scan

from recon.types import I64, Keyframe
from service.ground.live_site import FILE, Follower
from service.ground.portal import Portal, PortalConfig
from service.ground.vehicle import Vehicle
from service.offline.exports.view import ExportOptions, ScanView, export
from service.scans.folder import write_deliverables
from service.stream.codec import encode, encode_image
from service.stream.records import Repose
from service.stream.store import ScanStore

pytestmark = NEEDS
__all__ = ["browser"]  # the fixture


@pytest.fixture
def scans(tmp_path: Path, house: HouseFlight) -> Path:
    return flown_store(tmp_path, house)


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
    browser.click("Rename…")
    browser.answer("<img src=x onerror=alert(1)> Hof")
    browser.wait("document.querySelector('h2').textContent.startsWith('<img')")
    assert browser.run("document.querySelectorAll('article h2 img').length") == 0
    browser.click("Tags…")
    browser.answer("roof, spring")
    browser.wait("document.querySelectorAll('.tags span').length === 2")
    browser.click("Export…")
    browser.wait("document.querySelectorAll('.product').length > 20")
    size = browser.run(
        "fetch(document.querySelector('[aria-label=\"Download Cloud, LAZ\"]').href)"
        ".then(r => r.arrayBuffer()).then(b => b.byteLength)"
    )
    assert size > 10_000
    browser.key("Escape")
    browser.wait("!document.querySelector('dialog')")
    browser.click("Delete")
    browser.wait("document.querySelectorAll('article').length === 0")
    browser.click("Restore")
    browser.wait("document.querySelectorAll('article').length === 1")
    assert browser.run("document.querySelector('h2').textContent").startswith("<img")


def test_the_cloud_grows_and_moves_while_one_looks(
    browser: Browser, portal: Portal, scans: Path, house: HouseFlight
) -> None:
    browser.open("about:blank")  # the page before this one asks its own portal no more
    browser.wait("location.href === 'about:blank'")
    browser.requests.clear()
    browser.open(f"{base(portal)}/#/view/drone-1/test-1")
    before = browser.wait("Number(document.body.dataset.points) || 0")
    with ScanStore.open(scans / "drone-1/test-1/scan.db") as scan:
        one = house.keyframe(5, 30.0)
        scan.add_keyframe(5, encode(one, one.time_ns))
        scan.add_reposes([Repose(1, 1, house.pose(7.0), 1.0, np.eye(6))])
        scan.add_pose(house.record(5, 30.0))
    browser.wait(f"Number(document.body.dataset.points) > {before}")
    browser.wait("document.querySelector('.figures').textContent.includes('25 m')")
    browser.wait("Number(document.body.dataset.fps) > 0", 40)
    outside = [u for u in browser.requests if not u.startswith((base(portal), "data:", "ws:"))]
    assert [u for u in outside if not u.startswith(("blob:", "about:", "chrome"))] == []


def test_the_scale_of_heights_follows_what_comes_and_moves(
    browser: Browser, portal: Portal, scans: Path, house: HouseFlight
) -> None:
    browser.open("about:blank")
    browser.open(f"{base(portal)}/#/view/drone-1/test-1")
    browser.wait("document.body.dataset.image === '4'")
    browser.page.select_option('[aria-label="colour by"]', "height")
    top = "parseFloat(document.querySelector('.legend:not([hidden])').lastChild.textContent)"
    before = browser.wait(top)
    with ScanStore.open(scans / "drone-1/test-1/scan.db") as scan:
        one = house.keyframe(5, 30.0)
        one.depth.T_world_camera[2, 3] += 30.0  # over a hill
        scan.add_keyframe(5, encode(one, one.time_ns))
        grown = browser.wait(f"{top} > {before + 20.0} && {top}")
        assert grown < before + 40.0
        scan.add_reposes([Repose(5, 1, house.pose(30.0), 1.0, np.eye(6))])  # there was none
    assert browser.wait(f"{top} < {grown - 20.0} && {top}") == pytest.approx(before, abs=3.0)


def test_the_mesh_is_made_and_shown(browser: Browser, portal: Portal) -> None:
    pytest.importorskip("open3d", exc_type=ImportError)
    browser.open(portal.url)
    browser.wait("document.querySelectorAll('article').length === 1")
    browser.open(f"{base(portal)}/#/view/drone-1/test-1")
    browser.wait("Number(document.body.dataset.points) || 0")
    browser.page.select_option('[aria-label="colour by"]', "height")
    browser.click("Make mesh")
    browser.wait("document.body.dataset.mesh === 'shown'", 60)
    browser.page.wait_for_timeout(2500.0)  # the page has looked again what there is
    names = "[...document.querySelectorAll('.tools button')].map(b => b.textContent)"
    assert "Mesh" in browser.run(names) and "Make tiles" in browser.run(names)
    colour = (
        "(s => `${s.disabled} ${s.value}`)(document.querySelector('[aria-label=\"colour by\"]'))"
    )
    time_shown = "document.querySelector('.time').checkVisibility()"
    assert browser.run(f"[{colour}, {time_shown}]") == ["false colour", True]  # a mesh has no other
    browser.click("Points")
    browser.wait("!document.body.dataset.mesh")
    assert browser.run(f"[{colour}, {time_shown}]") == ["false height", True]


PRESSED = "[...document.querySelectorAll('.tools button.on')].map(b => b.textContent).join()"
SLIDE = """(() => {
  const input = document.querySelector('.time input'); input.value = '%d'; input.oninput();
})()"""


def test_a_finished_scan_opens_as_its_mesh(browser: Browser, portal: Portal, scans: Path) -> None:
    """Time, figures and what was measured alone are of the depth images: these are shown then."""
    pytest.importorskip("open3d", exc_type=ImportError)
    folder = scans / "drone-1/test-1"
    with ScanStore.open(folder / "scan.db") as store:
        store.finish({})
        write_deliverables(folder, store)
    browser.open("about:blank")
    browser.wait("location.href === 'about:blank'")
    browser.open(f"{base(portal)}/#/view/drone-1/test-1")
    browser.wait(f"{PRESSED} === 'Surface'")
    with ScanView(folder) as scan:
        export(scan, "glb", None, ExportOptions())
    browser.wait(f"document.body.dataset.mesh === 'shown' && {PRESSED} === 'Mesh'", 60)  # by itself
    browser.run(SLIDE % 2)
    browser.wait(f"{PRESSED} === 'Surface' && !document.body.dataset.mesh")
    figure = "document.querySelector('.figures').textContent"
    browser.wait(f"{figure}.includes('Images2')")
    browser.click("Mesh")
    browser.wait("document.body.dataset.mesh === 'shown'")
    assert browser.run("document.querySelector('.time input').value") == "5"  # a mesh is of all
    browser.wait(f"{figure}.includes('Images5')")
    browser.page.select_option('[aria-label="colour by"]', "height")
    browser.wait(f"{PRESSED} === 'Surface'")
    browser.wait("document.querySelector('.legend').checkVisibility()")
    browser.click("Mesh")
    browser.wait("document.body.dataset.mesh === 'shown'")
    assert not browser.run("document.querySelector('.legend').checkVisibility()")
    browser.wait("document.body.dataset.still === 'yes'")
    assert purple(browser) == 0, "the ground around the mesh is not drawn by height"
    browser.click("Measured only")
    browser.wait(f"{PRESSED} === 'Surface,Measured only'")
    browser.wait("document.body.dataset.still === 'yes'")
    assert purple(browser) > 0
    browser.click("Mesh")
    browser.wait(f"{PRESSED} === 'Mesh'")
    later = time.time() + 5
    os.utime(folder / "scan.json", (later, later))
    browser.open("about:blank")
    browser.wait("location.href === 'about:blank'")
    browser.open(f"{base(portal)}/#/view/drone-1/test-1")  # the scan has changed: as it is now
    browser.wait(
        "[...document.querySelectorAll('button')].some(b => b.textContent === 'Make mesh')"
    )
    browser.wait(f"{PRESSED} === 'Surface'")


def test_a_phone_stays_at_the_surface_where_the_mesh_is_large(
    browser: Browser, portal: Portal, scans: Path
) -> None:
    folder = scans / "drone-1/test-1"
    with ScanStore.open(folder / "scan.db") as store:
        store.finish({})
        write_deliverables(folder, store)
    with (folder / "mesh.glb").open("wb") as mesh:
        mesh.truncate(20_000_000)
    offered = "[...document.querySelectorAll('button')].some(b => b.textContent === 'Mesh')"
    for width, height, is_loaded in ((390, 844, False), (1280, 800, True)):
        browser.screen(width, height)
        browser.open("about:blank")
        browser.wait("location.href === 'about:blank'")
        browser.requests.clear()
        browser.open(f"{base(portal)}/#/view/drone-1/test-1")
        browser.wait(f"{offered} && document.body.dataset.still === 'yes'")
        assert any(url.endswith("/mesh.glb") for url in browser.requests) == is_loaded


def drawn(browser: Browser) -> I64:
    """(h, w, 3) the view, BGR."""
    script = "document.querySelector('.stage canvas').toDataURL('image/png').split(',')[1]"
    data = np.frombuffer(base64.b64decode(browser.run(script)), np.uint8)
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.int64)


def purple(browser: Browser) -> int:
    """Pixels in the colour of the lowest heights."""
    blue, green, red = np.moveaxis(drawn(browser), -1, 0)
    return int(((blue > green + 40) & (red > green + 30)).sum())


def roof_red(browser: Browser) -> float:
    """How bright the red roof is drawn, 0 to 255: (40, 40, 200) in the scan; 0 if none is seen."""
    image = drawn(browser)
    red = image[image[..., 2] > 2 * image[..., 1]]
    if len(red) <= 100:
        return 0.0
    assert np.median(red[:, 1]) < 70
    return float(np.median(red[:, 2]))


def shows_red(browser: Browser, red: float) -> bool:
    """Whether the view is drawn, with the roof as bright as that."""
    still = browser.run("document.body.dataset.still === 'yes'")
    return bool(still) and abs(roof_red(browser) - red) < 25


def test_the_tiles_are_loaded_where_the_cloud_was(
    browser: Browser, portal: Portal, scans: Path
) -> None:
    pytest.importorskip("py3dtiles")
    with ScanView(scans / "drone-1/test-1") as scan:
        export(scan, "3dtiles", None, ExportOptions())
    browser.open(portal.url)
    browser.wait("document.querySelectorAll('article').length === 1")
    browser.open(f"{base(portal)}/#/view/drone-1/test-1")
    browser.wait("Number(document.body.dataset.points) || 0")
    browser.click("Whole site")
    browser.wait("document.body.dataset.still === 'yes'")
    red = roof_red(browser)
    browser.click("Tiles")
    browser.wait("Number(document.body.dataset.tiles) > 0", 60)
    until(lambda: shows_red(browser, red), 60.0)  # the same colours, not washed out
    off = json.loads(browser.wait("document.body.dataset.tilesMiddle"))
    assert np.abs(off[:2]).max() < 15.0 and abs(off[2]) < 5.0  # about the scan's own origin


SPLAT = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"


def write_splats(folder: Path) -> None:
    """A Gaussian of 0.1 m at every fourth point of a scan, as PLY with y down."""
    rows = []
    with ScanStore.open(folder / "scan.db") as store:
        for k in store.keyframes():
            v, u = np.nonzero(k.fresh)
            v, u = v[::4], u[::4]
            z = k.depth.depth_m[v, u]
            rays = np.linalg.solve(k.depth.K, np.stack([u, v, np.ones_like(u)]).astype(float)).T
            T = k.depth.T_world_camera
            east, north, up = T[:3, :3] @ (rays * z[:, None]).T + T[:3, 3:]
            row = np.zeros((len(z), 14), "<f4")
            row[:, :3] = np.column_stack([east, -up, north])
            row[:, 3:6] = (k.bgr[v, u, ::-1] / 255.0 - 0.5) / 0.28209479
            row[:, 6:11] = [5.0, *np.log([0.1, 0.1, 0.1]), 1.0]
            rows.append(row)
    data = np.concatenate(rows)
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(data)}"]
    head += [f"property float {name}" for name in SPLAT.split()]
    text = "\n".join([*head, "end_header", ""]).encode()
    (folder / "splat.ply").write_bytes(text + data.tobytes())


class DuskFlight(HouseFlight):
    """The same flight with images half as bright."""

    def keyframe(self, seq: int, east_m: float, sigma_m: float = 0.05) -> Keyframe:
        """The exact view of the camera."""
        one = super().keyframe(seq, east_m, sigma_m)
        return replace(one, bgr=one.bgr // 2)


def test_splats_lie_where_the_surface_was_and_are_as_bright(
    browser: Browser, tmp_path: Path
) -> None:
    scans = flown_store(tmp_path, DuskFlight())
    write_splats(scans / "drone-1/test-1")
    with listing(browser, scans, 1) as address:
        look_at_splats(browser, address)


def look_at_splats(browser: Browser, address: str) -> None:
    browser.requests.clear()
    browser.open(f"{address}/#/view/drone-1/test-1")
    browser.wait("document.body.dataset.points === '72000'")
    browser.click("Whole site")
    browser.wait("document.body.dataset.still === 'yes'")
    red = roof_red(browser)
    assert red > 130  # the exposure makes it brighter than in the scan, 100
    assert not [url for url in browser.requests if "splat" in url]
    effect = "[...document.querySelectorAll('.settings label')].find(l => l.textContent === '{}')"
    for name in ("Bloom", "Depth of field"):  # have the same exposure
        browser.run(f"{effect.format(name)}.querySelector('input').click()")
        browser.wait("document.body.dataset.effects === 'yes'")
        until(lambda: shows_red(browser, red), 60.0)
        browser.run(f"{effect.format(name)}.querySelector('input').click()")
        browser.wait("document.body.dataset.effects === 'no'")
    browser.click("Splats")
    browser.wait("document.body.dataset.splats === 'shown'", 60)
    until(lambda: shows_red(browser, red), 60.0)
    browser.click("Measured only")  # without the filled ground below
    until(lambda: shows_red(browser, red), 60.0)
    browser.click("Surface")
    browser.wait("!document.body.dataset.splats")
    browser.click("Splats")
    browser.wait("document.body.dataset.splats === 'shown'", 60)
    browser.open(f"{address}/#/")
    browser.wait("!document.body.dataset.splats")  # who leaves the view leaves nothing behind


def test_the_latest_image_is_shown(
    browser: Browser, portal: Portal, scans: Path, house: HouseFlight
) -> None:
    browser.open(portal.url)
    browser.wait("document.querySelectorAll('article').length === 1")
    browser.open(f"{base(portal)}/#/view/drone-1/test-1")
    browser.wait("document.body.dataset.image === '4'")
    assert browser.run("document.querySelector('.latest img').naturalWidth") == 160
    whole = np.full((240, 320, 3), 128, np.uint8)
    one = house.keyframe(5, 30.0)
    little = replace(one, fresh=one.fresh & (np.arange(160) < 8))
    with ScanStore.open(scans / "drone-1/test-1/scan.db") as scan:
        scan.add_keyframe(5, encode(little, one.time_ns), encode_image(whole))
    browser.wait("document.body.dataset.image === '5'")
    assert browser.run("document.querySelector('.latest img').naturalWidth") == 320


def test_an_image_gets_finer_with_its_keyframe(
    browser: Browser, portal: Portal, scans: Path, house: HouseFlight
) -> None:
    one = house.keyframe(5, 30.0)
    coarse, *finer = encode(one, one.time_ns)
    width = "document.querySelector('.latest img').naturalWidth"
    faults: list[str] = []
    browser.page.on("console", lambda said: faults.append(said.text))
    with ScanStore.open(scans / "drone-1/test-1/scan.db") as scan:
        scan.add_keyframe(5, [coarse])
        browser.open("about:blank")
        browser.open(f"{base(portal)}/#/view/drone-1/test-1")
        browser.wait("document.body.dataset.image === '5'")
        small = browser.run(width)
        browser.wait("document.body.dataset.still === 'yes'")
        scan.add_keyframe(5, finer)
        browser.wait(f"{width} === 160", 20)
    assert small == 80
    assert [text for text in faults if "GL_" in text] == []  # the frustum shows it, too


def test_the_buttons_reach_the_vehicle_and_show_its_answer(browser: Browser, scans: Path) -> None:
    pytest.importorskip("mavsdk")
    port = free_port()
    vehicle = Vehicle(f"udpin://127.0.0.1:{port}")
    one = Portal(PortalConfig(scans, port=0, token=TOKEN), vehicle=vehicle)
    one.start()
    try:
        with RehearsalVehicle(f"udpout:127.0.0.1:{port}") as daemon:
            vehicle.start()
            browser.open(one.url)
            browser.wait(VEHICLE_SHOWN, 30)
            browser.click("Start scan")
            browser.answer()
            browser.wait("document.querySelector('.note').textContent === 'start: accepted'")
            browser.click("Baseline")
            browser.answer("2.5")
            browser.wait(
                "[...document.querySelectorAll('.note')].some(n => n.textContent ==="
                " 'baseline 2.5 m: accepted')",
                30,
            )
            assert daemon.link.parameters()["SR_BASELINE_M"] == 2.5
    finally:
        one.close()


def test_without_webgl_the_view_says_so_and_the_list_works(
    browser: Browser, portal: Portal
) -> None:
    blind = Browser(browser.driver, "--disable-3d-apis")
    try:
        blind.open(portal.url)
        blind.wait("document.querySelectorAll('article').length === 1")
        blind.open(f"{base(portal)}/#/view/drone-1/test-1")
        blind.wait("document.querySelector('.stage').textContent.includes('cannot draw in 3D')")
        blind.open(f"{base(portal)}/#/")
        blind.wait("document.querySelectorAll('article').length === 1")
    finally:
        blind.close()


def test_an_empty_library_says_how_scans_get_there(browser: Browser, tmp_path: Path) -> None:
    one = Portal(PortalConfig(tmp_path / "none", port=0, token=TOKEN))
    one.start()
    try:
        browser.open(one.url)
        browser.wait("document.querySelector('.empty h2').textContent === 'No scans yet'")
    finally:
        one.close()


def test_a_scan_in_flight_is_drawn_with_those_it_is_tied_to(
    browser: Browser, tmp_path: Path
) -> None:
    one = write_scan(tmp_path / "a/1", leg(0.0, 4), Errors((1.1, -0.7, 0.9)), finished=False)
    write_scan(tmp_path / "b/2", leg(np.pi / 2, 4), finished=False)
    follower, written_unix_s = Follower(tmp_path), time.time()
    errors: list[str] = []
    browser.page.on("pageerror", lambda error: errors.append(str(error)))
    with listing(browser, tmp_path, 2) as base:
        browser.open(f"{base}/#/view/a/1")
        alone = browser.wait(
            f"Number(document.body.dataset.points) >= {samples(one)} && {samples(one)}"
        )
        assert browser.run("document.body.dataset.ties") is None
        while follower.turn(written_unix_s):  # however long the page took to draw
            pass
        browser.wait("Number(document.body.dataset.ties) > 1")  # by the message `site`
        browser.wait("document.querySelector('.figures').textContent.includes('joined in ')")
        browser.wait(f"Number(document.body.dataset.points) > {alone}")
        own = "document.querySelector('.figures').innerText.match(/Images\\n(\\d+)/)?.[1]"
        slider = "document.querySelector('.time input')"
        assert browser.run(f"[{own}, {slider}.max]") == ["4", "4"]  # of this scan alone
        at = "document.querySelector('.time output').textContent"
        assert 0 <= int(browser.run(at).removesuffix(" s")) < 100  # of its own flight
        browser.run(f"{slider}.value = 2; {slider}.dispatchEvent(new Event('input'))")
        browser.wait(f"{own} === '2'")
        browser.run(f"{slider}.value = 4; {slider}.dispatchEvent(new Event('input'))")
        browser.wait(f"{own} === '4'")
        choose = (
            "(() => { const s = document.querySelector('.tools select'); s.value = 'scan';"
            " s.dispatchEvent(new Event('change')); return s.value; })()"
        )
        assert browser.wait(choose) == "scan"
        browser.wait("document.querySelector('.legend').textContent.includes('b/2')")
        browser.image(tmp_path / "tied.png")  # to look at
        (tmp_path / FILE).unlink()
    assert errors == []


def test_what_is_new_since_the_last_visit_has_its_colours(browser: Browser, tmp_path: Path) -> None:
    boxes: list[Box] = [(2.0, 3.0, 7.0, 7.0, 1.5), (-9.0, -7.0, -4.0, -3.0, 1.5)]
    last = write_scan(tmp_path / "a/may", leg(0.0), Errors((1.1, -0.7, 0.9)), boxes[:1], day=-30)
    with ScanStore.open(last / "scan.db") as store:
        write_deliverables(last, store)
    for path in last.glob("scan.db*"):
        os.utime(path, (0, 0))
    now = write_scan(tmp_path / "b/june", leg(np.pi / 2), None, boxes[1:], finished=False)
    follower = Follower(tmp_path)
    while follower.turn(time.time()):
        pass
    with listing(browser, tmp_path, 2) as base:
        browser.screen(1280, 800, pixel_ratio=1.0)  # pixels are counted
        browser.open(f"{base}/#/view/b/june")
        browser.wait(f"Number(document.body.dataset.points) > {samples(now)}")
        browser.click("Points")
        drawn = browser.wait("Number(document.body.dataset.drawn)")
        assert drawn <= samples(now)  # the earlier date is only compared with
        choose = (
            "(() => { const s = document.querySelector('.tools select'); s.value = 'change';"
            " s.dispatchEvent(new Event('change')); return s.value; })()"
        )
        assert browser.wait(choose) == "change"
        browser.wait("document.querySelector('.legend').textContent.includes('not seen before')")
        browser.click("Whole site")
        red, blue = changed_px(browser, tmp_path / "change.png")
        assert red > 300 and blue > 300
        assert red + blue < 15_000  # of about 300,000 that show ground


def changed_px(browser: Browser, path: Path) -> tuple[int, int]:
    """Pixels of the scene that are clearly red and clearly blue, once there are any."""
    script = "document.querySelector('.stage canvas').toDataURL('image/png').split(',')[1]"
    end, found = time.monotonic() + 60.0, (0, 0)
    while min(found) < 300 and time.monotonic() < end:
        time.sleep(1.0)
        data = np.frombuffer(base64.b64decode(browser.run(script)), np.uint8)
        image = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.int64)
        b, g, r = np.moveaxis(image[..., :3], -1, 0)
        found = int(np.sum(r - np.maximum(g, b) > 50)), int(np.sum(b - np.maximum(g, r) > 50))
    browser.image(path)  # to look at
    return found


def samples(folder: Path) -> int:
    """Points of all keyframes of a scan."""
    with ScanStore.open(folder / "scan.db") as store:
        return sum(int(one.fresh.sum()) for one in store.keyframes())
