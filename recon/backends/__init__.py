"""The heavy operations behind one protocol: one module a backend, one line in the table.

Arrays enter and leave as NumPy; a backend moves them to its device at its own edge. Every
operation has a short NumPy reference, in tests/support/dense_reference.py, that the tests compare
every backend against.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Protocol

from recon.types import F64, U8, DepthMap, DisparityMap, Registration, StereoPair

if TYPE_CHECKING:
    from recon.mapping.registration import IcpConfig
    from recon.stereo.belief_propagation import BeliefPropagationConfig


class Backend(Protocol):
    @property
    def name(self) -> str: ...

    @property
    def device(self) -> str:
        """Where it computes, such as "cpu" or "cuda"."""
        ...

    @property
    def keeps_pairs(self) -> bool:
        """True where :meth:`fused_depth` works, without giving the depth of single pairs."""
        ...

    def belief_propagation(
        self, left: U8, right: U8, labels: int, config: BeliefPropagationConfig
    ) -> DisparityMap:
        """Labels (real valued, 0 to labels - 1) of the left view, (h, w); Eq. 1."""
        ...

    def upsample(self, coarse: DisparityMap, guide: U8) -> DisparityMap:
        """``coarse`` (h, w) at the size of ``guide`` (H, W, 3), values unscaled; Eq. 2."""
        ...

    def register(
        self, source: DepthMap, target: DepthMap, T_target_source: F64, config: IcpConfig
    ) -> Registration:
        """Projective point-to-plane ICP from the given start."""
        ...

    def fused_depth(
        self,
        pairs: Sequence[StereoPair],
        K: F64,
        size_px: tuple[int, int],
        T_world_camera: F64,
        config: BeliefPropagationConfig,
    ) -> DepthMap | None:
        """Depth of a keyframe on its grid ``size_px`` (w, h), all stages on the device; None: do it
        stage by stage. ``config.fill_occluded`` is not for it."""
        ...


BACKENDS: dict[str, str] = {
    "cpu": "recon.backends.cpu:CpuBackend",
    "torch": "recon.backends.torch_plain:open_torch",
}
"""Name to ``module:factory``; imported on first use. A model on ONNX Runtime is one by its file."""


def load_backend(name: str) -> Backend:
    """The backend called ``name``, ready to run.

    Raises ValueError for a name that is not in the table, and whatever the backend raises when it
    cannot run here (ImportError, RuntimeError), with the reason.
    """
    if name not in BACKENDS:
        raise ValueError(f"no backend {name!r}; there are {', '.join(sorted(BACKENDS))}")
    module, _, cls = BACKENDS[name].partition(":")
    backend: Backend = getattr(import_module(module), cls)()
    return backend
