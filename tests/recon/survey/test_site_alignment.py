"""Alignment of scans by ties and priors, against closed forms and drawn errors."""

from __future__ import annotations

import numpy as np
import pytest

from recon import se3
from recon.similarity import Similarity
from recon.survey.site_alignment import (
    SiteAlignment,
    Tie,
    align,
    alike,
)
from recon.types import F64

SIGMA = np.array([0.005] * 3 + [1.0, 1.0, 1.5, 0.005])
CENTRE = np.array([0.0, 0.0, 60.0])


def priors(count: int) -> tuple[F64, F64]:
    return np.tile(CENTRE, (count, 1)), np.tile(SIGMA, (count, 1))


def drawn(rng: np.random.Generator) -> Similarity:
    """How wrongly a scan is placed, by the sigmas of its prior."""
    x = rng.normal(size=7) * SIGMA
    R, growth = se3.so3_exp(x[:3]), float(np.exp(x[6]))
    return Similarity(growth, R, CENTRE + x[3:6] - growth * R @ CENTRE)


def ties_between(
    a: int, b: int, wrong: list[Similarity], rng: np.random.Generator, count: int = 8
) -> list[Tie]:
    """Ties of places on the ground with noise of 3 cm."""
    out = []
    for _ in range(count):
        places = rng.uniform(-40, 40, (4, 3)) * [1, 1, 0.05]
        noise = rng.normal(size=(4, 3)) * 0.03
        spread = np.tile(np.eye(3) * 0.03**2, (4, 1, 1))
        out.append(Tie(a, b, wrong[a].points(places) + noise, wrong[b].points(places), spread))
    return out


def placed(move: Similarity, wrong: Similarity, places: F64) -> F64:
    return move.points(wrong.points(places)) - places


@pytest.mark.slow
def test_two_scans_meet_and_share_their_error() -> None:
    rng = np.random.default_rng(1)
    places = rng.uniform(-40, 40, (50, 3)) * [1, 1, 0.05]
    alone, together = [], []
    for _ in range(60):
        wrong = [drawn(rng), drawn(rng)]
        found = align(ties_between(0, 1, wrong, rng), *priors(2))
        off = [placed(m, w, places) for m, w in zip(found.moves, wrong, strict=True)]
        assert np.abs(off[0] - off[1]).max() < 0.1
        alone.append(np.linalg.norm(wrong[0].points(places).mean(0) - places.mean(0)))
        together.append(np.linalg.norm(off[0].mean(axis=0)))
    ratio = np.sqrt(np.mean(np.square(together)) / np.mean(np.square(alone)))
    assert 0.55 < ratio < 0.85  # one over the root of two is 0.71


@pytest.mark.slow
def test_ties_that_disagree_do_not_shrink_the_site() -> None:
    rng = np.random.default_rng(1)
    wrong, ties = [drawn(rng) for _ in range(4)], []
    for a in range(4):
        for b in range(a + 1, 4):
            for one in ties_between(a, b, wrong, rng, 70):
                wander = rng.normal(size=3) * 0.2
                ties.append(Tie(a, b, one.at_a + wander, one.at_b, one.covariance))
    found = align(ties, *priors(4))
    scales = [move.scale * w.scale for move, w in zip(found.moves, wrong, strict=True)]
    assert np.mean(scales) == pytest.approx(1.0, abs=0.015)


def test_ties_that_disagree_do_not_tilt_the_site() -> None:
    rng = np.random.default_rng(1)
    unsure = np.tile([0.06] * 3 + [3.0, 3.0, 40.0, 0.01], (2, 1))  # no attitude
    spread, ties = np.tile(np.diag([0.5, 0.25, 0.1]) ** 2, (4, 1, 1)), []
    for _ in range(70):
        places = rng.uniform(-40, 40, (4, 3)) * [1, 1, 0.05]
        wander = rng.normal(size=3) * [0.0, 0.0, 0.4]
        ties.append(Tie(0, 1, places + wander, places, spread))
    found = align(ties, priors(2)[0], unsure)
    turned = np.degrees([se3.so3_log(move.R) for move in found.moves])
    assert np.abs(turned).max() < 0.5


