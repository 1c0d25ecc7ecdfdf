"""Screenshots of the portal's states at the sizes of a desktop and a phone, and a sheet of them.

    PYTHONPATH=tests/support python docs/portal_states.py STORE OUT [BEFORE]

STORE is a ground station's folder; its newest scan is shown. BEFORE is the OUT of another version:
the sheet then has each state of it left of the present one. Needs Chromium, the built page, Pillow
and the extras "ground" and "dev". Maps, splats, mesh, report and another date are shown
where there are such.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from person import Browser
from PIL import Image, ImageDraw
from playwright.sync_api import sync_playwright

from service.ground.portal import Portal, PortalConfig

SIZES = {"desktop": (1440, 900), "phone": (390, 844)}
HIGH_PX, GAP_PX, LABEL_PX = 300, 8, 18
"""A state on the sheet."""
WAIT_S, STILL_S = 120.0, 60.0
SHOT_S = 300.0  # splats are drawn slowly in software
PRESS = "[...document.querySelectorAll('button')].find(b => b.textContent === '{}').click()"
COLOUR = (
    "(s => {{ s.value = '{}'; s.dispatchEvent(new Event('change', {{ bubbles: true }})) }})"
    "(document.querySelector('[aria-label=\"colour by\"]'))"
)
STILL = "new Promise(r => setTimeout(r, 2000)).then(() => document.body.dataset.still === 'yes')"
OPEN = (
    "[...document.querySelectorAll('details')].find(d => d.textContent.startsWith('{}')).open = {}"
)
MENU = (
    "(b => { if (b.checkVisibility() && b.ariaExpanded !== 'true') b.click() })"
    "(document.querySelector('.menu'))"
)
LAYER = (
    "[...document.querySelectorAll('.layers label')].find(l => l.textContent.includes('{}'))"
    ".querySelector('input').click()"
)
MAP = "new Promise(r => setTimeout(r, 1000)).then(() => document.body.dataset.map === 'shown')"
OTHER_DATE = (
    "(s => { if (s.length < 2) return false; s.selectedIndex = 1;"
    " s.dispatchEvent(new Event('change')); return true })"
    "(document.querySelector('.compare select'))"
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
    """Open or close the panel with this title, which a phone has in its menu."""

    def act(browser: Browser) -> None:
        browser.run(MENU)
        browser.run(OPEN.format(text, str(is_open).lower()))

    return act


def shown(product: str) -> Act:
    """Wait until the product is drawn."""
    return lambda browser: browser.wait(
        f"document.body.dataset.{product.lower()} === 'shown'", WAIT_S
    )


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
    yield "view-menu", [press("Notes"), lambda browser: browser.run(MENU)]
    yield "view-clip", [opened("Clip")]
    yield "view-settings", [opened("Clip", False), opened("Settings")]
    for name, file in (("Splats", "splat.ply"), ("Mesh", "mesh.glb")):
        if (scan / file).is_file():
            yield f"view-{name.lower()}", [opened("Settings", False), press(name), shown(name)]


def shots(browser: Browser, base: str, scan: Path, out: Path) -> None:
    """Write all states at the page's present size."""

    def shot(name: str) -> None:
        browser.page.wait_for_timeout(1500)  # controls fade in, images load
        browser.page.screenshot(path=out / f"{name}.png", timeout=1e3 * SHOT_S)

    where = f"{scan.parent.name}/{scan.name}"
    browser.open(f"{base}/#/")
    browser.wait("document.querySelector('article img')?.complete", WAIT_S)
    shot("library")
    press("Export…")(browser)
    browser.wait("document.querySelectorAll('.product').length > 0", WAIT_S)
    shot("library-export")
    browser.run(
        'document.querySelector(\'[aria-label^="Make"][aria-label$="Contours, DXF"]\').click()'
    )
    browser.wait("document.querySelector('.product .jobs li')", WAIT_S)
    browser.run("document.querySelector('.product .jobs li').scrollIntoView({ block: 'center' })")
    shot("library-job")
    browser.key("Escape")
    browser.open(f"{base}/#/view/{where}")
    browser.wait("Number(document.body.dataset.points) > 0", WAIT_S)
    for name, acts in view_states(scan):
        for act in acts:
            act(browser)
        with contextlib.suppress(RuntimeError):  # software rendering of a large scan never rests
            browser.wait(STILL, STILL_S)
        shot(name)
    browser.open(f"{base}/#/map/{where}")
    browser.wait(MAP, WAIT_S)
    shot("map")
    browser.run(LAYER.format("Fly again"))
    browser.wait("document.querySelector('.layers output').textContent", WAIT_S)
    shot("map-again")
    for layer in ("Fly again", "Height", "Contours"):
        browser.run(LAYER.format(layer))
    browser.wait(MAP, WAIT_S)
    press("Measure")(browser)
    box = browser.page.locator(".map").bounding_box()
    assert box is not None
    for x, y in CLICKS:
        browser.page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
    shot("map-measure")
    browser.key("Escape")
    browser.key("Escape")
    if browser.run(OTHER_DATE):
        browser.run(LAYER.format("Height"))
        browser.wait(MAP, WAIT_S)
        shot("map-dates")
    browser.open(f"{base}/#/view/{scan.parent.name}/no-such-scan")
    browser.wait("document.querySelector('h1').textContent.startsWith('There is no')", WAIT_S)
    shot("unknown")
    if (scan / "report.html").is_file():
        browser.open((scan / "report.html").resolve().as_uri())
        browser.wait("document.readyState === 'complete'", WAIT_S)
        shot("report")


def sheet(out: Path, before: Path | None) -> None:
    """Write all states as OUT/sheet.webp, a line each: per size the one before and the present."""
    folders = [folder / size for size in SIZES for folder in (before, out) if folder is not None]
    names = sorted({path.stem for folder in folders for path in folder.glob("*.png")})
    widths = [
        round(wide / high * HIGH_PX)
        for wide, high in SIZES.values()
        for _ in range(len(folders) // 2)
    ]
    row = HIGH_PX + LABEL_PX + GAP_PX
    image = Image.new("RGB", (sum(widths) + GAP_PX * len(widths), row * len(names)), "white")
    draw = ImageDraw.Draw(image)
    for k, name in enumerate(names):
        x = 0
        for folder, width in zip(folders, widths, strict=True):
            is_before = before is not None and folder.parent == before
            draw.text((x, k * row), f"{name}{', before' if is_before else ''}", "black")
            path = folder / f"{name}.png"
            if path.is_file():
                image.paste(Image.open(path).resize((width, HIGH_PX)), (x, k * row + LABEL_PX))
            x += width + GAP_PX
    image.save(out / "sheet.webp", quality=70, method=6)


def main(store: Path, out: Path, before: Path | None = None) -> None:
    """All states into a folder for each size, and the sheet."""
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
    sheet(out, before)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]))
