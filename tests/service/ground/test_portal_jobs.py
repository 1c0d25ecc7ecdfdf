"""The list of jobs in a real browser: percent, cancelling, and a refinement."""

from __future__ import annotations

import contextlib
import io
import time
import zipfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from house_flight import HouseFlight
from loopback import until
from person import Browser
from portal_client import NEEDS, ONE, TOKEN, Client, browser, flown_store

from service.ground.portal import Portal, PortalConfig
from service.ground.state import Job
from service.ground.storage import DroneLimits
from service.stream.store import ScanStore

if TYPE_CHECKING:
    from playwright.sync_api import Route

__all__ = ["browser"]  # the fixture

ROW = "document.querySelector('.jobs li')"
IN_CARD = "document.querySelector('article .jobs li')"


@pytest.fixture
def portal(tmp_path: Path, house: HouseFlight) -> Iterator[Portal]:
    one = Portal(PortalConfig(flown_store(tmp_path, house), port=0, token=TOKEN))
    one.start()
    yield one
    one.close()


def test_a_scan_is_refined_from_the_portal(portal: Portal, tmp_path: Path) -> None:
    client = Client(portal)
    with ScanStore.open(tmp_path / "drone-1/test-1/scan.db") as store:
        store.finish({"frames": 5})
    status, job, _ = client.ask(ONE + "/exports", "POST", {"kind": "refine"})
    assert status == 202
    ended = until(
        lambda: next((j for j in client.ask("/api/jobs")[1] if j["state"] == "done"), None),
        progress=lambda: client.ask("/api/jobs")[1],
    )
    assert ended["number"] == job["number"] and ended["percent"] > 0
    assert "refined" in " ".join(client.ask(ONE)[1]["notes"])
    assert client.ask(f"/api/jobs/{job['number']}", "DELETE")[0] == 404
    assert client.ask("/api/jobs/1", "DELETE", token="")[0] == 401


def test_a_product_is_made_above_the_datum_that_is_asked_for(
    portal: Portal, tmp_path: Path
) -> None:
    rasterio = pytest.importorskip("rasterio", exc_type=ImportError)
    client = Client(portal)
    for bad in ({"to_datum": "ellipsoid"}, {"vertical_datum": "NN"}, {"vertical_datum": 7}):
        status, said, _ = client.ask(ONE + "/exports", "POST", {"kind": "dsm", **bad})
        assert status == 400 and "not valid" in said["error"]
    order = {"kind": "dsm", "vertical_datum": "EGM96", "to_datum": None}
    assert client.ask(ONE + "/exports", "POST", order)[0] == 202
    assert until(lambda: not portal_jobs(client))
    with rasterio.open(tmp_path / "drone-1/test-1/dsm.tif") as image:
        assert image.tags()["HEIGHTS"] == "metres above EGM96"


def test_an_alignment_by_points_is_refused_with_its_reason(portal: Portal, tmp_path: Path) -> None:
    client = Client(portal)
    with ScanStore.open(tmp_path / "drone-1/test-1/scan.db") as store:
        store.finish({"frames": 5})
    place = {"scan": [0.0, 0.0, 0.0], "place": [8.5, 47.4, 400.0]}
    order = {"drone": "drone-1", "scan": "test-1", "points": 3 * [place]}
    for bad in ({"points": [{"scan": [0, 0]}]}, {"points": 7}, {"height": 3}):
        status, said, _ = client.ask(ONE + "/alignment", "POST", {**order, **bad})
        assert status == 400 and "not valid" in said["error"]
    assert client.ask(ONE + "/alignment", "POST", {**order, "scan": "../x"})[0] == 404
    assert client.ask(ONE + "/alignment", "POST", order, token="")[0] == 401
    assert client.ask(ONE + "/alignment", "POST", order)[0] == 202
    assert until(lambda: [j for j in client.ask("/api/jobs")[1] if j["state"] == "failed"])
    assert "--start" in client.ask("/api/jobs")[1][0]["error"]  # it has a georeference
    assert not (tmp_path / "site/drone-1-test-1").exists()


