"""The boxes of Figure 1 as small objects."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from recon import se3
from recon.backends import Backend
from recon.camera_model import Undistorter, scaled, scaled_K
from recon.image_quality import BlurWatch, stretch
from recon.pipeline.views import StereoView
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.stereo.depth_edges import drop_edges
from recon.stereo.polar import reproject_polar
from recon.stereo.posed_image import VirtualStereoConfig
from recon.stereo.reprojection import PairDepth, carry, fuse, label_noise, plausible, reproject
from recon.stereo.virtual_stereo import at_middle_row, drop_unseen, plane_relief, rectify
from recon.tracking.frame import NO_IMAGE, Frame
from recon.tracking.matching import build_pyramid
from recon.types import (
    F64,
    U8,
    Array,
    Bool,
    Camera,
    DepthMap,
    DisparityMap,
    Keyframe,
    PolarPair,
    Pose,
    RectifiedPair,
    StereoPair,
)

Timing = Callable[[str], AbstractContextManager[object]]
"""Gives a stage by name the context that it runs in."""


def untimed(stage: str) -> AbstractContextManager[object]:
    return nullcontext()


MAX_TRACKING_WIDTH_PX = 1280  # wider images are made smaller: tracking's time grows with their area


def check_image(image: U8, size_px: tuple[int, int]) -> None:
    """Raise ValueError, naming the fault, unless the image is (H, W, 3) uint8 of ``size_px``."""
    wanted = (size_px[1], size_px[0], 3)
    if not isinstance(image, np.ndarray) or image.shape != wanted or image.dtype != np.uint8:
        given = f"{image.shape} {image.dtype}" if isinstance(image, np.ndarray) else repr(image)
        raise ValueError(f"the image must be BGR, {wanted} uint8 by the camera model, not {given}")


class Undistort:
    """Images without distortion: in gray, as the odometry takes them, and views in colour."""

    def __init__(self, camera: Camera, guide_width_px: int, timing: Timing) -> None:
        """Raises ValueError for an unusable camera model."""
        self.undistorter = Undistorter(_within_width(camera, int(1.3 * guide_width_px)))
        self._timing, self._blur = timing, BlurWatch()
        self.camera = self.undistorter.camera
        self.tracking_camera = _within_width(self.camera, MAX_TRACKING_WIDTH_PX)
        mask = self.undistorter.valid
        if self.tracking_camera.size_px != self.camera.size_px:
            size = self.tracking_camera.size_px
            mask = np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST), np.uint8)
        self._seen = mask > 0
        self._mask = None if mask.all() else mask

    def __call__(self, frame: Frame) -> Frame:
        """Raises ValueError when the image is not of the camera model's size."""
        with self._timing("undistort"):
            image = frame.image
            if image.shape[1] > self.camera.size_px[0]:
                size = self.camera.size_px
                image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
            gray = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
            gray = self.undistorter.image(gray)
            small, size = gray, self.tracking_camera.size_px
            if size != self.camera.size_px:
                small = np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.uint8)
            small = stretch(small, self._seen)
            is_blurred = self._blur.blurred(small)
            return replace(
                frame, image=image, gray=gray, pyramid=build_pyramid(small), mask=self._mask,
                is_blurred=is_blurred,
            )  # fmt: skip


