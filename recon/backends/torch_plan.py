"""One operation at fixed shapes on a device: staging, one upload, and its CUDA graph."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from threading import Lock
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recon.backends.padding import place
from recon.types import Array

log = logging.getLogger(__name__)

ALIGNMENT = 64  # bytes

_capturing = Lock()
"""One thread captures at a time; what others launch meanwhile is no part of its graph."""

Part = tuple[tuple[int, ...], torch.dtype]
"""Shape and type of an input."""


class Plan:
    """An operation with its inputs in one buffer of the device; on CUDA captured as a graph.

    Inputs are written to pinned memory and go to the device in one copy that the host does not
    wait for; each ``slot`` is a staging buffer of its own, free again once the results that
    came of it were read. In Triton's interpreter the same operation runs without capture.
    """

    def __init__(
        self, device: str, operation: Callable[..., tuple[Tensor, ...]], parts: Sequence[Part]
    ) -> None:
        self.device = device
        self._operation = operation
        self._parts = list(parts)
        self._places = []
        at = 0
        for shape, kind in self._parts:
            size = math.prod(shape) * torch.empty(0, dtype=kind).element_size()
            self._places.append((at, at + size))
            at += -(-size // ALIGNMENT) * ALIGNMENT
        self.upload_bytes = at
        self._buffer = torch.zeros(at, dtype=torch.uint8, device=device)
        self._inputs = self._views(self._buffer)
        self._staging: dict[int, tuple[Tensor, list[Array]]] = {}
        self._replay: Callable[[], object] | None = None
        self._outputs: tuple[Tensor, ...] = ()

    def upload(self, arrays: Sequence[Array], slot: int = 0) -> None:
        """Write the inputs; a smaller image is continued by its last row and column."""
        if slot not in self._staging:
            host = torch.zeros(self.upload_bytes, dtype=torch.uint8, pin_memory=self._on_cuda)
            self._staging[slot] = host, [view.numpy() for view in self._views(host)]
        host, views = self._staging[slot]
        for view, array in zip(views, arrays, strict=True):
            place(view, array)
        self.send(slot)

    def send(self, slot: int = 0) -> None:
        """Copy what was staged in the slot to the device again."""
        self._buffer.copy_(self._staging[slot][0], non_blocking=True)

    def run(self) -> tuple[Tensor, ...]:
        """The results, on the device; on CUDA overwritten by the next run."""
        if not self._on_cuda:
            return self.eager()
        if self._replay is None:
            self._capture()
        assert self._replay is not None
        self._replay()
        return self._outputs

    def eager(self) -> tuple[Tensor, ...]:
        """The results, kernel by kernel, without a graph."""
        return self._operation(*self._inputs)

    @property
    def _on_cuda(self) -> bool:
        return self.device.startswith("cuda")

    def _views(self, buffer: Tensor) -> list[Tensor]:
        return [
            buffer[first:last].view(kind).view(shape)
            for (shape, kind), (first, last) in zip(self._parts, self._places, strict=True)
        ]

    def _capture(self) -> None:
        """Record the kernels once; capture needs them loaded, so some rounds run before it."""
        stream: Any = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream), compiling():
            for _ in range(2):
                self._operation(*self._inputs)
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with _capturing, torch.cuda.graph(graph, capture_error_mode="thread_local"):
            self._outputs = self._operation(*self._inputs)
        self._replay = graph.replay
        log.debug("captured a CUDA graph for %s", [shape for shape, _ in self._parts])


@contextmanager
def compiling() -> Iterator[None]:
    """RuntimeError, with the cause, where Triton cannot compile or load a kernel."""
    try:
        yield
    except RuntimeError:
        raise
    except Exception as error:  # its own classes, those of its compilers, and the code's
        cause = (str(error).splitlines() or [""])[-1]
        raise RuntimeError(f"a kernel cannot run: {type(error).__name__} {cause}") from error


def part(array: Array, shape: tuple[int, ...] | None = None) -> Part:
    """The input that holds such an array, in room for ``shape``."""
    return shape or array.shape, torch.from_numpy(np.empty(0, array.dtype)).dtype


def read(tensors: Sequence[Tensor]) -> list[Array]:
    """Results as arrays of the host, wider types first: one copy, one wait."""
    together = to_host(torch.cat([t.reshape(-1).view(torch.uint8) for t in tensors]))
    parts = torch.split(together, [t.numel() * t.element_size() for t in tensors])
    pairs = zip(parts, tensors, strict=True)
    return [part.view(t.dtype).view(t.shape).numpy() for part, t in pairs]


def to_host(tensor: Tensor) -> Tensor:
    """The tensor on the host; from CUDA in pinned memory, which a copy fills at full speed."""
    if not tensor.is_cuda:
        return tensor.cpu()
    host = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True)
    host.copy_(tensor, non_blocking=True)
    torch.cuda.current_stream().synchronize()
    return host
