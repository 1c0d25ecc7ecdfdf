"""Facts about a scan for the library, read from files that may come from a stranger.

Strict JSON into typed records with bounds: anything else raises InputError here, so that no NaN and
no broken text reaches the list.
"""

from __future__ import annotations

import stat
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec

from service.errors import InputError
from service.ground.storage import is_regular
from service.scans.writing import SUMMARY
from service.small_file import read_json
from service.stream.store import ScanStore

MAX_JSON_BYTES = 4_000_000
SCHEMA = 1
MAX_TROUBLE = 500
T = TypeVar("T")

UnixTime = Annotated[float, msgspec.Meta(ge=-1e11, le=1e11)]
Figure = Annotated[float, msgspec.Meta(ge=-1e300, le=1e300)]
Count = Annotated[int, msgspec.Meta(ge=0, le=2**53)]
Note = Annotated[str, msgspec.Meta(max_length=4000)]


class Origin(msgspec.Struct):
    lat_deg: Annotated[float, msgspec.Meta(ge=-90, le=90)]
    lon_deg: Annotated[float, msgspec.Meta(ge=-180, le=180)]
    alt_amsl_m: Annotated[float, msgspec.Meta(ge=-1e5, le=1e7)]


class Times(msgspec.Struct):
    started_unix_s: UnixTime


class TrustFacts(msgspec.Struct):
    level: Annotated[str, msgspec.Meta(max_length=40)]
    reasons: Annotated[list[Note], msgspec.Meta(max_length=100)]


Corner = tuple[
    Annotated[float, msgspec.Meta(ge=-90, le=90)], Annotated[float, msgspec.Meta(ge=-180, le=180)]
]


class Extent(msgspec.Struct):
    """None: the scan lies nowhere on the globe."""

    corners_lat_lon: tuple[Corner, Corner, Corner, Corner] | None = None


class Ground(msgspec.Struct):
    """When a scan was flown, and over which ground."""

    times: Times
    finished: bool
    coverage: Extent | None = None

    @property
    def box(self) -> tuple[Corner, Corner] | None:
        """Lowest and highest latitude and longitude; None without a georeference."""
        if self.coverage is None or self.coverage.corners_lat_lon is None:
            return None
        lat, lon = zip(*self.coverage.corners_lat_lon, strict=True)
        return (min(lat), min(lon)), (max(lat), max(lon))


class Facts(Ground, kw_only=True):
    """The part of a summary that the list shows."""

    counts: Annotated[dict[str, Count], msgspec.Meta(max_length=100)]
    quality: Annotated[dict[str, Figure | TrustFacts | None], msgspec.Meta(max_length=100)]
    notes: Annotated[list[Note], msgspec.Meta(max_length=1000)]
    origin: Origin | None = None
    newest: Count | None = None  # keyframe of a scan that has no files yet
    failed: Annotated[dict[str, Note], msgspec.Meta(max_length=100)] = {}

    def shown(self) -> dict[str, Any]:
        plain: dict[str, Any] = msgspec.to_builtins(self)
        failed, coverage = plain.pop("failed"), plain.pop("coverage")
        plain["corners_lat_lon"] = coverage and coverage["corners_lat_lon"]
        if failed:
            why = "; ".join(f"{name} ({reason})" for name, reason in failed.items())
            plain["trouble"] = f"could not be made: {why}"[:MAX_TROUBLE]
        return {**plain.pop("times"), **plain}


class _Schema(msgspec.Struct):
    schema: int


class Labels(msgspec.Struct, frozen=True):
    title: str = ""
    tags: tuple[str, ...] = ()
    edition: Count = 0  # counts the changes


def facts_of(folder: Path) -> dict[str, Any]:
    """A scan's entry in the list, from its ``scan.json`` or else its store. Raises InputError for a
    file that cannot be read, ValueError for an unfit store."""
    if (folder / SUMMARY).exists():
        return _of_summary(folder / SUMMARY, Facts).shown()
    with ScanStore.peek(folder / "scan.db") as store:
        return _from_store(store).shown()


def is_current(product: Path) -> bool:
    """Whether a file was made of the scan in its folder as that is now: no older than its
    ``scan.json``."""
    summary = product.with_name(SUMMARY)
    with suppress(OSError):  # it is replaced or deleted meanwhile
        made = product.lstat()
        if stat.S_ISREG(made.st_mode):
            return not summary.exists() or made.st_mtime >= summary.stat().st_mtime
    return False


def ground_in(path: Path) -> Ground:
    """When and where a scan was flown, from its ``scan.json``; InputError if it cannot be read."""
    return _of_summary(path, Ground)


def _of_summary(path: Path, kind: type[T]) -> T:
    if read_strictly(path, _Schema).schema != SCHEMA:
        raise InputError(f"{path.name} was written by another version; update skyrelief")
    return read_strictly(path, kind)


def _from_store(store: ScanStore) -> Facts:
    header, seqs = store.header, store.seqs()
    origin = {
        "lat_deg": header.origin_lat_deg,
        "lon_deg": header.origin_lon_deg,
        "alt_amsl_m": header.origin_alt_amsl_m,
    }
    return msgspec.convert(
        {
            "times": {"started_unix_s": header.started_unix_ns / 1e9},
            "finished": store.finished,
            "counts": {"keyframes": len(seqs)},
            "newest": max(seqs, default=None),
            "quality": {},
            "notes": list(header.notes),
            "origin": None if header.origin_lat_deg is None else origin,
        },
        Facts,
    )


def read_strictly(path: Path, kind: type[T]) -> T:
    """The content of a small JSON file. Raises InputError when it is another, or a link."""
    if not is_regular(path):
        raise InputError(f"{path.name} is not a regular file")
    return read_json(path, kind, MAX_JSON_BYTES, "file of a scan")
