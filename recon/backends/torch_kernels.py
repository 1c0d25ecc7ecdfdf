"""Which plain torch operations a fused kernel may take the place of.

Without Triton, as with many wheels for the Jetson, none does. :mod:`recon.backends.kernel_trials`
shows on the device at hand that a kernel gives what the plain operation gives.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from torch import Tensor

from recon.stereo.upsampling import UpsamplingConfig

if TYPE_CHECKING:
    from recon.backends.torch_partners import SourcePoints
    from recon.backends.torch_sums import Weighed
    from recon.backends.torch_surface import DeviceSurface
    from recon.clouds.registration import IcpConfig
    from recon.stereo.belief_propagation import BeliefPropagationConfig


class Sweep(Protocol):
    """Renews in place the messages that leave one colour of the checkerboard."""

    def __call__(
        self, data: Tensor, messages: Tensor, slope: Tensor, cut: Tensor, colour: int, /
    ) -> None:
        """See :func:`recon.backends.triton_propagation.sweep`."""
        ...


class Cost(Protocol):
    """Matching cost of every label."""

    def __call__(
        self, left: Tensor, right: Tensor, labels: int, true: Tensor,
        config: BeliefPropagationConfig, /,
    ) -> Tensor:  # fmt: skip
        """See :func:`recon.backends.torch_cost.matching_cost`."""
        ...


class Bilateral(Protocol):
    """Joint bilateral upsampling in one go."""

    def __call__(
        self, px: Tensor, confidence: Tensor, taps: Tensor, guide: Tensor, true: Tensor,
        config: UpsamplingConfig, /,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """See :class:`recon.backends.torch_upsampling.JointBilateral`."""
        ...


class Weigh(Protocol):
    """Partners, weights and sums of an iteration of ICP."""

    def __call__(
        self, seen: SourcePoints, a: DeviceSurface, b: DeviceSurface, T: Tensor, tukey: bool,
        config: IcpConfig, /,
    ) -> Weighed:  # fmt: skip
        """See :func:`recon.backends.torch_sums.weigh`."""
        ...


class Advance(Protocol):
    """The step of an iteration of ICP."""

    def __call__(
        self, weighed: Weighed, a: DeviceSurface, T: Tensor, state: Tensor, share: float,
        config: IcpConfig, /,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """See :func:`recon.backends.torch_sums.advance`."""
        ...


@dataclass(frozen=True, slots=True)
class Kernels:
    """What replaces plain operations; None: nothing does."""

    sweep: Sweep | None = None
    bilateral: Bilateral | None = None
    weigh: Weigh | None = None
    advance: Advance | None = None
    cost: Cost | None = None


PLAIN = Kernels()
"""Everything in plain torch."""
