"""Disparity at the resolution of a guidance image: joint bilateral upsampling (Eq. 2).

Kopf et al., https://doi.org/10.1145/1276377.1276497. The taps lie on the coarse grid, the
range kernel compares the guide at the fine pixel with the guide at the tap. The faster
guided filter is that of He and Sun, https://arxiv.org/abs/1505.00996, fitted on the coarse
grid and applied on the fine one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from numba import njit, prange

from recon.types import F32, U8, Bool, DisparityMap

PAPER_RATIO = 2704 / 320
"""Fine pixels per coarse pixel in the paper."""


@dataclass(frozen=True, slots=True)
class UpsamplingConfig:
    """The paper's "filter 15, diameter 10", mapped so that any guide size gives one look.

    The spatial sigma is ``filter_px`` pixels of the paper's 2704 px frame, which are
    15 / 8.45 = 1.78 coarse pixels; the range sigma is ``range_sigma`` grey levels of the
    Euclidean distance of the colours; the window is a disc of ``diameter_px`` coarse pixels.
    """

    method: str = "bilateral"  # "bilateral" (exact) or "guided" (fast)
    filter_px: float = 15.0
    range_sigma: float = 15.0  # grey levels
    diameter_px: float = 10.0  # coarse pixels
    min_support: float = 0.5  # share of the weight that must fall on known taps
    guided_radius_px: int = 4  # coarse pixels, of the guided filter
    guided_epsilon: float = 4.0  # grey levels; edges below it are smoothed

    def __post_init__(self) -> None:
        if self.method not in ("bilateral", "guided"):
            raise ValueError(f"method is 'bilateral' or 'guided', not {self.method!r}")
        if not (self.filter_px > 0 and self.range_sigma > 0 and self.guided_epsilon > 0):
            raise ValueError("filter_px, range_sigma and guided_epsilon must be positive")
        if not 2 <= self.diameter_px <= 64 or not 1 <= self.guided_radius_px <= 64:
            raise ValueError("diameter_px is 2 to 64 and guided_radius_px 1 to 64")
        if not 0 <= self.min_support <= 1:
            raise ValueError(f"min_support is a share, 0 to 1, not {self.min_support}")

    @property
    def spatial_sigma(self) -> float:
        """Coarse pixels."""
        return self.filter_px / PAPER_RATIO


def upsample(coarse: DisparityMap, guide: U8, config: UpsamplingConfig) -> DisparityMap:
    """``coarse`` (h, w) at the size of ``guide`` (H, W, 3) uint8; the values are not rescaled.

    Unknown taps carry no weight; a fine pixel is unknown (NaN) when less than
    ``config.min_support`` of its weight falls on known ones. Raises ValueError for bad shapes.
    """
    check_guide(coarse, guide)
    if config.method == "guided":
        return _guided(coarse, guide, config)
    px, confidence = _bilateral(
        coarse.px,
        coarse.confidence,
        guide,
        guide_at_taps(guide, coarse.px.shape),
        config.spatial_sigma,
        config.range_sigma,
        config.diameter_px / 2,
        config.min_support,
    )
    return DisparityMap(px, confidence)


def check_guide(coarse: DisparityMap, guide: U8) -> None:
    """Raises ValueError when the shapes do not fit the contract of :func:`upsample`."""
    if guide.ndim != 3 or guide.shape[2] != 3 or guide.dtype != np.uint8:
        raise ValueError(f"the guide must be (H, W, 3) uint8, not {guide.shape} {guide.dtype}")
    if coarse.px.ndim != 2 or coarse.px.shape != coarse.confidence.shape:
        raise ValueError(f"bad disparity {coarse.px.shape}, {coarse.confidence.shape}")
    if any(a < b for a, b in zip(guide.shape, coarse.px.shape, strict=False)):
        raise ValueError(f"guide {guide.shape[:2]} is smaller than disparity {coarse.px.shape}")


def guide_at_taps(guide: U8, shape: tuple[int, ...]) -> F32:
    """The guide at the coarse grid, (h, w, 3) float32: the mean of what each tap covers."""
    height, width = shape
    small = cv2.resize(guide.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32)


@njit(cache=True, nogil=True, parallel=True, fastmath={"contract", "arcp", "reassoc", "nsz"})
def _bilateral(
    px: Any,
    confidence: Any,
    guide: Any,
    taps: Any,
    spatial_sigma: float,
    range_sigma: float,
    radius: float,
    min_support: float,
) -> Any:  # pragma: no cover - compiled
    h, w = px.shape
    height, width = guide.shape[:2]
    out = np.empty((height, width), np.float32)
    sure = np.empty((height, width), np.float32)
    spatial = np.float32(-0.5 / spatial_sigma**2)
    tonal = np.float32(-0.5 / range_sigma**2)
    for y in prange(height):
        qy = (y + 0.5) * h / height - 0.5
        first_y = max(0, int(np.ceil(qy - radius)))
        last_y = min(h - 1, int(np.floor(qy + radius)))
        for x in range(width):
            qx = (x + 0.5) * w / width - 0.5
            first_x = max(0, int(np.ceil(qx - radius)))
            last_x = min(w - 1, int(np.floor(qx + radius)))
            everything = np.float32(0)
            known = np.float32(0)
            weight = np.float32(0)
            value = np.float32(0)
            b = np.float32(guide[y, x, 0])
            g = np.float32(guide[y, x, 1])
            r = np.float32(guide[y, x, 2])
            for j in range(first_y, last_y + 1):
                dy = np.float32(j - qy)
                for i in range(first_x, last_x + 1):
                    dx = np.float32(i - qx)
                    near = dx * dx + dy * dy
                    if near <= radius * radius:
                        db = b - taps[j, i, 0]
                        dg = g - taps[j, i, 1]
                        dr = r - taps[j, i, 2]
                        k = np.exp(spatial * near + tonal * (db * db + dg * dg + dr * dr))
                        everything += k
                        d = px[j, i]
                        if not np.isnan(d):
                            c = max(confidence[j, i], np.float32(1e-3))
                            known += k
                            weight += k * c
                            value += k * c * d
            if known > min_support * everything:
                out[y, x] = value / weight
                sure[y, x] = weight / everything
            else:
                out[y, x] = np.nan
                sure[y, x] = 0
    return out, sure


def _guided(coarse: DisparityMap, guide: U8, config: UpsamplingConfig) -> DisparityMap:
    """Local linear model of the disparity in the guide's brightness, applied at full size."""
    h, w = coarse.px.shape
    height, width = guide.shape[:2]
    grey = np.asarray(cv2.cvtColor(guide, cv2.COLOR_BGR2GRAY))
    small = np.asarray(cv2.resize(grey, (w, h), interpolation=cv2.INTER_AREA), np.float32)
    known = np.isfinite(coarse.px)
    weight = np.where(known, np.maximum(coarse.confidence, 1e-3), 0).astype(np.float32)
    slope, offset, sure = _linear_fit(
        small, np.where(known, coarse.px, 0).astype(np.float32), weight, config
    )
    size = (width, height)
    support = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    full_slope = cv2.resize(slope, size, interpolation=cv2.INTER_LINEAR)
    px = cv2.resize(offset, size, interpolation=cv2.INTER_LINEAR)
    px = np.asarray(px + full_slope * grey)
    unknown: Bool = np.asarray(support) < max(config.min_support, 1e-3)
    px[unknown] = np.nan
    confidence = cv2.resize(sure, size, interpolation=cv2.INTER_LINEAR)
    confidence[unknown] = 0
    return DisparityMap(np.asarray(px, np.float32), np.asarray(confidence, np.float32))


def _linear_fit(guide: F32, px: F32, weight: F32, config: UpsamplingConfig) -> tuple[F32, F32, F32]:
    """Slope, offset and confidence of the weighted fit about each coarse pixel."""
    side = (2 * config.guided_radius_px + 1,) * 2

    def mean(image: npt.NDArray[np.float32]) -> F32:
        return np.asarray(cv2.blur(image, side, borderType=cv2.BORDER_REFLECT), np.float32)

    total = np.maximum(mean(weight), 1e-9)
    m_guide = mean(weight * guide) / total
    m_px = mean(weight * px) / total
    variance = np.maximum(mean(weight * guide * guide) / total - m_guide * m_guide, 0)
    covariance = mean(weight * guide * px) / total - m_guide * m_px
    slope = covariance / (variance + config.guided_epsilon**2)
    offset = m_px - slope * m_guide
    return (
        (mean(weight * slope) / total).astype(np.float32),
        (mean(weight * offset) / total).astype(np.float32),
        np.minimum(total, 1).astype(np.float32),
    )
