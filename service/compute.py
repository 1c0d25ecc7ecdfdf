"""The backend that a configuration asks for."""

from __future__ import annotations

from typing import TYPE_CHECKING

from service.config import ComputeConfig

if TYPE_CHECKING:
    from recon.backends import Backend


def open_backend(config: ComputeConfig) -> Backend:
    """The backend named by ``compute.backend``, ready to run; "auto" is the fastest that works.

    A backend that is named and cannot run stops the start: InputError for an unknown name,
    OutsideError with the reason otherwise.
    """
    from service.backend_choice import choose_backend

    return choose_backend(config.backend)
