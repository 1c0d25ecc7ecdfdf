"""Take the screenshots in docs/images from the output of the demo.

    make demo && PYTHONPATH=tests/support python docs/screenshots.py demo-output

Needs Chromium, Pillow and the extras "ground" and "dev". The mesh is made first if it is missing.
"""

from __future__ import annotations

import io
import sys
from pathlib import Path

import cv2
from person import Browser
from PIL import Image
from playwright.sync_api import sync_playwright

from service.ground.portal import Portal, PortalConfig
from service.ground.storage import scan_files
from service.offline.exports.view import ExportOptions, ScanView, export

IMAGES = Path(__file__).resolve().parent / "images"
WIDTH_PX, HEIGHT_PX, QUALITY = 1400, 760, 85
GROWING_PX, GROWING_MS, LAST_MS = (980, 532), 400, 3000
"""Size of the animation, and how long it shows each keyframe and the last."""

LOAD_S = 300.0
BUTTON = "[...document.querySelectorAll('button')].find(b => b.textContent === '{}').click()"
WHOLE = "new Promise(r => setTimeout(r, 2000)).then(() => document.body.dataset.still === 'yes')"
"""True once the view has stood still, so that all points are drawn."""
MAP = "new Promise(r => setTimeout(r, 1000)).then(() => document.body.dataset.map === 'shown')"
LAYER = (
    "[...document.querySelectorAll('.layers label')]"
    ".find(l => l.textContent.startsWith(' {}')).querySelector('input').click()"
)
COLOURS = (
    "(s => { s.value = 'height'; s.dispatchEvent(new Event('change')) })"
    "(document.querySelector('select'))"
)
UNTIL = (
    "(s => {{ s.value = {}; s.dispatchEvent(new Event('input')) }})"
    "(document.querySelector('.time input'))"
)
"""Shows the cloud as it was at one of its keyframes."""


def seen(browser: Browser) -> Image.Image:
    """What the page shows."""
    return Image.open(io.BytesIO(browser.page.screenshot())).convert("RGB")


def shot(browser: Browser, name: str) -> None:
    """Write what the page shows as ``name``.jpg."""
    browser.page.mouse.move(WIDTH_PX / 2, HEIGHT_PX / 2)
    browser.run("new Promise(r => setTimeout(r, 3000))")  # the controls fade in
    seen(browser).save(IMAGES / f"{name}.jpg", quality=QUALITY)


def growing(browser: Browser) -> None:
    """Write how the cloud grew from keyframe to keyframe as growing.webp."""
    count = int(browser.run("document.querySelector('.time input').max"))
    images = []
    for k in range(1, count + 1):
        browser.run(UNTIL.format(k))
        browser.wait(WHOLE, LOAD_S)
        images.append(seen(browser).resize(GROWING_PX, Image.Resampling.LANCZOS))
    times = [GROWING_MS] * (count - 1) + [LAST_MS]
    first, *rest = images
    first.save(
        IMAGES / "growing.webp", save_all=True, append_images=rest, duration=times, loop=0,
        quality=60, method=6,
    )  # fmt: skip


def main(output: Path) -> None:
    """All screenshots, from the folder that ``skyrelief demo`` wrote."""
    (scan,) = (path.parent for path in scan_files(output / "ground", "scan.db"))
    if not (scan / "mesh.glb").is_file():
        with ScanView(scan) as view:
            export(view, "glb", None, ExportOptions(stored=True))
    preview = cv2.imread(str(scan / "preview.jpg"))
    assert preview is not None
    scale = 1200 / preview.shape[1]
    small = cv2.resize(preview, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(IMAGES / "demo.jpg"), small, (cv2.IMWRITE_JPEG_QUALITY, QUALITY))
    portal = Portal(PortalConfig(output / "ground", port=0))
    portal.start()
    with sync_playwright() as driver:
        browser = Browser(driver)
        try:
            browser.page.set_viewport_size({"width": WIDTH_PX, "height": HEIGHT_PX})
            browser.open(portal.url)
            browser.wait("document.querySelectorAll('article img').length === 1", LOAD_S)
            shot(browser, "portal-library")
            browser.run(BUTTON.format("Export…"))
            browser.wait("document.querySelectorAll('.product').length > 0", LOAD_S)
            shot(browser, "portal-export")
            browser.key("Escape")
            base = portal.url.split("/?")[0]
            browser.open(f"{base}/#/view/{scan.parent.name}/{scan.name}")
            browser.wait("Number(document.body.dataset.points) > 0", LOAD_S)
            browser.run(BUTTON.format("Surface"))  # as in flight: a finished scan has its mesh
            browser.run(BUTTON.format("Whole site"))
            browser.wait(WHOLE, LOAD_S)
            shot(browser, "portal-view")
            browser.run(COLOURS)
            browser.run(BUTTON.format("Coverage"))
            browser.wait(WHOLE, LOAD_S)
            shot(browser, "portal-height")
            browser.run(BUTTON.format("Coverage"))
            browser.run(BUTTON.format("Mesh"))
            browser.wait("document.body.dataset.mesh === 'shown'", LOAD_S)
            shot(browser, "portal-mesh")
            browser.open(f"{base}/#/map/{scan.parent.name}/{scan.name}")
            browser.wait(MAP, LOAD_S)
            for layer in ("Height", "Contours"):
                browser.run(LAYER.format(layer))
                browser.wait(MAP, LOAD_S)
            shot(browser, "portal-map")
            browser.open("about:blank")
            browser.open(f"{base}/#/view/{scan.parent.name}/{scan.name}")
            browser.wait("Number(document.body.dataset.points) > 0", LOAD_S)
            browser.run(BUTTON.format("Whole site"))
            browser.wait(WHOLE, LOAD_S)
            growing(browser)
            browser.open((scan / "report.html").resolve().as_uri())
            browser.wait("document.readyState === 'complete'", LOAD_S)
            browser.run(
                "[...document.querySelectorAll('h2')]"
                ".find(h => h.textContent === 'Coverage').scrollIntoView()"
            )
            shot(browser, "report")
        finally:
            browser.close()
            portal.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
