"""Opens the backend of the heavy operations: the configured one, or the fastest that works.

A learned model is an ONNX file and a TOML file next to it, which names the ONNX file
(``model = "net.onnx"``, relative to itself) and sets the fields of
:class:`recon.backends.onnx_backend.LearnedStereoConfig` that differ from their defaults.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import MISSING, dataclass, fields
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from recon.backends import BACKENDS, Backend, load_backend
from service.config import ComputeConfig
from service.errors import InputError, OutsideError
from service.packages import loads, needing

if TYPE_CHECKING:
    from recon.backends.onnx_backend import LearnedStereoBackend

log = logging.getLogger(__name__)

TRIAL_SIZE = (180, 320)
TRIAL_LABELS = 16
TRIAL_ROUNDS = 5


WITHOUT_DEVICE = 12
"""Duration of a replay by torch on the processor over that of the compiled backend, about."""


class FallbackBackend:
    """A backend on a device, with the CPU as fallback.

    The device serves one thread at a time. After the first RuntimeError (out of memory, device
    lost) the CPU repeats the operation and does all further ones; ``failure`` then gives the
    reason.
    """

    def __init__(self, backend: Backend) -> None:
        self._backend, self._one = backend, Lock()
        self.failure: str | None = None

    def __reduce__(self) -> tuple[Any, ...]:  # a lock cannot be copied
        return type(self), (self._backend,), {"failure": self.failure}

    def __getattr__(self, name: str) -> Any:
        """What the backend has under this name; an operation falls back."""
        found = getattr(self._backend, name)
        return partial(self._run, name) if callable(found) else found

    def fail(self, error: Exception) -> None:
        """Use the CPU from now on, because of this error."""
        self.failure = str(error).splitlines()[0] if str(error) else type(error).__name__
        log.error(
            "backend %s on %s failed (%s): the CPU takes over", self.name, self.device, self.failure
        )
        self._backend = load_backend("cpu")

    def _run(self, operation: str, *given: object, **named: object) -> Any:
        backend = self._backend
        try:
            with self._one if backend.name != "cpu" else nullcontext():
                return getattr(backend, operation)(*given, **named)
        except (RuntimeError, MemoryError) as error:
            if backend.name == "cpu":
                raise
            if self._backend is backend:
                self.fail(error)
            return getattr(self._backend, operation)(*given, **named)


def pointless(name: str, is_there: Callable[[str], object] = find_spec) -> str | None:
    """Why ``auto`` skips this backend, or None; imports nothing heavy."""
    if name == "torch" and is_there("torch") is None:
        return "torch is not installed"
    if name != "cpu" and not loads("libcuda.so.1"):
        return "there is no CUDA driver, and on a CPU the cpu backend is faster"
    return None


def trial(backend: Backend) -> float:
    """Minimum seconds from an image pair to upsampled disparity, after a warm-up round."""
    from recon.stereo.belief_propagation import BeliefPropagationConfig

    rng = np.random.default_rng(0)
    height, width = TRIAL_SIZE
    guide = rng.integers(0, 256, (2 * height, 2 * width, 3), np.uint8)
    left = np.ascontiguousarray(guide[:height, :width, 0])
    right = np.roll(left, -5, axis=1)
    matching = BeliefPropagationConfig()
    best = float("inf")
    for _ in range(TRIAL_ROUNDS + 1):
        start = time.perf_counter()
        coarse = backend.belief_propagation(left, right, TRIAL_LABELS, matching)
        backend.upsample(coarse, guide)
        best = min(best, time.perf_counter() - start)
    return best


@dataclass(frozen=True, slots=True)
class Choice:
    """How a backend is found out: its maker, why ``auto`` skips it, and its time in a trial."""

    load: Callable[[str], Backend] = load_backend
    pointless: Callable[[str], str | None] = pointless
    trial: Callable[[Backend], float] = trial


def choose_backend(name: str = "auto", by: Choice = Choice()) -> Backend:
    """The backend called ``name``, or for ``"auto"`` the fastest in a short measured trial.

    Raises InputError for an unknown name and OutsideError, with the reason, when a named
    backend cannot run here.
    """
    chosen = named_backend(name, by) if name != "auto" else fastest_backend(by)
    if chosen.name != "cpu" and chosen.device == "cpu":
        log.warning(
            "backend %s found no device but the processor: expect about %d times the duration of "
            "'--backend cpu'", chosen.name, WITHOUT_DEVICE,
        )  # fmt: skip
    return chosen if chosen.name == "cpu" else FallbackBackend(chosen)


def engine_folder() -> str | None:
    """Cache folder for compiled engines of GPU providers and Triton's kernels; None without one."""
    given = os.environ.get("CACHE_DIRECTORY", "").partition(":")[0]  # as systemd sets it
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(given or Path(home) / "skyrelief") / "engines"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        log.info("compiled engines are not cached: %s", error)
        return None
    os.environ.setdefault("TRITON_CACHE_DIR", str(folder / "triton"))
    return str(folder)


