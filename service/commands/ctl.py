"""``skyrelief ctl``: the operator's commands to the vehicle, over MAVLink."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.errors import InputError, OutsideError

if TYPE_CHECKING:
    from service.ground.operator import Operator

ACTIONS = (
    "start", "stop", "status", "baseline", "pause", "resume",
    "photo", "clear", "finalise", "selftest", "watch",
)  # fmt: skip
STATES = {1: "starting", 3: "ready", 4: "scanning", 5: "in trouble"}
ANSWER_S = 2.0
FIGURES = {
    "SR_SPEED": "speed_m_s",
    "SR_DIST": "distance_m",
    "SR_CAM_LAT": "camera_latency_ms",
    "SR_LAT_SIG": "camera_latency_sigma_ms",
}
"""Named values that come while scanning, and what the status calls them."""


def ctl(
    action: Annotated[str, typer.Argument(help=", ".join(ACTIONS))],
    metres: Annotated[
        float | None, typer.Argument(help="for baseline: metres, 0 follows the altitude")
    ] = None,
    connect: Annotated[
        str, typer.Option(help="where the vehicle's MAVLink comes from")
    ] = "udpin://0.0.0.0:14550",
    system: Annotated[int | None, typer.Option(help="the vehicle's system id")] = None,
    timeout: Annotated[float, typer.Option(help="seconds to wait for the vehicle")] = 10.0,
    seconds: Annotated[float, typer.Option(help="watch: how long; 0 until Ctrl-C")] = 0.0,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object")] = False,
) -> None:
    """Start, stop, watch and steer a scan from the ground."""
    _check(action, metres, timeout)
    from service.ground.operator import Operator

    with Operator(connect, system, timeout) as operator:
        if action == "watch":
            _watch(operator, seconds, as_json)
        elif action == "status":
            _print(status(operator), as_json)
        else:
            _print(order(operator, action, metres), as_json)


def _check(action: str, metres: float | None, timeout: float) -> None:
    if action not in ACTIONS:
        raise InputError(f"ctl {action}: there are {', '.join(ACTIONS)}")
    if (action == "baseline") != (metres is not None):
        raise InputError("ctl baseline METRES takes metres (0 follows the altitude), no other does")
    if metres is not None and not (math.isfinite(metres) and metres >= 0.0):
        raise InputError(f"ctl baseline {metres:g}: give 0 or more metres")
    if not timeout > 0.0:
        raise InputError(f"ctl --timeout {timeout:g}: give seconds")


def order(operator: Operator, action: str, metres: float | None) -> dict[str, Any]:
    """Give one of the orders; its result. OutsideError when the vehicle does not carry it out."""
    from service.ground.operator import ORDERS

    wanted = ORDERS[action]
    reasons: list[str] = []
    operator.subscribe("STATUSTEXT", lambda _, fields: reasons.append(str(fields.get("text", ""))))
    params = list(wanted.params)
    if wanted.takes_metres:
        assert metres is not None
        params = [metres]
    ack = operator.command(wanted.number, wanted.component, tuple(params))
    if ack.result != 0:
        _wait(lambda: bool(reasons))
        why = f": {reasons[-1]}" if reasons else ""
        raise OutsideError(f"{action} {ack.text} by system {ack.system}{why}")
    return {"action": action, "result": ack.text, "system": ack.system, "component": ack.component}


def _wait(done: Callable[[], bool], limit_s: float = 0.5) -> None:
    """Wait a moment for the words that come after a refusal."""
    deadline = time.monotonic() + limit_s
    while not done() and time.monotonic() < deadline:
        time.sleep(0.02)


def status(operator: Operator) -> dict[str, Any]:
    """What the companion says of itself, its scan and its storage."""
    from service.ground.operator import CAMERA, ONBOARD

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
    from service.ground.operator import ONBOARD

    if sender == ONBOARD:
        values[str(fields.get("name", ""))] = float(fields.get("value", math.nan))


def _watch(operator: Operator, seconds: float, as_json: bool) -> None:
    """Print what the companion says until the time is over or Ctrl-C."""
    for name, line in LINES.items():
        operator.subscribe(name, _printer(name, line, as_json))
    end = time.monotonic() + seconds if seconds > 0.0 else math.inf
    try:
        while time.monotonic() < end:
            time.sleep(0.1)
    except KeyboardInterrupt:
        return


def _printer(
    name: str, line: Callable[[dict[str, Any]], str], as_json: bool
) -> Callable[[int, dict[str, Any]], None]:
    def show(sender: int, fields: dict[str, Any]) -> None:
        from service.ground.operator import CAMERA, ONBOARD

        if sender not in (ONBOARD, CAMERA):
            return
        if as_json:
            print(json.dumps({"message": name, "component": sender, **_plain(fields)}), flush=True)
        else:
            print(line(fields), flush=True)

    return show


LINES: dict[str, Callable[[dict[str, Any]], str]] = {
    "STATUSTEXT": lambda f: str(f.get("text", "")),
    "CAMERA_IMAGE_CAPTURED": lambda f: (
        f"keyframe {f.get('image_index')} at {f.get('lat', 0) * 1e-7:.7f}, "
        f"{f.get('lon', 0) * 1e-7:.7f}, {f.get('alt', 0) * 1e-3:.1f} m"
    ),
    "CAMERA_CAPTURE_STATUS": lambda f: (
        ("scanning" if f.get("video_status") else "not scanning")
        + f", {f.get('image_count')} keyframes"
    ),
    "NAMED_VALUE_FLOAT": lambda f: f"{f.get('name')} {f.get('value', math.nan):.2f}",
}
"""Message name to its line on the terminal. The next message is one line."""


def _print(result: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print(json.dumps(_plain(result)))
        return
    for name, value in result.items():
        print(f"{name.replace('_', ' ')}: {'unknown' if value is None else value}")


def _plain(fields: dict[str, Any]) -> dict[str, Any]:
    """The fields with NaN, which JSON does not have, as None."""
    return {
        k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in fields.items()
    }
