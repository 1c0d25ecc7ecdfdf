"""Scans in flight aligned with the site: how soon, how well, and what must not disturb it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from site_scans import ELSEWHERE, FRAME, HEIGHT_M, Errors, header_of, layers, leg, write_scan

from recon import se3
from recon.types import F64
from service.errors import InputError
from service.georeference import LocalFrame
from service.offline.site.live import LiveSite, PlacedScan
from service.stream.records import Repose
from service.stream.store import ScanStore

WRONG = Errors((1.1, -0.7, 0.9), (0.002, -0.001, 0.004), 1.002)
OTHER = Errors((-0.8, 0.9, -0.6), (0.0, 0.002, -0.003), 0.998)


class Flight:
    """A scan that grows by one keyframe after the other."""

    def __init__(self, folder: Path, poses: list[F64], errors: Errors, ground: int = 1) -> None:
        self.folder, self._poses, self._errors, self._ground = folder, poses, errors, ground
        self.store = ScanStore.create(folder / "scan.db", header_of(folder.name, ELSEWHERE))
        self.flown = 0

    def fly(self) -> None:
        seq, T = self.flown, self._poses[self.flown]
        self.store.add_keyframe(seq, layers(seq, T, self._errors, (), self._ground, ELSEWHERE))
        self.flown += 1


def turn(site: LiveSite, *folders: Path) -> dict[Path, PlacedScan]:
    for folder in folders:
        site.refresh(folder)
        while site.scans[folder].due:
            site.compare(folder)
    return {one.folder: one for one in site.place() or []}


def miss_m(placed: PlacedScan, errors: Errors, spot: F64) -> F64:
    """(3,) between a place of the ground and where the scan is shown to have it, m."""
    return np.asarray(placed.move.points(errors.as_similarity().points(spot[None]))[0] - spot)


MIDDLE = np.zeros(3)
NORTH = leg(0.0, 6)


def coming() -> list[F64]:
    """A leg from the east to the middle, whose first half sees nothing of the northern leg."""
    leg_east = leg(np.pi / 2, 14)
    for T in leg_east:
        T[0, 3] += 60.0
    return sorted(leg_east, key=lambda T: -T[0, 3])


@pytest.fixture(scope="module")
def aligned(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[list[PlacedScan | None], list[PlacedScan | None]]:
    """Where a scan in flight is shown after each of its keyframes, and the ground's."""
    folder = tmp_path_factory.mktemp("live")
    ground = write_scan(folder / "ground", NORTH, WRONG)
    flight, site = Flight(folder / "flying", coming(), OTHER), LiveSite()
    site.add(ground, compare=False)
    site.add(flight.folder)
    shown: list[PlacedScan | None] = []
    on_ground: list[PlacedScan | None] = []
    for _ in coming():
        flight.fly()
        found = turn(site, ground, flight.folder)
        for kept, one in ((shown, flight.folder), (on_ground, ground)):
            kept.append(found.get(one, kept[-1] if kept else None))
    return shown, on_ground


def first_overlap(poses: list[F64]) -> int:
    """The first keyframe that shares at least a fifth of its view with the northern leg."""
    height_m = 136 / 180 * HEIGHT_M  # of a view along the flight; the leg's are as wide as long
    west, east = -120 / 180 * HEIGHT_M, 120 / 180 * HEIGHT_M
    for k, T in enumerate(poses):
        begin, end = T[0, 3] - height_m / 2, T[0, 3] + height_m / 2
        if max(min(end, east) - max(begin, west), 0.0) >= 0.2 * height_m:
            return k
    raise AssertionError("they never meet")


def test_a_scan_in_flight_is_aligned_two_keyframes_after_the_first_overlap(
    aligned: tuple[list[PlacedScan | None], list[PlacedScan | None]],
) -> None:
    shown, _ = aligned
    first = first_overlap(coming())
    ties = [0 if one is None else one.ties for one in shown]
    assert first > 5 and not any(ties[:first])
    assert ties[first + 2] >= 3


def test_its_place_is_as_good_as_its_sigma_says(
    aligned: tuple[list[PlacedScan | None], list[PlacedScan | None]],
) -> None:
    shown, on_ground = aligned
    before, after, ground = shown[0], shown[-1], on_ground[-1]
    assert before is not None and after is not None and ground is not None
    seam = miss_m(after, OTHER, MIDDLE) - miss_m(ground, WRONG, MIDDLE)
    assert np.abs(seam).max() < 0.15
    assert np.linalg.norm(miss_m(before, OTHER, MIDDLE)) > 1.0
    assert (np.abs(miss_m(after, OTHER, MIDDLE)) < 2.0 * after.sigma_m).all()
    assert (after.sigma_m < 0.8 * before.sigma_m).all()


@pytest.mark.slow
def test_a_scan_that_meets_no_other_stays_where_its_fixes_put_it(tmp_path: Path) -> None:
    ground = write_scan(tmp_path / "ground", NORTH[:3])
    flight, site = Flight(tmp_path / "winter", leg(np.pi / 2, 3), OTHER, ground=2), LiveSite()
    site.add(ground, compare=False)
    site.add(flight.folder)
    shown: dict[Path, PlacedScan] = {}
    for _ in range(3):
        flight.fly()
        shown |= turn(site, ground, flight.folder)
    assert shown[flight.folder].ties == 0
    assert shown[flight.folder].group != shown[ground].group
    np.testing.assert_array_equal(miss_m(shown[flight.folder], Errors(), MIDDLE), MIDDLE)


def test_corrections_of_the_drone_move_its_ties(tmp_path: Path) -> None:
    """The drone finds that it was 2 m off: what is shown stays where the ties put it."""
    ground = write_scan(tmp_path / "ground", NORTH[:4])
    flight, site = Flight(tmp_path / "flying", leg(np.pi / 2, 3), Errors()), LiveSite()
    site.add(ground, compare=False)
    site.add(flight.folder)
    for _ in range(3):
        flight.fly()
    before = turn(site, ground, flight.folder)[flight.folder]
    assert before.ties >= 3
    shift = se3.compose(np.eye(3), np.array([2.0, 0.0, 0.0]))
    placed = [(k, flight.store.keyframe(k)) for k in range(3)]
    flight.store.add_reposes(
        [
            Repose(k, 1, shift @ one.depth.T_world_camera, 1.0, one.pose.covariance)
            for k, one in placed
            if one is not None
        ]
    )
    after = turn(site, ground, flight.folder)[flight.folder]
    seam = after.move.t - before.move.t
    assert np.linalg.norm(after.move.points(np.array([[2.0, 0.0, 0.0]]))[0]) < 1.3  # of the fixes
    assert seam[0] < -0.8


def test_scans_without_georeference_or_far_away_are_refused(tmp_path: Path) -> None:
    site = LiveSite()
    site.add(write_scan(tmp_path / "ground", NORTH[:1]), compare=False)
    with pytest.raises(InputError, match="no georeference"):
        site.add(write_scan(tmp_path / "nowhere", NORTH[:1], frame=None))
    far = LocalFrame(FRAME.lat_deg + 1.0, FRAME.lon_deg, FRAME.alt_amsl_m)
    with pytest.raises(InputError, match="too far"):
        site.add(write_scan(tmp_path / "far", NORTH[:1], frame=far))
    assert len(site.scans) == 1
