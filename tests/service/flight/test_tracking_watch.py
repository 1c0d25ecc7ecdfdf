"""The operator hears that nothing is reconstructed while images come."""

from __future__ import annotations

from recon.tracking.frame import NO_IMAGE, Frame, Tracking
from service.flight.reports import TrackingWatch

S = 1_000_000_000


def flown(*states: str) -> list[str]:
    """The reports about a flight of so many states, one each half second."""
    reported: list[str] = []
    watch = TrackingWatch(reported.append)
    for k, state in enumerate(states):
        reason = {"lost": "too little texture", "waiting": "too little motion"}.get(state, "")
        frame = Frame(NO_IMAGE, 0, k, state=Tracking(state), reason=reason)
        watch.add(frame, 100 * S + k * S // 2)
    return reported


def test_a_long_loss_is_reported_once_with_its_reason_and_its_end() -> None:
    lost = "Tracking lost for 10 s (too little texture): nothing is scanned"
    assert flown("started", "keyframe", *["lost"] * 300) == [lost]
    once = ["keyframe", *["lost"] * 30, "tracked", "tracked"]
    assert flown(*once) == [lost, "Tracking recovered"]
    assert flown(*once, *once) == 2 * [lost, "Tracking recovered"]
    assert flown(*["lost"] * 30) == [lost]  # nothing to see from the first image on
    assert len(flown("keyframe", *(["lost"] * 12 + ["started", "waiting"]) * 9)) == 1


def test_short_losses_and_a_hover_are_not_reported() -> None:
    assert flown("keyframe", *["lost"] * 19, "keyframe", *["lost"] * 19, "tracked") == []
    assert flown("started", *["waiting"] * 500) == []
    assert flown("keyframe", *["tracked"] * 500) == []
    assert flown("keyframe", *["lost"] * 19, *["skipped"] * 2, *["lost"] * 19) == []
    assert flown("keyframe", *["lost"] * 9, "started", *["waiting"] * 100, "keyframe") == []
