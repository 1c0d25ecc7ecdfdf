"""A person at a browser: clicks, keys, dialogs, and what the page has asked for."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import service.bench.portal as bench


class Page(bench.Page):
    """One page; dialogs are accepted with :attr:`dialog` as the text."""

    def __init__(self, *where: Any) -> None:
        self.requests: list[str] = []
        self.dialog = ""  # what the next prompt is answered with
        super().__init__(*where)

    def _note(self, event: dict[str, Any]) -> None:
        if event.get("method") == "Network.requestWillBeSent":
            self.requests.append(event["params"]["request"]["url"])
        if event.get("method") == "Page.javascriptDialogOpening":
            self._send("Page.handleJavaScriptDialog", {"accept": True, "promptText": self.dialog})

    def click(self, text: str) -> None:
        """Click the button with this text, as an event of its own."""
        find = f"[...document.querySelectorAll('button')].find(b => b.textContent === '{text}')"
        self.wait(f"!!{find} && !{find}.disabled")
        self.run(f"setTimeout(() => {find}.click(), 0)")
        self.run("new Promise(r => setTimeout(r, 50))")

    def mouse(self, x: float, y: float, *, to: tuple[float, float] | None = None) -> None:
        """Click at a place of the page, or press there and release at ``to``; CSS pixels."""
        one = {"button": "left", "clickCount": 1}
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        self.call("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, **one)
        if to is not None:
            x, y = to
            self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y, **one)
        self.call("Input.dispatchMouseEvent", type="mouseReleased", x=x, y=y, **one)

    def key(self, name: str) -> None:
        """Press and release a key that writes nothing, such as Escape."""
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=name, code=name)

    def screen(self, width: int, height: int, mobile: bool = False) -> None:
        """Show pages on a screen of this size, in CSS pixels."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=mobile,
        )

    def image(self, path: Path) -> None:
        """Write what the page shows as PNG."""
        data = self.call("Page.captureScreenshot", format="png")["data"]
        path.write_bytes(base64.b64decode(data))


class Browser(bench.Browser, Page):
    """A Chromium and its first page; close it at the end."""

    def __init__(self, profile: Path, *flags: str) -> None:
        self._profile = profile
        self._others: list[bench.Page] = []
        super().__init__(profile, *flags)

    def other(self) -> Page:
        """A page as of another person's browser: nothing is shared with the first."""
        own = (self._profile / "DevToolsActivePort").read_text().split()[1]
        whole = bench.Page(self.process, f"ws://{self.host}{own}", domains=())
        context = whole.call("Target.createBrowserContext")["browserContextId"]
        made = whole.call("Target.createTarget", url="about:blank", browserContextId=context)
        page = Page(self.process, f"ws://{self.host}/devtools/page/{made['targetId']}")
        self._others += [page, whole]  # the context lives as long
        return page

    def close(self) -> None:
        for page in self._others:
            page.leave()
        super().close()
