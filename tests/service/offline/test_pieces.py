"""Segments of a flight that nothing ties together, and the report of a short scan."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import laspy
import numpy as np
import pytest
import rasterio
from painted_ground import CAMERA, FOOTPRINT_M, HEIGHT_M, pose, still
from typer.testing import CliRunner

from recon.calibration.global_bundle import Sightings
from recon.calibration.tracks import MIN_COMMON
from recon.posegraph.alignment_readings import Alignment
from recon.posegraph.records import Loop
from recon.posegraph.segments import Segment, Segments
from recon.types import F64, PosePrior
from service.cameras.camera_file import save_camera
from service.cli import app
from service.errors import InputError
from service.offline.exports.view import ExportOptions, ScanView, export
from service.offline.refine.by_images import stretches_untied
from service.progress import Progress
from service.scans.coverage import LiveCoverage, coverage_of
from service.scans.folder import write_deliverables
from service.scans.fused_cloud import extents_of
from service.scans.main_piece import main_poses, main_seqs
from service.stream.store import ScanStore

if TYPE_CHECKING:
    from house_flight import HouseFlight

NOWHERE = PosePrior()
PLACED = PosePrior(np.eye(3), 0.02, 0.1, np.zeros(3), np.ones(3))


@dataclass
class Ties:
    """How four segments of three keyframes are tied: 0 to 2, 10 to 12, 20 to 22, 30 to 32."""

    taken: list[Loop] = field(default_factory=list)
    fixed: tuple[int, ...] = ()
    tied: tuple[int, ...] = ()
    sigma_m: float = 1.0  # of the height, whatever it is against
    against_m: float | None = None  # of one segment's against another's
    sigma_scale: dict[int, float] = field(default_factory=dict)  # where it is not 0.01
    main: int = 0  # the largest
    false: tuple[int, ...] = ()  # as many of its views contradict themselves as not

    def segment(self, segments: Segments, number: int) -> Segment:
        """A segment with its similarity."""
        out = segments[number]
        scale = self.sigma_scale.get(number, 0.01)
        covariance = np.diag([1.0] * 5 + [self.sigma_m**2, scale**2])
        sources = ("gnss",) if number in self.fixed else ("altitude",)
        out.similarity = Alignment(1.0, np.eye(3), np.zeros(3), covariance, sources)
        if self.against_m is not None:
            heights = self.against_m / 2**0.5, 0.0, 0.0
            out.similarity = replace(out.similarity, heights=heights)
        out.agreement = 0 if number in self.false else 3
        out.is_tied_by_loop, out.keyframes = number in self.tied, 3 + (number == self.main)
        return out


def loop(a: int, b: int) -> Loop:
    return Loop(a, b, np.eye(4), np.eye(6))


def apart(
    ties: Ties, points: tuple[int, ...] = (100, 300, 200, 50), prior: PosePrior = NOWHERE
) -> list[tuple[int, int]]:
    """What is apart of four segments with so many points in each keyframe."""
    segments = Segments()
    for number, count in enumerate(points):
        segment = ties.segment(segments, number)
        for i in range(3):
            segment.add_surface(10 * number + i, count, prior)
    return segments.apart(ties.taken)


def test_without_ties_the_largest_stays() -> None:
    assert apart(Ties()) == [(0, 2), (20, 22), (30, 32)]


def test_loops_make_pieces() -> None:
    assert apart(Ties([loop(2, 30)])) == [(0, 2), (20, 22), (30, 32)]
    assert apart(Ties([loop(2, 21), loop(22, 30)])) == [(10, 12)]


def test_what_fixes_place_stays_whatever_its_size() -> None:
    assert apart(Ties(fixed=(3,))) == [(0, 2), (10, 12), (20, 22)]
    assert apart(Ties([loop(12, 22)], fixed=(0, 2))) == [(30, 32)]
    assert apart(Ties(), prior=PLACED) == []


def test_fixes_without_a_height_do_not_lay_one_stretch_on_another() -> None:
    """A camera's receiver errs by tens of metres in height: two layers of one ground."""
    every = (0, 1, 2, 3)
    high = replace(PLACED, sigma_position_m=np.array([5.0, 5.0, 50.0]))
    coarse = Ties(fixed=every, tied=every, sigma_m=50.0)
    assert apart(coarse, prior=high) == [(0, 2), (20, 22), (30, 32)]
    assert apart(replace(coarse, against_m=20.0), prior=high) == [(10, 12), (20, 22), (30, 32)]
    assert apart(replace(coarse, against_m=2.0), prior=high) == []
    tied = replace(coarse, taken=[loop(2, 11)])
    assert apart(tied, prior=high) == [(20, 22), (30, 32)]
    assert apart(Ties(fixed=every, tied=every, sigma_m=5.0)) == []


