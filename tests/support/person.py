"""A person at a browser: clicks, keys, dialogs, and what the page has asked for."""

from __future__ import annotations

import shutil
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import playwright.sync_api as playwright

FLAGS = (
    "--no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --window-size=1280,800"
    " --disable-dev-shm-usage"
)


def chromium() -> str:
    """The path of a Chromium on this machine; empty when there is none."""
    names = ("chromium", "chromium-browser", "google-chrome")
    return next(filter(None, map(shutil.which, names)), "")


class Page:
    """One page; the browser's own dialogs are accepted."""

    def __init__(self, page: playwright.Page) -> None:
        self.page = page
        self.requests: list[str] = []
        page.on("request", lambda request: self.requests.append(request.url))
        page.on("dialog", lambda dialog: dialog.accept())
        self._tools = page.context.new_cdp_session(page)
        self._tools.send("Page.enable")

    def call(self, method: str, **params: Any) -> Any:
        """The result of a DevTools method."""
        return self._tools.send(method, params)

    def run(self, script: str) -> Any:
        """The value of ``script``, awaited."""
        return self.page.evaluate(script)

    def open(self, url: str) -> None:
        """Go to ``url``; does not wait until it is loaded."""
        self.page.goto(url, wait_until="commit")

    def wait(self, script: str, timeout_s: float = 60.0) -> Any:
        """The first true value of ``script``; a page that is loading or being left has none."""
        quiet = f"(async () => {{ try {{ return await {script} }} catch {{ return null }} }})()"
        deadline = time.monotonic() + timeout_s
        while not (value := self._run_or_left(quiet)):
            if time.monotonic() >= deadline:
                raise RuntimeError(f"the page did not get there in {timeout_s:g} s: {script}")
            self.page.wait_for_timeout(50.0)
        return value

    def click(self, text: str) -> None:
        """Click the button with this text, as an event of its own; none of a page being left."""
        find = (
            "[...document.querySelectorAll('button')]"
            f".find(b => b.textContent === '{text}' && !b.closest('[inert]'))"
        )
        self.wait(f"!!{find} && !{find}.disabled")
        self.run(f"setTimeout(() => {find}.click(), 0)")
        self._run_or_left("new Promise(r => setTimeout(r, 50))")

    def answer(self, text: str | None = None) -> None:
        """Give the page's dialog a text, or agree to what it asks."""
        self.wait("!!document.querySelector('dialog.ask[open]')")
        if text is not None:
            self.page.fill("dialog.ask input", text)
        self.page.click("dialog.ask button.on")

    def _run_or_left(self, script: str) -> Any:
        """The value of ``script``; None when the page is left meanwhile."""
        from playwright.sync_api import Error

        try:
            return self.run(script)
        except Error as error:
            if "navigation" not in error.message:
                raise
            return None

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


class Browser(Page):
    """A Chromium and its first page; close it at the end."""

    def __init__(self, driver: playwright.Playwright, *flags: str) -> None:
        self.driver = driver
        self.browser = driver.chromium.launch(
            executable_path=chromium(), args=[*FLAGS.split(), *flags]
        )
        super().__init__(self.browser.new_page(no_viewport=True))

    def close(self) -> None:
        """End the browser."""
        self.browser.close()

    def other(self) -> Page:
        """A page as of another person's browser: nothing is shared with the first."""
        return Page(self.browser.new_context(no_viewport=True).new_page())
