"""Screenshots of the portal's states at the sizes of a desktop and a phone.

    PYTHONPATH=tests/support python docs/portal_states.py STORE OUT

STORE is a ground station's folder; its newest scan is shown. Needs Chromium, the built page and
the extras "ground" and "dev". Maps, mesh and report are shown where the scan has them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from person import Browser
from playwright.sync_api import sync_playwright

from service.ground.portal import Portal, PortalConfig

SIZES = {"desktop": (1440, 900), "phone": (390, 844)}
WAIT_S = 120.0
PRESS = "[...document.querySelectorAll('button')].find(b => b.textContent === '{}').click()"
COLOUR = (
    "(s => {{ s.value = '{}'; s.dispatchEvent(new Event('change', {{ bubbles: true }})) }})"
    "(document.querySelector('[aria-label=\"colour by\"]'))"
)
STILL = "new Promise(r => setTimeout(r, 2000)).then(() => document.body.dataset.still === 'yes')"
OPEN = (
    "[...document.querySelectorAll('details')].find(d => d.textContent.startsWith('{}')).open = {}"
)
FLY_AGAIN = (
    "[...document.querySelectorAll('.layers label')].find(l => l.textContent.includes('Fly again'))"
    ".querySelector('input').click()"
)
CLICKS = ((0.45, 0.55), (0.58, 0.5), (0.5, 0.62))
"""Places of the scene that are measured, in its widths and heights."""

Act = Callable[[Browser], object]


def press(text: str) -> Act:
    """Press the button with this text."""
    return lambda browser: browser.run(PRESS.format(text))


def colour(name: str) -> Act:
    """Colour the points by ``name``."""
    return lambda browser: browser.run(COLOUR.format(name))


def opened(text: str, is_open: bool = True) -> Act:
    """Open or close the panel with this title."""
    return lambda browser: browser.run(OPEN.format(text, str(is_open).lower()))


def click_points(browser: Browser) -> None:
    """Click the places to be measured."""
    stage = browser.page.locator(".stage canvas").bounding_box()
    assert stage is not None
    for x, y in CLICKS:
        at = stage["x"] + x * stage["width"], stage["y"] + y * stage["height"]
        browser.page.mouse.click(*at)
        browser.page.wait_for_timeout(500)


def view_states(scan: Path) -> Iterator[tuple[str, list[Act]]]:
    """What the view shows, one after the other; each undoes the one before."""
    yield "view", [press("Whole site")]
    yield "view-height", [colour("height")]
    yield "view-sigma", [colour("sigma")]
    yield "view-coverage", [colour("colour"), press("Coverage")]
    yield "view-measure", [press("Coverage"), press("Measure"), click_points]
    yield "view-notes", [press("Measure"), press("Notes")]
    yield "view-clip", [press("Notes"), opened("Clip")]
    yield "view-settings", [opened("Clip", False), opened("Settings")]
    if (scan / "mesh.glb").is_file():
        yield "view-mesh", [opened("Settings", False), press("Mesh")]


def shots(browser: Browser, base: str, scan: Path, out: Path) -> None:
    """Write all states at the page's present size."""

    def shot(name: str) -> None:
        browser.page.wait_for_timeout(1500)  # controls fade in, images load
        browser.page.screenshot(path=out / f"{name}.png")

    where = f"{scan.parent.name}/{scan.name}"
    browser.open(f"{base}/#/")
    browser.wait("document.querySelector('article img')?.complete", WAIT_S)
    shot("library")
    browser.run("document.querySelectorAll('article details').forEach(d => d.open = true)")
    shot("library-open")
    press("Make")(browser)
    browser.wait("!document.querySelector('.jobs').hidden", WAIT_S)
    shot("library-job")
    press("Cancel")(browser)
    browser.open(f"{base}/#/view/{where}")
    browser.wait("Number(document.body.dataset.points) > 0", WAIT_S)
    for name, acts in view_states(scan):
        for act in acts:
            act(browser)
        browser.wait(STILL, WAIT_S)
        shot(name)
    browser.open(f"{base}/#/map/{where}")
    browser.wait("document.body.dataset.map === 'shown'", WAIT_S)
    shot("map")
    browser.run(FLY_AGAIN)
    browser.wait("document.querySelector('.layers output').textContent", WAIT_S)
    shot("map-again")
    browser.open(f"{base}/#/view/{scan.parent.name}/no-such-scan")
    browser.wait("document.querySelector('h1').textContent.startsWith('There is no')", WAIT_S)
    shot("unknown")
    if (scan / "report.html").is_file():
        browser.open((scan / "report.html").resolve().as_uri())
        browser.wait("document.readyState === 'complete'", WAIT_S)
        shot("report")


def main(store: Path, out: Path) -> None:
    """All states into a folder for each size."""
    scan = max(store.rglob("scan.db"), key=lambda path: path.stat().st_mtime).parent
    portal = Portal(PortalConfig(store, port=0))
    portal.start()
    with sync_playwright() as driver:
        browser = Browser(driver)
        try:
            browser.open(portal.url)  # sets the cookie
            browser.wait("document.readyState === 'complete'", WAIT_S)
            for name, (width, height) in SIZES.items():
                folder = out / name
                folder.mkdir(parents=True, exist_ok=True)
                browser.page.set_viewport_size({"width": width, "height": height})
                shots(browser, portal.url.split("/?")[0], scan, folder)
        finally:
            browser.close()
            portal.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
