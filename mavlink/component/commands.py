"""The commands of our components: one function each, one line in :data:`COMMANDS`.

Within its window an identical call is a retransmission. Queries have no window and may be
repeated at will.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Protocol

from mavlink.component.camera import MIN_INTERVAL_S, CameraComponent
from mavlink.component.command_desk import Call, Command
from mavlink.component.control import (
    ACCEPTED,
    Answer,
    Handled,
    Phase,
    Power,
    Result,
    ScanControl,
    Work,
)
from mavlink.component.parameters import Parameters
from mavlink.wire.first_beat import CAMERA, ONBOARD
from mavlink.wire.messages import Stream

MAX_SERIES_INTERVAL_S = 3600.0
MAX_SHOTS = 100_000
MIN_MESSAGE_US, MAX_MESSAGE_US = 20_000, 3.6e9
GET_MESSAGE_INTERVAL = 510
PAUSE, RESUME, CLEAR_MAP, BASELINE, FINALISE, SELF_TEST, START, STOP = range(1, 9)
"""Actions of USER_1, by param 1."""

STOPS: dict[int, tuple[int, tuple[float, ...]]] = {
    2501: (0, ()),
    2001: (0, ()),
    200: (4, (0.0,)),
    31010: (1, (FINALISE, STOP)),
}
"""Stop commands: number to (parameter, values) that make it a stop (0: always)."""


class Host(Protocol):
    """What commands act on: the companion computer's components."""

    control: ScanControl
    camera: CameraComponent
    parameters: Parameters
    streams: Mapping[tuple[int, int], Stream]

    def when_disarmed(self, what: str, act: Callable[[], Handled]) -> Handled: ...

    def send_requested(self, component: int, number: int, index: int, link: int) -> bool: ...

    def send_interval(self, component: int, number: int, link: int) -> None: ...


def is_stop(call: Call) -> bool:
    """True for a call that stops something: it is executed however often it arrives."""
    k, values = STOPS.get(call.number, (1, ()))
    return k == 0 or call.param(k, math.nan) in values


# The scan.


def start_scan(call: Call, host: Host) -> Handled:
    """VIDEO_START_CAPTURE: start or resume a scan; a second start changes nothing. Param 2 requests
    CAMERA_CAPTURE_STATUS at that rate in Hz (0: none) until the scan ends."""
    return _start(call, host, call.param(2, 0.0))


def stop_scan(call: Call, host: Host) -> Handled:
    """VIDEO_STOP_CAPTURE: close the scan; also accepted when none runs."""
    return _stop(host, host.control.stop_scan)


def control_video(call: Call, host: Host) -> Handled:
    """DO_CONTROL_VIDEO, the old command to start (param 4 = 1 or 2) and stop (0) recording."""
    recording = call.param(4, -1.0)
    if recording in (1.0, 2.0):
        return _start(call, host)
    if recording == 0.0:
        return _stop(host, host.control.stop_scan)
    return Answer(Result.DENIED, "DO_CONTROL_VIDEO: param 4 must be 0, 1 or 2")


def _start(call: Call, host: Host, status_hz: float = 0.0) -> Handled:
    """Start a scan unless one takes frames, and stream the camera's status at a rate."""
    is_scanning = host.control.status().phase is Phase.SCANNING
    handled = ACCEPTED if is_scanning else host.control.start_scan()
    if isinstance(handled, Work) or handled.result is Result.ACCEPTED:
        host.camera.stream_while_recording(call.source, status_hz)
    return handled


def _stop(host: Host, how: Callable[[], Handled]) -> Handled:
    """End the scan, its retries and the series of photos. ``how`` is the control's method of
    stopping. It is called in every state, because a scan may be pending although none runs."""
    handled = how()
    host.camera.stop_shooting()
    return handled


def set_baseline(call: Call, host: Host) -> Handled:
    """DO_SET_CAM_TRIGG_DIST: set the virtual stereo baseline. Param 1: metres, 0 lets it follow the
    altitude; param 3 = 1 takes a photo now."""
    answer = host.parameters.change("SR_BASELINE_M", call.param(1, 0.0))
    if answer.result is Result.ACCEPTED and call.param(3, 0.0) == 1.0:
        host.camera.shoot()
    return answer


