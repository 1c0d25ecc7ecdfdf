"""The scan as a MAVLink camera (component 100, camera protocol v2).

Recording means scanning; a photo is one keyframe. The camera's status is sent before and after
every requested keyframe, because a ground station's button stays busy otherwise.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from mavlink.component.control import ACCEPTED, Answer, Handled, Result, ScanControl, Work
from mavlink.component.metadata import DEFINITION_URI, MODEL, VENDOR, VERSION
from mavlink.wire.dialect import dialect
from mavlink.wire.first_beat import CAMERA
from mavlink.wire.messages import Address, SendQueue, Streams

S = 1_000_000_000
CAPABILITIES = 1 | 2 | 8 | 16  # video, image, and each during the other
CAPTURE_STATUS = 262
SHOT_TIMEOUT_NS = 10 * S
MIN_INTERVAL_S = 0.2  # of a series of shots
KEPT = 500  # keyframes that can be requested again
UNKNOWN_I32 = 0


@dataclass(frozen=True, slots=True)
class KeyframeReport:
    """A keyframe as reported to ground stations; unknown parts are None."""

    unix_us: int = 0
    lat_deg: float | None = None
    lon_deg: float | None = None
    alt_amsl_m: float | None = None
    alt_agl_m: float | None = None
    q_ned_camera_wxyz: tuple[float, float, float, float] | None = None  # of the head, FRD
    ok: bool = True


class CameraComponent:
    """The camera's messages, shots and series. ``now`` is our time in ns."""

    def __init__(
        self,
        definition_version: int,
        control: ScanControl,
        outbox: SendQueue,
        streams: Streams,
        boot_ms: Callable[[], int],
        now: Callable[[], int],
    ) -> None:
        self._definition_version = definition_version
        self._control = control
        self._outbox = outbox
        self._streams = streams
        self._boot_ms = boot_ms
        self._now = now
        self._count = 0
        self._kept: deque[tuple[int, int, KeyframeReport]] = deque(maxlen=KEPT)  # index, boot ms
        self._shots: deque[tuple[Address, float]] = deque(maxlen=64)
        self._waiting: deque[int] = deque()  # times at which pending shots expire
        self._series: tuple[float, int] | None = None  # interval in s, shots left (0: unlimited)
        self._next_shot_ns = 0
        streams.add(CAMERA, CAPTURE_STATUS, -1, self.send_capture_status)

    # Called by commands.

    def stream_status(self, hz: float) -> None:
        """Send CAMERA_CAPTURE_STATUS at a rate; 0 stops it."""
        interval = -1 if hz <= 0.0 else max(20_000, round(1e6 / max(hz, 1e-3)))
        self._streams.set_interval(CAMERA, CAPTURE_STATUS, interval)

    def is_new_shot(self, source: Address, sequence: float) -> bool:
        """True the first time a numbered shot of a sender arrives."""
        if (source, sequence) in self._shots:
            return False
        self._shots.append((source, sequence))
        return True

    def shoot(self) -> Handled:
        """Request one keyframe; it is reported once it exists."""
        handled = self._control.capture_keyframe()
        if isinstance(handled, Work) or handled.result is Result.ACCEPTED:
            self._waiting.append(self._now() + SHOT_TIMEOUT_NS)
            self.send_capture_status()
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
        """Stop the series."""
        self._series = None
        self.send_capture_status()

    def reset_image_log(self) -> None:
        """Restart the keyframe count at zero."""
        self._count = 0
        self._kept.clear()

    # Called by the service.

    def report(self, keyframe: KeyframeReport) -> int:
        """Publish a keyframe; returns its index."""
        index = self._count
        self._count += 1
        boot_ms = self._boot_ms()
        self._kept.append((index, boot_ms, keyframe))
        self._outbox.put(CAMERA, self._image_captured(index, boot_ms, keyframe))
        if self._waiting:
            self._waiting.popleft()
            self.send_capture_status()
        return index

    def tick(self, now_ns: int) -> None:
        """Take the next shot of a series; drop expired shots."""
        while self._waiting and now_ns >= self._waiting[0]:
            self._waiting.popleft()
            failed = KeyframeReport(ok=False)
            self._outbox.put(CAMERA, self._image_captured(self._count, self._boot_ms(), failed))
            self.send_capture_status()
        if self._series is None or now_ns < self._next_shot_ns:
            return
        interval_s, left = self._series
        self._next_shot_ns = max(now_ns, self._next_shot_ns + round(interval_s * S))
        self._series = None if left == 1 else (interval_s, max(0, left - 1))
        handled = self.shoot()
        if isinstance(handled, Answer) and handled.result is not Result.ACCEPTED:
            self._series = None

    # Messages.

    def message(self, number: int, index: int) -> object | None:
        """The message with this number; None when the camera has no such message."""
        if number == 263:
            kept = next((kept for kept in self._kept if kept[0] == index), None)
            return None if kept is None else self._image_captured(*kept)
        maker = self._MAKERS.get(number)
        return None if maker is None else maker(self)

    def send_capture_status(self) -> None:
        """Send CAMERA_CAPTURE_STATUS to everyone."""
        self._outbox.put(CAMERA, self._capture_status())

    def _information(self) -> object:
        major, minor, patch = VERSION
        return dialect.MAVLink_camera_information_message(
            self._boot_ms(),
            list(VENDOR.encode().ljust(32, b"\0")),
            list(MODEL.encode().ljust(32, b"\0")),
            patch << 16 | minor << 8 | major,
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

    def _capture_status(self) -> object:
        status = self._control.status()
        busy, series = bool(self._waiting), self._series is not None
        image_status = (3 if busy else 2) if series else int(busy)
        return dialect.MAVLink_camera_capture_status_message(
            self._boot_ms(),
            image_status,
            int(status.is_recording),
            0.0 if self._series is None else self._series[0],
            status.recording_ms & 0xFFFFFFFF,
            status.storage_free_mib,
            self._count,
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
            b"",  # no address of the image
        )

    _MAKERS = {  # noqa: RUF012
        259: _information,
        260: _settings,
        261: _storage,
        262: _capture_status,
    }


def _scaled(value: float | None, scale: float) -> int:
    if value is None or not math.isfinite(value):
        return UNKNOWN_I32
    return max(-(2**31), min(2**31 - 1, round(value * scale)))
