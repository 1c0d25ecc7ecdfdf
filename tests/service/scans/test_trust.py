"""How far a scan can be trusted, from what its run noted."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from recon.tracking.frame import CONTRADICTED, TWO_ONLY
from service.scans.trust import BY_SURVEY, depth_share, scale_sigma, slope_deg, trust_of

SURE: dict[str, Any] = {
    "assumed": [],
    "scale": {"sigma": 0.01},
    "frames": 100,
    "frames_tracked": 99,
}


@pytest.mark.parametrize(
    ("changes", "georeference", "level", "reason"),
    [
        ({}, "gnss", "georeferenced", ""),
        ({}, "none", "scaled", "no positions"),
        ({"assumed": ["height"]}, "none", "relative", "assumed height"),
        ({"assumed": ["start"]}, "gnss", "relative", "when the recording began"),
        ({"scale": {"sigma": 0.2}}, "gnss", "relative", "20 % (1 sigma)"),
        ({"scale": {"from": "first telemetry", "sigma": None}}, "exif", "relative", "too few"),
        ({"assumed": ["lens"]}, "gnss", "doubtful", "lens"),
        ({"assumed": ["view", "level"]}, "gnss", "doubtful", "taken as level"),
        ({"assumed": ["distortion"]}, "gnss", "georeferenced", "distortion"),
        ({"assumed": ["turn"]}, "gnss", "doubtful", "narrower than 3 degrees"),
        ({"assumed": ["altitude"]}, "exif", "georeferenced", "above sea level"),
        ({"assumed": ["altitude"]}, BY_SURVEY, "georeferenced", ""),
        ({"assumed": ["altitude", "pressure"]}, "exif", "georeferenced", "air pressure"),
        ({"assumed": ["altitude", "pressure"]}, BY_SURVEY, "georeferenced", ""),
        ({"assumed": ["altitude", "no altitude"]}, "gnss", "georeferenced", "not above sea level"),
        ({"assumed": ["altitude", "no altitude"]}, BY_SURVEY, "georeferenced", ""),
        ({"sigma_focal": 0.008}, "gnss", "georeferenced", ""),
        (
            {"sigma_focal": 0.04},
            "gnss",
            "georeferenced",
            "focal length is uncertain by 4 % (1 sigma)",
        ),
        ({"sigma_focal": 0.2}, "gnss", "doubtful", "focal length is uncertain by 20 % (1 sigma)"),
        ({"sigma_focal": 1.77}, "gnss", "doubtful", "uncertain by more than half (1 sigma)"),
        ({"scale": {"gnss_over_heights": 0.95}}, "gnss", "georeferenced", "5 % smaller"),
        ({"scale": {"gnss_over_heights": 0.8}}, "gnss", "doubtful", "25 % smaller"),
        ({"assumed": ["height", "view"]}, "none", "relative", "assumed height"),
        ({"frames_tracked": 40}, "gnss", "doubtful", "40 of 100"),
        ({"frames": 101, "frames_tracked": 50}, "gnss", "georeferenced", ""),
        ({"frames_tracked": 60, "drops": {TWO_ONLY: 20}}, "gnss", "doubtful", "40 of 100"),
        ({"frames_tracked": 60, "drops": {TWO_ONLY: 8}}, "gnss", "georeferenced", ""),
        ({"keyframes": 4, "drops": {CONTRADICTED: 25}}, "gnss", "doubtful", "25 of 29 views"),
        ({"keyframes": 25, "drops": {CONTRADICTED: 24}}, "gnss", "georeferenced", ""),
        ({"frames": 1, "frames_tracked": 0, "drops": {TWO_ONLY: 1}}, "gnss", "doubtful", " 0 of 1"),
    ],
)
def test_the_weakest_fact_sets_the_level(
    changes: dict[str, Any], georeference: str, level: str, reason: str
) -> None:
    found = trust_of(SURE | changes, georeference)
    assert found["level"] == level
    assert [bool(reason)] == [bool(found["reasons"])]
    assert all(reason in text for text in found["reasons"])


def test_points_that_are_uncertain_by_many_pixels_leave_the_shape_in_doubt() -> None:
    usual = {"sigma_median_m": 0.06, "ground_sample_m": 0.12}
    assert trust_of(SURE, "gnss", points=usual) == trust_of(SURE, "gnss")
    poor = trust_of(SURE, "gnss", points=usual | {"sigma_median_m": 2.43})
    assert poor["level"] == "doubtful" and "2.4 m or more, 20 pixels" in poor["reasons"][0]
    assert trust_of(SURE, "gnss", points=dict.fromkeys(usual))["level"] == "georeferenced"


def test_a_doubtful_scan_names_the_source_of_its_scale_too() -> None:
    found = trust_of(SURE | {"assumed": ["view", "level", "height"]}, "none")
    assert found["level"] == "doubtful" and len(found["reasons"]) == 2
    assert "taken as level" in found["reasons"][0] and "assumed height" in found["reasons"][1]


def test_a_site_that_leans_was_not_seen_from_above() -> None:
    leaning = trust_of(SURE | {"assumed": ["view"]}, "gnss", 60.0)
    assert leaning["level"] == "doubtful" and "60 degrees" in leaning["reasons"][0]
    assert trust_of(SURE, "gnss", 60.0)["level"] == "georeferenced"


def test_what_is_level_is_as_sure_as_the_track_shows_it() -> None:
    unsure = trust_of(SURE | {"assumed": ["view"], "lean_sigma_deg": 5.8}, "exif", 10.0)
    assert unsure["level"] == "georeferenced" and "lean by 6 degrees" in unsure["reasons"][0]
    shown = trust_of(SURE | {"assumed": ["view"], "lean_sigma_deg": 0.3}, "exif", 10.0)
    assert shown["reasons"] == []
    apart = trust_of(SURE | {"lean_sigma_deg": 4.4}, "gnss")
    assert "attitudes and positions contradict" in apart["reasons"][0]


@pytest.mark.parametrize(
    ("refused", "level", "reason"),
    [
        (1, "georeferenced", ""),
        (6, "georeferenced", "6 of 17 positions contradict the track: they are less certain"),
        (12, "doubtful", "12 of 23 positions contradict the track"),
    ],
)
def test_positions_that_contradict_the_track_limit_it(
    refused: int, level: str, reason: str
) -> None:
    graph = {"left_out": {"position off": refused}, "residuals": {"position": {"count": 11}}}
    found = trust_of(SURE | {"graph": graph}, "exif")
    assert found["level"] == level
    assert [reason] == [text[: len(reason)] for text in found["reasons"] or [""]]


def test_positions_that_scatter_further_than_claimed_are_named() -> None:
    for over, reasons in (
        (1.4, []),
        (3.75, ["positions scatter 3.8 times as far as they claim: sigma follows it"]),
    ):
        found = trust_of(SURE | {"graph": {"over_claim": over}}, "gnss")
        assert found == {"level": "georeferenced", "reasons": reasons}


@pytest.mark.parametrize(("found_ms", "sigma_ms"), [(45.0, 3.0), (-30.0, 2.0)])
def test_a_latency_that_is_not_applied_is_named(found_ms: float, sigma_ms: float) -> None:
    latency = {"applied_ms": 0.0, "estimate_ms": found_ms, "sigma_ms": sigma_ms}
    found = trust_of(SURE | {"camera_latency": latency}, "gnss")
    assert found["level"] == "georeferenced"
    assert f"a camera latency of {found_ms:.0f} ms, 0 ms are applied" in found["reasons"][0]
    for other in ({"applied_ms": found_ms - 8.0}, {"sigma_ms": 10.0}, {"estimate_ms": None}):
        assert not trust_of(SURE | {"camera_latency": latency | other}, "gnss")["reasons"]


def test_a_scale_of_vision_that_wanders_is_named_and_less_certain() -> None:
    """As where the camera stabilises its images: their centre moves against the lens."""
    still, moved = ({"residuals": {"loop scale": {"count": 9, "rms": r}}} for r in (0.8, 3.0))
    sure = SURE | {"scale": {"from": "gnss", "sigma": 0.003}}
    found = trust_of(sure | {"graph": moved}, "gnss")
    assert found["level"] == "georeferenced" and "changes 3.0 times" in found["reasons"][0]
    assert trust_of(sure | {"graph": still}, "gnss")["reasons"] == []
    assert scale_sigma(sure | {"graph": moved}, "gnss") == pytest.approx(0.009)
    assert scale_sigma(sure | {"graph": still}, "gnss") == pytest.approx(0.003)


@pytest.mark.parametrize(
    ("why", "views"), [("tilt off", "attitudes"), ("view off", "assumed view directions")]
)
@pytest.mark.parametrize(("refused", "used"), [(35, 0), (20, 15)])
def test_attitudes_that_contradict_the_images_put_it_in_doubt(
    refused: int, used: int, why: str, views: str
) -> None:
    """Such a scan of level ground stood on edge."""
    residuals = {"attitude": {"count": used}} if used else {}
    graph = {"left_out": {why: refused}, "residuals": residuals}
    found = trust_of(SURE | {"graph": graph}, "exif")
    assert found["level"] == "doubtful"
    assert found["reasons"] == [f"{refused} of 35 {views} contradict the images"]
    graph = {"left_out": {"tilt off": 17}, "residuals": {"attitude": {"count": 18}}}
    assert trust_of(SURE | {"graph": graph}, "exif")["level"] == "georeferenced"


@pytest.mark.parametrize(("refuted", "level"), [(1, "georeferenced"), (4, "doubtful")])
def test_vision_that_two_sensors_contradict_limits_it(refuted: int, level: str) -> None:
    graph = {"left_out": {"vision off": refuted}, "residuals": {"vision": {"count": 30}}}
    found = trust_of(SURE | {"graph": graph}, "exif")
    assert found["level"] == level
    words = f"{refuted} of {30 + refuted} steps of vision contradict attitude and positions"
    assert [text[: len(words)] for text in found["reasons"]] == [words]


@pytest.mark.parametrize("angle", [0.0, 20.0, 80.0])
def test_the_slope_of_a_site_is_found_in_spite_of_towers(angle: float) -> None:
    rng = np.random.default_rng(2)
    flat = np.c_[rng.uniform(-50, 50, (4000, 2)), rng.normal(0, 0.2, 4000)]
    flat[::40, 2] += 15.0
    a = np.radians(angle)
    turn = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    assert slope_deg(flat @ turn.T + 300.0) == pytest.approx(angle, abs=1.0)
    assert slope_deg(flat[:2]) == 0.0


@pytest.mark.parametrize(
    "run",
    [
        {},
        {"assumed": 3, "scale": [], "frames": "x", "graph": {"residuals": 1}},
        {"drops": {CONTRADICTED: 1}},
    ],
)
def test_a_run_that_notes_nothing_limits_nothing(run: dict[str, Any]) -> None:
    assert trust_of(run, "gnss")["level"] == "georeferenced"


@pytest.mark.parametrize(
    ("changes", "georeference", "share"),
    [
        ({}, "gnss", 0.03),
        ({"sigma_focal": 0.04}, "gnss", 0.05),
        ({"scale": {"sigma": 0.03, "gnss_over_heights": np.exp(-0.04)}}, "gnss", 0.05),
        ({"scale": {"sigma": 0.03, "gnss_over_heights": -2.0}}, "gnss", 0.03),
        ({"assumed": ["lens"]}, "gnss", np.hypot(0.03, 0.02)),
        ({"assumed": ["distortion", "altitude"]}, "exif", np.hypot(0.03, 0.01)),
        ({"sigma_focal": 0.04, "assumed": ["distortion"]}, BY_SURVEY, 0.01),
        ({"scale": {"from": "first telemetry", "sigma": None}}, "exif", None),
        ({}, "none", None),
        ({"assumed": 3}, "gnss", 0.03),
        ({"sigma_focal": 10**400}, "gnss", 0.03),  # of a peer
        ({"scale": {"sigma": 1e300}}, "gnss", None),
    ],
)
def test_all_depths_share_the_errors_of_scale_and_lens(
    changes: dict[str, Any], georeference: str, share: float | None
) -> None:
    assert depth_share({"scale": {"sigma": 0.03}} | changes, georeference) == pytest.approx(share)
