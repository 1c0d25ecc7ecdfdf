"""Which fused kernels a device computes with: those that agree with plain torch and are faster."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from subprocess import SubprocessError

from recon.backends.torch_kernels import PLAIN, Kernels, Trial, joined, load_kernels, trials

log = logging.getLogger(__name__)

SIZE_PX, GUIDE_PX, LABELS = (320, 180), (1280, 720), 16
ROUNDS = 5


def choose_kernels(
    device: str,
    load: Callable[[], Kernels] = load_kernels,
    size_px: tuple[int, int] = SIZE_PX,
    guide_px: tuple[int, int] = GUIDE_PX,
) -> Kernels:
    """The kernels for ``device``; what is left out, and why, is logged.

    Each is compared with the plain operation on made-up pictures, and both are timed as they
    run in flight, on CUDA as captured graphs.
    """
    try:
        candidates = trials(load(), device, size_px, guide_px, LABELS)
    except _failures() as error:
        log.info("fused kernels: none, %s; plain torch goes on", _first_line(error))
        return PLAIN
    return joined([trial.alone for trial in candidates if _pays(trial, device)])


def _pays(trial: Trial, device: str) -> bool:
    """True for a kernel that gives the plain results in less time."""
    try:
        wrong = trial.difference()
        if wrong:
            log.warning("fused kernel for %s: not used, %s", trial.name, wrong)
            return False
        plain, fused = (_least_ms(work, device) for work in (trial.plain, trial.fused))
    except _failures() as error:
        log.info("fused kernel for %s: cannot run, %s", trial.name, _first_line(error))
        return False
    verdict = "used" if fused < plain else "not used"
    log.info(
        "fused kernel for %s: %s, %.2f ms beside %.2f ms of plain torch",
        trial.name, verdict, fused, plain,
    )  # fmt: skip
    return fused < plain


def _least_ms(work: Callable[[], object], device: str) -> float:
    """Least milliseconds of some rounds after one that captures or compiles."""
    import torch

    from recon.backends.torch_plan import Plan

    def results() -> tuple[torch.Tensor, ...]:
        found = work()
        assert isinstance(found, tuple)
        return found

    least = float("inf")
    with torch.inference_mode():
        plan = Plan(device, results, [])
        for number in range(ROUNDS + 1):
            start = time.perf_counter()
            plan.run()
            if device.startswith("cuda"):
                torch.cuda.synchronize()
            if number > 0:
                least = min(least, 1e3 * (time.perf_counter() - start))
    return least


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _failures() -> tuple[type[Exception], ...]:
    """What loading, compiling or launching a kernel may raise where Triton does not fit."""
    kinds: tuple[type[Exception], ...] = (ImportError, OSError, RuntimeError, SubprocessError)
    try:
        from triton.errors import TritonError
    except ImportError:
        return kinds
    return (*kinds, TritonError)
