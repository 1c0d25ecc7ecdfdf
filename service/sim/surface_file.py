"""Triangle meshes as PLY files: what ``simulate`` writes and ``score`` reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from recon.types import F64
from service.errors import InputError

I32 = npt.NDArray[np.int32]
FACE = np.dtype([("n", "u1"), ("v", "<i4", 3)])
FORMAT = "binary_little_endian 1.0"


def write_surface(path: Path, vertices: F64, triangles: I32) -> None:
    """Write (N, 3) vertices and (M, 3) triangles as binary PLY with float coordinates."""
    header = [
        "ply",
        f"format {FORMAT}",
        "comment ENU metres about the origin in origin.json",
        f"element vertex {len(vertices)}",
        "property float x",
        "property float y",
        "property float z",
        f"element face {len(triangles)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    faces = np.empty(len(triangles), FACE)
    faces["n"], faces["v"] = 3, triangles
    with path.open("wb") as out:
        out.write(("\n".join(header) + "\n").encode("ascii"))
        out.write(np.ascontiguousarray(vertices, "<f4").tobytes())
        out.write(faces.tobytes())


def read_surface(path: Path) -> tuple[F64, I32]:
    """(vertices (N, 3), triangles (M, 3)) of a PLY file of the form of :func:`write_surface`.

    Coordinates may be float or double. InputError, in one line, for anything else.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"surface {path}: no such file") from None
    except OSError as error:
        raise InputError(f"surface {path}: cannot be read ({error.strerror})") from error
    end = data.find(b"end_header\n")
    if not data.startswith(b"ply") or end < 0:
        raise InputError(f"surface {path}: not a PLY file")
    lines = data[:end].decode("ascii", "replace").split("\n")
    lines = [line.strip() for line in lines[1:] if line and not line.startswith("comment")]
    try:
        real, n, m = _layout(lines)
        body = memoryview(data)[end + len(b"end_header\n") :]
        vertices = np.frombuffer(body, real, 3 * n).reshape(n, 3).astype(np.float64)
        faces = np.frombuffer(body, FACE, m, offset=vertices.size * real.itemsize)
    except ValueError as error:
        raise InputError(f"surface {path}: {error}; expected the PLY of simulate") from error
    triangles = np.ascontiguousarray(faces["v"], np.int32)
    if m and (not (faces["n"] == 3).all() or triangles.min() < 0 or triangles.max() >= n):
        raise InputError(f"surface {path}: not a mesh of triangles over its own vertices")
    return vertices, triangles


def _layout(lines: list[str]) -> tuple[np.dtype[np.floating], int, int]:
    """(type of a coordinate, vertices, faces); ValueError for another layout."""
    words = [line.split() for line in lines]
    if len(words) != 7 or lines[0] != f"format {FORMAT}":
        raise ValueError("other properties than x, y, z and triangles")
    names = [w[-1] for w in words[2:5]]
    kind = words[2][1]
    same = all(w[:2] == ["property", kind] for w in words[2:5])
    if names != ["x", "y", "z"] or kind not in ("float", "double") or not same:
        raise ValueError("vertices are not float x, y, z")
    if words[1][:2] != ["element", "vertex"] or words[5][:2] != ["element", "face"]:
        raise ValueError("elements are not vertex and face")
    if words[6][:4] != ["property", "list", "uchar", "int"]:
        raise ValueError("faces are not lists of int with a uchar count")
    n, m = int(words[1][2]), int(words[5][2])
    if n < 0 or m < 0:
        raise ValueError("negative counts")
    return np.dtype("<f4" if kind == "float" else "<f8"), n, m
