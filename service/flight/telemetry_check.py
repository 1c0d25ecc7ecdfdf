"""Telemetry checked against the images: the camera's latency and roll, the gimbal's frame.

The operator is warned once; the latency found is applied when ``camera.latency`` is "auto",
the gimbal's frame when ``mavlink.gimbal_yaw_frame`` is "auto".
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from mavlink.telemetry.gimbal import FrameVerdict, frame_by_images, is_stabilised
from mavlink.telemetry.history import VehicleHistory
from mavlink.telemetry.latency import SURE, LatencyEstimate, LatencyWatch
from mavlink.telemetry.quaternion import Quaternion
from mavlink.telemetry.samples import GimbalFrame
from recon.frames import gimbal_from_camera
from recon.se3 import quaternion_from_rotation
from recon.tracking.frame import Frame, Tracking
from recon.types import F64
from service.cameras.rig import body_from_head, stated_roll_deg
from service.config import CameraConfig
from service.scans.trust import is_another_latency

log = logging.getLogger(__name__)

LOOK_NS = 10_000_000_000
REACH_NS = 60_000_000_000  # how far back telemetry is compared with frames, at least
AHEAD_NS = 2_000_000_000  # how far ahead of the newest frame; a recording's log goes on
SLEW = 0.1  # of the time that passes, so that frames stay in order when the latency changes
UNSEEN_S = 0.05  # sigma of a latency that the images have not shown yet
ROLL_SLACK_DEG = 20.0
"""A sensor is mounted by quarter turns; images that turn otherwise against telemetry say that one
of the two is wrong."""

STILLS = 60  # images that are compared, where they come more slowly than REACH_NS holds


class TelemetryCheck:
    """Takes every tracked frame; gives the exposure times of frames, and its findings."""

    def __init__(
        self,
        camera: CameraConfig,
        history: VehicleHistory | None,
        warn: Callable[[str], None] = log.warning,
        earlier_ms: float | None = None,
    ) -> None:
        """``earlier_ms``, found by an earlier scan, is taken with "auto" until there is news."""
        self.latency: LatencyEstimate | None = None
        self.frame: FrameVerdict | None = None
        self.is_stabilised = False  # the vehicle's attitude is not the camera's
        self.image_roll_deg = stated_roll_deg(camera)
        self.reported: dict[str, str] = {}  # by subject
        self.history, self._warn = history, warn
        self._fixed = camera.mount == "fixed"
        self._earlier_ms = earlier_ms
        self.camera = camera
        self.applied_ms = self._wanted_ms()
        self.turns = LatencyWatch()  # of the images
        self._last: tuple[int, int, F64] | None = None  # stamp, segment, R_odom_camera
        self.seen_ns: int | None = None  # stamp of the newest frame
        self.next_look_ns: int | None = None  # stamp from which on all is evaluated again

    # ---- the latency in force ------------------------------------------------------------

    def set_camera(self, camera: CameraConfig) -> None:
        """Follow another ``camera.latency`` or ``latency_ms`` from the next frame on."""
        self.camera = camera

    def _wanted_ms(self) -> float:
        """The latency to apply: the measured one if configured so, else the configured one."""
        if self.camera.latency == "auto":
            if self.latency is not None and self.latency.is_settled:
                return self.latency.latency_ms
            if self._earlier_ms is not None:
                return self._earlier_ms
        return self.camera.latency_ms

    @property
    def doubt_s(self) -> float:
        """Sigma of the latency applied, by the images."""
        if self.latency is None:
            return UNSEEN_S
        off_ms = self.latency.latency_ms - self.applied_ms
        return 1e-3 * math.hypot(self.latency.sigma_ms, off_ms)

    def exposed_ns(self, stamp_ns: int) -> int:
        """When the frame of this stamp was exposed; later for every later frame."""
        passed_ms = 0.0 if self.seen_ns is None else max(0, stamp_ns - self.seen_ns) * 1e-6
        self.seen_ns = stamp_ns
        change = self._wanted_ms() - self.applied_ms
        self.applied_ms += max(-SLEW * passed_ms, min(SLEW * passed_ms, change))
        return stamp_ns - round(self.applied_ms * 1e6)

    # ---- what the images say -------------------------------------------------------------

    def add(self, stamp_ns: int, frame: Frame) -> None:
        """Add a frame's pose by vision, at its stamp; evaluate all of them now and then."""
        if self.history is None or frame.state is Tracking.SKIPPED:
            return
        last, self._last = self._last, None
        if frame.is_placed:
            T = frame.T_odom_camera
            self._last = (stamp_ns, frame.segment, T[:3, :3].copy())
            if last is not None and last[1] == frame.segment:
                self._turn(last[0], stamp_ns, last[2].T @ T[:3, :3])
        if self.next_look_ns is None:
            self.next_look_ns = stamp_ns + LOOK_NS
        elif stamp_ns >= self.next_look_ns:
            self.next_look_ns = stamp_ns + LOOK_NS
            self._look(self.history, stamp_ns)

    def _turn(self, first_ns: int, second_ns: int, R_first_second: F64) -> None:
        R_head_camera = gimbal_from_camera(self.image_roll_deg)
        R = R_head_camera @ R_first_second @ R_head_camera.T
        w, x, y, z = (float(v) for v in quaternion_from_rotation(R))
        self.turns.add(first_ns, second_ns, (w, x, y, z))

    @property
    def is_clock_sure(self) -> bool:
        """Whether the images turn with the log."""
        return self.latency is not None and self.latency.correlation >= SURE

    def finish(self) -> None:
        if self.history is not None and self.seen_ns is not None:
            self._look(self.history, self.seen_ns)

    def attitudes(self, history: VehicleHistory) -> Callable[..., list[tuple[int, Quaternion]]]:
        """Telemetry's attitudes of what the camera turns with."""
        return history.bodies if self._fixed else history.heads

    def _look(self, history: VehicleHistory, now_ns: int) -> None:
        since_ns, stills_ns = now_ns - REACH_NS, self.turns.since_ns(STILLS)
        if stills_ns is not None:
            since_ns = min(since_ns, stills_ns)
        attitudes = self.attitudes(history)(since_ns, now_ns + AHEAD_NS)
        found = self.turns.estimate(attitudes)
        self.latency = found or self.latency
        if found is not None:
            self._report_latency(found)
            if self._is_turned(history, attitudes, found):
                return  # what came before is in wrong axes
        if not self._fixed:
            settled = self.latency is not None and self.latency.is_settled
            latency = self.latency.latency_ms if settled and self.latency else self.applied_ms
            seen = frame_by_images(self.turns.long_turns, history.claimed_at, latency)
            self.frame = seen or self.frame
            self._judge_frame(history)
            self._judge_mount(history)

    def _report_latency(self, found: LatencyEstimate) -> None:
        text = f"Camera latency {found.latency_ms:.0f} ms by the images"
        if self.camera.latency == "auto" and found.is_settled:
            self._once("latency", f"{text}: applied")
        elif is_another_latency(found.latency_ms, found.sigma_ms, self.applied_ms):
            self._once("latency", f"{text}, {self.applied_ms:.0f} ms is set")

    def _is_turned(
        self, history: VehicleHistory, attitudes: list[tuple[int, Quaternion]], now: LatencyEstimate
    ) -> bool:
        """Find out once that images are turned by quarters against gimbal or mount."""
        if self.camera.image_roll_deg != "auto" or self.image_roll_deg or now.correlation < SURE:
            return False
        is_body = self._fixed or history.gimbal_frame() is None
        R_head = body_from_head(self.camera).T if is_body else np.eye(3)
        found = self.turns.image_roll(attitudes, R_head, now.latency_ms)
        roll_deg, correlation = (0.0, 0.0) if found is None else (math.degrees(found[0]), found[1])
        quarters = round(roll_deg / 90.0)
        if correlation < SURE or abs(roll_deg - 90.0 * quarters) > ROLL_SLACK_DEG or not quarters:
            return False
        self.image_roll_deg = 90.0 * (quarters % 4)
        self.turns, self._last = LatencyWatch(), None
        self._once("roll", turned_note(self.image_roll_deg))
        return True

    def _judge_frame(self, history: VehicleHistory) -> None:
        """Correct the gimbal's declared reference when the images refute it."""
        verdict, used = self.frame, history.gimbal_frame()
        if verdict is None or not verdict.decided or used not in verdict.refuted:
            return
        seen = f"Gimbal angles refer to {_WORDS[verdict.frame]} by the images"
        if history.config.yaw_frame == "auto":
            history.trust_images(verdict.frame)
            self._once("frame", f"{seen}: applied")
        else:
            self._once("frame", f"{seen}; {used.value} is set" if used else seen)

    def _judge_mount(self, history: VehicleHistory) -> None:
        """Find out that a camera whose gimbal sends nothing is on one."""
        if self.camera.mount == "auto" and history.gimbal_frame() is None:
            turns = self.turns.long_turns
            self.is_stabilised |= is_stabilised(turns, history.body_at, self.applied_ms)
        if self.is_stabilised:
            self._once("mount", STABILISED)

    def _once(self, subject: str, text: str) -> None:
        if subject not in self.reported:
            self.reported[subject] = text
            self._warn(text)

    def summary(self) -> dict[str, Any]:
        """Findings, fit for JSON; empty without telemetry."""
        if self.history is None:
            return {}
        found, frame, used = self.latency, self.frame, self.history.gimbal_frame()
        latency: dict[str, Any] = {"applied_ms": round(self.applied_ms, 1)}
        if found is not None:
            latency |= {
                "estimate_ms": round(found.latency_ms, 1),
                "sigma_ms": round(found.sigma_ms, 1),
                "correlation": round(found.correlation, 3),
                "is_settled": found.is_settled,
            }
        seen = frame.frame.value if frame is not None and frame.decided else None
        gimbal = {"used": used.value if used is not None else None, "by_pictures": seen}
        return {"camera_latency": latency} | ({"gimbal_frame": gimbal} if used is not None else {})


def turned_note(image_roll_deg: float) -> str:
    """What the images show of their roll, in words."""
    return (
        f"The images are turned clockwise by {image_roll_deg:.0f} degrees against the telemetry, "
        f"as they turn with it: applied; set camera.image_roll_deg = {image_roll_deg:.0f}"
    )


STABILISED = (
    "The images hold still while the vehicle tilts, so its attitude is not the camera's, which is "
    "taken to look as camera.mount_pitch_deg says"
)

_WORDS = {
    GimbalFrame.EARTH: "the earth",
    GimbalFrame.VEHICLE: "the vehicle's heading",
    GimbalFrame.BODY: "the vehicle's body",
    GimbalFrame.SERVO: "servos on the body",
}
