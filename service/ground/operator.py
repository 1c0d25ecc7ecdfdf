"""The operator's side of MAVLink: orders to the companion and its status, by mavsdk."""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from mavlink.wire.ports import parse_link
from service.errors import InputError, OutsideError
from service.packages import needing

log = logging.getLogger(__name__)

ONBOARD, CAMERA = 191, 100
START_SCAN, STOP_SCAN, CAPTURE, BASELINE, USER_1, REQUEST = 2500, 2501, 2000, 206, 31010, 512
GROUND_STATION = (245, 190)
POLL_S = 0.05


ORDERS: Mapping[str, tuple[int, int, tuple[float, ...]]] = {
    "start": (START_SCAN, CAMERA, ()),
    "stop": (STOP_SCAN, CAMERA, ()),
    "photo": (CAPTURE, CAMERA, (0, 0, 1)),
    "baseline": (BASELINE, CAMERA, ()),  # and the metres that are given
    "pause": (USER_1, ONBOARD, (1,)),
    "resume": (USER_1, ONBOARD, (2,)),
    "clear": (USER_1, ONBOARD, (3,)),
    "finalise": (USER_1, ONBOARD, (5,)),
    "selftest": (USER_1, ONBOARD, (6,)),
}
"""Action to command, component and parameters. The next action is one line."""

RESULTS = (
    "accepted",
    "rejected for now",
    "denied",
    "not supported",
    "failed",
    "in progress",
    "cancelled",
)


def _quieten() -> None:
    """mavsdk's own log goes to our log, as debugging, instead of standard error."""
    from mavsdk.logging import log_subscribe  # type: ignore[import-untyped, unused-ignore]

    def pass_on(level: Any, text: str, *_: object) -> bool:
        log.debug("mavsdk: %s", text)
        return True

    log_subscribe(pass_on)


@dataclass(frozen=True, slots=True)
class Ack:
    system: int
    component: int
    result: int

    @property
    def text(self) -> str:
        return RESULTS[self.result] if self.result < len(RESULTS) else f"result {self.result}"


def mavsdk_url(link: str) -> str:
    """A link in the notation of ``mavlink.links`` as mavsdk writes it; any other as it is."""
    if "://" in link:
        return link
    try:
        spec = parse_link(link)
    except ValueError:
        return link
    return f"{'tcpout' if spec.kind == 'tcp' else spec.kind}://{spec.place}:{spec.number}"


