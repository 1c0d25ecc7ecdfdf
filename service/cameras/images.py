"""A folder of stills, as mapping drones leave it: times and positions from the pictures' tags."""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from statistics import median

import numpy as np

from recon.types import U8
from service.cameras import reject_options
from service.cameras.exif import Tags, read_tags
from service.cameras.source import CameraFrame
from service.errors import InputError

log = logging.getLogger(__name__)

SUFFIXES = frozenset((".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"))
SECOND_NS = 1_000_000_000
ZONE_NS = 900 * SECOND_NS  # time zones are whole quarters of an hour


class ImagesSource:
    """The stills of one folder in order of time; unreadable ones are left out, with a warning."""

    def __init__(self, folder: Path, interval_s: float | None) -> None:
        """Read the tags of every still; ``interval_s`` spaces stills by name instead of tags."""
        self.description = str(folder)
        self.is_live = False
        self.start_monotonic_ns: int | None = None
        self.warnings: list[str] = []
        tagged = self._same_size(self._read(folder))
        times, self.epoch_unix_ns = self._times(tagged, interval_s)
        order = sorted(range(len(tagged)), key=lambda i: (times[i], i))
        self._stills = [(*tagged[i], times[i]) for i in order]
        self.size_px = tagged[0][1].size_px
        span_s = (self._stills[-1][2] - self._stills[0][2]) / 1e9
        self.fps = (len(self._stills) - 1) / span_s if span_s > 0 else None

    def __iter__(self) -> Iterator[CameraFrame]:
        """Yield the stills that decode."""
        seq = 0
        for path, tags, time_ns in self._stills:
            image = _load(path, self.size_px)
            if image is None or image.shape[:2] != (self.size_px[1], self.size_px[0]):
                self._warn(f"{path.name} cannot be decoded; left out")
                continue
            yield CameraFrame(image, time_ns, seq, tags.geotag, path.name)
            seq += 1

    def close(self) -> None:
        """Nothing is held open."""

    def _read(self, folder: Path) -> list[tuple[Path, Tags]]:
        paths = sorted(
            (p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file()),
            key=natural_key,
        )
        tagged = []
        for path in paths:
            try:
                tagged.append((path, read_tags(path)))
            except OSError as error:
                why = " ".join(str(error).split())[:120] or type(error).__name__
                self._warn(f"{path.name} is not a picture that can be read ({why}); left out")
        if not tagged:
            raise InputError(f"{folder} holds no pictures (jpg, png, tif); name their folder")
        return tagged

    def _same_size(self, tagged: list[tuple[Path, Tags]]) -> list[tuple[Path, Tags]]:
        """Those of the most frequent size: one camera model fits one size."""
        size_px, _ = Counter(tags.size_px for _, tags in tagged).most_common(1)[0]
        kept = [(path, tags) for path, tags in tagged if tags.size_px == size_px]
        if len(kept) < len(tagged):
            self._warn(
                f"{len(tagged) - len(kept)} pictures are not {size_px[0]}x{size_px[1]} like the "
                "others; left out"
            )
        return kept

    def _times(
        self, tagged: list[tuple[Path, Tags]], interval_s: float | None
    ) -> tuple[list[int], int | None]:
        """(ns since the first still, UTC of the first still when known) of every still."""
        tags = [t for _, t in tagged]
        unix = [utc_ns(t, clock_offset_ns(tags)) for t in tags]
        known = [t for t in unix if t is not None]
        if interval_s is None and len(known) == len(tags):
            return _from_first(spread(known, tags)), min(known)
        local = [t.local_ns for t in tags if t.local_ns is not None]
        if interval_s is None and len(local) == len(tags):
            self._warn("the pictures name no time zone; their absolute time is unknown")
            return _from_first(spread(local, tags)), None
        if interval_s is None:
            missing = sum(t.local_ns is None and t.name_unix_ns is None for t in tags)
            self._warn(
                f"{missing} of {len(tags)} pictures name no time; taken by name, one a second "
                "(say otherwise with images:DIR?interval_s=2)"
            )
        step_ns = round((interval_s or 1.0) * SECOND_NS)
        return [i * step_ns for i in range(len(tags))], unix[0]

    def _warn(self, text: str) -> None:
        self.warnings.append(text)
        log.warning("%s: %s", self.description, text)


def open_images(rest: str, options: Mapping[str, str]) -> ImagesSource:
    """The stills in folder ``rest``; option ``interval_s`` sets their spacing by hand."""
    reject_options("images", options, ("interval_s",))
    folder = Path(rest)
    if not folder.is_dir():
        raise InputError(f"no such folder of pictures: {folder}")
    interval_s = None
    if "interval_s" in options:
        try:
            interval_s = float(options["interval_s"])
        except ValueError:
            interval_s = 0.0
        if not 0.0 < interval_s < 1e6:
            raise InputError(f"images: interval_s must be seconds, not {options['interval_s']!r}")
    return ImagesSource(folder, interval_s)


def natural_key(path: Path) -> list[tuple[int, int, str]]:
    """Sort key that puts IMG_9 before IMG_10."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(p), "") if p.isdecimal() else (1, 0, p.lower()) for p in parts if p]


def clock_offset_ns(tags: list[Tags]) -> int | None:
    """Camera's clock minus UTC: as written, else from the GPS times; None when neither is there.

    GPS times in EXIF are whole seconds and may lag, so the difference is rounded to a time
    zone (quarter of an hour) unless the camera's clock is off by more than a minute.
    """
    written = [t.offset_ns for t in tags if t.offset_ns is not None]
    if written:
        return Counter(written).most_common(1)[0][0]
    pairs = [(t.local_ns, t.gps_unix_ns) for t in tags]
    found = [local - gps for local, gps in pairs if local is not None and gps is not None]
    if not found:
        return None
    offset = round(median(found))
    zone = round(offset / ZONE_NS) * ZONE_NS
    return zone if abs(offset - zone) < 60 * SECOND_NS else offset


def utc_ns(tags: Tags, offset_ns: int | None) -> int | None:
    """Unix ns of a still: its own clock, else its file name, else its GPS time."""
    if tags.local_ns is not None and offset_ns is not None:
        return tags.local_ns - offset_ns
    return tags.name_unix_ns if tags.name_unix_ns is not None else tags.gps_unix_ns


def spread(times_ns: list[int], tags: list[Tags]) -> list[int]:
    """The same times, with stills of one whole second spread evenly over that second."""
    same = Counter(times_ns)
    taken: Counter[int] = Counter()
    out = []
    for time_ns, tag in zip(times_ns, tags, strict=True):
        step = 1 if tag.sub_second else SECOND_NS // same[time_ns]
        out.append(time_ns + taken[time_ns] * step)
        taken[time_ns] += 1
    return out


def _from_first(times_ns: list[int]) -> list[int]:
    first = min(times_ns)
    return [t - first for t in times_ns]


def _load(path: Path, size_px: tuple[int, int]) -> U8 | None:
    """(H, W, 3) BGR as stored (no EXIF turn: the camera model is of the stored pixels).

    None when the file does not decode, or says another size than ``size_px`` (W, H) meanwhile.
    """
    import cv2

    try:
        if read_tags(path).size_px != size_px:
            return None
        data = np.fromfile(path, np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except (OSError, cv2.error):
        return None
    return None if image is None else np.asarray(image, dtype=np.uint8)
