"""A segment's first frame found again in those after it, while there is no map yet."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from recon.tracking import matching, prediction
from recon.tracking.common_view import FeatureCache, common_view
from recon.tracking.keyframe_window import Incoming, OdometryKeyframe
from recon.tracking.matcher import Matcher
from recon.types import F64, Bool, Camera


class FirstViews:
    """Matches the first frame's corners by what is likely: as in the frame before, by
    telemetry, by the features that both images share."""

    def __init__(
        self,
        camera: Camera,
        config: matching.MatchingConfig,
        radius_px: float,
        matcher: Matcher,
        features: FeatureCache,
    ) -> None:
        self._matcher = matcher
        self._K, self._config, self._radius_px = camera.K, config, radius_px
        self._features = features
        self._drift = np.eye(3)  # from the first frame's pixels to the last one's

    def begin(self) -> None:
        """Forget the segment before."""
        self._drift = np.eye(3)

    def match(
        self, new: Incoming, first: OdometryKeyframe, R_b_a: F64 | None, still: bool
    ) -> tuple[F64, Bool]:
        """(N, 2) pixels and (N,) success of the first frame's corners in a new frame.

        ``R_b_a`` (3, 3) is the turn by telemetry; ``still`` pictures are far apart in time.
        """
        best: tuple[F64, Bool] | None = None
        for guess in self._guesses(new, first, R_b_a, still):
            found = self._matcher.match(
                first.pyramid,
                first.uv.astype(np.float32),
                new.pyramid,
                guess.uv.astype(np.float32),
                guess.radius_px,
                guess.warp.astype(np.float32),
                self._config,
            )
            if best is None or found.ok.sum() > best[1].sum():
                best = (found.uv_px.astype(np.float64), found.ok)
            if best[1].sum() > 0.5 * len(first.uv):
                self._drift = prediction.common_affine(first.uv[best[1]], best[0][best[1]])
                break
        if best is None:
            return first.uv, np.zeros(len(first.uv), np.bool_)
        return best

    def _guesses(
        self, new: Incoming, first: OdometryKeyframe, R_b_a: F64 | None, still: bool
    ) -> Iterator[prediction.Prediction]:
        """Where the corners went, best first."""
        if not still:
            yield prediction.by_homography(self._drift, first.uv, self._radius_px)
        if R_b_a is not None:
            H = self._by_telemetry(new, first, R_b_a)
            yield prediction.by_homography(H, first.uv, self._radius_px)
        here = self._features.of(new.seq, new.grey)
        view = common_view(self._features.of(first.seq, first.pyramid.levels[0]), here)
        if view is not None:
            yield view.predict(first.uv, self._radius_px)

    def _by_telemetry(self, new: Incoming, first: OdometryKeyframe, R_b_a: F64) -> F64:
        """(3, 3) homography of level ground by attitude, and by position and height if known."""
        a, b = first.prior, new.prior
        height, t = b.agl_m or 0.0, np.zeros(3)
        if b.position_m is not None and a.position_m is not None and height > 0:
            assert a.R_world_camera is not None
            t = R_b_a @ a.R_world_camera.T @ (a.position_m - b.position_m) / height
        n = first.T_camera_odom[:3, 2]  # up, seen from the camera
        return np.asarray(self._K @ (R_b_a - np.outer(t, n)) @ np.linalg.inv(self._K))
