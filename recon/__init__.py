"""Reconstruction mathematics: arrays in, arrays out; no clock, file, socket or environment.

``from recon import Camera, Frame, Mapper, PosePrior`` is the library; names load on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from recon.pipeline.mapper import (
        FramePosed,
        KeyframeReady,
        Mapper,
        MapperConfig,
        PosesChanged,
    )
    from recon.tracking.frame import Frame
    from recon.types import Camera, PointCloud, Pose, PosePrior

__all__ = [
    "Camera",
    "Frame",
    "FramePosed",
    "KeyframeReady",
    "Mapper",
    "MapperConfig",
    "PointCloud",
    "Pose",
    "PosePrior",
    "PosesChanged",
]

_ROOMS = ("recon.types", "recon.pipeline.mapper")


if not TYPE_CHECKING:  # a type checker refuses names that are not there

    def __getattr__(name: str) -> Any:
        if name in __all__:
            for room in map(import_module, _ROOMS):
                if hasattr(room, name):
                    return getattr(room, name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
