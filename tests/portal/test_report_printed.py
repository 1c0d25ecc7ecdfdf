"""The report as PDF, as a browser prints it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from person import FLAGS, chromium

from service.scans.folder import write_deliverables

if TYPE_CHECKING:
    from house_flight import HouseFlight


@pytest.mark.skipif(not chromium(), reason="needs Chromium")
def test_each_section_begins_a_page(tmp_path: Path, house: HouseFlight) -> None:
    with house.flown(tmp_path) as store:
        write_deliverables(tmp_path, store)
    api = pytest.importorskip("playwright.sync_api")
    with api.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium(), args=FLAGS.split())
        page = browser.new_page()
        page.goto((tmp_path / "report.html").as_uri())
        printed = [page.pdf()]
        for _ in range(4):
            page.evaluate("document.querySelector('section').remove()")
            printed.append(page.pdf())
        assert page.locator("section").count() == 1  # the appendix
        browser.close()
    counts = [pages(one) for one in printed]
    assert counts == sorted(set(counts), reverse=True) and counts[-1] >= 1


def pages(pdf: bytes) -> int:
    return len(re.findall(rb"/Type /Page\b", pdf))
