"""Disparity from a learned or exported model, on the fastest provider of ONNX Runtime.

Two rectified images in, one disparity out. The model's inputs are declared in a file and checked
when it is loaded, before the flight.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import onnxruntime  # type: ignore[import-untyped]
from onnxruntime.capi import onnxruntime_pybind11_state  # type: ignore[import-untyped]

from recon.backends.cpu import CpuBackend
from recon.stereo.belief_propagation import BeliefPropagationConfig, drop_unreliable
from recon.stereo.matching_cost import check_pair
from recon.types import F32, U8, DisparityMap

PROVIDERS = ("TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider")
"""Fastest first; ONNX Runtime falls back along the list."""

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


def provider_options(
    providers: list[str], model: bytes, engines: str | None
) -> list[tuple[str, dict[str, Any]]]:
    """The providers with their options: TensorRT keeps its engines, the others need none.

    Each model has a folder of its own, named by its digest: TensorRT distinguishes engines by the
    names in a model. ``engines`` must exist; TensorRT makes the folders in it.
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


@dataclass(frozen=True, slots=True)
class LearnedStereoConfig:
    """How the model is fed; declared in the TOML file next to it."""

    height: int  # px of the images that it takes
    width: int
    left: str = "left"  # names of its inputs and of the output that is used
    right: str = "right"
    disparity: str = "disparity"
    layout: str = "nchw"  # or "nhwc"
    channels: int = 3  # 1 or 3; gray is repeated
    scale: float = 1 / 255  # of the gray levels, before mean and deviation
    mean: float = 0.0
    deviation: float = 1.0
    disparity_scale: float = 1.0  # pixels per unit of its output; negative turns the sign
    confidence: float = 0.5  # given to its disparities: it reports none

    def __post_init__(self) -> None:
        if self.layout not in ("nchw", "nhwc") or self.channels not in (1, 3):
            raise ValueError("layout is 'nchw' or 'nhwc' and channels 1 or 3")
        if min(self.height, self.width) < 8 or self.deviation <= 0 or self.disparity_scale == 0:
            raise ValueError("height and width are at least 8, deviation and scale not zero")
        if not 0 < self.confidence <= 1:
            raise ValueError("confidence is above 0 and at most 1")

    @property
    def image_shape(self) -> tuple[int, ...]:
        if self.layout == "nchw":
            return (1, self.channels, self.height, self.width)
        return (1, self.height, self.width, self.channels)


class LearnedStereoBackend(CpuBackend):
    """The model's disparity in place of belief propagation's; the rest is the compiled code's.

    Contrast, visibility and speckles are checked as for every backend. TensorRT builds an engine
    of the model, which takes minutes; ``engines`` is the folder that keeps it between starts.
    Raises ValueError when the model's inputs or output are not as declared, with what was
    expected and found.
    """

    name = "learned"

    def __init__(
        self, model: bytes, config: LearnedStereoConfig, engines: str | None = None
    ) -> None:
        offered = onnxruntime.get_available_providers()
        providers = [p for p in PROVIDERS if p in offered]
        if not providers:
            raise ValueError(f"ONNX Runtime offers none of {', '.join(PROVIDERS)}")
        self.device = providers[0].removesuffix("ExecutionProvider").lower()
        self.config = config
        self._model = open_session(model, providers, engines)
        found = {i.name: (tuple(i.shape), i.type) for i in self._model.get_inputs()}
        for name in (config.left, config.right):
            _check_input(name, found, config.image_shape)
        if len(found) != 2:
            raise ValueError(f"the model takes {sorted(found)}; two images were expected")
        outputs = [o.name for o in self._model.get_outputs()]
        if config.disparity not in outputs:
            raise ValueError(f"output {config.disparity!r} was expected, found {outputs}")

    def belief_propagation(
        self, left: U8, right: U8, labels: int, config: BeliefPropagationConfig
    ) -> DisparityMap:
        """The model's disparity less ``config.min_disparity``, NaN outside the labels.

        A pair larger than the model's images is averaged down to fit (rectified pairs of a
        turning camera are larger than its images); its disparities grow back with it.
        """
        check_pair(left, right, labels)
        h, w = left.shape
        share = min(1.0, self.config.height / h, self.config.width / w)
        size = (max(1, int(w * share)), max(1, int(h * share)))
        images = (cv2.resize(i, size, interpolation=cv2.INTER_AREA) for i in (left, right))
        found = self._disparity(*(np.asarray(i, np.uint8) for i in images))
        grown = cv2.resize(found, (w, h), interpolation=cv2.INTER_NEAREST)
        px = np.asarray(grown, np.float32) * np.float32(w / size[0])
        px = px - np.float32(config.min_disparity)
        partner = np.arange(w)[None, :] - px - config.min_disparity
        sound = (px >= 0) & (px <= labels - 1) & (partner > -0.5) & (partner < w - 0.5)
        confidence = np.where(sound, self.config.confidence, 0).astype(np.float32)
        return drop_unreliable(
            left, np.where(sound, px, np.nan).astype(np.float32), confidence, config
        )

    def _disparity(self, left: U8, right: U8) -> F32:
        """(h, w) pixels, of images that fit the model."""
        h, w = left.shape
        given = {self.config.left: self._image(left), self.config.right: self._image(right)}
        try:
            (raw,) = self._model.run([self.config.disparity], given)
        except ORT_ERRORS as error:
            raise RuntimeError(str(error)) from error
        plane = np.asarray(raw, np.float32).squeeze()
        if plane.shape != (self.config.height, self.config.width):
            raise ValueError(
                f"the model gave {np.shape(raw)}; one plane of "
                f"{self.config.height}x{self.config.width} was expected"
            )
        return np.asarray(plane[:h, :w] * np.float32(self.config.disparity_scale))

    def _image(self, gray: U8) -> Any:
        """The image as the model takes it; a smaller one is continued by its border."""
        c = self.config
        pad = ((0, c.height - gray.shape[0]), (0, c.width - gray.shape[1]))
        level = (np.pad(gray, pad, mode="edge").astype(np.float32) * c.scale - c.mean) / c.deviation
        axis = 1 if c.layout == "nchw" else 3
        image = np.repeat(np.expand_dims(level[None], axis), c.channels, axis=axis)
        return np.ascontiguousarray(image, np.float32)


def _check_input(name: str, found: dict[str, tuple[Any, str]], shape: tuple[int, ...]) -> None:
    """ValueError unless the model has this input; free sizes (names, None) fit any number."""
    if name not in found:
        raise ValueError(f"input {name!r} was expected, found {sorted(found)}")
    its_shape, kind = found[name]
    fits = len(its_shape) == len(shape) and all(
        not isinstance(a, int) or a == b for a, b in zip(its_shape, shape, strict=True)
    )
    if kind != "tensor(float)" or not fits:
        raise ValueError(
            f"input {name!r}: float32 {list(shape)} was expected, found {kind} {list(its_shape)}"
        )
