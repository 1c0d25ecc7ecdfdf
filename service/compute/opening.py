"""Opens the configured backend, or the learned model of a declaration.

A model is an ONNX file and a TOML file next to it, which names the ONNX file
(``model = "net.onnx"``, relative to itself) and sets the fields of
:class:`recon.backends.learned_stereo.LearnedStereoConfig` that differ from their defaults.
"""

from __future__ import annotations

from dataclasses import MISSING, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from service.config import ComputeConfig
from service.errors import InputError, OutsideError

if TYPE_CHECKING:
    from recon.backends import Backend
    from recon.backends.learned_stereo import LearnedStereoBackend


def open_backend(config: ComputeConfig, image_px: tuple[int, int] | None = None) -> Backend:
    """The backend of ``compute.backend``, ready to run; "auto" is the fastest that works.

    With ``compute.model`` it is that learned model on ONNX Runtime; ``image_px`` (W, H) of the
    camera checks its input size before the flight. A named backend that cannot run stops the start:
    InputError for an unknown name or a model that does not fit, OutsideError with the reason
    otherwise.
    """
    from service.compute.backend_choice import FallbackBackend, choose_backend

    if not config.model:
        return choose_backend(config.backend)
    if config.backend not in ("auto", "onnx"):
        raise InputError(
            f"compute.model runs on ONNX Runtime: compute.backend must be onnx or auto, "
            f"not {config.backend}"
        )
    learned = load_learned_model(Path(config.model))
    width = config.stereo_width
    height = 0 if image_px is None else round(width * image_px[1] / image_px[0])
    if width > learned.config.width or height > learned.config.height:
        found = f"{width}x{height}" if height else f"{width} wide"
        raise InputError(
            f"{config.model}: takes pairs up to {learned.config.width}x{learned.config.height}, "
            f"but they would be {found}; set compute.stereo_width"
        )
    return FallbackBackend(learned)


def load_learned_model(declaration: Path) -> LearnedStereoBackend:
    """The model declared in a TOML file, checked and ready to run.

    TensorRT's engine, if available, is cached between starts.

    Raises InputError, with what was expected and what was found, when declaration and model
    do not fit, and OutsideError when ONNX Runtime is missing.
    """
    try:
        from recon.backends.learned_stereo import LearnedStereoBackend, LearnedStereoConfig
    except ImportError as error:
        raise OutsideError(f"a learned model needs ONNX Runtime: {error}") from error
    from service.compute.backend_choice import engine_folder

    try:
        given = msgspec.toml.decode(declaration.read_bytes(), type=dict[str, Any])
        model = declaration.parent / str(given.pop("model", ""))
        known = {f.name: f for f in fields(LearnedStereoConfig)}
        strange = sorted(set(given) - set(known))
        missing = sorted(n for n, f in known.items() if f.default is MISSING and n not in given)
        if strange or missing or not model.is_file():
            raise InputError(
                f"{declaration}: "
                + (f"unknown {', '.join(strange)}; known are model, {', '.join(known)}" if strange
                   else f"{', '.join(missing)} must be given" if missing
                   else f"model = {model.name!r} is no file next to it")
            )  # fmt: skip
        config = LearnedStereoConfig(**given)
        return LearnedStereoBackend(model.read_bytes(), config, engine_folder())
    except OSError as error:
        raise InputError(f"{declaration}: cannot be read: {error.strerror}") from error
    except (msgspec.DecodeError, ValueError, TypeError) as error:
        raise InputError(f"{declaration}: {error}") from error
