"""First depths: new ground before the next keyframe shows it, and no part of the map."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from painted_ground import CAMERA, HEIGHT_M, pose, still

from recon.pipeline.mapper import Event, KeyframeReady, Mapper, MapperConfig, PosesChanged
from recon.tracking.frame import Frame
from recon.types import F64, PosePrior
from service.config import load_config
from service.flight.pipeline import mapper_config

FRAMES, STEP_M = 56, 0.5
"""A keyframe each 4 m."""
STRIP_PX = 12
"""Of 160 across: the ground on the right that the keyframe before does not see."""


def fly(
    first_depths: bool, width_px: int = 320, later_gain: float = 1.0, keeps_debug: bool = False
) -> list[Event]:
    """``later_gain`` is the exposure of the second half."""
    config = MapperConfig(upsample=False, first_depths=first_depths, keeps_debug=keeps_debug)
    mapper, events = Mapper(CAMERA, config), list[Event]()
    mapper.set_effort(config.pairs, width_px, upsample=False)
    for i in range(FRAMES):
        T = pose(STEP_M * i)
        prior = PosePrior(T[:3, :3], 0.005, 0.01, T[:3, 3], np.full(3, 0.1), HEIGHT_M, 0.1)
        image = cv2.cvtColor(still(T), cv2.COLOR_GRAY2BGR)
        image = cv2.convertScaleAbs(image, alpha=later_gain if i >= FRAMES // 2 else 1.0)
        events += mapper.track(Frame(np.asarray(image, np.uint8), i * 100_000_000, i, prior))
    return [*events, *mapper.finish()]


def is_first_depth(event: Event) -> bool:
    return isinstance(event, KeyframeReady) and event.is_first_depth


@pytest.mark.slow
def test_a_first_depth_shows_new_ground_early_and_leaves_the_map_as_it_is() -> None:
    plain, events = fly(False), fly(True)
    ready = [event for event in events if isinstance(event, KeyframeReady)]
    rest = [event for event in events if not is_first_depth(event)]
    assert len(rest) == len(plain) and not any(map(is_first_depth, plain))
    for one, other in zip(plain, rest, strict=True):
        assert type(one) is type(other)
        if isinstance(one, KeyframeReady) and isinstance(other, KeyframeReady):
            assert one.keyframe.seq == other.keyframe.seq
            for name in ("depth_m", "sigma_m", "views", "T_world_camera"):
                pair = (getattr(e.keyframe.depth, name) for e in (one, other))
                np.testing.assert_array_equal(*pair)
            np.testing.assert_array_equal(one.keyframe.fresh, other.keyframe.fresh)
        if isinstance(one, PosesChanged) and isinstance(other, PosesChanged):
            assert one.poses.keys() == other.poses.keys()
            for seq, found in one.poses.items():
                np.testing.assert_array_equal(found.T_world_camera, other.poses[seq].T_world_camera)
    whole = {e.keyframe.seq: e.keyframe for e in ready if not e.is_first_depth}
    order = [e.keyframe.seq for e in ready]
    firsts = [e.keyframe for e in ready if e.is_first_depth]
    assert len(firsts) >= 3
    for first in firsts:
        assert order.index(first.seq) < len(order) - 1 - order[::-1].index(first.seq)
        shown, final = first.fresh & np.isfinite(first.depth.depth_m), whole[first.seq]
        coming = final.fresh & np.isfinite(final.depth.depth_m)
        assert shown[:, -STRIP_PX:-2].mean() > 0.7  # no earlier image has it
        off = np.abs(first.depth.depth_m[shown] / HEIGHT_M - 1.0)
        assert np.median(off) < 0.03
        assert np.median(first.depth.sigma_m[shown]) > np.median(final.depth.sigma_m[coming])


@pytest.mark.slow
def test_each_keyframe_says_the_stages_of_its_own_where_they_are_kept() -> None:
    ready = [e for e in fly(False, keeps_debug=True) if isinstance(e, KeyframeReady)]
    assert len(ready) > 5
    for event in ready:
        np.testing.assert_array_equal(event.stages["depth_m"], event.keyframe.depth.depth_m)
        np.testing.assert_array_equal(event.stages["bgr"], event.keyframe.bgr)


@pytest.mark.slow
def test_a_step_of_exposure_shows_in_no_keyframe_and_no_first_depth() -> None:
    def brightness(events: list[Event], of_first: bool) -> F64:
        ready = [e for e in events if isinstance(e, KeyframeReady) and e.is_first_depth == of_first]
        return np.array([np.median(event.keyframe.bgr) for event in ready])

    plain, stepped = fly(True), fly(True, later_gain=0.6)
    for of_first, unlevelled in ((False, 0), (True, 1)):
        one, other = brightness(plain, of_first), brightness(stepped, of_first)
        off = np.abs(other / one - 1.0)
        assert len(one) == len(other) > 3 and off[0] == 0.0 and 0.0 < off[-1] < 0.15
        # A first depth comes before its keyframe, and so with the exposure before.
        assert np.count_nonzero(off > 0.15) <= unlevelled


@pytest.mark.slow
def test_first_depths_are_coarser_than_whole_ones_of_another_effort() -> None:
    events = [event for event in fly(True, 160) if isinstance(event, KeyframeReady)]
    widths = {(event.is_first_depth, event.keyframe.depth.depth_m.shape[1]) for event in events}
    assert widths == {(False, 160), (True, 80)}


@pytest.mark.parametrize(
    ("live", "settings", "expected"),
    [
        (True, ["datalink.connect=['tcp/127.0.0.1:7447']"], True),
        (False, ["datalink.connect=['tcp/127.0.0.1:7447']"], False),
        (True, [], False),
        (True, ["datalink.connect=['tcp/127.0.0.1:7447']", "datalink.budget_kbit_s=300"], False),
    ],
)
def test_first_depths_are_computed_where_a_link_sends_them(
    live: bool, settings: list[str], expected: bool
) -> None:
    config = load_config(None, settings)
    assert mapper_config(CAMERA, config, live=live).first_depths == expected
