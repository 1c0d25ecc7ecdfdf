"""A learned stereo model on disk: an ONNX file and the TOML beside it that declares it.

The TOML names the file (``model = "net.onnx"``, relative to itself) and gives the fields of
:class:`recon.backends.learned_stereo.LearnedStereoConfig` that differ from their defaults.
"""

from __future__ import annotations

from dataclasses import MISSING, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from service.compute.backend_choice import engine_folder
from service.errors import InputError, OutsideError

if TYPE_CHECKING:
    from recon.backends.learned_stereo import LearnedStereoBackend


def load_learned_model(declaration: Path) -> LearnedStereoBackend:
    """The model declared in a TOML file, checked and ready to run.

    TensorRT's engine of it, where there is TensorRT, is kept between starts.

    Raises InputError, with what was expected and what was found, when declaration and model
    do not fit, and OutsideError when ONNX Runtime is missing.
    """
    try:
        from recon.backends.learned_stereo import LearnedStereoBackend, LearnedStereoConfig
    except ImportError as error:
        raise OutsideError(f"a learned model needs ONNX Runtime: {error}") from error
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
                   else f"model = {model.name!r} is no file beside it")
            )  # fmt: skip
        config = LearnedStereoConfig(**given)
        return LearnedStereoBackend(model.read_bytes(), config, engine_folder())
    except OSError as error:
        raise InputError(f"{declaration}: cannot be read: {error.strerror}") from error
    except (msgspec.DecodeError, ValueError, TypeError) as error:
        raise InputError(f"{declaration}: {error}") from error
