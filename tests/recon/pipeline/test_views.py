"""Which frames become views, and which views pair up."""

from __future__ import annotations

import weakref
from collections import Counter
from dataclasses import dataclass, replace
from typing import cast
from unittest.mock import Mock

import numpy as np
import pytest
from some_views import keyframe_at

from recon import se3
from recon.camera_model import Undistorter
from recon.image_quality import ExposureTimeWatch
from recon.pipeline.views import ViewSelection, VirtualStereoCamera
from recon.rolling_shutter import FrameRows, RowClock, Rows
from recon.tracking.frame import Frame, Landmarks, Tracking
from recon.tracking.odometry import Odometry
from recon.tracking.readout_search import ReadoutSearch
from recon.types import Camera, PosePrior
from service.config import ScanConfig
from service.flight.pipeline import spacing_of


def frame(seq: int, x_m: float, segment: int = 0, blurred: bool = False) -> Frame:
    T = se3.compose(np.eye(3), np.array([x_m, 0.0, 50.0]))
    key = keyframe_at(seq, T, segment)
    image = np.zeros((32, 32, 3), np.uint8)
    return Frame(
        image, seq, seq, gray=image[..., 0], is_blurred=blurred, segment=segment,
        T_keyframe_camera=np.eye(4), reference=key,
    )  # fmt: skip


@dataclass
class KnownTrack:
    """What views ask of an odometry."""

    keyframes: list[Frame]
    readout: ReadoutSearch | None = None
    segment: int = 0
    K = np.diag([30.0, 30.0, 1.0])


def stereo_camera(
    keys: list[Frame],
    readout: ReadoutSearch | None = None,
    shown_s: float = 0.0,
    undistorter: Undistorter | None = None,
) -> VirtualStereoCamera:
    K, size = np.array([[30.0, 0, 16], [0, 30, 16], [0, 0, 1]]), (32, 32)
    views = VirtualStereoCamera(
        ViewSelection(), cast(Odometry, KnownTrack(keys, readout)),
        undistorter or Undistorter(Camera(K, np.zeros(5), size)), Counter(),
    )  # fmt: skip
    views.exposure_time = Mock(ExposureTimeWatch, shown_s=shown_s)
    return views


def offer(
    views: ViewSelection, seq: int, x_m: float, state: str, segment: int = 0, blurred: bool = False
) -> Frame | None:
    taken = replace(frame(seq, x_m, segment, blurred), state=Tracking(state))
    return taken if views.offer(taken) else None


def test_colour_is_undistorted_when_its_view_is_given_and_not_kept() -> None:
    lens = Camera(np.array([[30.0, 0, 16], [0, 30, 16], [0, 0, 1]]), np.full(5, 0.05), (32, 32))
    undistorter, keys = Mock(wraps=Undistorter(lens)), list[Frame]()
    undistorter.valid, undistorter.camera = np.ones((32, 32), np.uint8), lens
    views = stereo_camera(keys, undistorter=undistorter)
    held = []
    for i in range(3):
        plain = frame(i, 5.0 * i)
        keys.append(plain.reference_keyframe)
        image = np.random.default_rng(i).integers(0, 255, (32, 32, 3), np.uint8)
        held.append((weakref.ref(image), Undistorter(lens).image(image)))
        state = Tracking.STARTED if i == 0 else Tracking.KEYFRAME
        taken = replace(plain, image=image, state=state)
        views.take(taken)
        del image, taken
    assert not undistorter.image.called and all(there() is not None for there, _ in held)
    for view, (_, want) in zip(views.ready(everything=True), held, strict=True):
        np.testing.assert_array_equal(view.bgr, want)
    undistorter.reset_mock()
    assert all(there() is None for there, _ in held)


def test_automatic_takes_the_odometrys_keyframes() -> None:
    views = ViewSelection()
    states = ["started", "tracked", "keyframe", "tracked", "keyframe"]
    taken = [offer(views, i, float(i), s) is not None for i, s in enumerate(states)]
    assert taken == [True, False, True, False, True]


