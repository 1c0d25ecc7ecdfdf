"""Corners and tracks of the odometry in torch: a picture goes up once, a few numbers come down.

The pyramid is made on the host and goes to the device in one copy; finding corners and
following points from one picture to another are one run of kernels each (on CUDA a captured
graph) and one small result. Motion between pictures (phase correlation), pose and landmarks
stay on the host. The dense stages run in another thread, so this has a stream of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from recon.backends.torch_matching import harris_cells
from recon.backends.torch_plan import Plan, part
from recon.backends.torch_tracking import match
from recon.tracking.matching import (
    FAR,
    Corners,
    Matches,
    MatchingConfig,
    Pyramid,
    checked_points,
    checked_warps,
    start_level,
)
from recon.types import U8, Array

KEPT_PLANS = 16
ROOM_POINTS = 128
"""The number of points is rounded up to a multiple, so that few graphs serve a flight."""

Shapes = tuple[tuple[int, int], ...]
"""Heights and widths of the levels of a pyramid."""


class TorchMatcher:
    """A :class:`recon.tracking.matcher.Matcher` for one thread at a time."""

    def __init__(self, device: str) -> None:
        self.device = device
        cuda = device.startswith("cuda")
        self._stream: Any = None
        if cuda:  # ahead of the dense stages: the pose is waited for
            self._stream = torch.cuda.Stream(device, priority=-1)  # type: ignore[no-untyped-call]
        self._plans: dict[Any, Plan] = {}
        self._pictures: dict[Shapes, tuple[Tensor, Tensor]] = {}
        self._mask: tuple[U8, Tensor] | None = None

    def pyramid(self, gray: U8, levels: int) -> Pyramid:
        """The pyramid of ``gray`` (H, W), its levels one after the other on the device too."""
        made = Pyramid.build(gray, levels)
        with self._own_stream():
            return Pyramid(made.levels, self._sent(made))

    def corners(self, pyramid: Pyramid, config: MatchingConfig, mask: U8 | None) -> Corners:
        """As :func:`recon.tracking.matching.harris_grid`; ValueError for a mask of another size."""
        shapes = _shapes(pyramid)
        if mask is not None and mask.shape != shapes[0]:
            raise ValueError(f"mask {mask.shape} and image {shapes[0]} differ")
        with torch.inference_mode(), self._own_stream():
            image, _ = self._room(shapes)
            image.copy_(self._held(pyramid), non_blocking=True)
            hole = self._mask_on_device(mask)
            first = _levels(image, shapes[:1])[0]
            plan = self._plan(
                ("corners", shapes, config, None if hole is None else hole.data_ptr()),
                lambda: lambda: (harris_cells(first, config, hole),),
                [],
            )
            cells = plan.run()[0].cpu().numpy().reshape(-1, 3)
        best = cells[cells[:, 2] > config.min_response]
        return Corners(np.ascontiguousarray(best[:, :2]), np.ascontiguousarray(best[:, 2]))

    def match(
        self, pyramid_a: Pyramid, uv_a: npt.ArrayLike, pyramid_b: Pyramid,
        uv_b_predicted: npt.ArrayLike, radius_px: float, warp: npt.ArrayLike | None,
        config: MatchingConfig,
    ) -> Matches:  # fmt: skip
        """As :func:`recon.tracking.matching.match`; both pyramids are of one size."""
        a = checked_points(uv_a, "uv_a")
        predicted = checked_points(uv_b_predicted, "uv_b_predicted", len(a))
        if not (np.isfinite(radius_px) and radius_px > 0):
            raise ValueError(f"radius_px must be positive, got {radius_px}")
        shapes = _shapes(pyramid_a)
        if shapes != _shapes(pyramid_b):
            raise ValueError(f"pyramids {shapes} and {_shapes(pyramid_b)} differ")
        start = start_level(radius_px, len(shapes), config)
        warps = checked_warps(warp, len(a))
        everyone = np.abs(np.hstack([a, predicted])).max(axis=1, initial=0.0) < FAR
        room = max(-(-len(a) // ROOM_POINTS) * ROOM_POINTS, ROOM_POINTS)
        given = [_padded(x, room) for x in (a, predicted, *warps, everyone.astype(np.uint8))]
        given.append(np.array([radius_px]))
        with torch.inference_mode(), self._own_stream():
            both = self._room(shapes)
            for there, pyramid in zip(both, (pyramid_a, pyramid_b), strict=True):
                there.copy_(self._held(pyramid), non_blocking=True)
            plan = self._plan(
                ("match", shapes, room, start, config),
                lambda: _matching(both, shapes, start, config),
                given,
            )
            plan.upload(given)
            found = plan.run()[0].cpu().numpy()[: len(a)]
        ok = found[:, 3] > 0
        return Matches(np.array(found[:, :2]), np.array(found[:, 2]), ok)

    def _own_stream(self) -> AbstractContextManager[object]:
        if self._stream is None:
            return nullcontext()
        context: AbstractContextManager[object] = torch.cuda.stream(self._stream)
        return context

    def _plan(
        self, key: Any, build: Callable[[], Callable[..., tuple[Tensor, ...]]], given: list[Array]
    ) -> Plan:
        if key not in self._plans:
            while len(self._plans) >= KEPT_PLANS:
                self._plans.pop(next(iter(self._plans)))
            self._plans[key] = Plan(self.device, build(), [part(x) for x in given])
        return self._plans[key]

    def _room(self, shapes: Shapes) -> tuple[Tensor, Tensor]:
        """Where the pictures of a run lie: graphs read them from a place that never moves."""
        if shapes not in self._pictures:
            self._plans.clear()
            size = sum(h * w for h, w in shapes)
            one, other = torch.zeros((2, size), dtype=torch.uint8, device=self.device)
            self._pictures = {shapes: (one, other)}
        return self._pictures[shapes]

    def _held(self, pyramid: Pyramid) -> Tensor:
        return pyramid.held if isinstance(pyramid.held, Tensor) else self._sent(pyramid)

    def _sent(self, pyramid: Pyramid) -> Tensor:
        """(all pixels,) uint8 on the device: one copy that nobody waits for."""
        flat = torch.from_numpy(np.concatenate([level.ravel() for level in pyramid.levels]))
        if self._stream is not None:
            flat = flat.pin_memory()
        return flat.to(self.device, non_blocking=True)

    def _mask_on_device(self, mask: U8 | None) -> Tensor | None:
        """The mask of a flight's pictures, sent once."""
        if mask is None or mask.all():
            return None
        if self._mask is None or not np.array_equal(self._mask[0], mask):
            self._mask = mask.copy(), torch.from_numpy(mask.copy()).to(self.device)
        return self._mask[1]


def _matching(
    pictures: tuple[Tensor, Tensor], shapes: Shapes, start: tuple[int, int], config: MatchingConfig
) -> Callable[..., tuple[Tensor, ...]]:
    """What a plan runs: from the points to their matches."""
    a, b = (_levels(flat, shapes) for flat in pictures)

    def run(
        uv: Tensor, near: Tensor, forward: Tensor, inverse: Tensor, active: Tensor, radius: Tensor
    ) -> tuple[Tensor, ...]:
        return (match(a, b, uv, near, (forward, inverse), active > 0, radius[0], start, config),)

    return run


def _levels(flat: Tensor, shapes: Shapes) -> list[Tensor]:
    """The pictures (h, w) that lie one after the other."""
    out, at = [], 0
    for h, w in shapes:
        out.append(flat[at : at + h * w].view(h, w))
        at += h * w
    return out


def _shapes(pyramid: Pyramid) -> Shapes:
    return tuple((level.shape[0], level.shape[1]) for level in pyramid.levels)


def _padded(values: Array, room: int) -> Array:
    """The rows, and rows of zeros up to ``room``."""
    return np.pad(values, [(0, room - len(values))] + [(0, 0)] * (values.ndim - 1))
