"""Orders to the companion, and what it says of itself, over an operator's MAVLink."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from service.errors import OutsideError
from service.ground.operator import CAMERA, ONBOARD, ORDERS, Operator

STATES = {1: "starting", 2: "not ready", 3: "ready", 4: "scanning", 5: "in trouble"}
ANSWER_S = 2.0
FIGURES = {
    "SR_SPEED": "speed_m_s",
    "SR_DIST": "distance_m",
    "SR_CAM_LAT": "camera_latency_ms",
    "SR_LAT_SIG": "camera_latency_sigma_ms",
}
"""Named values that come while scanning, and what the status calls them."""


def order(operator: Operator, action: str, metres: float | None) -> dict[str, Any]:
    """Give one of the orders; its result. OutsideError when the vehicle does not carry it out."""
    wanted = ORDERS[action]
    reasons: list[str] = []
    params = list(wanted.params)
    if wanted.takes_metres:
        assert metres is not None
        params = [metres]
    end = operator.subscribe(
        "STATUSTEXT", lambda _, fields: reasons.append(str(fields.get("text", "")))
    )
    try:
        ack = operator.command(wanted.number, wanted.component, tuple(params))
        if ack.result != 0:
            _wait(lambda: bool(reasons))
            why = f": {reasons[-1]}" if reasons else ""
            raise OutsideError(f"{action} {ack.text} by system {ack.system}{why}")
    finally:
        end()
    return {"action": action, "result": ack.text, "system": ack.system, "component": ack.component}


def _wait(done: Callable[[], bool], limit_s: float = 0.5) -> None:
    """Wait a moment for the words that come after a refusal."""
    deadline = time.monotonic() + limit_s
    while not done() and time.monotonic() < deadline:
        time.sleep(0.02)


def status(operator: Operator) -> dict[str, Any]:
    """What the companion says of itself, its scan and its storage."""
    beats: dict[int, dict[str, Any]] = {}
    values: dict[str, float] = {}
    operator.subscribe("HEARTBEAT", lambda sender, fields: beats.update({sender: fields}))
    operator.subscribe("NAMED_VALUE_FLOAT", lambda sender, fields: _keep(values, sender, fields))
    capture = operator.request(262, "CAMERA_CAPTURE_STATUS", CAMERA, ANSWER_S)
    storage = operator.request(261, "STORAGE_INFORMATION", CAMERA, ANSWER_S)
    _wait(lambda: ONBOARD in beats, ANSWER_S)
    state = beats.get(ONBOARD, {}).get("system_status")
    if capture and capture.get("video_status"):
        _wait(lambda: "SR_DIST" in values, ANSWER_S)
        _wait(lambda: "SR_LAT_SIG" in values, 0.1)  # comes right behind, where it is known
    return {
        "system": operator.system,
        "state": STATES.get(state, "unknown") if isinstance(state, int) else "unknown",
        "recording": bool(capture.get("video_status")) if capture else None,
        "recording_s": capture.get("recording_time_ms", 0) / 1000.0,
        "keyframes": capture.get("image_count"),
        **{field: values.get(name) for name, field in FIGURES.items()},
        "storage_free_mib": storage.get("available_capacity"),
        "storage_total_mib": storage.get("total_capacity"),
    }


def _keep(values: dict[str, float], sender: int, fields: dict[str, Any]) -> None:
    """Take in a figure of the companion's."""
    if sender == ONBOARD:
        values[str(fields.get("name", ""))] = float(fields.get("value", math.nan))
