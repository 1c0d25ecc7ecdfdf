"""Rolling shutter: when each pixel is exposed, and where it would be at the middle row's time.

An image's pose is that of its middle row. Within the readout the camera moves by a twist and
its change, which the poses of neighbouring frames give, or telemetry where they are far apart.
A free velocity per frame would be degenerate over flat ground (arXiv:2209.08503).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from recon import se3
from recon.camera_model import rays
from recon.types import F64, Camera, PosePrior

NEAR_S = 0.25  # frames further apart do not show the rotation within a readout

SHORT = 1.7
"""Times the change by one more neighbour that a rate errs: 1.6 with 5 frames a second and 3 with 15
on simulated flights; 1 to 1.8 by noise alone."""

UNKNOWN_RAD_S = 0.1  # sigma of a turn of which nothing is known

STEADY_S = 0.15
"""All frames within it shape the motion; of those further away the two nearest on each side."""


def row_times_s(camera: Camera) -> F64:
    """(N,) times of the rows from the middle, of columns where the shutter moves sideways."""
    rows = np.arange(camera.size_px[camera.shutter.axis], dtype=np.float64)
    return camera.shutter.readout_s * row_shares(camera, rows)


def row_shares(camera: Camera, px: F64 | float) -> F64:
    """(N,) share of the readout, from the middle row, at which the image's rows ``px`` (N,) are
    exposed; columns where the shutter moves sideways."""
    shutter = camera.shutter
    return np.asarray(shutter.sign * ((px + 0.5) / camera.size_px[shutter.axis] - 0.5))


class RowClock:
    """When a camera with a rolling shutter exposes what it sees."""

    def __init__(self, camera: Camera) -> None:
        """``camera`` is the one with distortion, at any size of its images. ``readout_s`` may be
        set; it is negative against the shutter's direction."""
        axis, sign = camera.shutter.axis, camera.shutter.sign
        self.readout_s = camera.shutter.readout_s
        self._sideways = axis == 0
        self._distortion = camera.distortion
        self._scale = sign * camera.K[axis, axis] / camera.size_px[axis]
        self._offset = float(row_shares(camera, camera.K[axis, 2]))

    def seconds(self, ray: F64) -> F64:
        """(N,) seconds from the middle row of undistorted rays (N, 3) with z = 1."""
        x, y = ray[:, 0], ray[:, 1]
        k1, k2, p1, p2, k3 = self._distortion
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        if self._sideways:
            distorted = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        else:
            distorted = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return np.asarray(self.readout_s * (self._scale * distorted + self._offset))


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """The motion of a camera while it reads an image.

    At ``t`` seconds from the middle row, T_camera_world is ``exp(rate t + change t^2 / 2)``
    times that of the middle row. Twists are rotation (rad), then translation.
    """

    clock: RowClock
    rate: F64  # (6,) per s
    change: F64  # (6,) per s^2
    covariance: F64 = field(default_factory=lambda: np.zeros((6, 6)))  # of the rate

    def now(self) -> Rows:
        """These rows with the readout as known now, which a search may change."""
        return self.reading(self.clock.readout_s)

    def reading(self, readout_s: float) -> Rows:
        """The same motion, with the rows read in another time."""
        clock = copy(self.clock)
        clock.readout_s = readout_s
        return replace(self, clock=clock)

    def twists(self, ray: F64) -> F64:
        """(N, 6) motion from the middle row to the rows that expose the rays (N, 3)."""
        t = self.clock.seconds(ray)[:, None]
        return np.asarray(t * self.rate + 0.5 * t * t * self.change)

    def at_middle(self, K: F64, uv: F64, inverse_depth: F64) -> F64:
        """(N, 2) where the pixels (N, 2) of the image would be at the middle row's time."""
        ray = rays(K, uv)
        return _moved(K, ray, inverse_depth, -self.twists(ray))

    def at_rows(self, K: F64, uv: F64, inverse_depth: F64) -> F64:
        """(N, 2) pixels of the image that show what the middle row's camera sees at (N, 2)."""
        ray = rays(K, uv)
        there = uv
        for _ in range(3):
            there = _moved(K, ray, inverse_depth, self.twists(rays(K, there)))
        return there


def _moved(K: F64, ray: F64, inverse_depth: F64, twist: F64) -> F64:
    """(N, 2) pixels of points on rays (N, 3) after small motions (N, 6)."""
    there = _after(ray, inverse_depth, twist)
    return np.asarray(there[:, :2] / there[:, 2:] * [K[0, 0], K[1, 1]] + K[:2, 2])


def _after(ray: F64, inverse_depth: F64, twist: F64) -> F64:
    """(N, 3) points on rays (N, 3) over their depth after small motions (N, 6), to second order."""
    step = np.cross(twist[:, :3], ray) + twist[:, 3:] * inverse_depth[:, None]
    return np.asarray(ray + step + 0.5 * np.cross(twist[:, :3], step))