def fastest_backend(by: Choice) -> Backend:
    """The fastest working backend in a short measured trial."""
    engine_folder()
    working: list[Backend] = []
    for candidate in BACKENDS:
        reason = by.pointless(candidate)
        if reason:
            log.info("backend %s: not tried, %s", candidate, reason)
            continue
        try:
            working.append(by.load(candidate))
        except (ImportError, RuntimeError, ValueError) as error:
            log.info("backend %s: cannot run here, %s", candidate, error)
    if len(working) == 1:
        log.info("backend %s on %s, the only one", working[0].name, working[0].device)
        return working[0]
    timed: list[tuple[float, Backend]] = []
    for backend in working:
        try:
            timed.append((by.trial(backend), backend))
        except (RuntimeError, MemoryError) as error:
            log.info("backend %s: failed its trial, %s", backend.name, error)
    if not timed:
        raise OutsideError("no backend runs here; 'skyrelief doctor' says what is missing")
    seconds, chosen = min(timed, key=lambda entry: entry[0])
    figures = ", ".join(f"{b.name} {1e3 * s:.1f} ms" for s, b in timed)
    log.info(
        "backend %s on %s: %.1f ms a trial, the fastest of %s",
        chosen.name, chosen.device, 1e3 * seconds, figures,
    )  # fmt: skip
    return chosen


def named_backend(name: str, by: Choice) -> Backend:
    """The backend called ``name``, ready to run. Raises InputError when there is none of that name,
    OutsideError when it cannot run here."""
    if name == "onnx":
        raise InputError(
            "backend onnx runs a stereo model: give it with compute.model (stereo: --model); "
            "'skyrelief export-model' writes one"
        )
    if name not in BACKENDS:
        raise InputError(f"backend {name}: available: auto, {', '.join(BACKENDS)}, onnx")
    engine_folder()
    try:
        backend = by.load(name)
    except (ImportError, RuntimeError, ValueError) as error:
        raise OutsideError(f"backend {name} cannot run here: {error}") from error
    log.info("backend %s on %s, as configured", backend.name, backend.device)
    return backend


def open_backend(
    config: ComputeConfig, image_px: tuple[int, int] | None = None, by: Choice = Choice()
) -> Backend:
    """The backend of ``compute.backend``, ready to run; "auto" is the fastest that works.

    With ``compute.model`` it is that learned model on ONNX Runtime; ``image_px`` (W, H) of the
    camera checks its input size before the flight. A named backend that cannot run stops the start:
    InputError for an unknown name or a model that does not fit, OutsideError with the reason
    otherwise.
    """
    if not config.model:
        return choose_backend(config.backend, by)
    if config.backend not in ("auto", "onnx"):
        raise InputError(
            f"compute.model runs on ONNX Runtime: compute.backend must be onnx or auto, "
            f"not {config.backend}"
        )
    learned = load_learned_model(Path(config.model))
    width = config.stereo_width
    height = 0 if image_px is None else round(width * image_px[1] / image_px[0])
    if width > learned.config.width or height > learned.config.height:
        found = f"{width}x{height}" if height else f"{width} wide"
        raise InputError(
            f"{config.model}: takes pairs up to {learned.config.width}x{learned.config.height}, "
            f"but they would be {found}; set compute.stereo_width"
        )
    return FallbackBackend(learned)


def load_learned_model(declaration: Path) -> LearnedStereoBackend:
    """The model declared in a TOML file, checked and ready to run.

    TensorRT's engine, if available, is cached between starts.

    Raises InputError, with what was expected and what was found, when declaration and model
    do not fit, and OutsideError when ONNX Runtime is missing.
    """
    with needing("a learned model"):
        from recon.backends.onnx_backend import LearnedStereoBackend, LearnedStereoConfig
    try:
        given = msgspec.toml.decode(declaration.read_bytes(), type=dict[str, Any])
        model = declaration.parent / str(given.pop("model", ""))
        known = {f.name: f for f in fields(LearnedStereoConfig)}
        strange = sorted(set(given) - set(known))
        missing = sorted(n for n, f in known.items() if f.default is MISSING and n not in given)
        if strange:
            words = f"unknown {', '.join(strange)}; known are model, {', '.join(known)}"
            raise InputError(f"{declaration}: {words}")
        if missing:
            raise InputError(f"{declaration}: {', '.join(missing)} must be given")
        if not model.is_file():
            raise InputError(f"{declaration}: model = {model.name!r} is not a file next to it")
        config = LearnedStereoConfig(**given)
        return LearnedStereoBackend(model.read_bytes(), config, engine_folder())
    except OSError as error:
        raise InputError(f"{declaration}: cannot be read: {error.strerror}") from error
    except (msgspec.DecodeError, ValueError, TypeError) as error:
        raise InputError(f"{declaration}: {error}") from error
