"""The heavy operations by ONNX Runtime, with the fastest provider that it brings.

:class:`LearnedStereoBackend` takes the disparity from a model that the operator brings: two
rectified images in, one disparity out. The model's inputs are declared in a file and checked when
it is loaded, before the flight.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import onnxruntime  # type: ignore[import-untyped]
from onnxruntime.capi import onnxruntime_pybind11_state  # type: ignore[import-untyped]

from recon.backends.cpu import CpuBackend
from recon.backends.onnx_dense import stereo_model, tap_windows, upsampling_model
from recon.backends.room import kept, place, pyramid_levels, room
from recon.stereo.belief_propagation import BeliefPropagationConfig, drop_unreliable
from recon.stereo.matching_cost import check_pair
from recon.stereo.upsampling import UpsamplingConfig, check_guide, guide_at_taps
from recon.types import F32, U8, Array, DisparityMap

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


def _run(session: Any, given: dict[str, Array], outputs: list[str] | None = None) -> list[Array]:
    """The ``outputs`` of a model, or all; RuntimeError where the device cannot compute them."""
    try:
        found: list[Array] = session.run(outputs, given)
    except ORT_ERRORS as error:
        raise RuntimeError(str(error)) from error
    return found


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
        """Of one input."""
        if self.layout == "nchw":
            return (1, self.channels, self.height, self.width)
        return (1, self.height, self.width, self.channels)


class LearnedStereoBackend(OnnxBackend):
    """The onnx backend with the model's disparity in place of belief propagation's.

    Contrast, visibility and speckles are checked as for every backend. Raises ValueError when
    the model's inputs or output are not as declared, with what was expected and found.
    """

    name = "learned"

    def __init__(
        self, model: bytes, config: LearnedStereoConfig, engines: str | None = None
    ) -> None:
        super().__init__(engines)
        self.config = config
        self._model = open_session(model, self.providers, engines)
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
        (raw,) = _run(self._model, given, [self.config.disparity])
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
