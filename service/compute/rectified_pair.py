"""A rectified image pair from files, and the matching settings for a single pair."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from service.errors import InputError

if TYPE_CHECKING:
    from recon.stereo.belief_propagation import BeliefPropagationConfig
    from recon.types import U8


def matching_config(iterations: int, min_disparity: int, checked: bool) -> BeliefPropagationConfig:
    """How the pair is matched; InputError for numbers out of range."""
    from recon.stereo.belief_propagation import BeliefPropagationConfig

    try:
        if checked:
            return BeliefPropagationConfig(iterations=iterations, min_disparity=min_disparity)
        return BeliefPropagationConfig(
            iterations=iterations,
            min_disparity=min_disparity,
            min_evidence=0.05,
            min_contrast=0.3,
            fill_occluded=True,
        )
    except ValueError as error:
        raise InputError(f"stereo: {error}") from error


def read_gray(path: Path) -> U8:
    """A gray 8-bit image (h, w); InputError when there is none."""
    import cv2
    import numpy as np

    if not path.is_file():
        raise InputError(f"{path}: no such file")
    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE) if (
        path.stat().st_size
    ) else None  # fmt: skip
    if image is None:
        raise InputError(f"{path}: not an image that can be read; give PNG, JPEG or TIFF")
    return np.asarray(image, np.uint8)
