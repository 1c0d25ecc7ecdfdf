"""The page of control points in a real browser: load, choose, click, residual, refine."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from house_flight import HouseFlight
from person import Browser
from portal_client import NEEDS, ONE, TOKEN, browser, serving

from recon import se3
from service.georeference import LocalFrame
from service.ground.state import REFINE

pytestmark = NEEDS
__all__ = ["browser"]  # the fixture

MARKED = "document.querySelectorAll('.sights figure.marked').length"
POINTS_SHOWN = "document.querySelectorAll('.points li').length"
U_OF_MARKS = f"""fetch('{ONE}/control-points').then(answer => answer.json()).then(
  all => all.points[0].images.reduce((sum, i) => sum + (i.marked_px?.[0] ?? 0), 0))"""
PLACE = """(() => {{
  const find = [...document.querySelectorAll('.sights figure')].find(
    f => f.querySelector('figcaption span').textContent === 'keyframe {seq}');
  const drawing = find.querySelector('svg');
  drawing.scrollIntoView({{ block: 'center' }});
  const p = new DOMPoint({u}, {v}).matrixTransform(drawing.getScreenCTM());
  return [p.x, p.y];
}})()"""
"""Where on the screen a pixel of a keyframe's image is."""


@pytest.fixture
def base(tmp_path: Path, house: HouseFlight) -> Iterator[str]:
    """The address of a portal with a finished scan of a whole camera."""
    with house.flown(tmp_path / "drone-1" / "test-1") as scan:
        K = house.K.ravel().tolist()
        scan.update_header(camera={"width": 160, "height": 90, "K": K, "distortion": [0.0] * 5})
        scan.finish({})
    with serving(tmp_path) as client:
        yield client.base


def survey(house: HouseFlight, folder: Path) -> Path:
    """Two points on the ground that the map has 0.4 m too far east."""
    rows = ["name,lat,lon,alt_amsl_m"]
    for name, x, y in (("A", 2.0, -6.0), ("B", 20.0, -9.0)):
        lat, lon, alt = LocalFrame(*house.origin).to_geodetic(np.array([[x - 0.4, y, 0.0]]))[0]
        rows.append(f"{name},{lat:.9f},{lon:.9f},{alt:.3f}")
    path = folder / "points.csv"
    path.write_text("\n".join(rows) + "\n")
    return path


def click(page: Browser, house: HouseFlight, seq: int, spot: tuple[float, float, float]) -> None:
    """Click where the image of a keyframe shows a place of the map."""
    there = se3.transform(se3.inverse(house.pose(5.0 * seq)), np.array([spot]))
    (u, v), *_ = cv2.projectPoints(there, np.zeros(3), np.zeros(3), house.K, None)[0][0]
    before = page.run(MARKED)
    page.mouse(*page.run(PLACE.format(seq=seq, u=u, v=v)))
    page.wait(f"{MARKED} === {before + 1}")


@pytest.mark.parametrize("width", [1440, 390])
def test_a_click_gives_the_residual_at_once(
    browser: Browser, base: str, house: HouseFlight, tmp_path: Path, width: int
) -> None:
    browser.screen(width, 844, mobile=width < 400)
    browser.open("about:blank")
    browser.open(f"{base}/?token={TOKEN}#/control/drone-1/test-1")
    browser.wait("document.querySelector('.control .blank') !== null")
    browser.page.set_input_files("input[type=file]", survey(house, tmp_path))
    browser.wait(f"{POINTS_SHOWN} === 2 && document.querySelectorAll('.sights image').length > 2")
    click(browser, house, 0, (2.0, -6.0, 0.0))
    click(browser, house, 1, (2.0, -6.0, 0.0))
    browser.wait("document.querySelector('.points li output').textContent.startsWith('+0.4')")
    browser.wait("document.querySelector('.points li').textContent.includes('2 marks')")
    browser.page.focus(".sights figure.marked svg")
    before = browser.run(U_OF_MARKS)
    for _ in range(4):  # faster than the answers
        browser.key("ArrowRight")
    browser.wait(f"{U_OF_MARKS}.then(now => Math.abs(now - {before} - 2) < 1e-6)")
    browser.wait(f"{MARKED} === 2")
    browser.click("Remove")
    browser.wait(f"{MARKED} === 1")
    browser.click("Refine")
    jobs = (
        f"fetch('/api/jobs').then(a => a.json()).then(all => all.some(j => j.kind === '{REFINE}'))"
    )
    browser.wait(jobs)
    browser.screen(1280, 800)