def on_image(points: F64) -> F64:
    """(N, 2) where points (N, 3) are at a depth of 1."""
    return np.asarray(points[:, :2] / points[:, 2:])


def depth_share(
    view: Rows, partner: Rows, T_partner_view: F64, points: F64, readout_s: float
) -> float:
    """Error of depth over depth, rms, that a readout makes in a pair which knows of none.

    ``points`` (N, 3) of the view's camera are what both see; T_partner_view (4, 4) is that of the
    middle rows.
    """
    R, t = T_partner_view[:3, :3], T_partner_view[:3, 3]
    ray, inverse_depth = points / points[:, 2:], 1.0 / points[:, 2]
    there = ray @ R.T + t * inverse_depth[:, None]
    parallax = on_image(there) - on_image(ray @ R.T)
    there /= there[:, 2:]
    here_off, there_off = (
        on_image(_after(at, inverse_depth, rows.reading(readout_s).twists(at))) - at[:, :2]
        for at, rows in ((ray, view), (there, partner))
    )
    wrong = there_off - here_off @ R[:2, :2].T
    square = float((parallax**2).sum())
    if square == 0.0:
        return 0.0
    along = (wrong * parallax).sum(axis=1) / np.sqrt(square / len(points))
    return float(np.sqrt((along**2).sum() / square))


@dataclass(slots=True, eq=False)
class FrameRows:
    """A frame's place and its rows' motion, which gets better as its neighbours are found."""

    time_ns: int
    prior: PosePrior
    T_camera_odom: F64  # (4, 4)
    fitted: Rows | None = None  # as asked for last
    is_settled: bool = True  # no frame to come changes it
    is_measured: bool = False  # by neighbouring frames
    off: F64 | None = None  # (6,) by how much one more neighbour would change the rate
    fit: Callable[[], Rows] | None = None  # by the neighbours known now; None: done

    @property
    def rows(self) -> Rows | None:
        """The motion by what is known now, fitted once it is asked for; None: a global shutter."""
        if self.fit is not None:
            self.fitted, self.fit = self.fit(), None
        return self.fitted

    @property
    def is_awaited(self) -> bool:
        """True where frames to come still change what a rolling shutter does to this one."""
        return not self.is_settled and self.rows is not None and bool(self.rows.clock.readout_s)

    def at_middle(self, K: F64, uv: F64, inverse_depth: F64, readout_s: float | None = None) -> F64:
        """(N, 2) where the frame's pixels (N, 2) would be at the middle row's time; with another
        readout than the known one if ``readout_s`` is given."""
        rows = self.rows
        if rows is None:
            return uv
        rows = rows if readout_s is None else rows.reading(readout_s)
        return rows.at_middle(K, uv, inverse_depth)


GLOBAL_SHUTTER = FrameRows(0, PosePrior(), np.eye(4))
"""The motion of rows that are all exposed at once: none."""


class RowTrack:
    """The motion of each frame's rows, from its neighbours' poses in the odometry."""

    def __init__(self, camera: Camera, is_sought: bool = False) -> None:
        """``camera`` is the one with distortion, at any size of its images. ``is_sought``: its
        readout may yet be found. The ``clock`` of all frames is None for a global shutter."""
        self.clock = RowClock(camera) if camera.shutter.readout_s or is_sought else None
        self._frames: deque[FrameRows] = deque(maxlen=32)
        self._offs: deque[F64] = deque(maxlen=8)  # of settled frames

    @property
    def is_rolling(self) -> bool:
        return self.clock is not None

    @property
    def is_known(self) -> bool:
        """True for a rolling shutter whose readout is known or found."""
        return self.clock is not None and self.clock.readout_s != 0.0

    def needs_telemetry(self, time_ns: int) -> bool:
        """True where too few frames are near ``time_ns`` to show the turn within a readout."""
        near = sum(abs(f.time_ns - time_ns) < NEAR_S * 1e9 for f in self._frames)
        return self.is_rolling and near < 2

    def stop(self) -> None:
        """The shutter is global: frames to come need no motion of their rows."""
        self.clock = None
        self._frames.clear()

    def begin(self) -> None:
        """Forget the segment before."""
        self._frames.clear()
        self._offs.clear()

    def expect(self, time_ns: int, prior: PosePrior, T_camera_odom: F64) -> FrameRows:
        """A new frame, whose pose is about ``T_camera_odom`` (4, 4)."""
        frame = FrameRows(time_ns, prior, T_camera_odom)
        self._refresh(frame)
        return frame

    def place(self, frame: FrameRows, T_camera_odom: F64) -> None:
        """Take ``T_camera_odom`` (4, 4) for the frame's pose."""
        frame.T_camera_odom = T_camera_odom
        self._refresh(frame)

    def add(self, frame: FrameRows, T_camera_odom: F64) -> None:
        """Keep the frame with its final pose; it gives the motion of those before it."""
        if self.clock is None:
            return
        self.place(frame, T_camera_odom)
        self._frames.append(frame)
        for before in list(self._frames)[:-1]:
            if not before.is_settled:
                self._refresh(before)
                if before.is_settled and before.rows is not None and before.off is not None:
                    self._offs.append(before.off)

    def _refresh(self, frame: FrameRows) -> None:
        """From now on the motion of its rows is by its neighbours and by telemetry."""
        if self.clock is None:
            return
        times = np.array([(f.time_ns - frame.time_ns) * 1e-9 for f in self._frames])
        before, later = np.flatnonzero(times < 0), np.flatnonzero(times > 0)
        chosen = np.abs(times) <= STEADY_S
        chosen[before[-2:]] = chosen[later[:2]] = True
        near = np.flatnonzero(chosen & (times != 0) & (np.abs(times) < NEAR_S))
        after = int((times[near] > 0).sum())
        since_s = float(times[-1]) if times.size else 0.0
        frame.is_settled = since_s >= NEAR_S or (after >= 2 and since_s >= STEADY_S)
        frame.is_measured = near.size >= 2
        if near.size < (1 if frame.prior.turn_rad_s is None else 2):
            frame.fit = partial(_by_telemetry, frame, self.clock)
            return
        degree = min(near.size, 2 + min(after, near.size - after, 2))
        rest = np.flatnonzero(times)
        rest = rest[~np.isin(rest, near)]
        more = np.append(near, rest[np.abs(times[rest]).argsort(kind="stable")[:1]])
        there = [self._frames[n].T_camera_odom for n in more]
        frame.fit = partial(
            _by_neighbours, frame, self.clock, times[more], there, near.size, degree,
            tuple(self._offs),
        )  # fmt: skip


