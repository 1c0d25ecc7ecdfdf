"""The events of :class:`recon.pipeline.mapper.Mapper`: frames, keyframes, and their new poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from recon.tracking.frame import Frame
from recon.types import Array, Keyframe, Pose


@dataclass(frozen=True, slots=True, eq=False)
class FramePosed:
    """A frame went through tracking. One that was lost comes again where the next one places it."""

    frame: Frame  # without its images; ``relative`` gives its pose again, as known later
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