def test_partners_are_the_nearest_of_the_same_segment() -> None:
    views = ViewSelection(partners=2)
    offer(views, 0, 100.0, "started", segment=0)
    kept = [offer(views, 1 + i, 5.0 * i, "keyframe", segment=1) for i in range(4)]
    middle = kept[1]
    assert middle is not None and views.ready(middle)
    assert sorted(v.seq for v in views.partners(middle)) == [1, 3]
    assert views.confirmed(middle)
    last = kept[3]
    assert last is not None and not views.ready(last)


def test_two_views_alone_confirm_nothing() -> None:
    views = ViewSelection()
    first = offer(views, 0, 0.0, "started")
    offer(views, 1, 5.0, "keyframe")
    assert first is not None and not views.ready(first) and not views.confirmed(first)
    offer(views, 2, 10.0, "keyframe")
    assert views.ready(first) and views.confirmed(first)
    fixed = ViewSelection((2.0, 0))
    left = offer(fixed, 0, 0.0, "started")
    offer(fixed, 1, 2.5, "tracked")
    assert left is not None and fixed.ready(left) and fixed.confirmed(left)


@pytest.mark.parametrize(
    ("baseline", "seqs"),
    [("2/10", [0, 10, 20, 30]), ("3/10", [0, 5, 10]), ("1/5", [0, 5, 10]), ("6/10", [0, 2, 4])],
)
def test_the_papers_notation_takes_every_so_many_frames(baseline: str, seqs: list[int]) -> None:
    views = ViewSelection(spacing_of(ScanConfig(baseline=baseline)))
    taken = [i for i in range(31) if offer(views, i, 0.1 * i, "keyframe" if i == 0 else "tracked")]
    assert taken[: len(seqs)] == seqs


def test_a_baseline_in_metres_is_kept_and_may_change_in_flight() -> None:
    views = ViewSelection((2.0, 0))
    taken = [i for i in range(20) if offer(views, i, 0.5 * i, "keyframe" if i == 0 else "tracked")]
    assert taken == [0, 4, 8, 12, 16]
    views.spacing = 1.0, 0
    more = [i for i in range(20, 26) if offer(views, i, 0.5 * i, "tracked")]
    assert more == [20, 22, 24]


def test_the_operator_can_ask_for_the_next_frame() -> None:
    views = ViewSelection()
    offer(views, 0, 0.0, "started")
    assert offer(views, 1, 0.1, "tracked") is None
    views.takes_next = True
    assert offer(views, 2, 0.2, "tracked") is not None
    assert offer(views, 3, 0.3, "tracked") is None


def test_fewer_partners_from_now_on() -> None:
    views = ViewSelection(partners=4)
    kept = [offer(views, i, 5.0 * i, "started" if i == 0 else "keyframe") for i in range(5)]
    middle = kept[2]
    assert middle is not None
    assert len(views.partners(middle)) == 4
    views.max_partners = 2
    assert sorted(v.seq for v in views.partners(middle)) == [1, 3]


def test_blurred_views_are_no_partners() -> None:
    views = ViewSelection(partners=2)
    kept = [
        offer(views, i, 5.0 * i, "keyframe" if i else "started", blurred=i == 1) for i in range(5)
    ]
    first = kept[0]
    assert first is not None and [v.seq for v in views.partners(first)] == [2, 3]