class Operator:
    """A connection to one vehicle with our companion on it; use it in a ``with``."""

    def __init__(self, endpoint: str, system: int | None, timeout_s: float) -> None:
        with needing("ctl"):
            from mavsdk import (  # type: ignore[import-untyped, unused-ignore]
                ComponentType,
                Configuration,
                Mavsdk,
            )
            from mavsdk.plugins.mavlink_direct import (  # type: ignore[import-untyped, unused-ignore]
                mavlink_direct,
            )
        _quieten()
        self._direct_module = mavlink_direct
        kind = ComponentType.GROUND_STATION
        self._mavsdk = Mavsdk(Configuration.create_with_component_type(kind))
        self._direct: Any = None
        try:
            self._connect(endpoint)
            self._system = self._find(system, endpoint, timeout_s)
        except (InputError, OutsideError):
            self._mavsdk.destroy()
            raise
        self._direct = mavlink_direct.MavlinkDirect(self._system)

    def _connect(self, endpoint: str) -> None:
        from mavsdk import ConnectionResult

        result = self._mavsdk.add_any_connection(mavsdk_url(endpoint))
        if result != ConnectionResult.SUCCESS:
            raise InputError(
                f"{endpoint}: no connection ({getattr(result, 'name', result)}); "
                "use udpin://0.0.0.0:14550, tcpout://HOST:PORT or serial:///dev/ttyUSB0:57600"
            )

    def _find(self, system: int | None, endpoint: str, timeout_s: float) -> Any:
        deadline = time.monotonic() + timeout_s
        heard: set[int] = set()
        while time.monotonic() < deadline:
            for candidate in self._mavsdk.get_systems():
                number = candidate.get_system_id()
                heard.add(number)
                components = candidate.component_ids()
                if system in (None, number) and ONBOARD in components and CAMERA in components:
                    return candidate
            time.sleep(POLL_S)
        who = f"systems {', '.join(map(str, sorted(heard)))}, but no companion" if heard else "none"
        raise OutsideError(
            f"{endpoint}: no skyrelief companion heard in {timeout_s:g} s (heard {who}); "
            "is the daemon running and its link to the autopilot forwarded?"
        )

    def __enter__(self) -> Operator:
        return self

    def __exit__(self, *_: object) -> None:
        self._direct.destroy()
        self._mavsdk.destroy()

    @property
    def system(self) -> int:
        number: int = self._system.get_system_id()
        return number

    def command(self, number: int, component: int, params: tuple[float, ...] = ()) -> Ack:
        """Send a command and wait for the final answer of the component asked.

        OutsideError when nothing answers, or another component does: an autopilot that has not
        heard the companion carries out its commands itself.
        """
        padded = [*params, *[0.0] * (7 - len(params))]
        fields = {
            "target_system": self.system,
            "target_component": component,
            "command": number,
            "confirmation": 0,
            **{f"param{k}": value for k, value in enumerate(padded, 1)},
        }
        others: list[Ack] = []

        def overhear(message: Any, _: Any = None) -> None:
            answer = parse_fields(message.fields_json)
            if message.component_id != component and answer.get("command") == number:
                result = answer.get("result", 4)
                others.append(Ack(message.system_id, message.component_id, int(result)))

        module = self._direct_module
        handle = self._direct.subscribe_message("COMMAND_ACK", overhear)
        message = module.MavlinkMessage(
            "COMMAND_LONG", *GROUND_STATION, self.system, component, json.dumps(fields)
        )
        try:
            answer = self._direct.send_command(message)
        except module.MavlinkDirectError as error:
            if others:
                raise OutsideError(
                    f"component {others[0].component} of system {others[0].system} answered "
                    f"({others[0].text}) instead of component {component}: the autopilot does not "
                    "know the companion's link"
                ) from error
            raise OutsideError(
                f"no answer from component {component} of system {self.system}; "
                "the link to the vehicle may be down"
            ) from error
        finally:
            self._direct.unsubscribe_message(handle)
        result = int(json.loads(answer.fields_json)["result"])
        return Ack(answer.system_id, answer.component_id, result)

    def subscribe(
        self, name: str, callback: Callable[[int, dict[str, Any]], None]
    ) -> Callable[[], None]:
        """Call back with (component, fields) for every message of a name; "" is all. Returns what
        ends the subscription."""

        def on_message(message: Any, _: Any = None) -> None:
            callback(message.component_id, parse_fields(message.fields_json))

        handle = self._direct.subscribe_message(name, on_message)
        return lambda: self._direct.unsubscribe_message(handle)

    def request(self, number: int, name: str, component: int, wait_s: float) -> dict[str, Any]:
        """Request one message of a kind; empty when it does not arrive in time."""
        found: dict[str, Any] = {}
        self.subscribe(
            name, lambda sender, fields: found.update(fields if sender == component else {})
        )
        if self.command(REQUEST, component, (float(number),)).result == 0:
            _wait(lambda: bool(found), wait_s)
        return dict(found)


def parse_fields(text: str) -> dict[str, Any]:
    """The fields of a message in mavsdk's JSON; unreadable text has none. ``null`` is NaN."""
    try:
        fields = json.loads(text)
    except ValueError:
        return {}
    if not isinstance(fields, dict):
        return {}
    return {k: math.nan if v is None else v for k, v in fields.items()}


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
    number, component, params = ORDERS[action]
    reasons: list[str] = []
    end = operator.subscribe(
        "STATUSTEXT", lambda _, fields: reasons.append(str(fields.get("text", "")))
    )
    try:
        ack = operator.command(number, component, params if metres is None else (metres,))
        if ack.result != 0:
            _wait(lambda: bool(reasons))
            why = f": {reasons[-1]}" if reasons else ""
            raise OutsideError(f"{action} {ack.text} by system {ack.system}{why}")
    finally:
        end()
    return {"action": action, "result": ack.text, "system": ack.system, "component": ack.component}


def _wait(done: Callable[[], bool], limit_s: float = 0.5) -> None:
    """Wait a moment for what comes after an answer, such as the words of a refusal."""
    deadline = time.monotonic() + limit_s
    while not done() and time.monotonic() < deadline:
        time.sleep(0.02)


def status(operator: Operator) -> dict[str, Any]:
    """The companion's report about itself, its scan and its storage."""
    beats: dict[int, dict[str, Any]] = {}
    values: dict[str, float] = {}

    def keep(sender: int, fields: dict[str, Any]) -> None:
        if sender == ONBOARD:
            values[str(fields.get("name", ""))] = float(fields.get("value", math.nan))

    operator.subscribe("HEARTBEAT", lambda sender, fields: beats.update({sender: fields}))
    operator.subscribe("NAMED_VALUE_FLOAT", keep)
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
