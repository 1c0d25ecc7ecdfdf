"""Depth images of one ground against each other: sigmas that are right stay, others are widened."""

from __future__ import annotations

import numpy as np
import pytest

from recon import se3
from recon.mapping import disagreement
from recon.mapping.disagreement import Disagreement
from recon.types import F64, DepthMap

SIZE = (160, 120)
K = np.array([[150.0, 0.0, 79.5], [0.0, 150.0, 59.5], [0.0, 0.0, 1.0]])
DOWN = np.diag([1.0, -1.0, -1.0])


def _pose(x: float, y: float, yaw: float = 0.0) -> F64:
    turn = se3.so3_exp(np.array([0.0, 0.0, yaw]))
    return se3.compose(turn @ DOWN, np.array([x, y, 50.0]))


def _seen(T: F64, sigma_m: float, seed: int, tilt: float = 0.0, noise: float = 1.0) -> DepthMap:
    """Level ground at z = 0, with noise; ``tilt`` adds metres from the left edge to the right."""
    w, h = SIZE
    rng = np.random.default_rng(seed)
    z = 50.0 + noise * sigma_m * rng.normal(size=(h, w)) + tilt * (np.arange(w) / w - 0.5)
    sigma = np.full((h, w), sigma_m, np.float32)
    return DepthMap(z.astype(np.float32), sigma, np.full((h, w), 2, np.uint8), K, T)


PLACES = [_pose(0.0, 0.0), _pose(8.0, 2.0), _pose(12.0, 8.0, 1.7), _pose(6.0, 10.0, 3.1)]


def test_noise_as_the_sigmas_say_leaves_them() -> None:
    found = Disagreement()
    assert found.take(_seen(PLACES[0], 0.1, 0)) == 1.0
    factors = [found.take(_seen(T, 0.1, k)) for k, T in enumerate(PLACES[1:], 1)]
    assert max(factors) < 1.05 and min(factors) >= 1.0


def test_noise_of_twice_the_sigma_is_reported() -> None:
    found = Disagreement()
    factors = [found.take(_seen(T, 0.1, k, noise=2.0)) for k, T in enumerate(PLACES)]
    assert factors[0] == 1.0 and factors[1:] == pytest.approx([2.0] * 3, rel=0.05)


def test_images_tilted_their_own_way_disagree_once_the_camera_has_turned(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A lens off its axis: along a leg the tilts look alike, and meet at the turn."""
    leg = [_pose(0.0, 4.0 * k) for k in range(3)]
    found = Disagreement()
    assert max(found.take(_seen(T, 0.05, k, tilt=1.0)) for k, T in enumerate(leg)) < 1.1
    turned = found.take(_seen(_pose(0.0, 4.0, np.pi), 0.05, 9, tilt=1.0))
    assert turned == 5.0  # the largest
    monkeypatch.setattr(disagreement, "MAX_FACTOR", 100.0)
    loose = Disagreement()
    for k, T in enumerate(leg):
        loose.take(_seen(T, 0.05, k, tilt=1.0))
    # They differ by 2 m over the width: the median of |x| over an even spread of +-1 m is 0.5 m.
    expected = 0.5 / 0.6745 / np.hypot(0.05, 0.05)
    assert loose.take(_seen(_pose(0.0, 4.0, np.pi), 0.05, 9, tilt=1.0)) == pytest.approx(
        expected, rel=0.1
    )


def test_other_ground_single_pairs_and_what_was_forgotten_say_nothing() -> None:
    found = Disagreement()
    found.take(_seen(PLACES[0], 0.1, 0))
    assert found.take(_seen(_pose(500.0, 0.0), 0.1, 1, noise=9.0)) == 1.0
    alone = _seen(PLACES[0], 0.1, 2, noise=9.0)
    alone.views[:] = 1
    assert found.take(alone) == 1.0
    upward = se3.compose(np.eye(3), np.array([0.0, 0.0, 50.0]))
    assert found.take(_seen(upward, 0.1, 3, noise=9.0)) == 1.0
    found.forget()
    assert found.take(_seen(PLACES[0], 0.1, 4, noise=9.0)) == 1.0
    assert found.take(_seen(PLACES[0], 0.1, 5, noise=3.0)) > 3.0
