"""Draw the images of docs/concepts.md: the life of a frame, and a track that is corrected.

    python docs/concepts.py

The second is a simulated flight through the pose graph itself.
"""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

from recon import se3
from recon.posegraph.pose_graph import PoseGraph
from recon.posegraph.records import Node
from recon.types import F64, PosePrior

IMAGES = Path(__file__).resolve().parent / "images"
INK, GRAY, BLUE, GREEN, RED = "#334155", "#94a3b8", "#2563eb", "#059669", "#dc2626"

BOXES = {
    "frame": (20, 30, "image and time"),
    "followed": (190, 30, "corners, pose"),
    "view": (360, 30, "far enough on"),
    "keyframe": (530, 30, "depth, sigma, colour"),
    "chunk": (700, 30, "new surface, coded"),
    "skipped": (190, 120, "no pose stored"),
    "telemetry": (20, 210, "attitude, fixes, height"),
    "pose graph": (360, 210, "where keyframes are"),
    "re-pose": (530, 210, "a better pose"),
    "store": (700, 120, "scan.db on board"),
    "ground store": (700, 210, "the same scan.db"),
    "files": (700, 300, "cloud, maps, mesh"),
}
"""Name to the corner of its box, and what it holds."""

ARROWS = [
    ("frame", "followed"), ("followed", "view"), ("view", "keyframe"), ("keyframe", "chunk"),
    ("frame", "skipped"), ("telemetry", "pose graph"), ("view", "pose graph"),
    ("pose graph", "re-pose"), ("re-pose", "store"), ("chunk", "store"), ("store", "ground store"),
    ("ground store", "files"),
]  # fmt: skip
BOX_W, BOX_H = 130, 48
LEG_M, LEGS, APART_M, STEP_M, HEIGHT_M = 120.0, 3, 30.0, 10.0, 50.0
UNIT_M, FIX_M, SEED = 40.0, 1.5, 4
"""Metres of a unit of the drawn odometry, and sigma of a fix."""


def image_of(width: int, height: int, parts: list[str]) -> str:
    """An SVG image of these parts."""
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        'font-family="sans-serif" font-size="13">'
        '<defs><marker id="a" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="8" '
        f'markerHeight="8" orient="auto"><path d="M0 0L8 4L0 8z" fill="{INK}"/></marker></defs>'
        f'<rect width="{width}" height="{height}" fill="white"/>'
    )
    return "\n".join([head, *parts, "</svg>", ""])


def life() -> str:
    """The life of a frame."""
    parts = [arrow(*ends) for ends in ARROWS]
    for name, (x, y, holds) in BOXES.items():
        middle = x + BOX_W / 2
        parts.append(
            f'<rect x="{x}" y="{y}" width="{BOX_W}" height="{BOX_H}" rx="5" fill="#f1f5f9" '
            f'stroke="{INK}"/><text x="{middle:g}" y="{y + 20}" text-anchor="middle" '
            f'font-weight="bold">{escape(name)}</text><text x="{middle:g}" y="{y + 38}" '
            f'text-anchor="middle" font-size="11">{escape(holds)}</text>'
        )
    return image_of(850, 370, parts)


def arrow(start: str, end: str) -> str:
    """From one box to another: to the right, down, or down and to the right."""
    (ax, ay, _), (bx, by, _) = BOXES[start], BOXES[end]
    points: list[tuple[float, float]]
    if ax == bx:
        points = [(ax + BOX_W / 2, ay + BOX_H), (bx + BOX_W / 2, by)]
    elif ay == by or by < ay:
        points = [(ax + BOX_W, ay + BOX_H / 2), (bx, by + BOX_H / 2)]
    else:
        points = [(ax + BOX_W / 2, ay + BOX_H), (ax + BOX_W / 2, by + BOX_H / 2), (bx, by + 24)]
    path = " ".join(f"{x:g},{y:g}" for x, y in points)
    return (
        f'<polyline points="{path}" fill="none" stroke="{INK}" stroke-width="1.5" '
        'marker-end="url(#a)"/>'
    )