def test_like_receivers_share_their_sigma_and_a_better_one_keeps_its_own() -> None:
    own = [[0.2, 1.0, 0.4], [1.0, 1.0, 0.4], [1.0, 0.02, 2.0]]
    shared = alike(np.array([np.concatenate([SIGMA[:3], place, SIGMA[6:]]) for place in own]))
    rms = np.sqrt((0.04 + 1.0 + 1.0) / 3), np.sqrt((0.16 + 0.16 + 4.0) / 3)
    assert np.allclose([s[3] for s in shared], [rms[0], 1.0, 1.0])
    assert np.allclose([s[4] for s in shared], [1.0, 1.0, 0.02])  # RTK
    assert np.allclose([s[5] for s in shared], [rms[1], rms[1], 2.0])
    assert all(np.array_equal(s[[0, 1, 2, 6]], SIGMA[[0, 1, 2, 6]]) for s in shared)


def between_sigma_m(found: SiteAlignment, centres_m: F64) -> F64:
    """(3,) sigma of the motion between the first two scans at the origin."""
    J = np.zeros((3, len(found.covariance)))
    for scan, sign in ((0, 1.0), (1, -1.0)):
        lever = -found.moves[scan].points(centres_m[scan][None])
        sides = [-se3.hat(lever)[0], np.eye(3), lever.T]
        J[:, 7 * scan : 7 * scan + 7] = sign * np.hstack(sides)
    return np.asarray(np.sqrt(np.diag(J @ found.covariance @ J.T)))


@pytest.mark.slow
def test_the_motion_between_scans_is_as_sure_as_it_says() -> None:
    rng = np.random.default_rng(2)
    ratios = []
    for _ in range(40):
        wrong = [drawn(rng), drawn(rng)]
        own = priors(2)
        found = align(ties_between(0, 1, wrong, rng), *own)
        place = np.zeros((1, 3))
        off = [placed(m, w, place)[0] for m, w in zip(found.moves, wrong, strict=True)]
        ratios.append((off[0] - off[1]) / between_sigma_m(found, own[0]))
    rms = float(np.sqrt(np.mean(np.square(ratios))))
    assert 0.6 < rms < 1.4


def test_a_scan_without_ties_stays() -> None:
    rng = np.random.default_rng(3)
    wrong = [drawn(rng) for _ in range(3)]
    found = align(ties_between(0, 1, wrong, rng), *priors(3))
    np.testing.assert_allclose(found.moves[2].R, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(found.moves[2].t, 0.0, atol=1e-9)
    assert found.groups == [0, 0, 2]


def test_a_chain_of_scans_is_one_group() -> None:
    rng = np.random.default_rng(4)
    wrong = [drawn(rng) for _ in range(4)]
    ties = [t for a in (2, 1, 0) for t in ties_between(a, a + 1, wrong, rng)]
    found = align(ties, *priors(4))
    assert found.groups == [0, 0, 0, 0]
    places = rng.uniform(-40, 40, (20, 3)) * [1, 1, 0.05]
    off = [placed(m, w, places) for m, w in zip(found.moves, wrong, strict=True)]
    assert max(np.abs(one - off[0]).max() for one in off) < 0.15


def test_a_wrong_tie_is_left_out() -> None:
    rng = np.random.default_rng(5)
    wrong = [drawn(rng), drawn(rng)]
    ties = ties_between(0, 1, wrong, rng)
    bad = ties[0]
    ties[0] = Tie(0, 1, bad.at_a + np.array([6.0, 0.0, 0.0]), bad.at_b, bad.covariance)
    found = align(ties, *priors(2))
    assert not found.used[0] and found.used[1:].all()
    off = [placed(m, w, np.zeros((1, 3)))[0] for m, w in zip(found.moves, wrong, strict=True)]
    assert np.abs(off[0] - off[1]).max() < 0.1
