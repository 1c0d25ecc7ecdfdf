"""The backend that a configuration asks for."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from service.config import ComputeConfig
from service.errors import InputError

if TYPE_CHECKING:
    from recon.backends import Backend


def open_backend(config: ComputeConfig, picture_px: tuple[int, int] | None = None) -> Backend:
    """The backend named by ``compute.backend``, ready to run; "auto" is the fastest that works.

    With ``compute.model`` it is the learned model declared there, by ONNX Runtime; with the
    size of the camera's pictures (W, H) its size is checked before anything flies. A backend
    that is named and cannot run stops the start: InputError for an unknown name or a model that
    does not fit, OutsideError with the reason otherwise.
    """
    from service.compute.backend_choice import FallbackBackend, choose_backend

    if not config.model:
        return choose_backend(config.backend)
    if config.backend not in ("auto", "onnx"):
        raise InputError(
            f"compute.model runs on ONNX Runtime: compute.backend must be onnx or auto, "
            f"not {config.backend}"
        )
    from service.compute.learned_model import load_learned_model

    learned = load_learned_model(Path(config.model))
    width = config.stereo_width
    height = 0 if picture_px is None else round(width * picture_px[1] / picture_px[0])
    if width > learned.config.width or height > learned.config.height:
        found = f"{width}x{height}" if height else f"{width} wide"
        raise InputError(
            f"{config.model}: takes pairs up to {learned.config.width}x{learned.config.height}, "
            f"but they would be {found}; set compute.stereo_width"
        )
    return FallbackBackend(learned)
