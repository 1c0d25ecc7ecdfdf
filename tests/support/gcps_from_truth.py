"""Synthetic ground control for a scan of a simulated flight: marks with noise, from the truth.

``python tests/support/gcps_from_truth.py SCAN TRUTH OUT.csv [--control 5] [--check 8] [--seed 1]``
writes points spread over the site, each marked in up to three keyframes, half a pixel off.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import cv2
import numpy as np

from recon import se3
from recon.camera_model import rays
from recon.surface import metrics
from recon.types import F64
from service.sim.truth import Truth, read_truth
from service.stream.store import ScanStore

COLUMNS = ("name", "keyframe_seq", "u_px", "v_px", "lat", "lon", "alt_amsl_m",
           "sigma_h_m", "sigma_v_m", "role")  # fmt: skip
SURVEY_M = (0.02, 0.02, 0.03)
MARK_PX = 0.5
MARKS = 3


def flat_points(truth: Truth, poses: F64, rng: np.random.Generator, count: int) -> F64:
    """(count, 3) points on level, open surface that the cameras see, far from each other."""
    W, H = truth.size_px
    uv = rng.uniform([0.2 * W, 0.2 * H], [0.8 * W, 0.8 * H], (4000, 2))
    ways = rays(truth.K, uv)
    pick = rng.integers(0, len(poses), len(uv))
    out = []
    for k in range(len(poses)):
        mine = np.flatnonzero(pick == k)
        R, t = poses[k][:3, :3], poses[k][:3, 3]
        reach, hit = truth.surface.cast(t, ways[mine] @ R.T)
        level = truth.surface.normals()[:, 2]
        for n, r, h in zip(mine, reach, hit, strict=True):
            if h >= 0 and level[h] > 0.97:
                spot = t + r * (R @ ways[n])
                around = spot + np.array([[1.2, 0, 5], [-1.2, 0, 5], [0, 1.2, 5], [0, -1.2, 5]])
                drop, _ = truth.surface.cast(around, np.tile([0.0, 0.0, -1.0], (4, 1)))
                if np.isfinite(drop).all() and np.abs(drop - 5.0).max() < 0.3:
                    out.append(spot)
    spots = np.array(out)
    chosen = [int(np.argmin(spots[:, 0] + spots[:, 1]))]
    while len(chosen) < count:
        apart = np.min(np.linalg.norm(spots[:, None, :2] - spots[chosen][:, :2], axis=2), axis=1)
        chosen.append(int(np.argmax(apart)))
    return spots[chosen]


def marks_of(
    truth: Truth, spot: F64, seqs: list[int], poses: F64, distortion: F64, rng: np.random.Generator
) -> list[tuple[int, float, float]]:
    """(keyframe, u, v) in the distorted image wherever ``spot`` is seen, the best first."""
    W, H = truth.size_px
    found = []
    for seq, T in zip(seqs, poses, strict=True):
        p = se3.transform(se3.inverse(T), spot[None])[0]
        if p[2] <= 0:
            continue
        way = spot - T[:3, 3]
        reach, _ = truth.surface.cast(T[:3, 3], way[None])
        if not reach[0] > 0.995:
            continue
        uv = cv2.projectPoints(p[None], np.zeros(3), np.zeros(3), truth.K, distortion)[0][0, 0]
        inside = min(uv[0], W - 1 - uv[0], uv[1], H - 1 - uv[1])
        if inside > 0.06 * W:
            u, v = uv + rng.normal(0, MARK_PX, 2)
            found.append((inside, seq, float(u), float(v)))
    found.sort(reverse=True)
    step = max(1, len(found) // MARKS)
    return [(seq, u, v) for _, seq, u, v in found[::step][:MARKS]]


def write(
    scan: Path, truth_folder: Path, out: Path, control: int = 5, check: int = 8, seed: int = 1
) -> int:
    """Write the CSV; how many points it holds."""
    rng = np.random.default_rng(seed)
    truth = read_truth(truth_folder)
    with ScanStore.open(scan / "scan.db") as store:
        keyframes = [(seq, k.time_ns) for seq in store.seqs() if (k := store.keyframe(seq))]
        distortion = np.array(store.header.camera["distortion"])
    seqs = [seq for seq, _ in keyframes]
    times = np.array([t * 1e-9 for _, t in keyframes])
    poses, known = metrics.poses_at(truth.times_s, truth.poses, times)
    assert known.all()
    spots = flat_points(truth, poses, rng, control + check)
    rows = []
    for n, spot in enumerate(spots):
        surveyed = truth.frame.to_geodetic((spot + rng.normal(0, 1, 3) * SURVEY_M)[None])[0]
        role = "control" if n < control else "check"
        for seq, u, v in marks_of(truth, spot, seqs, poses, distortion, rng):
            place = [f"{surveyed[0]:.9f}", f"{surveyed[1]:.9f}", f"{surveyed[2]:.3f}"]
            sigma = [SURVEY_M[0], SURVEY_M[2]]
            rows.append([f"{role[:2].upper()}{n}", seq, f"{u:.2f}", f"{v:.2f}", *place, *sigma,
                         role])  # fmt: skip
    with out.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)
        table.writerows(rows)
    return len({row[0] for row in rows})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scan", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--control", type=int, default=5)
    parser.add_argument("--check", type=int, default=8)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    print(write(given.scan, given.truth, given.out, given.control, given.check, given.seed))