def test_an_alignment_by_points_that_does_not_fit_the_disk_share_is_refused(
    tmp_path: Path, house: HouseFlight
) -> None:
    store, limits = flown_store(tmp_path, house), DroneLimits(drone_share=1e-9, reserve_bytes=0)
    place = {"scan": [0.0, 0.0, 0.0], "place": [8.5, 47.4, 400.0]}
    order = {"drone": "drone-1", "scan": "test-1", "points": 3 * [place]}
    with contextlib.closing(
        Portal(PortalConfig(store, port=0, token=TOKEN, limits=limits))
    ) as portal:
        portal.start()
        client = Client(portal)
        assert client.ask(ONE + "/alignment", "POST", order)[0] == 202
        assert until(lambda: [j for j in client.ask("/api/jobs")[1] if j["state"] == "failed"])
        assert "has reached its share" in client.ask("/api/jobs")[1][0]["error"]
    assert not (tmp_path / "site").exists()


def portal_jobs(client: Client) -> list[str]:
    """States of the jobs that have not ended well."""
    return [job["state"] for job in client.ask("/api/jobs")[1] if job["state"] != "done"]


@pytest.mark.parametrize("needs", [pytest.param(None, marks=NEEDS)])
def test_the_datum_is_chosen_on_the_page(browser: Browser, portal: Portal, needs: None) -> None:
    made: list[Job] = []

    def carry_out(job: Job) -> str:
        made.append(job)
        return "dsm.tif"

    def has_made(kind: str) -> bool:
        return bool(made) and made[-1].kind == kind

    portal.jobs.carry_out = carry_out
    browser.open(portal.url)
    browser.wait("document.querySelectorAll('article').length === 1")
    browser.click("Export…")
    browser.wait("document.querySelectorAll('.product').length > 20")
    for kind, title in (("gpkg", "Contours, GeoPackage"), ("glb", "Mesh, glTF")):
        browser.page.select_option("[aria-label=heights]", label="EGM96 to ellipsoid")
        browser.page.click(f"[aria-label='Make {title}']")
        assert until(partial(has_made, kind))
    options = [(job.options.vertical_datum, job.options.to_datum) for job in made]
    assert options == [("EGM96", "ellipsoid"), (None, None)]  # a mesh in local metres has no datum


def test_all_maps_come_in_one_zip(portal: Portal, tmp_path: Path) -> None:
    client = Client(portal)
    assert client.ask(ONE + "/maps.zip")[0] == 404 and not client.ask(ONE)[1]["maps"]
    maps = tmp_path / "drone-1/test-1/maps"
    maps.mkdir()
    files = {"manifest.json": b"{}", "dsm.tif": bytes(range(256)) * 9000, "empty.csv": b""}
    for name, data in files.items():
        (maps / name).write_bytes(data)
    (maps / "token").symlink_to(tmp_path / "portal-token")  # left out
    assert client.ask(ONE)[1]["maps"]
    status, data, headers = client.ask(ONE + "/maps.zip")
    assert status == 200 and "test-1-maps.zip" in headers["content-disposition"]
    with zipfile.ZipFile(io.BytesIO(data)) as found:
        assert found.testzip() is None
        assert {name: found.read(name) for name in found.namelist()} == files


def test_products_that_are_folders_come_as_a_zip(portal: Portal, tmp_path: Path) -> None:
    client, scan = Client(portal), tmp_path / "drone-1/test-1"
    assert client.ask(ONE + "/colmap.zip")[0] == 404
    files = {"images/keyframe_000001.jpg": b"x", "sparse/0/cameras.txt": b"1 PINHOLE"}
    for name, data in files.items():
        path = scan / "colmap" / name
        path.parent.mkdir(parents=True)
        path.write_bytes(data)
    (scan / "colmap/elsewhere").symlink_to(tmp_path)  # left out
    status, data, headers = client.ask(ONE + "/colmap.zip")
    assert status == 200 and "test-1-colmap.zip" in headers["content-disposition"]
    with zipfile.ZipFile(io.BytesIO(data)) as found:
        assert {name: found.read(name) for name in found.namelist()} == files
    (scan / "mesh-obj").symlink_to(scan / "colmap")
    (scan / "tokens").mkdir()
    assert [client.ask(f"{ONE}/{name}.zip")[0] for name in ("mesh-obj", "tokens")] == [404, 404]


@pytest.mark.slow
@pytest.mark.parametrize("needs", [pytest.param(None, marks=NEEDS)])
def test_a_folder_is_downloaded_from_the_page(
    browser: Browser, portal: Portal, tmp_path: Path, needs: None
) -> None:
    made = tmp_path / "drone-1/test-1/mesh-obj"
    made.mkdir()
    (made / "mesh.obj").write_bytes(b"v 0 0 0")
    browser.open(portal.url)
    browser.wait("document.querySelectorAll('article').length === 1")
    browser.click("Export…")
    browser.wait("document.querySelectorAll('.product').length > 20")
    with browser.page.expect_download() as download:
        browser.page.click("[aria-label='Download Mesh, OBJ']")
    with zipfile.ZipFile(download.value.path()) as found:
        assert found.namelist() == ["mesh.obj"]


