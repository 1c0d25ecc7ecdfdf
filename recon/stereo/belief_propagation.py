"""Stereo by hierarchical min-sum belief propagation on a grid (paper section 2.2, Eq. 1).

The energy is the matching cost plus a truncated linear smoothness, weaker where the image has
an edge; messages pass through the
lower envelope of Felzenszwalb and Huttenlocher, https://doi.org/10.1007/s11263-006-7899-4,
coarse to fine, on a checkerboard: an iteration updates the pixels of one colour from those of
the other. :mod:`recon.stereo.message_passing` does that; here labels become a disparity map:
between labels by the matching cost about the winner, and unknown where nothing speaks for it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from recon.stereo.disparity_selection import check_visibility, select
from recon.stereo.matching_cost import (
    COST_UNIT,
    MatchingCostConfig,
    check_pair,
    matching_cost,
    plain,
)
from recon.stereo.message_passing import MAX_TRUNCATION, Smoothness, propagate
from recon.stereo.workspace import Workspace
from recon.types import F32, U8, DisparityMap

_space = Workspace()

SPECKLE_STEP = 16
"""Sixteenths of a label: neighbours further apart than one label belong to two surfaces."""


@dataclass(frozen=True, slots=True)
class BeliefPropagationConfig:
    """How the labels are found and which of them are believed."""

    iterations: int = 5  # per level; one iteration updates one colour of the checkerboard
    levels: int = 5  # of the pyramid; fewer when the image is small
    smoothness_truncation: float = 2.5  # labels; a larger jump costs no more
    edge_floor: float = 0.4  # share of the smoothness that is left across strong edges
    edge_contrast: int = 32  # grey levels between neighbours that make a strong edge
    min_disparity: int = 0  # px, disparity of label 0
    cost: MatchingCostConfig = field(default_factory=MatchingCostConfig)
    min_evidence: float = 0.2  # how much better than the mean label, 0 to 1; 0: believe all
    min_contrast: float = 0.5  # grey levels of standard deviation in 9x9; 0: believe all
    occlusion_tolerance: float = 1.0  # labels; a surface seen behind another one; < 0: no check
    fill_occluded: bool = False  # with the farther neighbour of the row, at low confidence
    speckle_px: int = 24  # smaller islands are dropped; 0: none

    def __post_init__(self) -> None:
        if not 1 <= self.iterations <= 1000 or not 1 <= self.levels <= 16:
            raise ValueError("iterations must be 1 to 1000 and levels 1 to 16")
        if not 1 <= self.truncation <= MAX_TRUNCATION:
            raise ValueError(
                f"smoothness_truncation must be above 0 and at most {MAX_TRUNCATION // COST_UNIT}"
                f" labels, not {self.smoothness_truncation}"
            )
        if not 0 < self.edge_floor <= 1 or not 1 <= self.edge_contrast <= 255:
            raise ValueError("edge_floor must be in (0, 1] and edge_contrast 1 to 255")
        if abs(self.min_disparity) > 32767 or self.speckle_px < 0:
            raise ValueError("min_disparity or speckle_px is out of range")

    @property
    def truncation(self) -> int:
        """The largest smoothness cost in integer units."""
        return round(self.smoothness_truncation * COST_UNIT)

    @property
    def smoothness(self) -> Smoothness:
        """The smoothness term in integer units."""
        return Smoothness(COST_UNIT, self.truncation, self.edge_floor, self.edge_contrast)


def belief_propagation(
    left: U8, right: U8, labels: int, config: BeliefPropagationConfig
) -> DisparityMap:
    """Real-valued labels (0 to labels - 1) of the left view, (h, w), NaN where not trusted.

    ``left`` and ``right`` are rectified grey images (h, w) uint8; left pixel (u, v) at label
    ``l`` matches ``right[v, u - l - config.min_disparity]``. Raises ValueError for bad input.
    """
    check_pair(left, right, labels)
    height, width = left.shape
    volume = _space.take("cost", (height, labels, width))
    cost = matching_cost(left, right, labels, config.cost, config.min_disparity, volume)
    data, messages = propagate(
        cost, plain(left), config.iterations, config.levels, config.smoothness
    )
    px, confidence = select(
        data, messages, cost, config.min_disparity, config.truncation, config.min_evidence
    )
    return believe(left, px, confidence, config)


def believe(left: U8, px: F32, confidence: F32, config: BeliefPropagationConfig) -> DisparityMap:
    """The labels that contrast, visibility and size of their surface speak for.

    ``px`` and ``confidence`` are changed in place. Every backend ends with this.
    """
    if config.min_contrast > 0:
        confidence[_contrast(left) < config.min_contrast] = 0
    if config.occlusion_tolerance >= 0:
        check_visibility(
            px, confidence, config.min_disparity, config.occlusion_tolerance, config.fill_occluded
        )
    else:
        px[confidence <= 0] = np.nan
    if config.speckle_px > 0:
        _drop_speckles(px, config.speckle_px)
    confidence[np.isnan(px)] = 0
    return DisparityMap(px, confidence)


def _contrast(image: U8) -> F32:
    """Standard deviation of the grey levels in 9x9, (h, w)."""
    mean = cv2.boxFilter(image, cv2.CV_32F, (9, 9), borderType=cv2.BORDER_REPLICATE)
    square = cv2.sqrBoxFilter(image, cv2.CV_32F, (9, 9), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(np.sqrt(np.maximum(square - mean * mean, 0)), np.float32)


def _drop_speckles(px: F32, smallest: int) -> None:
    """NaN for surfaces of at most ``smallest`` pixels."""
    unknown = -32768
    labels = np.where(np.isnan(px), -2048, px) * SPECKLE_STEP
    coarse = np.ascontiguousarray(labels, np.int16)
    cv2.filterSpeckles(coarse, unknown, smallest, SPECKLE_STEP)
    px[coarse == unknown] = np.nan
