"""Depth images of one ground against each other: sigmas that are right stay, others change."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import toeplitz

from recon import se3
from recon.mapping.disagreement import MIN_FACTOR, NEIGHBOURS_CORRELATION, Disagreement
from recon.types import F64, Bool, DepthMap

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


class _Images:
    """Images in a map that has each where it is."""

    def __init__(self) -> None:
        self.placed = dict[int, F64]()
        self.found = Disagreement(lambda seqs: np.array([self.placed[seq] for seq in seqs]))

    def take(self, depth: DepthMap) -> float:
        seq = len(self.placed)
        self.placed[seq] = depth.T_world_camera
        return self.found.take(seq, depth)


def _independent(found: _Images, depth: DepthMap) -> float:
    """The factor of an image that shares no frame with those before it: two lie in between."""
    blank = _seen(depth.T_world_camera, 0.1, 0)
    blank.depth_m[:] = np.nan
    for _ in NEIGHBOURS_CORRELATION:
        assert found.take(blank) == 1.0
    return found.take(depth)


def test_noise_as_the_sigmas_say_leaves_them() -> None:
    found = _Images()
    factors = [_independent(found, _seen(T, 0.1, k)) for k, T in enumerate(PLACES)]
    assert factors[0] == 1.0 and factors == pytest.approx([1.0] * 4, abs=0.05)


def test_images_clearer_than_stereo_states_have_smaller_sigmas_down_to_a_limit() -> None:
    found = _Images()
    factors = [_independent(found, _seen(T, 0.1, k, noise=0.85)) for k, T in enumerate(PLACES)]
    assert factors[1:] == pytest.approx([0.85] * 3, rel=0.06)
    same = _Images()
    same.take(_seen(PLACES[0], 0.1, 0, noise=0.0))
    assert _independent(same, _seen(PLACES[0], 0.1, 1, noise=0.0)) == MIN_FACTOR


def test_noise_of_twice_the_sigma_is_reported() -> None:
    found = _Images()
    factors = [_independent(found, _seen(T, 0.1, k, noise=2.0)) for k, T in enumerate(PLACES)]
    assert factors[0] == 1.0 and factors[1:] == pytest.approx([2.0] * 3, rel=0.05)


@pytest.mark.parametrize("noise", [1.0, 1.5])
def test_neighbours_disagree_by_less_than_they_err(noise: float) -> None:
    """Noise with the correlation of images that share frames, at one place."""
    correlation = toeplitz([1.0, *NEIGHBOURS_CORRELATION, 0.0, 0.0, 0.0])
    w, h = SIZE
    white = np.random.default_rng(1).normal(size=(6, h * w))
    errors = noise * 0.1 * (np.linalg.cholesky(correlation) @ white).reshape(6, h, w)
    found = _Images()
    for k, error in enumerate(errors):
        image = _seen(PLACES[0], 0.1, 0, noise=0.0)
        image.depth_m[:] += error.astype(np.float32)
        factor = found.take(image)
        assert factor == pytest.approx(noise if k else 1.0, rel=0.06)


def test_images_tilted_their_own_way_disagree_once_the_camera_has_turned() -> None:
    """A lens off its axis: along a leg the tilts look alike, and meet at the turn."""
    leg = [_pose(0.0, 4.0 * k) for k in range(3)]
    found = _Images()
    assert max(_independent(found, _seen(T, 0.05, k, tilt=1.0)) for k, T in enumerate(leg)) < 1.1
    turned = _independent(found, _seen(_pose(0.0, 4.0, np.pi), 0.05, 9, tilt=1.0))
    # They differ by 2 m over the width: the median of |x| over an even spread of +-1 m is 0.5 m.
    expected = 0.5 / 0.6745 / np.hypot(0.05, 0.05)
    assert turned == pytest.approx(expected, rel=0.1)


def test_what_a_loop_has_corrected_is_no_error_of_the_map() -> None:
    """Back over the start the odometry is off by 2 % in scale, and by as much in height."""
    images = _Images()
    for k in range(3):
        _independent(images, _seen(_pose(0.0, 4.0 * k), 0.05, k))
    back, again = (_seen(_pose(4.0, 0.0), 0.05, k) for k in (8, 9))
    back.depth_m[:] *= np.float32(1.02)
    assert _independent(images, back) > 10.0
    images.placed[len(images.placed) - 1][:3, :3] /= 1.02
    assert _independent(images, again) == pytest.approx(1.0, abs=0.1)


def test_points_of_single_pairs_count_where_there_are_too_few_others() -> None:
    found = _Images()
    found.take(_seen(PLACES[0], 0.1, 0))
    mixed = _seen(PLACES[0], 0.1, 1)
    noisy = _seen(PLACES[0], 0.1, 2, noise=9.0)
    mixed.depth_m[:, 40:], mixed.views[:, 40:] = noisy.depth_m[:, 40:], 1
    assert _independent(found, mixed) < 1.1
    alone = _seen(PLACES[0], 0.1, 3, noise=9.0)
    alone.views[:] = 1
    assert _independent(found, alone) > 4.0


def test_other_ground_and_what_was_forgotten_say_nothing() -> None:
    found = _Images()
    found.take(_seen(PLACES[0], 0.1, 0))
    assert found.take(_seen(_pose(500.0, 0.0), 0.1, 1, noise=9.0)) == 1.0
    upward = se3.compose(np.eye(3), np.array([0.0, 0.0, 50.0]))
    assert found.take(_seen(upward, 0.1, 3, noise=9.0)) == 1.0
    found.found.forget()
    assert found.take(_seen(PLACES[0], 0.1, 4, noise=9.0)) == 1.0
    assert found.take(_seen(PLACES[0], 0.1, 5, noise=3.0)) > 3.0


TOWER = np.s_[20:30, 30:42]


def _with_tower(T: F64, seed: int, pairs: int) -> DepthMap:
    """Level ground, and on it an object 8 m high that so many pairs saw."""
    image = _seen(T, 0.1, seed)
    image.depth_m[TOWER], image.views[TOWER] = 42.0, pairs
    return image


def _refuted(*images: DepthMap) -> Bool:
    """What is refuted of the last image by those before it."""
    placed = np.array([one.T_world_camera for one in images])
    found = Disagreement(lambda seqs: placed[list(seqs)])
    return [found.refuted(seq, one) for seq, one in enumerate(images)][-1]


def test_what_one_pair_alone_saw_goes_where_earlier_images_see_through_it() -> None:
    before = [_seen(T, 0.1, k) for k, T in enumerate(PLACES[:2])]
    false = _refuted(*before, _with_tower(PLACES[2], 3, pairs=1))
    assert false[TOWER].all()
    false[TOWER] = False
    assert not false.any()


def test_what_earlier_images_see_or_two_pairs_say_stays() -> None:
    here, ground = PLACES[0], [_seen(T, 0.1, k) for k, T in enumerate(PLACES[1:])]
    assert not _refuted(_with_tower(here, 4, pairs=2), _with_tower(here, 3, pairs=1)).any()
    assert not _refuted(*ground, _with_tower(here, 3, pairs=2)).any()
    assert not _refuted(_with_tower(here, 3, pairs=1)).any()


def test_nothing_is_refuted_where_it_would_be_much_of_an_image_and_so_shows_a_false_pose() -> None:
    low = _seen(PLACES[2], 0.1, 3)
    low.depth_m[:, 80:], low.views[:, 80:] = low.depth_m[:, 80:] - 8.0, 1
    assert not _refuted(*(_seen(T, 0.1, k) for k, T in enumerate(PLACES[:2])), low).any()
