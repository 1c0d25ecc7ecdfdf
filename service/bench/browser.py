"""A page in a headless Chromium, driven over its DevTools protocol."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

FLAGS = (
    "--headless=new --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader"
    " --remote-debugging-port=0 --window-size=1280,800 --disable-extensions --no-first-run"
    " --disable-background-networking --disable-dev-shm-usage"
)
ANSWER_S = 180.0


def chromium() -> str:
    """The path of a Chromium on this machine; empty when there is none."""
    names = ("chromium", "chromium-browser", "google-chrome")
    return next(filter(None, map(shutil.which, names)), "")


class Page:
    """One page; dialogs are accepted with :attr:`dialog` as the text."""

    def __init__(self, process: subprocess.Popen[bytes], address: str) -> None:
        """Take over the page whose DevTools answer at the WebSocket ``address``."""
        from websockets.sync.client import connect

        self.process = process
        self._socket = connect(address, max_size=None)
        self._number = 0
        self.requests: list[str] = []
        self.dialog = ""  # what the next prompt is answered with
        for domain in ("Page", "Runtime", "Network"):
            self.call(f"{domain}.enable")

    def leave(self) -> None:
        """Let go of the page."""
        self._socket.close()

    def call(self, method: str, **params: Any) -> Any:
        """The result of a DevTools method; RuntimeError when it fails."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": params}))
        wanted = self._number
        while True:
            message = json.loads(self._socket.recv(timeout=ANSWER_S))
            if message.get("id") == wanted:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error']}")
                return message["result"]
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        if message.get("method") == "Network.requestWillBeSent":
            self.requests.append(message["params"]["request"]["url"])
        if message.get("method") == "Page.javascriptDialogOpening":
            self._number += 1
            params = {"accept": True, "promptText": self.dialog}
            answer = {"method": "Page.handleJavaScriptDialog", "params": params}
            self._socket.send(json.dumps({"id": self._number, **answer}))

    def run(self, script: str) -> Any:
        """The value of ``script``, awaited; RuntimeError when it throws."""
        found = self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        if "exceptionDetails" in found:
            raise RuntimeError(str(found["exceptionDetails"])[:300])
        return found["result"].get("value")

    def open(self, url: str) -> None:
        """Go to ``url``; does not wait."""
        self.call("Page.navigate", url=url)

    def wait(self, script: str, timeout_s: float = 60.0) -> Any:
        """The first true value of ``script``; a page that is still loading has none."""
        quiet = f"(() => {{ try {{ return {script} }} catch {{ return null }} }})()"
        return self.until(lambda: self.run(quiet), timeout_s)

    def click(self, text: str) -> None:
        """Click the button with this text, as an event of its own."""
        find = f"[...document.querySelectorAll('button')].find(b => b.textContent === '{text}')"
        self.wait(f"!!{find} && !{find}.disabled")
        self.run(f"setTimeout(() => {find}.click(), 0)")
        self.run("new Promise(r => setTimeout(r, 50))")

    def picture(self, path: Path) -> None:
        """Write what the page shows as PNG."""
        data = self.call("Page.captureScreenshot", format="png")["data"]
        path.write_bytes(base64.b64decode(data))

    def until(self, true: Callable[[], Any], timeout_s: float = 60.0) -> Any:
        """The first true value of ``true()``; RuntimeError after ``timeout_s``."""
        deadline = time.monotonic() + timeout_s
        while not (value := true()):
            if time.monotonic() >= deadline:
                raise RuntimeError("the page did not get there")
            if self.process.poll() is not None:
                raise RuntimeError("the browser ended")
            time.sleep(0.05)
        return value


class Browser(Page):
    """A Chromium and its first page; close it at the end."""

    def __init__(self, profile: Path, *flags: str) -> None:
        """Start Chromium with a fresh ``profile`` folder."""
        self.process = subprocess.Popen(
            [chromium(), *FLAGS.split(), *flags, f"--user-data-dir={profile}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        port_file = profile / "DevToolsActivePort"
        self.until(lambda: port_file.is_file() and port_file.read_text().count("\n") > 0)
        port, own = port_file.read_text().split()
        self._host = f"127.0.0.1:{port}"
        pages = json.load(urllib.request.urlopen(f"http://{self._host}/json"))
        page = next(p for p in pages if p["type"] == "page")
        super().__init__(self.process, page["webSocketDebuggerUrl"])
        self._own = f"ws://{self._host}{own}"
        self._others: list[Page] = []

    def other(self) -> Page:
        """A page as of another person's browser: nothing is shared with the first."""
        from websockets.sync.client import connect

        def ask(number: int, method: str, **params: Any) -> Any:
            whole.send(json.dumps({"id": number, "method": method, "params": params}))
            while True:
                message = json.loads(whole.recv(timeout=ANSWER_S))
                if message.get("id") == number:
                    return message["result"]

        whole = self._whole = connect(self._own, max_size=None)  # the context lives as long
        context = ask(1, "Target.createBrowserContext")["browserContextId"]
        made = ask(2, "Target.createTarget", url="about:blank", browserContextId=context)
        page = Page(self.process, f"ws://{self._host}/devtools/page/{made['targetId']}")
        self._others.append(page)
        return page

    def close(self) -> None:
        """End the browser."""
        for page in (*self._others, self):
            page.leave()
        self.process.terminate()
        self.process.wait(timeout=10)