def user(call: Call, host: Host) -> Handled:
    """USER_1 to the onboard computer: actions without a standard command, by param 1.

    1 pause, 2 resume, 3 clear the map, 4 baseline of param 2 metres (0: automatic),
    5 finalise, 6 self-test, 7 start a scan, 8 stop it.
    """
    control, action = host.control, call.param(1, 0.0)
    if action in (PAUSE, RESUME):
        if not control.status().is_recording:
            return Answer(Result.TEMPORARILY_REJECTED, "no scan is running")
        return control.pause() if action == PAUSE else control.resume()
    if action == CLEAR_MAP:
        return control.clear_map()
    if action == BASELINE:
        return host.parameters.change("SR_BASELINE_M", call.param(2, 0.0))
    if action == SELF_TEST:
        if control.status().phase is not Phase.IDLE:
            return Answer(Result.TEMPORARILY_REJECTED, "stop the scan before the self-test")
        return control.self_test()
    if action == START:
        return _start(call, host)
    if action in (FINALISE, STOP):
        return _stop(host, control.finalise if action == FINALISE else control.stop_scan)
    return Answer(Result.DENIED, "USER_1: unknown action, use 1 to 8")


# Photos.


def start_capture(call: Call, host: Host) -> Handled:
    """IMAGE_START_CAPTURE: one photo now, or several at an interval.

    Param 2: interval in s, param 3: count (0: until stopped), param 4: sequence. A numbered single
    shot that is repeated within seconds is taken once. Without a number, a repetition within a
    moment is the same call received on two links.
    """
    host.camera.show_status()  # a ground station's button waits for it, whatever the answer
    interval_s, count = call.param(2, 0.0), call.param(3, 1.0)
    if not 0.0 <= interval_s <= MAX_SERIES_INTERVAL_S or not 0.0 <= count <= MAX_SHOTS:
        return Answer(Result.DENIED, "photo refused: interval or count out of range")
    if count == 1.0:
        number = call.param(4, 0.0)
        return host.camera.shoot_once(call.source, number) if number > 0.0 else host.camera.shoot()
    if interval_s < MIN_INTERVAL_S:
        return Answer(Result.DENIED, "photo refused: interval too short")
    return host.camera.shoot_every(interval_s, int(count))


def stop_capture(call: Call, host: Host) -> Handled:
    """IMAGE_STOP_CAPTURE: end a series of photos; also accepted when there is none."""
    host.camera.stop_shooting()
    host.camera.show_status()
    return ACCEPTED


def digicam(call: Call, host: Host) -> Handled:
    """DO_DIGICAM_CONTROL: one photo when param 5 = 1 (ArduPilot's CAM1_TYPE=5 sends it). Zoom,
    focus and session are ignored."""
    host.camera.show_status()
    return host.camera.shoot() if call.param(5, 0.0) == 1.0 else Answer(Result.UNSUPPORTED)


def set_mode(call: Call, host: Host) -> Handled:
    """SET_CAMERA_MODE by param 2: always video (1), in which photos are taken, too."""
    return ACCEPTED if call.param(2, -1.0) == 1.0 else Answer(Result.DENIED)


# The computer and its storage.


def reboot(call: Call, host: Host) -> Handled | None:
    """PREFLIGHT_REBOOT_SHUTDOWN of the companion; refused unless the vehicle is disarmed. Param 2:
    1 reboots, 2 shuts down; param 3 = 1 with param 4 = 191 restarts the service."""
    action = {1.0: Power.REBOOT, 2.0: Power.SHUT_DOWN}.get(call.param(2, 0.0))
    if action is None and call.param(3, 0.0) == 1.0 and call.param(4, 0.0) == ONBOARD:
        action = Power.RESTART_SERVICE
    if action is None:
        return None  # for the autopilot or another component
    return host.when_disarmed(action.value, partial(host.control.power, action))


def erase(call: Call, host: Host) -> Handled:
    """STORAGE_FORMAT: erase the finished scans; refused while scanning or unless disarmed. Param 1:
    storage (1, or 0 for all), param 2 = 1 erases, param 3 = 1 resets the count."""
    if call.param(1, 0.0) not in (0.0, 1.0) or call.param(2, 0.0) != 1.0:
        return Answer(Result.DENIED, "erase refused: needs storage 1, param 2 = 1")

    def act() -> Handled:
        refusal = _unless_idle(host, "erase")
        if refusal is None and call.param(3, 0.0) == 1.0:
            host.camera.reset_image_log()
        return refusal or host.control.erase_scans()

    return _unless_idle(host, "erase") or host.when_disarmed("erase", act)


