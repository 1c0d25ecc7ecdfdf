"""Wrong pixels of stereo on pairs with true disparity, against OpenCV's semi-global matcher.

The matcher is at its best: images padded on the left by the number of disparities, dense (no
uniqueness or left-right check), block size 3, and the better of its two-pass modes.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from stereo_scenes import EXPOSURES, SCENES, TruePair, exposed, rendered

from recon.backends import Backend
from recon.types import F32, F64
from service.bench import BenchOptions, BenchResult
from service.bench.stereo import ITERATIONS, semi_global
from service.commands.stereo import matching_config
from service.compute.backend_choice import choose_backend


def run(options: BenchOptions) -> list[BenchResult]:
    """Wrong pixels of each rendered scene."""
    return accuracy([rendered(name) for name in SCENES], choose_backend(options.backend))


def accuracy(pairs: Sequence[TruePair], backend: Backend) -> list[BenchResult]:
    """Wrong pixels of each pair, also where the right image's exposure differs, and the means."""
    same = [(pair.name, _wrong([pair], backend)) for pair in pairs]
    other = [
        (f"{pair.name}, exposures differ", _wrong([exposed(pair, e) for e in EXPOSURES], backend))
        for pair in pairs
    ]
    for name, of in (("mean", same), ("mean, exposures differ", other)):
        of.append((name, np.mean([shares for _, shares in of], axis=0)))
    return [
        BenchResult(
            f"{name}, bad-1.0", float(ours), "%", peer="OpenCV SGBM, padded",
            peer_value=float(theirs), note="visible pixels unknown or off by over 1 px",
        )
        for name, (ours, theirs) in same + other
    ]  # fmt: skip


def _wrong(pairs: Sequence[TruePair], backend: Backend) -> F64:
    """Per cent of wrong pixels, ours and the matcher's: the mean of some pairs."""
    shares = []
    for pair in pairs:
        config = matching_config(pair.labels, ITERATIONS, 0, checked=False)
        ours = backend.belief_propagation(pair.left, pair.right, pair.labels, config).px
        theirs = min(bad_share(semi_global_disparity(pair, m), pair, 1.0) for m in (0, 2))
        shares.append((bad_share(ours, pair, 1.0), theirs))
    return np.asarray(100 * np.mean(shares, axis=0), np.float64)


def semi_global_disparity(pair: TruePair, mode: int) -> F32:
    """Disparity of the matcher on the padded pair, NaN where it found none."""
    pad = -(-pair.labels // 16) * 16
    left, right = (
        cv2.copyMakeBorder(image, 0, 0, pad, 0, cv2.BORDER_REPLICATE)
        for image in (pair.left, pair.right)
    )
    found = semi_global(pair.labels, mode).compute(left, right)[:, pad:].astype(np.float32) / 16
    found[found < 0] = np.nan
    return np.asarray(found, np.float32)


def bad_share(px: F32, pair: TruePair, limit: float) -> float:
    """Share of the visible pixels that are unknown or wrong by more than ``limit`` px."""
    good = np.abs(px - pair.truth_px) <= limit
    return float(1 - good[pair.visible].mean())
