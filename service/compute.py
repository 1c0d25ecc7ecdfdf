"""The backend that a configuration asks for."""

from __future__ import annotations

from typing import TYPE_CHECKING

from service.config import ComputeConfig
from service.errors import InputError, OutsideError

if TYPE_CHECKING:
    from recon.backends import Backend


def open_backend(config: ComputeConfig) -> Backend:
    """The backend named by ``compute.backend``, ready to run.

    "auto" is the CPU backend as long as no other one is in the table. A backend that is named
    and cannot run stops the start: InputError for an unknown name, OutsideError with the
    reason otherwise.
    """
    from recon.backends import load_backend

    name = "cpu" if config.backend == "auto" else config.backend
    try:
        return load_backend(name)
    except ValueError as error:
        raise InputError(f"compute.backend: {error}") from error
    except (ImportError, RuntimeError) as error:
        raise OutsideError(f"backend {name} cannot run here: {error}") from error