def test_fixes_that_leave_the_size_open_do_not_lay_one_stretch_on_another() -> None:
    """Five steps of a phone within the error of its receiver: depths of any length."""
    every = (0, 1, 2, 3)
    ties = Ties(fixed=every, tied=every, sigma_scale={1: 0.7, 2: 0.1, 3: 0.3})
    for prior in (NOWHERE, PLACED):
        assert apart(ties, prior=prior) == [(10, 12), (30, 32)]
        assert apart(replace(ties, main=1), prior=prior) == [(30, 32)]
        assert apart(replace(ties, taken=[loop(2, 11)]), prior=prior) == [(30, 32)]


def test_what_is_false_is_no_piece_and_ties_none() -> None:
    assert apart(Ties(false=(1,))) == [(0, 2), (30, 32)]
    assert apart(Ties([loop(2, 11), loop(11, 21)], fixed=(0,), false=(1,))) == [(20, 22), (30, 32)]


def test_a_forgotten_loop_still_ties() -> None:
    assert apart(Ties(tied=(2,))) == [(0, 2), (30, 32)]


def test_a_segment_without_nodes_is_tied_as_it_was() -> None:
    """A long flight drops the nodes of short segments; their keyframes stay as published."""
    segments = Segments()
    for number, count in enumerate((300, 100, 100)):
        segment = Ties(fixed=(1,)).segment(segments, number)
        segment.add_surface(10 * number, count, NOWHERE)
    segments.thin([])
    assert segments.apart([]) == [(20, 20)]


