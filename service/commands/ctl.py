"""``skyrelief ctl``: the operator's commands to the vehicle, over MAVLink."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.commands import AsJson, choices, one_of, showing
from service.errors import InputError

if TYPE_CHECKING:
    from service.ground.operator import Operator

ACTIONS = (
    "start", "stop", "status", "baseline", "pause", "resume",
    "photo", "clear", "finalise", "selftest", "watch",
)  # fmt: skip


def ctl(
    action: Annotated[
        str, typer.Argument(help=", ".join(ACTIONS), autocompletion=choices(ACTIONS))
    ],
    metres: Annotated[float | None, typer.Argument(help="baseline: metres; 0: by altitude")] = None,
    connect: Annotated[
        str, typer.Option(help="where the vehicle's MAVLink comes from")
    ] = "udpin://0.0.0.0:14550",
    system: Annotated[int | None, typer.Option(help="the vehicle's system id")] = None,
    timeout: Annotated[float, typer.Option(help="seconds to wait for the vehicle")] = 10.0,
    seconds: Annotated[float, typer.Option(help="watch: how long; 0 until Ctrl-C")] = 0.0,
    as_json: AsJson = False,
) -> None:
    """Start, stop, watch and steer a scan from the ground."""
    _check(action, metres, timeout)
    from service.ground.operator import Operator, order, status

    with showing("ctl") as progress:
        progress(f"waiting for the vehicle at {connect}")
        heard = Operator(connect, system, timeout)
    with heard as operator:
        if action == "watch":
            _watch(operator, seconds, as_json)
        elif action == "status":
            print_result(status(operator), as_json)
        else:
            print_result(order(operator, action, metres), as_json)


def _check(action: str, metres: float | None, timeout: float) -> None:
    one_of(action, ACTIONS, "ctl")
    if (action == "baseline") != (metres is not None):
        raise InputError(
            "ctl baseline METRES takes metres (0 follows the altitude); no other action does"
        )
    if metres is not None and not (math.isfinite(metres) and metres >= 0.0):
        raise InputError(f"ctl baseline {metres:g}: give 0 or more metres")
    if not timeout > 0.0:
        raise InputError(f"ctl --timeout {timeout:g}: give seconds")


def _watch(operator: Operator, seconds: float, as_json: bool) -> None:
    """Print the companion's messages until the time is over or Ctrl-C."""
    from service.ground.operator import CAMERA, ONBOARD

    def show(name: str, sender: int, fields: dict[str, Any]) -> None:
        if sender not in (ONBOARD, CAMERA):
            return
        if as_json:
            print(json.dumps({"message": name, "component": sender, **_plain(fields)}), flush=True)
        else:
            print(LINES[name](fields), flush=True)

    for name in LINES:
        operator.subscribe(name, partial(show, name))
    end = time.monotonic() + seconds if seconds > 0.0 else math.inf
    with suppress(KeyboardInterrupt):
        while time.monotonic() < end:
            time.sleep(0.1)


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


def print_result(result: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print(json.dumps(_plain(result)))
        return
    for name, value in result.items():
        if isinstance(value, float):
            value = f"{value:.7f}" if name.startswith(("lat", "lon")) else f"{value:.2f}"
        print(f"{name.replace('_', ' ')}: {'unknown' if value is None else value}")


def _plain(fields: dict[str, Any]) -> dict[str, Any]:
    """The fields with NaN, which JSON does not have, as None."""
    return {
        k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in fields.items()
    }
