"""A person at a browser: clicks, keys, dialogs, and what the page has asked for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import service.bench.portal as bench


class Page(bench.Page):
    """One page; dialogs are accepted with :attr:`dialog` as the text."""

    def __init__(self, page: Any) -> None:
        self.requests: list[str] = []
        self.dialog = ""  # what the next prompt is answered with
        page.on("request", lambda request: self.requests.append(request.url))
        page.on("dialog", lambda dialog: dialog.accept(self.dialog))
        super().__init__(page)

    def click(self, text: str) -> None:
        """Click the button with this text, as an event of its own."""
        find = f"[...document.querySelectorAll('button')].find(b => b.textContent === '{text}')"
        self.wait(f"!!{find} && !{find}.disabled")
        self.run(f"setTimeout(() => {find}.click(), 0)")
        self.run("new Promise(r => setTimeout(r, 50))")

    def mouse(self, x: float, y: float, *, to: tuple[float, float] | None = None) -> None:
        """Click at a place of the page, or press there and release at ``to``; CSS pixels."""
        self.page.mouse.move(x, y)
        self.page.mouse.down()
        if to is not None:
            self.page.mouse.move(*to)
        self.page.mouse.up()

    def key(self, name: str) -> None:
        """Press and release a key that writes nothing, such as Escape."""
        self.page.keyboard.press(name)

    def screen(
        self, width: int, height: int, mobile: bool = False, pixel_ratio: float = 0.0
    ) -> None:
        """Show pages on a screen of this size, in CSS pixels; ``pixel_ratio`` of the screen's own
        lie along each, with 0 as many as the browser has."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=pixel_ratio,
            mobile=mobile,
        )
        if not mobile:
            self.wait(f"innerWidth === {width} && innerHeight === {height}")

    def image(self, path: Path) -> None:
        """Write what the page shows as PNG."""
        self.page.screenshot(path=path)


class Browser(bench.Browser, Page):
    """A Chromium and its first page; close it at the end."""

    def other(self) -> Page:
        """A page as of another person's browser: nothing is shared with the first."""
        return Page(self.browser.new_context(no_viewport=True).new_page())