@pytest.mark.slow
@pytest.mark.parametrize("needs", [pytest.param(None, marks=NEEDS)])
def test_all_maps_are_two_clicks_away(
    browser: Browser, portal: Portal, tmp_path: Path, needs: None
) -> None:
    def carry_out(job: Job) -> str:
        maps = job.folder / "maps"
        maps.mkdir()
        (maps / "manifest.json").write_text("{}")
        return maps.name

    portal.jobs.carry_out = carry_out
    browser.screen(1280, 800)
    browser.open(portal.url)
    browser.wait("document.querySelectorAll('article').length === 1")
    browser.click("Export…")
    browser.wait("document.querySelectorAll('.product').length > 20")
    browser.page.click("[aria-label='Make All maps']")
    browser.key("Escape")
    done = f"{IN_CARD}?.className === 'done' && !{IN_CARD}.querySelector('a').hidden"
    browser.wait(done)  # where it was asked for
    browser.open("about:blank")
    browser.open(portal.url)  # as long after as one likes, for a day
    browser.wait(done)
    with browser.page.expect_download() as download:
        browser.page.locator(".jobs li a").click()
    with zipfile.ZipFile(download.value.path()) as found:
        assert found.namelist() == ["manifest.json"]


@pytest.mark.parametrize("where", ["/", "/#/view/drone-1/test-1"])
@pytest.mark.parametrize("needs", [pytest.param(None, marks=NEEDS)])
@pytest.mark.slow
def test_a_job_shows_its_percent_and_is_cancelled_by_its_button(
    browser: Browser, portal: Portal, where: str, needs: None
) -> None:
    def slow(job: Job) -> str:
        for _ in job.progress.over(range(4), 4):
            while job.progress.share >= 0.75:  # until it is cancelled
                job.progress("fusing the cloud")
                time.sleep(0.05)
        return "dsm.tif"

    portal.jobs.carry_out = slow
    browser.screen(1280, 800)
    browser.open(portal.url)
    browser.wait("document.querySelectorAll('article').length === 1")
    browser.open(portal.url.split("/?")[0] + where)
    assert Client(portal).ask(ONE + "/exports", "POST", {"kind": "dsm"})[0] == 202
    browser.wait(f"{ROW} && {ROW}.textContent.includes('75 %')")
    assert browser.run(f"{ROW}.querySelector('progress').value") == 75
    assert "Surface model, GeoTIFF of " in browser.run(f"{ROW}.textContent")
    browser.click("Cancel")
    browser.wait(f"{ROW}.className === 'cancelled'")
    assert browser.run(f"{ROW}.querySelector('button').hidden")


@pytest.mark.parametrize("needs", [pytest.param(None, marks=NEEDS)])
@pytest.mark.slow
def test_a_job_has_one_row_however_late_the_name_of_its_scan_comes(
    browser: Browser, portal: Portal, needs: None
) -> None:
    asked: list[Route] = []
    held: list[Route] = []
    job = {
        "number": 1, "drone": "drone-2", "scan": "late", "kind": "align", "title": "Alignment",
        "state": "running", "percent": 5, "left_s": None, "doing": "", "ended_s": None,
        "error": None, "file": None,
    }  # fmt: skip

    def jobs(route: Route) -> None:
        asked.append(route)
        route.fulfill(json=[job])

    def name(route: Route) -> None:
        held.append(route)

    browser.open(portal.url)
    browser.wait("document.querySelectorAll('article').length === 1")
    browser.page.route("**/api/jobs", jobs)
    browser.page.route("**/api/scans/drone-2/late", name)
    browser.open(portal.url.split("/?")[0] + "/#/view/drone-1/test-1")
    meanwhile = partial(until, limit_s=60.0, sleep=lambda s: browser.page.wait_for_timeout(1e3 * s))
    meanwhile(lambda: held)
    seen = len(asked)
    meanwhile(lambda: len(asked) > seen)  # by the next turn
    browser.page.wait_for_timeout(500.0)  # it has its answer, and waits for the name too
    held[0].fulfill(status=404)
    browser.wait(f"{ROW}?.textContent.startsWith('Alignment of late')")
    seen = len(asked)
    meanwhile(lambda: len(asked) >= seen + 2)
    assert browser.run("document.querySelectorAll('.jobs li').length") == 1
    browser.page.unroute_all(behavior="wait")