class DenseStereo:
    """Depth of a view by all its partners: rectification, Eq. 1 to 3 and the fusion, each by the
    backend or on the host.

    Two images that were matched before, when the other one was the view, say the same when matched
    again: of a keyframe's pairs that is one in four. Their depth is carried over. A device that
    keeps the depth of pairs to itself matches them all.
    """

    def __init__(
        self,
        backend: Backend,
        config: VirtualStereoConfig,
        matching: BeliefPropagationConfig,
        rejected: Counter[str],
        debug: dict[str, Array] | None,
        timing: Timing,
    ) -> None:
        self._backend, self._config, self._matching = backend, config, matching
        self._rejected, self._debug, self._timing = rejected, debug, timing
        self._relief_m = (0.0, 0.0)
        self._noise = 1.0  # of labels, as the last view with several pairs showed
        self._kept: dict[tuple[int, int], PairDepth] = {}  # by view and partner
        self.pairs = 0

    def __call__(self, view: StereoView) -> tuple[DepthMap | None, U8]:
        """Depth in units of the odometry and (h, w, 3) BGR; None and no image where no pair can be
        used."""
        config = self._config  # another thread may set it meanwhile
        H, W = view.image.gray.shape
        w, h = size_px = config.width_px, round(config.width_px * H / W)
        K = scaled_K(view.image.K, w / W, h / H)
        T_odom_camera, depth = view.image.T_odom_camera, None
        depths = self.carried(view, K, size_px)  # by images that are matched already
        pairs = self._rectified(view, depths, config)  # virtual stereo pairs, section 2.1
        self.pairs += len(pairs) + len(depths)
        if pairs:
            depth = self._whole_path([*pairs.values()], K, size_px, T_odom_camera)
        if depth is None and (pairs or depths):
            for partner, pair in pairs.items():
                disparity = self._matched(pair)  # belief propagation, Eq. 1
                disparity = self._upsampled(disparity, pair)  # joint bilateral, Eq. 2
                depths[partner] = self._reprojected(disparity, pair, K, size_px)  # Eq. 3
            self.keep(view.seq, depths)
            with self._timing("fuse"):
                found = [*depths.values()]
                self._noise = label_noise(found) or self._noise
                depth = fuse(found, K, T_odom_camera, self._noise)
        if depth is None:
            return None, NO_IMAGE
        bgr = cv2.resize(at_middle_row(view.image, view.bgr), size_px, interpolation=cv2.INTER_AREA)
        return depth, np.asarray(bgr, np.uint8)

    def carried(self, view: StereoView, K: F64, size_px: tuple[int, int]) -> dict[int, PairDepth]:
        """Depth on the view's grid by images that are matched already, by the number of the
        partner."""
        found = dict[int, PairDepth]()
        for partner in view.partners:
            pair = self._kept.get((partner.seq, view.seq))
            if pair is not None and pair.depth_m.shape == size_px[::-1]:
                with self._timing("carry"):
                    T = se3.inverse(view.image.T_odom_camera) @ partner.T_odom_camera
                    found[partner.seq] = carry(pair, K, T)
        return found

    def keep(self, seq: int, depths: Mapping[int, PairDepth]) -> None:
        """Remember a view's depth by partners that are views later; what is past is dropped."""
        if self._backend.keeps_pairs:
            return
        later = {(seq, partner): depth for partner, depth in depths.items() if partner > seq}
        self._kept = {key: depth for key, depth in self._kept.items() if key[1] > seq} | later

    def learn(self, depth: DepthMap | None) -> None:
        """Make room for as much relief as the last view showed."""
        if depth is not None:
            self._relief_m = plane_relief(depth, self._relief_m)

    def change(self, **parameters: Any) -> None:
        """Set parameters of :class:`VirtualStereoConfig` from the next view on."""
        self._config = replace(self._config, **parameters)

    def _rectified(
        self, view: StereoView, known: Collection[int], config: VirtualStereoConfig
    ) -> dict[int, RectifiedPair]:
        """The pairs that stereo can use by the number of the partner, which is not ``known``."""
        pairs: dict[int, RectifiedPair] = {}
        for partner in view.partners:
            if partner.seq in known:
                continue
            with self._timing("rectify"):
                pair = rectify(view.image, partner, view.points, config, self._relief_m)
            if isinstance(pair, str):
                self._rejected[pair] += 1
                continue
            pairs[partner.seq] = pair
            self._show(raw_left=view.bgr, raw_right=partner.gray)
        return pairs

    def _whole_path(
        self, pairs: Sequence[RectifiedPair], K: F64, size_px: tuple[int, int], T_odom_camera: F64
    ) -> DepthMap | None:
        """Eq. 1 to 3 without leaving the device; None where the stages must do it."""
        plain = [pair for pair in pairs if isinstance(pair, StereoPair)]  # as devices know them
        if not self._backend.keeps_pairs or len(plain) < len(pairs) or self._debug is not None:
            return None
        with self._timing("dense path"):
            return self._backend.fused_depth(plain, K, size_px, T_odom_camera, self._matching)

    def _matched(self, pair: RectifiedPair) -> DisparityMap:
        """Labels of the left view."""
        with self._timing("belief propagation"):
            coarse = self._backend.belief_propagation(
                pair.left, pair.right, pair.labels, self._matching
            )
            coarse = drop_unseen(coarse, pair)
        self._show(rect_left=pair.left, rect_right=pair.right, disparity=coarse.px)
        return coarse

    def _upsampled(self, coarse: DisparityMap, pair: RectifiedPair) -> DisparityMap:
        """The labels at the size of the pair's guide; as they are without one."""
        fine = coarse
        if pair.guide is not None:
            with self._timing("upsample"):
                fine = self._backend.upsample(coarse, pair.guide)
        self._show(upsampled=fine.px)
        return fine

    def _reprojected(
        self, disparity: DisparityMap, pair: RectifiedPair, K: F64, size_px: tuple[int, int]
    ) -> PairDepth:
        with self._timing("reproject"):
            if isinstance(pair, PolarPair):
                return reproject_polar(disparity, pair, K, size_px)
            return reproject(disparity, pair, K, size_px)

    def _show(self, **arrays: Array) -> None:
        if self._debug is not None:
            self._debug |= arrays


def without_false_surface(view: StereoView, depth: DepthMap, bgr: U8) -> DepthMap | None:
    """A view's ``depth``, which has the colours ``bgr``, where its camera can have seen that; None
    with nothing left."""
    return plausible(drop_edges(depth, bgr), view.frame.prior)


def keyframe_of(view: StereoView, depth: DepthMap, bgr: U8, fresh: Bool, pose: Pose) -> Keyframe:
    """The pipeline's output: metric depth in colour, its pose, and the new part of it. ``depth`` is
    in units of the odometry."""
    metric = depth.scaled(pose.scale, pose.T_world_camera)
    return Keyframe(view.seq, view.frame.time_ns, metric, bgr, pose, fresh)


def _within_width(camera: Camera, width_px: int) -> Camera:
    """The camera, or its image made smaller when it is wider than ``width_px``."""
    W, H = camera.size_px
    if width_px >= W:
        return camera
    return scaled(camera, (width_px, round(H * width_px / W)))