def test_the_last_frame_of_a_stretch_becomes_a_view_when_it_shows_more() -> None:
    views = ViewSelection()
    for i in range(3):
        for j in range(10):
            state = "tracked" if j else "keyframe" if i else "started"
            assert (offer(views, 10 * i + j, 5.0 * i + 0.5 * j, state) is None) == (j > 0)
    assert not views.end_segment(frame(20, 10.4))
    assert not views.end_segment(frame(28, 14.0, blurred=True))
    last = frame(28, 14.0)
    assert views.end_segment(last) and [v.seq for v in views.partners(last)] == [23, 20, 10, 0]
    assert not views.end_segment(None) and len(views.partners(last)) == 4
    fixed = ViewSelection((2.0, 0))
    for i in range(3):
        offer(fixed, i, 2.5 * i, "tracked" if i else "started")
    assert not fixed.end_segment(frame(3, 6.5))


def test_all_frames_count_where_the_operator_chose_the_baseline_or_wants_the_next_one() -> None:
    assert ViewSelection((2.0, 0)).frames_per_step == np.inf
    assert ViewSelection((0.0, 10)).frames_per_step == np.inf
    views = ViewSelection()
    views.takes_next = True
    assert views.frames_per_step == np.inf


def test_as_many_frames_are_needed_as_pair_up() -> None:
    few, many = ViewSelection(partners=4), ViewSelection(partners=30)
    assert np.isfinite(few.frames_per_step)
    steps_with_partners = 2.2 - 0.6  # ahead of the first view
    assert many.frames_per_step * steps_with_partners >= 30


@pytest.mark.parametrize(("doubt_s", "expected"), [(0.0, False), (0.02, True)])
def test_a_view_knows_what_an_unknown_readout_does_to_its_depth(
    doubt_s: float, expected: bool
) -> None:
    K, size = np.array([[30.0, 0, 16], [0, 30, 16], [0, 0, 1]]), (32, 32)
    ground, clock = Landmarks(), RowClock(Camera(K, np.zeros(5), size))
    corners = np.random.default_rng(0).uniform(-20, 20, (40, 2))
    ids = ground.add(np.c_[corners, np.full(40, 100.0)])
    keys: list[Frame] = []
    views = stereo_camera(keys, Mock(ReadoutSearch, doubt_s=doubt_s))
    for i in range(3):
        plain = frame(i, 5.0 * i)
        keys.append(replace(plain.reference_keyframe, uv=corners, landmark=ids, landmarks=ground))
        turn = np.array([0.0, 2.0 * i, 0.0, 0.0, 0.0, 0.0])
        row_motion = FrameRows(i, PosePrior(), np.eye(4), Rows(clock, turn, np.zeros(6)))
        state = Tracking.STARTED if i == 0 else Tracking.KEYFRAME
        views.take(replace(plain, state=state, reference=keys[-1], row_motion=row_motion))
    shares = [view.rows_share for view in views.ready(everything=True)]
    assert len(shares) == 3 and all((share.min() > 0.005) == expected for share in shares)


@pytest.mark.parametrize(
    ("is_open", "is_measured", "expected"),
    [
        (True, True, [0, 0, 0, 0, 1, 5]),
        (True, False, [0, 0, 2, 3, 4, 5]),
        (False, True, [0, 0, 2, 3, 4, 5]),
    ],
)
def test_views_wait_for_the_first_word_on_their_readout(
    is_open: bool, is_measured: bool, expected: list[int]
) -> None:
    """Not for stills, which never show it; the sixth view comes with that word."""
    search, keys = Mock(ReadoutSearch, doubt_s=0.0, is_open=is_open), list[Frame]()
    views = stereo_camera(keys, search)
    given, counts = [], []
    for i in range(6):
        plain = frame(i, 5.0 * i)
        keys.append(plain.reference_keyframe)
        row_motion = FrameRows(i, PosePrior(), np.eye(4), is_measured=is_measured)
        state = Tracking.STARTED if i == 0 else Tracking.KEYFRAME
        views.take(replace(plain, state=state, row_motion=row_motion))
        search.is_open = is_open and i < 5
        given += list(views.ready())
        counts.append(len(given))
    assert counts == expected


