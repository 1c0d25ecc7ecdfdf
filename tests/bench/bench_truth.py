"""How far registration, matches and poses are off where the truth is known, next to peers."""

from __future__ import annotations

import numpy as np

from recon import se3
from recon.mapping.registration import IcpConfig, register_projective
from recon.tracking import pnp
from recon.tracking.matching import MatchingConfig, harris_grid
from service.bench import BenchOptions, BenchResult
from service.bench.mapping import SCENES, pair, peers, start
from service.bench.tracking import SHIFT_PX, SIZE, K, by_opencv, images, matched, scene, tracked


def run(options: BenchOptions) -> list[BenchResult]:
    """Centimetres, pixels and shares.

    The second figure of registration has noise that neighbouring pixels share, as stereo has it.
    """
    noises = (
        (0.0, "error in a village, noise of each pixel"),
        (2.0, "error in a village, noise of patches"),
    )
    aligned = [row for blur_px, words in noises for row in errors(words, blur_px, IcpConfig())]
    return [*aligned, *accuracy(), position_error()]


def errors(what: str, blur_px: float, config: IcpConfig) -> list[BenchResult]:
    """Mean error of the ground below the camera over several scenes, ours and each peer's."""
    off: dict[str, list[float]] = {}
    below = np.array([[0.0, 0.0, 60.0]])
    for seed in range(SCENES):
        source, target, T = pair(seed, blur_px)
        guess = start(seed, T)
        result = register_projective(source, target, guess, config)
        answers = {"": result.T_target_source}
        answers |= {name: other(source, target, guess) for name, other in peers().items()}
        for name, answer in answers.items():
            miss = se3.transform(answer, below) - se3.transform(T, below)
            off.setdefault(name, []).append(100 * float(np.linalg.norm(miss)))
    ours = float(np.mean(off.pop("")))
    return [
        BenchResult(what, ours, "cm", 0.0, name, float(np.mean(values)))
        for name, values in off.items()
    ]


def accuracy() -> list[BenchResult]:
    """Root mean square error of the good matches, and the share found."""
    (a, b), config = images(), MatchingConfig()
    corners = np.ascontiguousarray(harris_grid(a, config)[:, :2])
    ours = matched(a, b, corners, config)
    theirs = tracked(a, b, corners[:, None])
    truth = corners - SHIFT_PX
    visible = np.all((truth > 12) & (truth < np.array(SIZE[::-1]) - 12), axis=1)
    rms, shares = [], []
    for here, there in (ours, theirs):
        error = np.linalg.norm(there - (here - SHIFT_PX), axis=1)
        good = error < 1.0
        rms.append(float(np.sqrt(np.mean(error[good] ** 2) / 2)))
        shares.append(100 * float(good.sum() / visible.sum()))
    peer = "OpenCV PyrLK both ways"
    return [
        BenchResult("error of a coordinate", rms[0], "px", 0.0, peer, rms[1]),
        BenchResult(
            "found within 1 px, of the visible", shares[0], "%", 0.0, peer, shares[1],
            note="more is better",
        ),
    ]  # fmt: skip


def position_error() -> BenchResult:
    """Mean error of the camera's place over twenty scenes."""
    ours, theirs = [], []
    for seed in range(20):
        points, uv, T = scene(seed)
        result = pnp.solve(points, uv, K)
        truth = se3.inverse(T)[:3, 3]
        if result is not None:
            ours.append(se3.inverse(result.T_camera_points)[:3, 3] - truth)
        theirs.append(se3.inverse(by_opencv(points, uv))[:3, 3] - truth)
    mean = [100 * float(np.linalg.norm(e, axis=1).mean()) for e in (ours, theirs)]
    return BenchResult(
        "place of the camera, mean of 20", mean[0], "cm", 0.0, "OpenCV RANSAC EPnP + LM",
        mean[1], note=f"{len(ours)} of 20 solved",
    )  # fmt: skip
