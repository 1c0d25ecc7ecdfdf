"""Warnings about telemetry that contradicts itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon import se3
from recon.posegraph.pose_graph import PoseGraph
from recon.posegraph.records import Node
from recon.types import F64, PosePrior
from service.flight.reports import GraphWatch

NADIR = np.diag([1.0, -1.0, -1.0])
COVARIANCE = np.diag([2e-4**2] * 3 + [0.02**2] * 3)


def track(count: int = 30) -> list[F64]:
    """A bent flight at 60 m."""
    turns = [se3.so3_exp(np.array([0.0, 0.0, 0.05 * i])) for i in range(count)]
    places = [np.array([6.0 * i, 0.15 * i * i, 60.0]) for i in range(count)]
    return [se3.compose(R @ NADIR, p) for R, p in zip(turns, places, strict=True)]


def prior(T: F64, agl_m: float = 60.0) -> PosePrior:
    return PosePrior(T[:3, :3], 0.01, 0.05, T[:3, 3].copy(), np.full(3, 0.5), agl_m, 2.0)


def warnings_of(priors: list[PosePrior]) -> tuple[list[str], GraphWatch]:
    graph, heard = PoseGraph(), list[str]()
    watch = GraphWatch(graph)
    for i, (T, p) in enumerate(zip(track(len(priors)), priors, strict=True)):
        graph.add_keyframe(Node(i, i * 10**9, 0, T, COVARIANCE, p, 60.0))
        heard += watch.new_findings()
    return heard, watch


def test_agreeing_sensors_are_no_news() -> None:
    heard, watch = warnings_of([prior(T) for T in track()])
    assert heard == [] and watch.sentences() == []


@pytest.mark.parametrize(("agl_m", "word"), [(75.0, "smaller"), (48.0, "larger")])
def test_scales_that_disagree_are_reported_once(agl_m: float, word: str) -> None:
    heard, watch = warnings_of([prior(T, agl_m) for T in track()])
    assert len(heard) == 1
    assert heard[0].startswith("scale: GNSS makes the map 25 % " + word)
    assert watch.sentences() == heard


def test_an_assumed_view_that_is_wrong_is_no_attitude() -> None:
    """Each fifth of the images looks ahead, which nothing states."""
    priors = [prior(T) for T in track(40)]
    ahead = se3.so3_exp(np.array([0.8, 0.0, 0.0]))
    for i, one in enumerate(priors):
        R = one.R_world_camera
        assert R is not None
        R = R @ ahead if i % 5 == 0 else R
        priors[i] = replace(
            one, R_world_camera=R, sigma_tilt_rad=0.105, sigma_yaw_rad=3.0, is_view_assumed=True
        )
    _, watch = warnings_of(priors)
    assert [text[2:25] for text in watch.sentences()] == ["images do not look as a"]


def test_a_jump_of_the_receiver_is_reported() -> None:
    priors = [prior(T) for T in track(40)]
    for i in range(20, 28):
        place = priors[i].position_m
        assert place is not None
        priors[i] = replace(priors[i], position_m=place + np.array([30.0, 0.0, 0.0]))
    heard, watch = warnings_of(priors)
    assert any("does GNSS jump" in text for text in heard)
    assert any(text.startswith("8 positions") for text in watch.sentences())


def test_a_position_that_repeats_on_the_ground_is_no_news() -> None:
    priors = [prior(T) for T in track(40)]
    place = priors[19].position_m
    priors[20:] = [replace(p, position_m=place, is_at_rest=True) for p in priors[20:]]
    heard, watch = warnings_of(priors)
    assert not any("frozen" in text for text in [*heard, *watch.sentences()])


def test_a_frozen_receiver_is_reported() -> None:
    priors = [prior(T) for T in track(40)]
    priors[20:] = [replace(p, position_m=priors[19].position_m) for p in priors[20:]]
    heard, _ = warnings_of(priors)
    assert any("is GNSS frozen" in text for text in heard)


@pytest.mark.slow
def test_a_track_that_the_fixes_contradict_is_reported() -> None:
    """Vision that swings by metres, as a rolling shutter makes it, under a receiver of 5 cm."""
    graph, watch_said = PoseGraph(), list[str]()
    watch = GraphWatch(graph)
    for i, T in enumerate(track(60)):
        fix = replace(prior(T), sigma_position_m=np.full(3, 0.05))
        swing = np.array([0.0, 3.0 * np.sin(0.5 * i), 1.5 * np.cos(0.5 * i)])
        seen = se3.compose(T[:3, :3], T[:3, 3] + swing)
        graph.add_keyframe(Node(i, i * 10**9, 0, seen, COVARIANCE, fix, 60.0))
        watch_said += watch.new_findings()
    assert sum("track and GNSS differ" in text for text in watch_said) == 1
