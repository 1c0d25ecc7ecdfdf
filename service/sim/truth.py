"""The folder ``truth/`` of ``simulate``, read back: place, surface, poses and visibility."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from recon import se3
from recon.surface import metrics, triangle_grid
from recon.surface.triangle_grid import TriangleGrid
from recon.types import F64, I32, Bool
from service.errors import InputError
from service.georeference import LocalFrame
from service.small_file import read_json

SAMPLE_SPACING_M = 0.4
FRAMES_FOR_VISIBILITY = 60
VIEWS_TO_COUNT = 3
MAX_JSON_BYTES = 1 << 26


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Contents of ``truth/`` as ``simulate`` wrote them."""

    folder: Path
    frame: LocalFrame
    surface: TriangleGrid
    times_s: F64  # (F,)
    poses: F64  # (F, 4, 4)
    K: F64
    size_px: tuple[int, int]
    agl_m: float


@dataclass(frozen=True, slots=True, eq=False)
class SeenSurface:
    """Places of the true surface, evenly by area, that the flight saw."""

    places: F64  # (S, 3)
    normals: F64  # (S, 3)
    area_m2: float


def read_truth(folder: Path) -> Truth:
    """The truth in ``folder``, or in its ``truth`` subfolder."""
    if not (folder / "surface.ply").exists() and (folder / "truth").is_dir():
        folder = folder / "truth"
    if not folder.is_dir():
        raise InputError(f"truth {folder}: no such folder; `skyrelief simulate` makes one")
    origin, params = (
        read_json(folder / f"{name}.json", dict[str, Any], MAX_JSON_BYTES, "truth of simulate")
        for name in ("origin", "params")
    )
    vertices, triangles = read_surface(folder / "surface.ply")
    times, poses = read_tum(folder / "trajectory.tum")
    with reading(folder):
        frame = LocalFrame(origin["lat_deg"], origin["lon_deg"], origin["alt_amsl_m"])
        K = np.array(params["K"], np.float64).reshape(3, 3)
        width, height = (int(v) for v in params["size_px"])
        agl = float(params["median_agl_m"])
        surface = triangle_grid.build(vertices, triangles)
        if len(times) < 2:
            raise ValueError("trajectory.tum has fewer than two poses")
    return Truth(folder, frame, surface, times, poses, K, (width, height), agl)


def heights_below(surface: TriangleGrid, xy_m: F64) -> F64:
    """(N,) height of the highest surface at (N, 2) places; NaN outside."""
    above = np.column_stack([xy_m, np.full(len(xy_m), surface.bounds[5] + 10.0)])
    t, _ = surface.cast(above, np.tile([0.0, 0.0, -1.0], (len(above), 1)))
    return np.asarray(above[:, 2] - t)


def seen_surface(truth: Truth) -> SeenSurface:
    """Surface that at least VIEWS_TO_COUNT of the frames see; InputError when that is none."""
    samples, normals = metrics.sample_surface(truth.surface, SAMPLE_SPACING_M)
    seen = seen_by_enough(truth, samples, normals)
    if not seen.any():
        raise InputError("the truth's cameras see none of the truth's surface; wrong folder?")
    area = float(truth.surface.areas().sum()) * float(seen.mean())
    return SeenSurface(samples[seen], normals[seen], area)


def seen_by_enough(truth: Truth, places: F64, normals: F64) -> Bool:
    """(N,) places of the true surface that VIEWS_TO_COUNT of the frames see."""
    frames = np.unique(np.linspace(0, len(truth.poses) - 1, FRAMES_FOR_VISIBILITY).astype(int))
    views = np.zeros(len(places), np.int64)
    for k in frames:
        views += metrics.seen_from(
            places, normals, truth.surface, truth.poses[k], truth.K, np.array(truth.size_px)
        )
    return np.asarray(views >= min(VIEWS_TO_COUNT, len(frames)))


def read_tum(path: Path) -> tuple[F64, F64]:
    """(times (N,) unix s, poses (N, 4, 4)) of a TUM trajectory, in order of time."""
    with reading(path):
        rows = [r.split() for r in path.read_text().splitlines() if r and not r.startswith("#")]
        table = np.array([[float(v) for v in row] for row in rows]).reshape(len(rows), 8)
        if not np.isfinite(table).all():
            raise ValueError("numbers that are not finite")
        table = table[np.argsort(table[:, 0], kind="stable")]
        poses = np.tile(np.eye(4), (len(table), 1, 1))
        for k, row in enumerate(table):
            poses[k, :3, :3] = se3.rotation_from_quaternion(row[[7, 4, 5, 6]])
        poses[:, :3, 3] = table[:, 1:4]
    return table[:, 0], poses


UNFIT = (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError, struct.error)


@contextmanager
def reading(path: Path, *faults: type[Exception]) -> Iterator[None]:
    """Turn what a file that is not as it should be raises into an InputError in one line."""
    unfit: tuple[type[Exception], ...] = (*UNFIT, *faults)
    try:
        yield
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except unfit as error:
        why = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: cannot be read ({why})") from error


FACE = np.dtype([("n", "u1"), ("v", "<i4", 3)])
HEADER = re.compile(
    rb"ply\nformat binary_little_endian 1\.0\n(?:comment [^\n]*\n)*element vertex (\d{1,9})\n"
    rb"property (float|double) x\nproperty \2 y\nproperty \2 z\nelement face (\d{1,9})\n"
    rb"property list uchar int [^\n]*\nend_header\n"
)


def write_surface(path: Path, vertices: F64, triangles: I32) -> None:
    """Write (N, 3) vertices and (M, 3) triangles as binary PLY with float coordinates."""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        "comment ENU metres about the origin in origin.json\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(triangles), FACE)
    faces["n"], faces["v"] = 3, triangles
    with path.open("wb") as out:
        out.write(header.encode("ascii"))
        out.write(np.ascontiguousarray(vertices, "<f4").tobytes())
        out.write(faces.tobytes())


def read_surface(path: Path) -> tuple[F64, I32]:
    """(vertices (N, 3), triangles (M, 3)) of a PLY file of the form of :func:`write_surface`.
    Coordinates may be float or double. InputError, in one line, for anything else."""
    with reading(path):
        data = path.read_bytes()
        head = HEADER.match(data)
        if head is None:
            raise ValueError("not a PLY file of simulate")
        real, n, m = np.dtype("<f4" if head[2] == b"float" else "<f8"), int(head[1]), int(head[3])
        vertices = np.frombuffer(data, real, 3 * n, head.end()).reshape(n, 3).astype(np.float64)
        faces = np.frombuffer(data, FACE, m, head.end() + vertices.size * real.itemsize)
        triangles = np.ascontiguousarray(faces["v"], np.int32)
        if m and (not (faces["n"] == 3).all() or triangles.min() < 0 or triangles.max() >= n):
            raise ValueError("not a mesh of triangles over its own vertices")
    return vertices, triangles