def flown() -> list[F64]:
    """(4, 4) true poses of a camera that looks straight down, top to the north, on three legs."""
    R = np.diag([1.0, -1.0, -1.0])
    along = np.arange(0.0, LEG_M + 1.0, STEP_M)
    poses = []
    for leg in range(LEGS):
        for x in along if leg % 2 == 0 else along[::-1]:
            poses.append(se3.compose(R, np.array([x, leg * APART_M, HEIGHT_M])))
    return poses


def track() -> dict[str, F64]:
    """(N, 2) m of a flight: the truth, fixes, poses as first published and as corrected last;
    and (N,) sigma of the first ones."""
    rng = np.random.default_rng(SEED)
    truth = flown()
    graph, odom = PoseGraph(), np.eye(4)
    covariance = np.diag([0.004**2] * 3 + [0.01**2] * 3)
    first, sigma, fixes = [], [], []
    for seq, pose in enumerate(truth):
        if seq:
            step = se3.inverse(truth[seq - 1]) @ pose
            step[:3, 3] /= UNIT_M
            odom = odom @ se3.exp(rng.multivariate_normal(np.zeros(6), covariance)) @ step
        fix = pose[:3, 3] + rng.normal(0.0, FIX_M, 3)
        prior = PosePrior(pose[:3, :3], 0.02, 0.1, fix, np.full(3, FIX_M))
        known = graph.add_keyframe(Node(seq, seq * 10**9, 1, odom, covariance, prior))
        at = se3.about(known.T_world_camera[:3, 3], known.covariance)
        first.append(known.T_world_camera[:2, 3])
        sigma.append(np.sqrt(np.trace(at[3:5, 3:5]) / 2.0))
        fixes.append(fix[:2])
    graph.solve()
    return {
        "truth": np.array(truth)[:, :2, 3],
        "fixes": np.array(fixes),
        "first": np.array(first),
        "last": graph.poses()[:, :2, 3],
        "sigma": np.array(sigma),
    }


def correction(flight: dict[str, F64]) -> str:
    """The flight from above: what was published first, with its sigma, and the re-poses."""

    def at(place: F64) -> tuple[float, float]:
        return 50.0 + 5.2 * float(place[0]), 400.0 - 5.2 * float(place[1])

    lines = {"truth": (GRAY, 5.0), "last": (GREEN, 1.5)}
    parts = []
    for name, (colour, width) in lines.items():
        path = " ".join("{:.0f},{:.0f}".format(*at(place)) for place in flight[name])
        parts.append(
            f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="{width:g}" '
            'stroke-opacity="0.6"/>'
        )
    for fix in flight["fixes"]:
        x, y = at(fix)
        parts.append(
            f'<path d="M{x - 3:.0f} {y:.0f}h6M{x:.0f} {y - 3:.0f}v6" stroke="{RED}" fill="none"/>'
        )
    for place, last, sigma in zip(flight["first"], flight["last"], flight["sigma"], strict=True):
        (x, y), (to_x, to_y) = at(place), at(last)
        parts.append(
            f'<circle cx="{x:.0f}" cy="{y:.0f}" r="{5.2 * min(sigma, 6.0):.0f}" fill="{BLUE}" '
            f'fill-opacity="0.12" stroke="{BLUE}"/><line x1="{x:.0f}" y1="{y:.0f}" '
            f'x2="{to_x:.0f}" y2="{to_y:.0f}" stroke="{INK}"/><circle cx="{to_x:.0f}" '
            f'cy="{to_y:.0f}" r="2.5" fill="{GREEN}"/>'
        )
    words = [
        (GRAY, "true track"), (RED, "fix"), (BLUE, "keyframe as published, 1 sigma"),
        (GREEN, "after its re-poses"),
    ]  # fmt: skip
    for k, (colour, text) in enumerate(words):
        x = 40 + (0, 110, 160, 390)[k]
        parts.append(f'<text x="{x}" y="30" fill="{colour}" font-weight="bold">{text}</text>')
    return image_of(740, 450, parts)


if __name__ == "__main__":
    (IMAGES / "frame_life.svg").write_text(life(), encoding="utf-8")
    (IMAGES / "reposes.svg").write_text(correction(track()), encoding="utf-8")
