"""The portal on a telephone, by keyboard and for a screen reader; in a real browser."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from person import Browser
from portal_client import NEEDS, TOKEN, browser, flown_store

from service.ground.http import PAGE
from service.ground.portal import Portal, PortalConfig

if TYPE_CHECKING:
    from conftest import HouseFlight

pytestmark = NEEDS
__all__ = ["browser"]  # the fixture

AXE = PAGE.parent / "node_modules/axe-core/axe.min.js"
SERIOUS = """axe.run().then(found => found.violations
  .filter(v => v.impact === 'serious' || v.impact === 'critical')
  .map(v => v.id + ': ' + v.nodes.map(n => n.html).join(' ').slice(0, 300)))"""
PHONE = (390, 844)


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory, house: HouseFlight) -> Iterator[str]:
    portal = Portal(
        PortalConfig(flown_store(tmp_path_factory.mktemp("scans"), house), port=0, token=TOKEN)
    )
    portal.start()
    yield portal.url.split("/?")[0]
    portal.close()


def show(browser: Browser, address: str, size: tuple[int, int]) -> None:
    browser.screen(*size, mobile=size == PHONE)
    browser.open("about:blank")
    browser.open(address)
    browser.wait("!!document.querySelector('h1')")
    if address.endswith("/test-1"):
        browser.wait("document.body.dataset.points === '72000'")
        browser.wait("document.body.dataset.image === '4'")


def box(browser: Browser, selector: str) -> dict[str, float]:
    """Where an element is seen, CSS pixels."""
    found: Any = browser.run(
        f"document.querySelector('{selector}').getBoundingClientRect().toJSON()"
    )
    return dict(found)


def test_on_a_telephone_nothing_is_out_of_reach(browser: Browser, base: str) -> None:
    show(browser, base, PHONE)
    browser.wait("document.querySelectorAll('article').length === 1")
    for selector in (".import input", ".import button", "article .acts"):
        assert 0 <= box(browser, selector)["left"] < box(browser, selector)["right"] <= PHONE[0]
    assert browser.run("document.documentElement.scrollWidth") <= PHONE[0]
    show(browser, f"{base}/#/view/drone-1/test-1", PHONE)
    browser.click("Measure")
    assert browser.run("document.documentElement.scrollWidth") <= PHONE[0]
    assert browser.run("document.documentElement.scrollHeight") <= PHONE[1]
    stage, side = box(browser, ".stage"), box(browser, ".side")
    assert stage["width"] == PHONE[0] and stage["height"] > 0.4 * PHONE[1]
    panels = [box(browser, f".side .{name}") for name in ("measure", "figures", "latest")]
    for upper, lower in zip([stage, *panels], panels, strict=False):
        assert upper["bottom"] <= lower["top"]  # no panel lies over another, or over the cloud
        assert lower["right"] <= PHONE[0] and side["bottom"] <= PHONE[1]
    show(browser, f"{base}/api/scans/drone-1/test-1/files/report.html", PHONE)
    assert browser.run("document.documentElement.scrollWidth") <= PHONE[0]


def test_choosing_a_deliverable_by_keyboard_starts_nothing(browser: Browser, base: str) -> None:
    show(browser, base, (1440, 900))
    browser.wait("document.querySelectorAll('article').length === 1")
    browser.run(
        "(() => { const kinds = document.querySelector('article select'); kinds.focus();"
        " kinds.value = 'ply'; for (const name of ['input', 'change'])"
        " kinds.dispatchEvent(new Event(name, { bubbles: true })); })()"
    )
    jobs = "fetch('/api/scans/drone-1/test-1').then(r => r.json()).then(s => s.jobs.length)"
    assert browser.run(f"new Promise(r => setTimeout(r, 300)).then(() => {jobs})") == 0


@pytest.mark.skipif(not AXE.is_file(), reason="needs axe-core (npm ci in service/ground/web)")
@pytest.mark.parametrize("size", [(1440, 900), PHONE])
def test_axe_finds_nothing_serious(
    browser: Browser, base: str, size: tuple[int, int], tmp_path: Path
) -> None:
    for page, address in {
        "library": base,
        "view": f"{base}/#/view/drone-1/test-1",
        "unknown": f"{base}/#/view/drone-1/nothing",
    }.items():
        show(browser, address, size)
        if page == "view":
            for name in ("Measure", "Coverage"):
                browser.click(name)
            browser.run("document.querySelector('details.group').open = true")
        browser.run(AXE.read_text() + ";0")
        assert browser.run(SERIOUS) == [], page
        browser.image(tmp_path / f"{page}.png")  # to look at
