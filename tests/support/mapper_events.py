"""Picks from what a mapper says."""

from __future__ import annotations

from collections.abc import Iterable

from recon.pipeline.mapper import Event, KeyframeReady
from recon.types import Keyframe


def keyframes_of(events: Iterable[Event]) -> list[Keyframe]:
    """The keyframes among events, in order."""
    return [event.keyframe for event in events if isinstance(event, KeyframeReady)]
