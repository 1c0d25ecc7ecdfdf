"""The scan as a MAVLink camera (component 100, camera protocol v2).

Recording means scanning; a photo is one image of a scan with its tag. The camera's status is sent
whenever it changes and after each request of a photo, because a ground station's buttons follow it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from mavlink.component.control import (
    ACCEPTED,
    Answer,
    Handled,
    Result,
    ScanControl,
    ScanStatus,
    Work,
)
from mavlink.component.metadata import DEFINITION_URI, MODEL, VENDOR, VERSION
from mavlink.component.status import WARNING
from mavlink.wire.dialect import dialect
from mavlink.wire.first_beat import CAMERA
from mavlink.wire.messages import Address, SendQueue, Stream

S = 1_000_000_000
CAPABILITIES = 1 | 2 | 8 | 16  # video, image, and each during the other
CAPTURE_STATUS = 262
MAJOR, MINOR, _ = VERSION
FIRMWARE = MAJOR << 24 | MINOR << 16 | MINOR << 8 | MAJOR
"""MAVLink and ArduPilot read it from the lowest byte on, QGroundControl from the highest."""
SHOT_TIMEOUT_NS = 10 * S
REPEATED_NS = 3 * S  # a sender without an acknowledgement repeats its command sooner
MAX_SENDERS = 16
MIN_INTERVAL_S = 0.2  # of a series of shots
KEPT = 500  # keyframes that can be requested again
UNKNOWN_I32 = 0
UNKNOWN_PLACE = (2**31 - 1,) * 3  # of CAMERA_FOV_STATUS


@dataclass(frozen=True, slots=True)
class KeyframeReport:
    """A photo or a keyframe as reported to ground stations; unknown parts are None."""

    unix_us: int = 0
    lat_deg: float | None = None
    lon_deg: float | None = None
    alt_amsl_m: float | None = None
    alt_agl_m: float | None = None
    q_ned_camera_wxyz: tuple[float, float, float, float] | None = None  # of the head, FRD
    ok: bool = True
    file: str = ""  # of a photo, in the folder of scans


class CameraComponent:
    """The camera's messages, shots and series. ``now`` is our time in ns."""

    def __init__(
        self,
        definition_version: int,
        control: ScanControl,
        outbox: SendQueue,
        boot_ms: Callable[[], int],
        now: Callable[[], int],
        say: Callable[[int, str], None],
    ) -> None:
        """``say`` gets severity and text for the operator."""
        self._definition_version = definition_version
        self._control = control
        self._outbox = outbox
        self._boot_ms = boot_ms
        self._now = now
        self._say = say
        self._count = 0
        self._kept: deque[tuple[int, int, KeyframeReport]] = deque(maxlen=KEPT)  # index, boot ms
        self._numbered: dict[Address, tuple[float, int]] = {}  # last shot, and its time
        self._waiting: deque[int] = deque()  # times at which pending shots expire
        self._series: tuple[float, int] | None = None  # interval in s, shots left (0: unlimited)
        self._next_shot_ns = 0
        self._shown: tuple[int, int, float] | None = 0, 0, 0.0  # status as sent; None: send it
        self._is_recording = False
        self._while_recording = Stream(-1, lambda: outbox.put(CAMERA, self._capture_status()))

    # Called by commands.

    def stream_while_recording(self, subscriber: Address, hz: float) -> None:
        """Send CAMERA_CAPTURE_STATUS at a rate until the recording ends; 0: not for this one."""
        interval = -1 if hz <= 0.0 else max(20_000, round(1e6 / max(hz, 1e-3)))
        self._while_recording.set_interval(subscriber, interval)

    def shoot(self) -> Handled:
        """Request one photo; it is reported once it is taken."""
        handled = self._control.capture_keyframe()
        if isinstance(handled, Work) or handled.result is Result.ACCEPTED:
            self._waiting.append(self._now() + SHOT_TIMEOUT_NS)
        return handled

    def shoot_once(self, source: Address, number: float) -> Handled:
        """Request a photo of a sender's number, unless it has just sent the same. Its numbers may
        start over at any time, as after its restart."""
        last, now_ns = self._numbered.pop(source, None), self._now()
        is_repeated = last is not None and last[0] == number and now_ns - last[1] < REPEATED_NS
        handled = ACCEPTED if is_repeated else self.shoot()
        if isinstance(handled, Work) or handled.result is Result.ACCEPTED:
            self._numbered[source] = number, now_ns
            if len(self._numbered) > MAX_SENDERS:
                del self._numbered[next(iter(self._numbered))]
        return handled

    def shoot_every(self, interval_s: float, count: int) -> Handled:
        """Start a series; the first shot is taken now. A count of 0 means until stopped."""
        first = self.shoot()
        if isinstance(first, Answer) and first.result is not Result.ACCEPTED:
            return first
        self._series = (interval_s, count - 1 if count else 0) if count != 1 else None
        self._next_shot_ns = self._now() + round(interval_s * S)
        return ACCEPTED

    def stop_shooting(self) -> None:
        self._series = None

    def show_status(self) -> None:
        self._shown = None

    def reset_image_log(self) -> None:
        self._count = 0
        self._kept.clear()

    # Called by the service.

    def report(self, keyframe: KeyframeReport) -> int:
        """Publish a photo or a keyframe; returns its index."""
        index = self._count
        self._count += 1
        boot_ms = self._boot_ms()
        self._kept.append((index, boot_ms, keyframe))
        self._outbox.put(CAMERA, self._image_captured(index, boot_ms, keyframe))
        if self._waiting and (keyframe.file or not keyframe.ok):
            self._waiting.popleft()
            self.show_status()
        return index

    def tick(self, now_ns: int) -> None:
        """Take the next shot of a series, give up shots that do not come, and send the status
        where it has changed."""
        while self._waiting and now_ns >= self._waiting[0]:
            self._fail(1, f"no image for {SHOT_TIMEOUT_NS // S} s")
        if self._series is not None and now_ns >= self._next_shot_ns:
            self._shoot_next(self._series, now_ns)
        self._while_recording.tick(now_ns)
        self._follow_status()

    def _shoot_next(self, series: tuple[float, int], now_ns: int) -> None:
        interval_s, left = series
        self._next_shot_ns = max(now_ns, self._next_shot_ns + round(interval_s * S))
        self._series = None if left == 1 else (interval_s, max(0, left - 1))
        handled = self.shoot()
        if isinstance(handled, Answer) and handled.result is not Result.ACCEPTED:
            self._series = None

    def _fail(self, shots: int, why: str) -> None:
        if shots:
            self._say(WARNING, f"photo failed: {why}")
        for _ in range(shots):
            self.report(KeyframeReport(ok=False))

    def _follow_status(self) -> None:
        """Send the status if it is not as it was sent last: the only place that sees it change."""
        status = self._control.status()
        if self._is_recording and not status.is_recording:  # however it ended
            self._while_recording.end()
            self.stop_shooting()
            self._fail(len(self._waiting), "the scan has ended")
        self._is_recording = status.is_recording
        every_s = 0.0 if self._series is None else self._series[0]
        shown = self._image_status(), int(status.is_recording), every_s
        if shown != self._shown:
            self._shown = shown
            self._outbox.put(CAMERA, self._capture_status(status))

    # Messages.

    def message(self, number: int, index: int = 0) -> object | None:
        """The message with this number; None when the camera has no such message."""
        if number == 263:
            kept = next((kept for kept in self._kept if kept[0] == index), None)
            return None if kept is None else self._image_captured(*kept)
        maker = self._MAKERS.get(number)
        return None if maker is None else maker(self)

    def _information(self) -> object:
        return dialect.MAVLink_camera_information_message(
            self._boot_ms(),
            list(VENDOR.encode().ljust(32, b"\0")),
            list(MODEL.encode().ljust(32, b"\0")),
            FIRMWARE,
            *(math.nan,) * 3,  # focal length, sensor width and height
            *(0,) * 3,  # resolution, lens
            CAPABILITIES,
            self._definition_version,
            DEFINITION_URI.encode(),
        )

    def _settings(self) -> object:
        return dialect.MAVLink_camera_settings_message(self._boot_ms(), 1, math.nan, math.nan)

    def _storage(self) -> object:
        status = self._control.status()
        total, free = status.storage_total_mib, status.storage_free_mib
        known = total > 0.0
        return dialect.MAVLink_storage_information_message(
            self._boot_ms(),
            1,
            1,
            2 if known else 3,  # ready, or not supported
            total,
            max(0.0, total - free),
            free,
            math.nan,
            math.nan,
            254 if known else 0,  # MAV_STORAGE_TYPE_OTHER
            b"scans",
        )

    def _image_status(self) -> int:
        """Idle, one image, between two images of a series, or taking one of them."""
        return 2 * (self._series is not None) + bool(self._waiting)

    def _capture_status(self, status: ScanStatus | None = None) -> Any:
        status = status or self._control.status()
        return dialect.MAVLink_camera_capture_status_message(
            self._boot_ms(),
            self._image_status(),
            int(status.is_recording),
            0.0 if self._series is None else self._series[0],
            status.recording_ms & 0xFFFFFFFF,
            status.storage_free_mib,
            self._count,
        )

    def _field_of_view(self) -> object:
        view = self._control.view()
        camera, ground = (
            (_scaled(p[0], 1e7), _scaled(p[1], 1e7), _scaled(p[2], 1e3)) if p else UNKNOWN_PLACE
            for p in (view.camera, view.ground)
        )
        head = list(view.q_ned_camera_wxyz or (math.nan,) * 4)
        return dialect.MAVLink_camera_fov_status_message(
            self._boot_ms(), *camera, *ground, head, view.hfov_deg, view.vfov_deg
        )

    def _image_captured(self, index: int, boot_ms: int, k: KeyframeReport) -> object:
        return dialect.MAVLink_camera_image_captured_message(
            boot_ms,
            max(0, k.unix_us),
            0,
            _scaled(k.lat_deg, 1e7),
            _scaled(k.lon_deg, 1e7),
            _scaled(k.alt_amsl_m, 1e3),
            _scaled(k.alt_agl_m, 1e3),
            list(k.q_ned_camera_wxyz or (math.nan,) * 4),
            index & 0x7FFFFFFF,
            int(k.ok),
            k.file.encode("ascii", "replace"),
        )

    _MAKERS: dict[int, Callable[[CameraComponent], object]] = {  # noqa: RUF012
        259: _information,
        260: _settings,
        261: _storage,
        CAPTURE_STATUS: _capture_status,
        271: _field_of_view,
    }
    STREAMED = tuple(_MAKERS)


def _scaled(value: float | None, scale: float) -> int:
    if value is None or not math.isfinite(value):
        return UNKNOWN_I32
    return max(-(2**31), min(2**31 - 1, round(value * scale)))
