"""The portal's screen at frames that took no part in the scan.

A portal serves the scan to a headless Chromium, which looks from each frame's pose as people do, at
the layer that the scan opens with: of a finished scan with ``mesh.glb`` the mesh, else the depth
images over the filled ground. What stands there is turned to the frame's own camera and scored as
``skyrelief score --views`` scores the products. The page brightens all colours by one factor, which
it states and which is taken back.
"""

from __future__ import annotations

import base64
import json
import math
import shutil
import statistics
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from bench_options import DataOptions
from person import Browser, chromium
from playwright.sync_api import sync_playwright

from recon.types import F64, U8, Bool, Camera
from service.bench import BenchResult
from service.errors import InputError, OutsideError
from service.ground.http import PAGE
from service.ground.portal import Portal, PortalConfig
from service.offline.exports.view import ScanView
from service.offline.view_scoring import frame_scores, left_out
from service.scans.main_piece import main_keyframes
from service.scans.track import camera_of

AWAY_M = 40.0  # from the eye to the place looked at
ASIDE_M = 0.05  # which never lies straight below: there a view without roll has no heading
DARKER_EV = -2  # the darkest that the page has: hardly a value is clipped then
SAME = 2  # a pixel that differs by more under another sky shows the sky
IMAGE = "document.querySelector('.stage canvas').toDataURL('image/png').split(',')[1]"
SETTING = """(() => {
  const label = [...document.querySelectorAll('.settings label')]
    .find(l => l.textContent.startsWith('%s'));
  const field = label.querySelector('input');
  %s
  for (const kind of ['input', 'change'])
    field.dispatchEvent(new Event(kind, { bubbles: true }));
})()"""
WAIT_S, TRIES = 600.0, 8
LIMIT_S = 900.0
"""No further frame is begun after so long: software rendering is slow on a busy machine."""

GO_TO = """new Promise(done => {
  addEventListener('hashchange', () => setTimeout(done, 0), { once: true });
  location.hash = '%s';
})"""
ALL_SHOWN = """[...document.querySelectorAll('.figures div')]
  .some(row => row.textContent === 'Images%d')"""
SIDE = """(() => {
  const { width, height } = document.querySelector('.stage canvas').getBoundingClientRect();
  return [Math.floor(width), Math.floor(height)];
})()"""
FIGURES = (
    ("covered", 100.0, "%"),
    ("PSNR", 1.0, "dB"),
    ("SSIM", 1.0, ""),
    ("PSNR on grids", 1.0, "dB"),
    ("PSNR as exposed", 1.0, "dB"),
)
"""As view_scoring.FrameScore has them."""


