"""Frames that wait for a segment's second view are unused only where it never comes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from recon.pipeline.mapper import Mapper
from recon.tracking.frame import NO_IMAGE, Frame, Tracking
from recon.tracking.odometry import Odometry
from recon.types import Camera

POSE = np.eye(4)
STARTED, WAITING = (Tracking.STARTED, POSE, ""), (Tracking.WAITING, None, "too little motion")
KEYFRAME, LOST = (Tracking.KEYFRAME, POSE, ""), (Tracking.LOST, None, "too few matches")


@pytest.mark.parametrize(
    ("states", "unused"),
    [
        ([STARTED, WAITING, WAITING, KEYFRAME], {}),
        ([STARTED, WAITING, WAITING], {"too little motion": 2}),
        ([STARTED, WAITING, LOST, STARTED, KEYFRAME],
         {"too little motion": 1, "too few matches": 1}),
    ],
)  # fmt: skip
def test_waiting_counts_where_it_is_in_vain(states: list[Any], unused: dict[str, int]) -> None:
    image = Frame(NO_IMAGE, 0, 0, segment=0)
    results = iter(
        [
            [replace(image, state=state, T_keyframe_camera=at, reason=why)]
            for state, at, why in states
        ]
    )
    odometry = Mock(Odometry)
    odometry.track.side_effect = results
    mapper = Mapper(Camera(np.diag([30.0, 30.0, 1.0]), np.zeros(5), (32, 32)))
    mapper.odometry = odometry
    for _ in states:
        mapper.locate(image)
    assert mapper.refusals() == unused
