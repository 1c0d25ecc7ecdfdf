"""Scans without georeference join a site by points that a person names."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from site_scans import FRAME, HEIGHT_M, Errors, leg, write_scan
from typer.testing import CliRunner

from recon import se3
from recon.types import F64
from service.cli import app
from service.errors import InputError
from service.offline.site.alignment import align_site
from service.offline.site.start import Pair, read_start
from service.stream.store import ScanStore

NORTH, EAST = leg(0.0), leg(np.pi / 2)
ELSEWHERE = Errors((310.0, -120.0, 35.0), (0.2, -0.1, 2.0), 0.4)
"""Where vision alone has a scan: any place, direction and scale."""

SPOTS = np.array([[-14.0, -9.0, 0.5], [15.0, -6.0, -0.5], [2.0, 12.0, 1.0]])
MISS = np.array([[0.8, -0.5, 0.3], [-0.6, 0.9, -0.4], [0.5, 0.7, 0.6]])
"""How far the clicks are off, m."""


def points(here: F64, there: F64) -> list[dict[str, Any]]:
    lat_lon = FRAME.to_geodetic(there)
    return [
        {"scan": [float(v) for v in a], "place": [float(lon), float(lat), float(alt)]}
        for a, (lat, lon, alt) in zip(here, lat_lon, strict=True)
    ]


def clicks() -> list[dict[str, Any]]:
    return points(ELSEWHERE.as_similarity().points(SPOTS), SPOTS + MISS)


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("start")
    placed = write_scan(folder / "placed", NORTH)
    return placed, write_scan(folder / "nowhere", EAST, ELSEWHERE, frame=None)


def errors_m(site: Path, first: int, truth: list[F64]) -> F64:
    """(N, 3) how far the ground below the cameras lies off the truth, from a keyframe on."""
    out = []
    with ScanStore.open(site / "scan.db") as store:
        for seq, T in enumerate(truth, first):
            one = store.keyframe(seq)
            assert one is not None
            ahead = np.array([[0.0, 0.0, float(np.nanmedian(one.depth.depth_m))]])
            out.append(se3.transform(one.depth.T_world_camera, ahead)[0])
            out[-1] -= T[:3, 3] + T[:3, 2] * HEIGHT_M
    return np.array(out)


@pytest.mark.slow
def test_three_points_and_the_surface_place_a_scan(
    scans: tuple[Path, Path], tmp_path: Path
) -> None:
    placed, nowhere = scans
    (tmp_path / "points.json").write_text(json.dumps(clicks()))
    site = tmp_path / "site"
    words = ["site", "align", str(nowhere), str(placed), "--out", str(site)]
    done = CliRunner().invoke(app, [*words, "--start", f"{nowhere}:{tmp_path / 'points.json'}"])
    assert done.exit_code == 0, done.output
    document = json.loads((site / "site.json").read_text())
    assert [s["placed"] for s in document["scans"]] == ["aligned", "aligned"]
    assert document["scans"][0]["name"] == "placed"  # the frame is that of a placed one
    assert document["scans"][1]["scale"] == pytest.approx(2.5, rel=0.005)
    seam = errors_m(site, len(NORTH), EAST)[:, :2] - errors_m(site, 0, NORTH)[:, :2].mean(axis=0)
    assert np.linalg.norm(seam.mean(axis=0)) < 0.15  # the clicks are off by a metre
    assert np.linalg.norm(errors_m(site, 0, NORTH)[:, :2].mean(axis=0)) < 0.3


@pytest.mark.slow
def test_points_are_remembered_when_the_site_is_aligned_again(
    scans: tuple[Path, Path], tmp_path: Path
) -> None:
    placed, nowhere = scans
    starts = {nowhere: msgspec.convert(clicks(), list[Pair])}
    align_site([placed, nowhere], tmp_path / "site", deliver=False, starts=starts)
    again = align_site([placed], tmp_path / "site", deliver=False).document
    assert [s["name"] for s in again["scans"]] == ["placed", "nowhere"]
    assert json.loads(json.dumps(again["scans"][1]["start"])) == clicks()
    assert again["revision"] == 2


def test_a_scan_that_nothing_ties_stays_where_the_points_put_it(
    scans: tuple[Path, Path], tmp_path: Path
) -> None:
    placed, _ = scans
    winter = write_scan(tmp_path / "winter", EAST[:3], ELSEWHERE, ground=2, frame=None)
    exact = points(ELSEWHERE.as_similarity().points(SPOTS), SPOTS)
    site = tmp_path / "site"
    document = align_site(
        [placed, winter], site, deliver=False, starts={winter: msgspec.convert(exact, list[Pair])}
    ).document
    assert document["scans"][1]["placed"] == "by its points"
    assert any("winter" in note and "its points put it" in note for note in document["notes"])
    assert np.abs(errors_m(site, len(NORTH), EAST[:3])[:, :2]).max() < 1.2  # the relief's


TRIANGLE = ELSEWHERE.as_similarity().points(SPOTS)
LINE = np.array([[0.0, 0.0, 0.0], [10.0, 0.2, 0.0], [20.0, 0.0, 0.1]])


@pytest.mark.parametrize(
    ("pairs", "reason"),
    [
        (points(TRIANGLE[:2], SPOTS[:2]), "3 to 100 points, not 2"),
        ([], "3 to 100 points, not 0"),
        (points(LINE, SPOTS), "in the scan lie in a line"),
        (points(TRIANGLE, LINE), "on the ground lie in a line"),
        (points(np.zeros((3, 3)), SPOTS), "in the scan lie in a line"),
        (points(TRIANGLE, SPOTS * [2.5, 1.0, 1.0]), "contradict each other"),
    ],
)
def test_points_that_place_nothing_are_refused(
    scans: tuple[Path, Path], tmp_path: Path, pairs: list[dict[str, Any]], reason: str
) -> None:
    placed, nowhere = scans
    starts = {nowhere: msgspec.convert(pairs, list[Pair])}
    with pytest.raises(InputError, match=reason):
        align_site([placed, nowhere], tmp_path / "site", deliver=False, starts=starts)
    assert not (tmp_path / "site").exists()


@pytest.mark.parametrize(
    "text",
    ["", "{", "{}", "[1]", '[{"scan": [0, 0], "place": [8, 47, 0]}]',
     '[{"scan": [0, 0, NaN], "place": [8, 47, 0]}]', '[{"scan": [0, 0, 0], "place": [8, 97, 0]}]',
     '[{"scan": [0, 0, 0], "place": [8, 47, 0], "x": 1}]', "[" * 100_000],
)  # fmt: skip
def test_files_that_are_no_list_of_points_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "points.json").write_text(text)
    with pytest.raises(InputError, match="points"):
        read_start(tmp_path / "points.json")


def test_a_start_for_the_wrong_scan_is_refused(scans: tuple[Path, Path], tmp_path: Path) -> None:
    placed, nowhere = scans
    start = msgspec.convert(clicks(), list[Pair])
    for folders, of, reason in (
        ([placed, nowhere], placed, "has a georeference"),
        ([placed], nowhere, "none of the scans"),
        ([nowhere], nowhere, "no usable scan with a georeference"),
    ):
        with pytest.raises(InputError, match=reason):
            align_site(folders, tmp_path / "site", deliver=False, starts={of: start})
    done = CliRunner().invoke(
        app, ["site", "align", str(placed), "--out", str(tmp_path / "s"), "--start", "points.json"]
    )
    assert done.exit_code != 0 and isinstance(done.exception, InputError | SystemExit)
