"""What a :class:`recon.pipeline.mapper.Mapper` is given, and the events by which it answers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field

import numpy as np

from recon.tracking.frame import Frame
from recon.types import U8, Array, Keyframe, Pose, PosePrior

Timing = Callable[[str], AbstractContextManager[object]]
"""Gives a stage by name the context that it runs in."""


def untimed(stage: str) -> AbstractContextManager[object]:
    return nullcontext()


TWO_ONLY = "seen by two views only"
"""Reason why a view is refused: nothing confirms its one pair."""

CONTRADICTED = "pairs contradict each other"
"""Another: its pairs, or those of most views before it, do not agree on a surface."""


@dataclass(frozen=True, slots=True)
class MapperConfig:
    """Parameters of a :class:`recon.pipeline.mapper.Mapper`."""

    # A view each so many metres along the track, or frames; by base to height where both are 0.
    spacing_m: float = 0.0
    spacing_frames: int = 0
    pairs: int = 4  # partners of a view, at most
    base_to_height: float = 0.1  # motion between the odometry's keyframes over the distance
    seeks_readout: bool = False  # the shutter's readout is a start, to be found by the images
    guide_width_px: int = 1280  # of the images that guide the upsampling
    stereo_width_px: int = 320
    upsample: bool = True
    labels: int = 16  # of disparity, at least
    iterations: int = 5  # of belief propagation per level
    loops: bool = True
    loop_views: int = 400  # keyframes kept for loop detection
    graph_keyframes: int = 400  # nodes of the pose graph; above that, keyframes are interpolated
    resolution_m: float = 0.0  # of the map, at least; 0: as fine as the images
    keeps_debug: bool = False  # the images of each view's stages
    first_depths: bool = False  # of views whose partners have not come, while no work waits


@dataclass(frozen=True, slots=True, eq=False)
class FramePosed:
    """A frame went through tracking. One that was lost comes again where the next one places it."""

    frame: Frame  # without its images; gives its pose in the odometry again, as known later
    pose: Pose | None = None  # in the world; by telemetry alone when vision fails
    is_view: bool = False  # the frame takes part in stereo and may become a keyframe


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeReady:
    """A view has become a keyframe, with the depth of all its partners.

    ``is_first_depth``: only what one partner shows, to look at now. The same view comes again with
    its whole depth, unless it is refused. ``stages``: the images of its stages, by name, where they
    are kept.
    """

    keyframe: Keyframe
    is_first_depth: bool = False
    stages: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class PosesChanged:
    """Better poses of keyframes that came before, by number."""

    poses: Mapping[int, Pose]


Event = FramePosed | KeyframeReady | PosesChanged


def check_image(image: U8, size_px: tuple[int, int]) -> None:
    """Raise ValueError, naming the fault, unless the image is (H, W, 3) uint8 of ``size_px``."""
    wanted = (size_px[1], size_px[0], 3)
    if not isinstance(image, np.ndarray) or image.shape != wanted or image.dtype != np.uint8:
        given = f"{image.shape} {image.dtype}" if isinstance(image, np.ndarray) else repr(image)
        raise ValueError(f"the image must be BGR, {wanted} uint8 by the camera model, not {given}")


def check_prior(prior: PosePrior) -> None:
    """Raise ValueError, naming the field, where a part of the prior is none that can be."""
    if not isinstance(prior, PosePrior):
        raise ValueError(f"the prior must be a PosePrior, not {prior!r}; leave it out for none")
    R = prior.R_world_camera
    if R is not None and not (
        _is_finite(R, (3, 3))
        and np.allclose(R @ R.T, np.eye(3), atol=1e-3)
        and np.linalg.det(R) > 0.0
    ):
        raise ValueError(f"R_world_camera must be a (3, 3) rotation, or None, not {R!r}")
    for name in ("position_m", "sigma_position_m", "velocity_m_s", "turn_rad_s"):
        value = getattr(prior, name)
        if value is not None and not _is_finite(value, (3,)):
            raise ValueError(f"{name} must be an array of 3 numbers, or None, not {value!r}")


def _is_finite(value: object, shape: tuple[int, ...]) -> bool:
    return isinstance(value, np.ndarray) and value.shape == shape and bool(np.isfinite(value).all())
