"""The portal's surface as it stands on the screen, at frames that took no part in the scan.

A portal serves the scan to a headless Chromium, which looks from each frame's pose as people do:
surfaces over the filled ground. What stands there is turned to the frame's own camera and scored
as ``skyrelief score --views`` scores the products. The page brightens all colours by one factor;
it is found at a keyframe, and taken back.
"""

from __future__ import annotations

import base64
import json
import math
import shutil
import statistics
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from bench_options import DataOptions
from person import Browser, chromium
from playwright.sync_api import sync_playwright

from recon.types import F64, U8, Bool, Camera, Keyframe
from service.bench import BenchResult
from service.errors import InputError, OutsideError
from service.ground.http import PAGE
from service.ground.portal import Portal, PortalConfig
from service.offline.exports.view import ScanView
from service.offline.view_scoring import frame_scores
from service.scans.main_piece import main_keyframes
from service.scans.track import camera_of

AWAY_M = 40.0  # from the eye to the place looked at
ASIDE_M = 0.05  # which never lies straight below: there a view without roll has no heading
DARKER_EV = -2  # the darkest that the page has: hardly a value is clipped then
SAME = 2  # a pixel that differs by more under another sky shows the sky
DARK, BRIGHT = 8, 250  # colours between these give the brightness
IMAGE = "document.querySelector('.stage canvas').toDataURL('image/png').split(',')[1]"
SETTING = """(() => {
  const label = [...document.querySelectorAll('.settings label')]
    .find(l => l.textContent.startsWith('%s'));
  const field = label.querySelector('input');
  %s
  for (const kind of ['input', 'change'])
    field.dispatchEvent(new Event(kind, { bubbles: true }));
})()"""
WAIT_S, TRIES = 300.0, 8
ALL_SHOWN = """[...document.querySelectorAll('.figures div')]
  .some(row => row.textContent === 'Images%d')"""
SIDE = """(() => {
  const { width, height } = document.querySelector('.stage canvas').getBoundingClientRect();
  return [Math.floor(width), Math.floor(height)];
})()"""
FIGURES = (("covered", 100.0, "%"), ("PSNR", 1.0, "dB"), ("SSIM", 1.0, ""))


def run(options: DataOptions) -> list[BenchResult]:
    """Medians over the frames, next to those of the depth grids; each frame's are kept."""
    if options.scan is None or options.flight is None:
        raise InputError("bench screen needs --scan and --flight")
    if not chromium():
        raise OutsideError("bench screen needs Chromium; apt install chromium")
    if not (PAGE / "index.html").is_file():
        raise OutsideError("bench screen needs the portal's page; see CONTRIBUTING.md")
    kept = options.previews
    with ScanView(options.scan) as scan, _screen(scan) as screen:
        views = None if kept is None else kept / "views"
        others = {"screen": screen.shaded, "screen without shading": screen.unshaded}
        scores = frame_scores(scan, options.flight, views, others)
    if kept is not None:
        (kept / "frames.json").write_text(json.dumps(scores, indent=1))
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
            note=f"mean {times * statistics.mean(row[n] for row in rows):.4g}",
        )
        for name, rows in scores.items()
        for n, (figure, times, unit) in enumerate(FIGURES)
    ]