def _unless_idle(host: Host, what: str) -> Answer | None:
    """The refusal while a scan runs, waits or is being closed."""
    if host.control.status().phase is Phase.IDLE:
        return None
    return Answer(Result.TEMPORARILY_REJECTED, f"{what} refused while scanning")


def reset_settings(call: Call, host: Host) -> Handled:
    """RESET_CAMERA_SETTINGS: reset every parameter (param 1 = 1); refused while scanning."""
    if call.param(1, 0.0) != 1.0:
        return Answer(Result.DENIED, "reset refused: param 1 must be 1")
    refusal = _unless_idle(host, "reset")
    if refusal is None:
        host.parameters.reset()
    return refusal or ACCEPTED


# Queries.


def request_message(call: Call, host: Host) -> Handled | None:
    """REQUEST_MESSAGE: send the message of a number (param 1) from the addressed component.

    UNSUPPORTED when the component has no such message. A broadcast is answered by the first
    component that has it.
    """
    asked = (CAMERA, ONBOARD) if call.is_broadcast else (call.target.component,)
    number = int(call.param(1, -1.0))
    index = int(max(-1.0, min(2.0**31, call.param(2, 0.0))))
    if any(host.send_requested(c, number, index, call.link) for c in asked):
        return ACCEPTED
    return None if call.is_broadcast else Answer(Result.UNSUPPORTED)


CAMERA_MESSAGES = {521: 259, 522: 260, 525: 261, 527: 262, 2504: 269, 2505: 270}
"""Older camera queries of older ground stations: command to message."""


def request_camera(call: Call, host: Host) -> Handled:
    """Send the message that the command requests, whatever its parameter: some ground stations
    set it to 0, which is no request by the protocol."""
    sent = host.send_requested(CAMERA, CAMERA_MESSAGES[call.number], 0, call.link)
    return ACCEPTED if sent else Answer(Result.UNSUPPORTED)


def message_interval(call: Call, host: Host) -> Handled | None:
    """SET_MESSAGE_INTERVAL and GET_MESSAGE_INTERVAL for the messages that can be streamed.

    Param 1: message, param 2: interval in us, 0 for the default, -1 for never. Of several ground
    stations' intervals the shortest counts.
    """
    if call.is_broadcast:
        return None
    component, number = call.target.component, int(call.param(1, -1.0))
    stream = host.streams.get((component, number))
    if stream is None:
        return Answer(Result.UNSUPPORTED)
    if call.number == GET_MESSAGE_INTERVAL:
        host.send_interval(component, number, call.link)
        return ACCEPTED
    interval_us = call.param(2, 0.0)
    if 0.0 < interval_us < MIN_MESSAGE_US or interval_us > MAX_MESSAGE_US:
        return Answer(Result.DENIED)
    stream.set_interval(call.source, int(interval_us))
    return ACCEPTED


_CAMERA, _ONBOARD = frozenset({CAMERA}), frozenset({ONBOARD})

COMMANDS: dict[int, Command] = {
    2500: Command(_CAMERA, 3.0, start_scan),
    2501: Command(_CAMERA, 3.0, stop_scan),
    200: Command(_CAMERA, 3.0, control_video),
    206: Command(_CAMERA | _ONBOARD, 3.0, set_baseline),
    31010: Command(_ONBOARD, 3.0, user),
    2000: Command(_CAMERA, 0.3, start_capture),
    2001: Command(_CAMERA, 3.0, stop_capture),
    203: Command(_CAMERA, 0.3, digicam),
    246: Command(_ONBOARD, 3.0, reboot),
    526: Command(_CAMERA, 3.0, erase),
    529: Command(_CAMERA, 3.0, reset_settings),
    530: Command(_CAMERA, 3.0, set_mode),
    512: Command(_CAMERA | _ONBOARD, 0.0, request_message),
    **{number: Command(_CAMERA, 0.0, request_camera) for number in CAMERA_MESSAGES},
    511: Command(_CAMERA | _ONBOARD, 0.0, message_interval),
    GET_MESSAGE_INTERVAL: Command(_CAMERA | _ONBOARD, 0.0, message_interval),
}
"""MAV_CMD to its handler. A new command is one function and one line."""