def replayed(tmp_path: Path, track: list[F64]) -> tuple[dict[str, Any], F64]:
    """The scan.json and the cloud's points of a folder of stills, two seconds apart."""
    folder, out = tmp_path / "stills", tmp_path / "scan"
    folder.mkdir()
    for i, T in enumerate(track):
        gray = still(T)
        cv2.imwrite(str(folder / f"{i:02d}.png"), np.dstack([gray, gray, gray]))
    save_camera(tmp_path / "camera.yaml", CAMERA)
    done = CliRunner().invoke(
        app,
        ["replay", f"images:{folder}?interval_s=2", "--camera-model", str(tmp_path / "camera.yaml"),
         "--out", str(out), "--backend", "cpu", "--json",
         "--set", f"scan.assumed_agl_m={HEIGHT_M}"],
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    xyz = np.asarray(laspy.read(out / "cloud.laz").xyz, np.float64)
    return json.loads((out / "scan.json").read_text()), xyz


@pytest.mark.slow
def test_two_places_are_not_laid_into_one_cloud(tmp_path: Path) -> None:
    """Five stills here, five far away, no telemetry: the cloud is as wide as one place."""
    step = 0.25 * FOOTPRINT_M
    here = [pose(step * i - 90.0, seed=i) for i in range(5)]
    there = [pose(step * i + 30.0, seed=9 + i) for i in range(5)]
    scan, xyz = replayed(tmp_path, here + there)
    assert scan["run"]["segments"] == 2 and scan["run"]["keyframes"] > scan["counts"]["keyframes"]
    wide = np.ptp(xyz[:, :2], axis=0)
    assert FOOTPRINT_M < wide.max() < FOOTPRINT_M + 5 * step
    assert any("left out of the cloud" in warning for warning in scan["run"]["warnings"])


@pytest.mark.slow
def test_a_scan_finished_at_its_end_is_not_called_empty(tmp_path: Path) -> None:
    """Of three stills all surface comes when the scan is closed."""
    scan, xyz = replayed(tmp_path, [pose(0.25 * FOOTPRINT_M * i, seed=i) for i in range(3)])
    assert scan["counts"]["keyframes"] > 0 and len(xyz) > 1000
    assert not [w for w in scan["run"]["warnings"] if "nothing was reconstructed" in w]


def finished(store: ScanStore, apart: list[list[int]]) -> ScanStore:
    """The store, closed with these stretches apart."""
    store.finish({"frames": 5, "frames_tracked": 5, "apart": apart})
    return store


def test_no_deliverable_shows_what_is_apart(tmp_path: Path, house: HouseFlight) -> None:
    """The last two keyframes of five are tied to nothing: they lie 5 m further east each."""
    with finished(house.flown(tmp_path), [[3, 4]]) as store:
        summary = write_deliverables(tmp_path, store)
        coverage = coverage_of(store)
    assert coverage is not None and coverage.places["seq"].tolist() == [0, 1, 2]
    assert any("2 of 5 keyframes" in note for note in summary["notes"])
    assert "2 of 5 keyframes" in (tmp_path / "report.html").read_text(encoding="utf-8")
    with ScanView(tmp_path) as view:
        assert [p.keyframe_seq for p in view.poses] == [0, 1, 2]
        assert [p.seq for p in extents_of(view.store, Progress())[0]] == [0, 1, 2]
        assert len(view.off_nadir_deg) == 3
        east = [export(view, kind, None, ExportOptions(cell_m=1.0)) for kind in ("dsm", "geojson")]
    with rasterio.open(east[0]) as dsm:
        assert dsm.bounds.right - dsm.bounds.left < 160 / 140 * 40 + 10 + 4
    features = json.loads(east[1].read_text())["features"]
    assert [f["properties"].get("keyframe") for f in features[1:]] == [0, 1, 2]
    assert len(features[0]["geometry"]["coordinates"]) == 3


def test_a_scan_of_false_depth_alone_shows_none(tmp_path: Path, house: HouseFlight) -> None:
    """Images that tie its keyframes place them, and make their depth no truer."""
    with house.flown(tmp_path) as store:
        store.finish({"frames": 5, "frames_tracked": 5, "apart": [[0, 4]], "false": [[0, 4]]})
        summary = write_deliverables(tmp_path, store)
        set_refinement(store, {"apart": []})
        assert not main_seqs(store)
    assert summary["counts"]["points"] == 0 and not summary["failed"]
    assert any("5 of 5 keyframes" in note for note in summary["notes"])
    assert not list(tmp_path.glob("piece-*")) and len(laspy.read(tmp_path / "cloud.laz")) == 0
    with ScanView(tmp_path) as view:
        for kind in ("dsm", "glb", "laz"):
            with pytest.raises(InputError):
                export(view, kind, None, ExportOptions())


def test_a_piece_that_nothing_ties_is_a_cloud_of_its_own(
    tmp_path: Path, house: HouseFlight
) -> None:
    """Three keyframes from 10 m east on, 40 m above the ground; two more are too few."""
    with finished(house.flown(tmp_path), [[2, 4], [0, 1], *[[2, 9]] * 100]) as store:
        summary = write_deliverables(tmp_path, store)
        first = store.keyframe(2)
        assert first is not None
        assert [path.name for path in tmp_path.glob("piece-*")] == ["piece-1.laz"]
        assert any(note.startswith("piece-1.laz: what is left out") for note in summary["notes"])
        piece = laspy.read(tmp_path / "piece-1.laz")
        high_m = first.depth.T_world_camera[2, 3]
        assert len(piece) > 1000 and abs(np.median(piece.z) + high_m) < 1.0
        assert abs(np.median(piece.x)) < 20.0 and piece.header.parse_crs() is None
        set_refinement(store, {"apart": []})
        write_deliverables(tmp_path, store)
    assert not list(tmp_path.glob("piece-*"))


def test_the_preview_says_what_is_left_out(tmp_path: Path, house: HouseFlight) -> None:
    sizes = []
    for name, apart in (("whole", []), ("apart", [[3, 4]])):
        with finished(house.flown(tmp_path / name), apart) as store:
            write_deliverables(tmp_path / name, store)
        image = cv2.imread(str(tmp_path / name / "preview.jpg"))
        assert image is not None
        sizes.append(image.shape)
    assert sizes[1][1] < sizes[0][1] or sizes[1][0] > sizes[0][0]


def test_coverage_begins_again_where_a_piece_leaves(tmp_path: Path, house: HouseFlight) -> None:
    with house.flown(tmp_path) as store:
        live = LiveCoverage(store)
        before = live.refresh()
        finished(store, [[0, 0]])
        after = live.refresh()
        assert before is not None and len(before.places) == 5
        assert after is not None and after.places["seq"].tolist() == [1, 2, 3, 4]


def set_refinement(store: ScanStore, figures: dict[str, Any]) -> None:
    store.database.set("refinement", json.dumps({"figures": figures}))


def test_a_refinement_that_ties_brings_back(tmp_path: Path, house: HouseFlight) -> None:
    with finished(house.flown(tmp_path), [[3, 4]]) as store:
        set_refinement(store, {"apart": []})
        assert main_seqs(store) == [0, 1, 2, 3, 4]
        set_refinement(store, {"undone": True})
        assert main_seqs(store) == [0, 1, 2]


def test_poses_follow_the_view_before_them(house: HouseFlight) -> None:
    poses = [replace(house.record(i, 0.0), keyframe_seq=i if i % 2 == 0 else None)
             for i in range(8)]  # fmt: skip
    left = main_poses(poses, [(2, 4)])
    assert [round((p.time_unix_ns - house.start_ns) / 1e9) for p in left] == [0, 1, 6, 7]


@pytest.mark.parametrize(("common", "fixes", "expected"), [
    (MIN_COMMON, (), []),
    (MIN_COMMON - 1, (), [[13, 14]]),
    (MIN_COMMON - 1, (3, 4), [[13, 14]]),
    (0, (2, 3, 4), [[13, 14]]),
])  # fmt: skip
def test_images_tie_pieces_by_common_places(
    common: int, fixes: tuple[int, ...], expected: list[list[int]]
) -> None:
    """Views 0 to 2 see places 0 to 19, views 3 and 4 ``common`` of them and as many others."""
    lists = [np.arange(20)] * 3 + [np.r_[np.arange(common), np.arange(20, 40)]] * 2
    view = np.repeat(np.arange(5), [len(a) for a in lists])
    seen = Sightings(view, np.concatenate(lists), np.zeros((len(view), 2)))
    fixed = np.isin(np.arange(5), fixes)
    assert stretches_untied([10, 11, 12, 13, 14], seen, fixed) == expected


def test_a_piece_with_fixes_is_tied() -> None:
    view = np.repeat(np.arange(9), 20)
    landmark = np.tile(np.arange(20), 9) + 20 * np.repeat([0, 1, 0], 60)
    seen = Sightings(view, landmark, np.zeros((180, 2)))
    seqs = list(range(9))
    assert stretches_untied(seqs, seen, np.zeros(9, bool)) == [[3, 5]]
    assert stretches_untied(seqs, seen, np.isin(seqs, (3, 4, 5))) == []