class Screen:
    """What the page shows of a scan from a camera's place."""

    def __init__(self, browser: Browser, address: str, scan: ScanView) -> None:
        self.browser, self.address = browser, address
        self.camera = camera_of(scan.store.header)
        self.keyframes = sum(1 for _ in scan.store.keyframes())
        w, h = self.camera.size_px
        away = np.array([[0, 0], [w, 0], [0, h], [w, h]]) - self.camera.K[:2, 2]
        widest = np.arctan(np.hypot(*away.T).max() / self.camera.K[1, 1])
        self.degrees = math.ceil(2 * math.degrees(widest)) + 1  # however the image is turned
        self.side_px = math.ceil(2 * self.camera.K[1, 1] * math.tan(math.radians(self.degrees / 2)))
        self.gain = 1.0
        self.last: tuple[F64, list[U8], Bool] | None = None
        keyframes = list(main_keyframes(scan.store))
        self.gain = self._brightness(keyframes[len(keyframes) // 2])

    def shaded(self, T: F64) -> tuple[U8, Bool]:
        """(H, W, 3) BGR and (H, W) covered pixels from a T_world_camera (4, 4)."""
        images, covered = self._from(T)
        return images[0], covered.copy()

    def unshaded(self, T: F64) -> tuple[U8, Bool]:
        """As ``shaded``, where the page's shading is off."""
        images, covered = self._from(T)
        return images[1], covered.copy()

    def _from(self, T: F64) -> tuple[list[U8], Bool]:
        if self.last is None or self.last[0] is not T:
            self.last = (T, *self._seen(T))
        return self.last[1:]

    def _seen(self, T: F64) -> tuple[list[U8], Bool]:
        """The camera's image as it is shown, without shading too, and where there is no sky."""
        eye = np.round(T[:3, 3], 3)
        aim = np.round(T[:3, 3] + AWAY_M * T[:3, 2], 3)
        if math.hypot(*(aim - eye)[:2]) < ASIDE_M:
            aim[1] += 2 * ASIDE_M
        self._open(eye, aim)
        dark = [self._image()]
        self._set("Shading", "field.value = 0;")
        dark.append(self._image())
        self._set("Light scene", "field.checked = true;")
        light = self._image()
        H = to_camera(self.camera, T, eye, aim, self.degrees, self.side_px)
        turned = [
            np.asarray(cv2.warpPerspective(image, H, self.camera.size_px), np.uint8)
            for image in (*dark, light)
        ]
        change = np.abs(turned[1].astype(int) - turned[2]).max(axis=2)
        return [as_recorded(image, self.gain) for image in turned[:2]], change <= SAME

    def _open(self, eye: F64, aim: F64) -> None:
        """Waits until the view from ``eye`` to ``aim`` is drawn to the end."""
        place = ",".join(f"{value:.3f}" for value in (*eye, *aim))
        self.browser.open("about:blank")
        self.browser.wait("location.href === 'about:blank'")
        self.browser.open(f"{self.address}/{place}")
        self.browser.wait(ALL_SHOWN % self.keyframes, WAIT_S)
        self._fit()
        self._set("Field of view", f"field.value = {self.degrees};")
        self._set("Exposure", f"field.value = {DARKER_EV};")

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
        self.browser.wait("document.body.dataset.still === 'yes'", WAIT_S)
        data = np.frombuffer(base64.b64decode(self.browser.run(IMAGE)), np.uint8)
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)

    def _brightness(self, keyframe: Keyframe) -> float:
        """The factor of the page, in linear light: that of the middle pixel of a keyframe."""
        images, covered = self._from(keyframe.depth.T_world_camera)
        size = (keyframe.bgr.shape[1], keyframe.bgr.shape[0])
        shown = cv2.resize(images[1], size, interpolation=cv2.INTER_AREA)
        there = cv2.resize(covered.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        shared = there & keyframe.fresh
        for image in (shown, keyframe.bgr):
            shared &= (image.min(axis=2) >= DARK) & (image.max(axis=2) <= BRIGHT)
        if not shared.any():
            raise InputError("bench screen: the portal shows nothing of the middle keyframe")
        self.last = None
        return float(np.median(_linear(shown[shared]) / _linear(keyframe.bgr[shared])))


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
        shutil.copytree(scan.folder, Path(root) / "scans" / "bench" / "screen")
        portal = Portal(PortalConfig(Path(root) / "scans", port=0))
        portal.start()
        try:
            with sync_playwright() as driver:
                browser = Browser(driver)
                yield Screen(browser, f"{portal.url.split('/?')[0]}/#/view/bench/screen", scan)
                browser.close()
        finally:
            portal.close()
