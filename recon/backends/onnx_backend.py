"""The heavy operations by ONNX Runtime, with the fastest provider that it brings."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any

import numpy as np
import onnxruntime  # type: ignore[import-untyped]
from onnxruntime.capi import onnxruntime_pybind11_state  # type: ignore[import-untyped]

from recon.backends.cpu import CpuBackend
from recon.backends.onnx_dense import stereo_model, tap_windows, upsampling_model
from recon.backends.room import kept, place, pyramid_levels, room
from recon.stereo.belief_propagation import BeliefPropagationConfig, drop_unreliable
from recon.stereo.matching_cost import check_pair
from recon.stereo.upsampling import UpsamplingConfig, check_guide, guide_at_taps
from recon.types import U8, Array, DisparityMap

PROVIDERS = ("TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider")
"""Fastest first; ONNX Runtime falls back along the list."""

KEPT_SESSIONS = 8

ORT_ERRORS: tuple[type[Exception], ...] = (
    RuntimeError,
    ValueError,
    *(
        kind
        for kind in vars(onnxruntime_pybind11_state).values()
        if isinstance(kind, type) and issubclass(kind, Exception)
    ),
)
"""Errors of ONNX Runtime; its own exceptions share no base class."""

ENGINE_NAME_DIGITS = 16


class OnnxBackend(CpuBackend):
    """Builds one model per shape and keeps its session; needs no torch.

    Shapes are few, see :mod:`recon.backends.room`.

    TensorRT builds an engine of each model, which takes minutes; ``engines`` is the folder that
    keeps them between starts (None: nothing is kept). ICP is the compiled one.
    """

    name = "onnx"

    def __init__(self, engines: str | None = None) -> None:
        self.engines = engines
        found = onnxruntime.get_available_providers()
        self.providers = [p for p in PROVIDERS if p in found]
        if not self.providers:
            raise RuntimeError(f"ONNX Runtime offers none of {', '.join(PROVIDERS)}")
        self.device = self.providers[0].removesuffix("ExecutionProvider").lower()
        self._sessions: dict[Any, Any] = {}

    def belief_propagation(
        self, left: U8, right: U8, labels: int, config: BeliefPropagationConfig
    ) -> DisparityMap:
        """Labels of the left view, (h, w); Eq. 1."""
        check_pair(left, right, labels)
        h, w = left.shape
        *size, label_room = room(h, w, labels)
        levels = pyramid_levels(h, w, config)
        key = ("stereo", *size, label_room, levels, config)
        session = self._session(
            key, lambda: stereo_model((size[0], size[1]), label_room, config, levels)
        )
        given = {name: np.empty(size, np.uint8) for name in ("left", "right")}
        place(given["left"], left)
        place(given["right"], right)
        px, confidence = _run(session, {**given, "true": np.array([h, w, labels])})
        return drop_unreliable(left, px[:h, :w].copy(), confidence[:h, :w].copy(), config)

    def upsample(self, coarse: DisparityMap, guide: U8, config: UpsamplingConfig) -> DisparityMap:
        """``coarse`` (h, w) at the size of ``guide`` (H, W, 3), values unscaled; Eq. 2."""
        check_guide(coarse, guide)
        (h, w), (H, W) = coarse.px.shape, guide.shape[:2]
        small, large = room(h, w, 1)[:2], room(H, W, 1)[:2]
        key = ("upsample", small, large, config)
        session = self._session(key, lambda: upsampling_model(small, large, config, fixed=False))
        given: dict[str, Array] = {
            "px": np.empty(small, np.float32),
            "confidence": np.empty(small, np.float32),
            "taps": np.empty((*small, 3), np.uint8),
            "guide": np.empty((*large, 3), np.uint8),
        }
        arrays: list[Array] = [coarse.px, coarse.confidence, guide_at_taps(guide, (h, w)), guide]
        for name, array in zip(given, arrays, strict=True):
            place(given[name], array)
        px, sure = _run(session, given | tap_windows((h, w), (H, W), large, config))
        return DisparityMap(px[:H, :W].copy(), sure[:H, :W].copy())

    def _session(self, key: Any, model: Callable[[], bytes]) -> Any:
        def opened() -> Any:
            try:
                return open_session(model(), self.providers, self.engines)
            except ValueError as error:  # our own model: it is the device that cannot
                raise RuntimeError(str(error)) from error

        return kept(self._sessions, key, KEPT_SESSIONS, opened)


def _run(session: Any, given: dict[str, Array]) -> tuple[Array, Array]:
    try:
        first, second = session.run(None, given)
    except ORT_ERRORS as error:
        raise RuntimeError(str(error)) from error
    return first, second


def provider_options(
    providers: list[str], model: bytes, engines: str | None
) -> list[tuple[str, dict[str, Any]]]:
    """The providers with their options: TensorRT keeps its engines, the others need none.

    Each model has a folder of its own, named by its digest: TensorRT distinguishes engines by the
    names in a model, which ours share whatever numbers they hold. ``engines`` must exist;
    TensorRT makes the folders in it.
    """
    kept: dict[str, Any] = {}
    if engines is not None and "TensorrtExecutionProvider" in providers:
        folder = f"{engines}/{hashlib.sha256(model).hexdigest()[:ENGINE_NAME_DIGITS]}"
        kept = {
            "trt_engine_cache_enable": True,
            "trt_engine_cache_path": folder,
            "trt_timing_cache_enable": True,
            "trt_timing_cache_path": engines,
        }
    return [(p, kept if p == "TensorrtExecutionProvider" else {}) for p in providers]


def open_session(model: bytes, providers: list[str], engines: str | None = None) -> Any:
    """A session for an ONNX file; ValueError, with the reason, when it cannot be used."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    # Threads that spin while they wait take the cores from tracking.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    chosen = provider_options(providers, model, engines)
    try:
        return onnxruntime.InferenceSession(model, options, providers=chosen)
    except ORT_ERRORS as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"ONNX Runtime cannot use the model: {first}") from error