def run(options: DataOptions) -> list[BenchResult]:
    """Medians over the frames, next to those of the depth grids; each frame's are kept."""
    if options.scan is None or options.flight is None:
        raise InputError("bench screen needs --scan and --flight")
    if not chromium():
        raise OutsideError("bench screen needs Chromium; apt install chromium")
    if not (PAGE / "index.html").is_file():
        raise OutsideError("bench screen needs the portal's page; see CONTRIBUTING.md")
    kept, until = options.previews, time.monotonic() + LIMIT_S

    def goes_on(done: int) -> bool:
        return done < options.frames and time.monotonic() < until

    with ScanView(options.scan) as scan, _screen(scan) as screen:
        used = {k.time_ns for k in main_keyframes(scan.store)}
        every = max(1, len(left_out(scan.poses, used, 1)) // options.frames)
        views = None if kept is None else kept / "views"
        others = {f"screen, {screen.layer}": screen.view}
        scores = frame_scores(scan, options.flight, views, others, every, goes_on)
    if kept is not None:
        (kept / "frames.json").write_text(json.dumps(scores, indent=1))
    late = f"; cut after {LIMIT_S:g} s" if time.monotonic() > until else ""
    middle = {
        name: [statistics.median(f) for f in zip(*rows, strict=True)]
        for name, rows in scores.items()
    }
    return [
        BenchResult(
            f"{name}: {figure}, median of {len(rows)} frames",
            times * middle[name][n],
            unit,
            times * (max(row[n] for row in rows) - min(row[n] for row in rows)),
            "depth grids",
            times * middle["surface"][n],
            note=f"mean {times * statistics.mean(row[n] for row in rows):.4g}{late}",
        )
        for name, rows in scores.items()
        for n, (figure, times, unit) in enumerate(FIGURES)
    ]


class Screen:
    """What the page shows of a scan from a camera's place."""

    def __init__(self, browser: Browser, address: str, scan: ScanView, layer: str) -> None:
        """``layer`` is what the scan opens with."""
        self.browser, self.address, self.layer = browser, address, layer
        self.camera = camera_of(scan.store.header)
        w, h = self.camera.size_px
        away = np.array([[0, 0], [w, 0], [0, h], [w, h]]) - self.camera.K[:2, 2]
        widest = np.arctan(np.hypot(*away.T).max() / self.camera.K[1, 1])
        self.degrees = math.ceil(2 * math.degrees(widest)) + 1  # however the image is turned
        self.side_px = math.ceil(2 * self.camera.K[1, 1] * math.tan(math.radians(self.degrees / 2)))
        browser.open(address)
        keyframes = sum(1 for _ in scan.store.keyframes())
        self._wait(ALL_SHOWN % keyframes, f"all {keyframes} keyframes")
        if layer == "mesh":
            self._wait("document.body.dataset.mesh === 'shown'", "the mesh")
        self._fit()
        self._set("Field of view", f"field.value = {self.degrees};")
        self._set("Exposure", f"field.value = {DARKER_EV};")

    def view(self, T: F64) -> tuple[U8, Bool]:
        """(H, W, 3) BGR and (H, W) covered pixels from a T_world_camera (4, 4)."""
        eye = np.round(T[:3, 3], 3)
        aim = np.round(T[:3, 3] + AWAY_M * T[:3, 2], 3)
        if math.hypot(*(aim - eye)[:2]) < ASIDE_M:
            aim[1] += 2 * ASIDE_M
        place = ",".join(f"{value:.3f}" for value in (*eye, *aim))
        self.browser.run(GO_TO % f"{self.address.split('#')[1]}/{place}")
        dark = self._image()
        self._set("Light scene", "field.checked = true;")
        light = self._image()
        self._set("Light scene", "field.checked = false;")
        H = to_camera(self.camera, T, eye, aim, self.degrees, self.side_px)
        dark, light = (
            np.asarray(cv2.warpPerspective(image, H, self.camera.size_px), np.uint8)
            for image in (dark, light)
        )
        change = np.abs(dark.astype(int) - light).max(axis=2)
        gain = float(self.browser.run("Number(document.body.dataset.gain)"))
        return as_recorded(dark, gain), change <= SAME

    def _wait(self, script: str, what: str) -> None:
        try:
            self.browser.wait(script, WAIT_S)
        except RuntimeError as error:
            raise OutsideError(
                f"bench screen: the page did not show {what} in {WAIT_S:g} s; "
                "try on a quiet machine, or with fewer --frames"
            ) from error

    def _fit(self) -> None:
        """Makes the page so large that the scene has the camera's pixels."""
        for _ in range(TRIES):  # what stands next to the scene may take its room later
            has = self.browser.run(SIDE)
            if has == [self.side_px, self.side_px]:
                return
            across, down = self.browser.run("[innerWidth, innerHeight]")
            self.browser.screen(
                across + self.side_px - has[0], down + self.side_px - has[1], pixel_ratio=1.0
            )
            self.browser.wait(f"{SIDE}.join() !== '{has[0]},{has[1]}'", WAIT_S)
        raise OutsideError("bench screen: the page does not keep the size of its scene")

    def _set(self, label: str, act: str) -> None:
        self.browser.run(SETTING % (label, act))

    def _image(self) -> U8:
        self._wait("document.body.dataset.still === 'yes'", "a frame drawn to the end")
        data = np.frombuffer(base64.b64decode(self.browser.run(IMAGE)), np.uint8)
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def to_camera(camera: Camera, T: F64, eye: F64, aim: F64, degrees: float, side_px: int) -> F64:
    """(3, 3) from pixels of a square scene, which looks from ``eye`` to ``aim`` without roll, to
    those of the camera at T_world_camera (4, 4), in the same place."""
    ahead = (aim - eye) / np.linalg.norm(aim - eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R = np.column_stack([right, np.cross(ahead, right), ahead])
    f, middle = side_px / 2 / math.tan(math.radians(degrees / 2)), side_px / 2 - 0.5
    K = np.array([[f, 0.0, middle], [0.0, f, middle], [0.0, 0.0, 1.0]])
    return np.asarray(camera.K @ T[:3, :3].T @ R @ np.linalg.inv(K))


def as_recorded(image: U8, gain: float) -> U8:
    """The image without a factor of its linear light; what that clipped stays dark."""
    light = _linear(np.arange(256)) / gain
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.asarray(cv2.LUT(image, np.rint(255 * np.clip(srgb, 0, 1)).astype(np.uint8)))


def _linear(srgb: npt.ArrayLike) -> F64:
    """Linear light, 0 to 1, of colours of 0 to 255."""
    x = np.asarray(srgb, np.float64) / 255
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


@contextmanager
def _screen(scan: ScanView) -> Iterator[Screen]:
    """The scan in a browser, before a portal that has nothing else."""
    with tempfile.TemporaryDirectory() as root:
        folder = Path(root) / "scans" / "bench" / "screen"
        shutil.copytree(scan.folder, folder, ignore=shutil.ignore_patterns("splat.ply", "*.mcap"))
        portal = Portal(PortalConfig(Path(root) / "scans", port=0))
        portal.start()
        try:
            with sync_playwright() as driver:
                browser = Browser(driver)
                address = f"{portal.url.split('/?')[0]}/#/view/bench/screen"
                is_meshed = portal.state.library.entry("bench", "screen")["meshed"]
                yield Screen(browser, address, scan, "mesh" if is_meshed else "surface")
                browser.close()
        finally:
            portal.close()