def _by_neighbours(
    frame: FrameRows, clock: RowClock, times: F64, there: Sequence[F64], near: int, degree: int,
    offs: Sequence[F64],
) -> Rows:  # fmt: skip
    """The motion by the first ``near`` of neighbours (N,) seconds later at poses (4, 4) each, and
    what one more would do to its rate."""
    from_odom = se3.inverse(frame.T_camera_odom)
    twists = np.array([se3.log(T @ from_odom) for T in there])
    rate, change = _polynomial(times[:near], twists[:near], degree)
    if times.size > near:
        frame.off = _polynomial(times, twists, degree + 1)[0] - rate
    return _with_telemetry(frame.prior, Rows(clock, rate, change, _covariance(frame.off, offs)))


def _covariance(off: F64 | None, before: Sequence[F64]) -> F64:
    """(6, 6) of a rate that one more neighbour changes by ``off`` (6,): half by that, half by the
    frames ``before``."""
    own = [] if off is None else [off]
    parts = [np.transpose(part) @ part / len(part) for part in (own, before) if part]
    return np.asarray(SHORT**2 * np.mean(parts, axis=0)) if parts else np.zeros((6, 6))


def _polynomial(t: F64, twists: F64, degree: int) -> tuple[F64, F64]:
    """(6,) first and second derivative at 0 of a polynomial that is 0 there, of (N, 6) at (N,)."""
    scale = float(np.abs(t).max())
    A = (t[:, None] / scale) ** np.arange(1, degree + 1)
    c = np.linalg.lstsq(A, twists, rcond=None)[0]
    second = 2.0 * c[1] / scale**2 if degree > 1 else np.zeros(6)
    return np.asarray(c[0] / scale), np.asarray(second)


def _by_telemetry(frame: FrameRows, clock: RowClock) -> Rows:
    """The motion by the prior's rotation and velocity; unknown parts are zero."""
    prior, rate, sigma = frame.prior, np.zeros(6), UNKNOWN_RAD_S
    if prior.turn_rad_s is not None:
        rate[:3], sigma = -prior.turn_rad_s, prior.sigma_turn_rad_s
    if prior.velocity_m_s is not None:
        rate[3:] = -frame.T_camera_odom[:3, :3] @ prior.velocity_m_s
    return Rows(clock, rate, np.zeros(6), np.diag([sigma**2] * 3 + [0.0] * 3))


def _with_telemetry(prior: PosePrior, rows: Rows) -> Rows:
    """Motion by neighbours and by telemetry's turn, where there is one, each by its weight. The
    velocity stays: few samples make the covariance, too few for the correlation of both."""
    if prior.turn_rad_s is None:
        return rows
    P, rate, spread = rows.covariance[:3, :3], rows.rate.copy(), np.zeros((6, 6))
    gain = P @ np.linalg.inv(P + prior.sigma_turn_rad_s**2 * np.eye(3))
    rate[:3] -= gain @ (rate[:3] + prior.turn_rad_s)
    spread[:3, :3], spread[3:, 3:] = P - gain @ P, rows.covariance[3:, 3:]
    return replace(rows, rate=rate, covariance=spread)
