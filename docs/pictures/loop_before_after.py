"""Draws loop_before_after.png: a section through the ground of a flight whose chain drifts.

    python docs/pictures/loop_before_after.py FLIGHT_DIR OUT_DIR

``FLIGHT_DIR`` is made by ``skyrelief simulate --pattern legs``. Each keyframe's step climbs a
few centimetres too much and turns a little, as a badly calibrated camera's would; positions
and heights are not used, so that nothing but loops can mend it. The flight is replayed without
and with loops, and the ground that more than one leg saw is drawn across the legs.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from typer.testing import CliRunner

from recon import se3
from recon.camera_model import rays
from recon.graph.trajectory import Trajectory
from recon.types import F64
from service.cli import app
from service.sim.truth import read_truth
from service.stream.store import ScanStore

DRIFT = se3.exp(np.array([0.0, 0.0, 0.001, 0.0, 0.0, 0.15]))
"""Of each step, in the camera's frame: rad, then metres."""

SPREAD = np.diag([1.5e-3**2] * 3 + [0.15**2] * 3)
STRIP_M, REACH_M, HEIGHT_M = 1.5, 75.0, 14.0
SIZE = (1200, 330)  # of one section, px
COLOURS = ((60, 60, 220), (60, 160, 60), (220, 120, 40))


class Drifting(Trajectory):
    """A trajectory whose chain is spoilt on its way in."""

    def __init__(self) -> None:
        super().__init__()
        self._last: tuple[F64, F64] | None = None

    def add(self, seq, segment, T_map_camera, prior, height, time_ns, covariance):  # type: ignore[no-untyped-def]
        """The same keyframe after a step that drifts."""
        spoilt = T_map_camera
        if self._last is not None:
            spoilt = self._last[1] @ DRIFT @ se3.inverse(self._last[0]) @ T_map_camera
        self._last = (T_map_camera, spoilt)
        super().add(seq, segment, spoilt, prior, height, time_ns, covariance + SPREAD)


def replay(flight: Path, out: Path, loops: bool) -> None:
    """Replay the flight into ``out``."""
    words = ["replay", str(flight / "flight.mp4"), "--telemetry", str(flight / "flight.tlog")]
    words += ["--camera-model", str(flight / "camera.yaml"), "--out", str(out), "--json"]
    for setting in ("gnss=false", "altitude=false", f"loops={str(loops).lower()}"):
        words += ["--set", f"fusion.{setting}"]
    result = CliRunner().invoke(app, [*words, "--set", "scan.assumed_agl_m=60"])
    if result.exit_code:
        raise SystemExit(result.output)


def section(scan: Path, flight: Path) -> np.ndarray:
    """(H, W, 3) picture of the ground across the legs, one colour per leg."""
    truth = read_truth(flight)
    start = truth.poses[0][:3, 3]
    ahead = truth.poses[len(truth.poses) // 8][:3, 3] - start
    ahead /= np.linalg.norm(ahead)
    picture = np.full((SIZE[1], SIZE[0], 3), 255, np.uint8)
    with ScanStore.open(scan / "scan.db") as store:
        keyframes = list(store.keyframes())
        first = keyframes[0].pose.T_world_camera
    legs = np.array([k.pose.T_world_camera[:3, 0] @ first[:3, 0] > 0 for k in keyframes])
    number = np.r_[0, np.cumsum(legs[1:] != legs[:-1])]
    along = np.array([(k.pose.T_world_camera[:3, 3] - first[:3, 3]) @ ahead for k in keyframes])
    middle = 0.5 * (along.min() + along.max())
    across = np.array([-ahead[1], ahead[0], 0.0])
    ground = first[2, 3] - float(np.nanmedian(keyframes[0].depth.depth_m))
    for keyframe, leg in zip(keyframes, number, strict=True):
        depth = keyframe.depth
        v, u = np.nonzero(np.isfinite(depth.depth_m))
        points = rays(depth.K, np.column_stack([u, v]).astype(np.float64))
        world = se3.transform(keyframe.pose.T_world_camera, points * depth.depth_m[v, u, None])
        off = world - first[:3, 3]
        off = off[np.abs(off @ ahead - middle) < STRIP_M]
        x = (off @ across / REACH_M + 1.0) * 0.5 * SIZE[0]
        y = SIZE[1] * (0.75 - (off[:, 2] + first[2, 3] - ground) / HEIGHT_M)
        for place in np.rint(np.column_stack([x, y])).astype(int):
            cv2.circle(picture, place.tolist(), 1, COLOURS[int(leg) % 3], -1)
    return picture


def main() -> None:
    """Replay twice and draw both sections, one above the other."""
    flight, out = Path(sys.argv[1]), Path(sys.argv[2])
    import service.onboard.dense

    vars(service.onboard.dense)["Trajectory"] = Drifting
    rows = []
    for loops, title in ((False, "without loops"), (True, "with loops")):
        replay(flight, out / title.replace(" ", "_"), loops)
        row = section(out / title.replace(" ", "_"), flight)
        cv2.putText(row, title, (14, 34), cv2.FONT_HERSHEY_SIMPLEX, 0.9, (0, 0, 0), 2)
        scale = SIZE[0] / (2 * REACH_M)
        cv2.line(row, (14, 316), (14 + round(10 * scale), 316), (0, 0, 0), 2)
        cv2.putText(row, "10 m across, 2 m up", (24 + round(10 * scale), 321),
                    cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1)  # fmt: skip
        cv2.line(row, (14, 316), (14, 316 - round(2 * SIZE[1] / HEIGHT_M)), (0, 0, 0), 2)
        rows.append(row)
    line = np.full((4, SIZE[0], 3), 180, np.uint8)
    cv2.imwrite(str(Path(__file__).with_suffix(".png")), np.vstack([rows[0], line, rows[1]]))


if __name__ == "__main__":
    main()
