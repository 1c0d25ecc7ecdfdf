"""The first depth of a view: coarse, by one frame that follows soon, until its partners come.

New ground is in no earlier image, so that depth of it takes a later one.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

from recon.backends import Backend, DenseStages
from recon.mapping.exposure_compensation import ExposureCompensation
from recon.pipeline.config import Timing, untimed
from recon.pipeline.keyframe_map import KeyframeMap
from recon.pipeline.stages import PairStages, Rectify, keyframe_of, without_false_surface
from recon.pipeline.surface_map import SurfaceMap
from recon.pipeline.views import StereoView
from recon.stereo.posed_image import VirtualStereoConfig
from recon.types import Keyframe

COARSER = 2
"""The images are smaller by this factor than those of the view's whole depth."""

MIN_BASE_TO_HEIGHT = 0.02


class FirstDepths:
    """Reconstructs views ahead of time. Changes nothing that their whole depth rests on."""

    def __init__(
        self,
        backend: Backend,
        stereo: VirtualStereoConfig,
        dense: DenseStages,
        keyframes: KeyframeMap,
        surface: SurfaceMap,
        exposure: ExposureCompensation,
        timing: Timing,
    ) -> None:
        stereo = replace(
            stereo, min_base_to_height=MIN_BASE_TO_HEIGHT, guided=False,
            width_px=stereo.width_px // COARSER,
        )  # fmt: skip
        self._rectify = Rectify(stereo, Counter(), None, untimed)
        self._stereo = PairStages(backend, dense, None, untimed)
        self._keyframes, self._surface = keyframes, surface
        self._exposure, self._timing = exposure, timing

    def set_width(self, width_px: int) -> None:
        """Follow the width of whole depths."""
        self._rectify.set_effort(width_px // COARSER, upsample=False)

    def __call__(self, view: StereoView) -> Keyframe | None:
        """The new surface that the view's only partner shows; None where it shows none."""
        predicted = self._keyframes.predicted(view)
        if predicted is None:
            return None
        with self._timing("first depth"):
            grid = self._rectify.grid(view)
            pairs = self._rectify(view, ()).values()
            if not pairs:
                return None
            depth = self._stereo.whole_path(pairs, grid)
            if depth is None:
                depths = [self._stereo.reproject(self._stereo.match(p), p, grid) for p in pairs]
                depth = self._stereo.fuse(depths, grid)
            bgr = self._rectify.colours(view, grid)
            if depth is not None:
                depth = without_false_surface(view, depth, bgr)
            self._rectify.learn(depth)
            if depth is None or self._keyframes.graph.segments[view.segment].agreement < 0:
                return None
            T_odom, pose = predicted
            sigma_m, fresh = self._surface.peek(depth, view.rows_share, T_odom)
            bgr = self._exposure.level(bgr)
            return keyframe_of(view, depth, bgr, sigma_m, fresh, pose)
