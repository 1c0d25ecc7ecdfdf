"""Where a scan without georeference lies, by points that a person names in it and on the ground."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from recon.similarity import Similarity, umeyama
from recon.types import F64
from service.errors import InputError
from service.georeference import LocalFrame
from service.small_file import read_json

MIN_PAIRS, MAX_PAIRS, MAX_BYTES = 3, 100, 100_000
MAX_MISS = 0.1
"""Rms of what the points miss each other by, as a share of their extent."""

LINE = 0.1
"""Width over length of the points, below which they lie in a line."""

SIGMA_RAD, SIGMA_SCALE = 0.1, 0.1
"""Of a scan that points place."""

SIGMA_SHARE = 1.0
"""Sigma of its place, as a share of the points' extent: the points are only where ties begin."""

Metres = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]


class Pair(msgspec.Struct, forbid_unknown_fields=True):
    """One place: in the scan's own coordinates, and as longitude, latitude, AMSL metres."""

    scan: tuple[Metres, Metres, Metres]
    place: tuple[
        Annotated[float, msgspec.Meta(ge=-180, le=180)],
        Annotated[float, msgspec.Meta(ge=-85, le=85)],
        Annotated[float, msgspec.Meta(ge=-1000, le=20_000)],
    ]


class KnownScan(msgspec.Struct):
    folder: str
    start: list[Pair] | None = None


class KnownSite(msgspec.Struct):
    """What an alignment takes from the document of the one before it."""

    scans: list[KnownScan]  # without them the file is another program's
    revision: int = 0
    history: list[dict[str, Any]] = []


def placing(pairs: Sequence[Pair], site: LocalFrame) -> tuple[Similarity, F64]:
    """From the coordinates of the scan that ``pairs`` place to the site's, and (6, 6) its left
    covariance there.

    Raises InputError for too few points, points in a line, and points that disagree.
    """
    if not MIN_PAIRS <= len(pairs) <= MAX_PAIRS:
        raise InputError(f"a start takes {MIN_PAIRS} to {MAX_PAIRS} points, not {len(pairs)}")
    here = np.array([pair.scan for pair in pairs])
    lon, lat, alt = np.array([pair.place for pair in pairs]).T
    there = site.to_enu(np.column_stack([lat, lon, alt]))
    for points, which in ((here, "in the scan"), (there, "on the ground")):
        size = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if not size[1] > LINE * size[0]:
            raise InputError(f"the points {which} lie in a line; choose a triangle")
    move = umeyama(here, there)
    assert move is not None  # they span a plane
    extent = float(np.linalg.norm(there - there.mean(axis=0), axis=1).max())
    miss = float(np.sqrt(np.mean(np.sum((move.points(here) - there) ** 2, axis=1))))
    if move.scale <= 0.0 or miss > MAX_MISS * extent:
        raise InputError(
            f"the points contradict each other by {miss:.1f} m; check their order and places"
        )
    sigma = np.append(np.full(3, SIGMA_RAD), np.full(3, SIGMA_SHARE * extent))
    return move, np.diag(sigma**2)


def read_start(path: Path) -> list[Pair]:
    """The points in a JSON file. Raises InputError for anything else."""
    return read_json(path, list[Pair], MAX_BYTES, "list of points")