def test_a_view_that_waited_while_the_next_segment_grew_is_confirmed_by_its_own() -> None:
    """Only one of those is kept by then."""
    search, keys = Mock(ReadoutSearch, doubt_s=0.0, is_open=True), list[Frame]()
    views = stereo_camera(keys, search)
    given = []
    for i in range(8):
        plain = frame(i, 5.0 * i, segment=i // 4)
        keys.append(plain.reference_keyframe)
        row_motion = FrameRows(i, PosePrior(), np.eye(4), is_measured=True)
        state = Tracking.KEYFRAME if i % 4 else Tracking.STARTED
        views.take(replace(plain, state=state, row_motion=row_motion))
        given += [view.seq for view in views.ready()]
    assert given == [0, 1, 2, 3]


def test_a_view_knows_the_earlier_ones_of_its_segment_alone() -> None:
    """Their poses say how far the odometry has moved them since; another segment's say nothing."""
    keys = list[Frame]()
    views, earlier = stereo_camera(keys), dict[int, set[int]]()
    for i in range(8):
        plain = frame(i, 5.0 * i, segment=i // 4)
        keys.append(plain.reference_keyframe)
        views.take(replace(plain, state=Tracking.KEYFRAME if i % 4 else Tracking.STARTED))
        earlier |= {view.seq: set(view.earlier) for view in views.ready()}
    assert {5, 6} <= earlier.keys() and earlier[6] >= {5}
    assert all(seq // 4 == other // 4 for seq, others in earlier.items() for other in others)


@pytest.mark.parametrize("exposure_s", [0.0, 0.05])
def test_a_view_knows_how_far_its_image_moved_while_it_was_exposed(exposure_s: float) -> None:
    keys = list[Frame]()
    views = stereo_camera(keys, shown_s=exposure_s)
    for i in range(4):
        plain = frame(i, float(i))
        keys.append(plain.reference_keyframe)
        state = Tracking.STARTED if i == 0 else Tracking.KEYFRAME
        image_rad_s = np.array([-0.2, 0.1]) if i else None
        views.take(replace(plain, state=state, image_rad_s=image_rad_s, pyramid=(plain.gray,)))
    blurs = [view.image.blur_px for view in views.ready(everything=True)]
    if not exposure_s:
        assert blurs == [None] * 4
        return
    assert blurs[0] is None
    for blur in blurs[1:]:
        assert blur is not None
        np.testing.assert_allclose(blur, 30.0 * exposure_s * np.array([-0.2, 0.1]))


def test_a_view_is_given_once_with_the_first_frame_that_shows_its_depth() -> None:
    """From the third view of a stretch on, by a sharp frame 0.3 of a step away, whether or not
    its other partners are there; then it comes again with all of them."""
    keys = list[Frame]()
    views = stereo_camera(keys)

    def take(seq: int, x_m: float, blurred: bool = False) -> None:
        plain = frame(seq, x_m, blurred=blurred)
        is_key = seq % 10 == 0
        if is_key:
            keys.append(plain.reference_keyframe)
        state = Tracking.TRACKED if not is_key else Tracking.KEYFRAME if seq else Tracking.STARTED
        views.take(replace(plain, state=state))

    take(0, 0.0)
    take(10, 6.0)
    take(14, 8.5)
    assert views.first() is None  # two views alone confirm nothing
    take(20, 12.0)
    assert views.first() is None
    take(21, 13.5)
    assert views.first() is None  # too near
    take(22, 14.5, blurred=True)
    assert views.first() is None
    take(23, 15.0)
    first = views.first()
    assert first is not None and first.is_first_depth
    assert (first.seq, [partner.seq for partner in first.partners]) == (20, [23])
    take(24, 16.0)
    assert views.first() is None  # once
    take(30, 18.0)
    whole = {view.seq: view for view in views.ready()}
    assert not any(view.is_first_depth for view in whole.values())
    assert {partner.seq for partner in whole[20].partners} == {0, 10, 30}
    np.testing.assert_array_equal(whole[20].bgr, first.bgr)
