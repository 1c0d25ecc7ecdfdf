"""Where corners are found and followed: on the host, or on the device of a backend."""

from __future__ import annotations

from typing import Protocol

import numpy.typing as npt

from recon.tracking import matching
from recon.tracking.matching import Corners, Matches, MatchingConfig, Pyramid
from recon.types import U8


class Matcher(Protocol):
    """What the odometry asks of pictures."""

    def pyramid(self, gray: U8, levels: int) -> Pyramid:
        """The pyramid of ``gray`` (H, W), held where this matcher works."""
        ...

    def corners(self, pyramid: Pyramid, config: MatchingConfig, mask: U8 | None) -> Corners:
        """As :func:`recon.tracking.matching.harris_grid`, of the pyramid's first level."""
        ...

    def match(
        self, pyramid_a: Pyramid, uv_a: npt.ArrayLike, pyramid_b: Pyramid,
        uv_b_predicted: npt.ArrayLike, radius_px: float, warp: npt.ArrayLike | None,
        config: MatchingConfig,
    ) -> Matches:  # fmt: skip
        """As :func:`recon.tracking.matching.match`."""
        ...


class HostMatcher:
    """The compiled kernels of the processor."""

    def pyramid(self, gray: U8, levels: int) -> Pyramid:
        """See :class:`Matcher`."""
        return Pyramid.build(gray, levels)

    def corners(self, pyramid: Pyramid, config: MatchingConfig, mask: U8 | None) -> Corners:
        """See :class:`Matcher`."""
        return matching.harris_grid(pyramid.levels[0], config, mask)

    def match(
        self, pyramid_a: Pyramid, uv_a: npt.ArrayLike, pyramid_b: Pyramid,
        uv_b_predicted: npt.ArrayLike, radius_px: float, warp: npt.ArrayLike | None,
        config: MatchingConfig,
    ) -> Matches:  # fmt: skip
        """See :class:`Matcher`."""
        return matching.match(pyramid_a, uv_a, pyramid_b, uv_b_predicted, radius_px, warp, config)
