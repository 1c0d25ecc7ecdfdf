"""A folder of stills, as mapping drones store them: times and positions from the images' tags."""

from __future__ import annotations

import logging
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from copy import copy
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np

from recon.types import U8
from service.cameras import reject_options
from service.cameras.exif import Tags, read_tags
from service.cameras.lens import turned
from service.cameras.source import CameraFrame
from service.errors import InputError

log = logging.getLogger(__name__)

SUFFIXES = frozenset((".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"))
SECOND_NS = 1_000_000_000
ZOOM = 0.03
"""Relative tolerance of the focal lengths of one camera."""

AS_OFTEN = 0.9
"""Of two cameras of one drone, one misses some images at times."""

MAX_PAN_DEG = 30.0
"""Gimbals follow the nose: where images head further off it than that, their heading is wrong, as
that of a gimbal without a compass, which drifts; or turned on purpose, and the track shows it."""

NEAR_M, FASTEST_M_S = 1000.0, 100.0
"""Errors of fixes that the track corrects; and no aircraft that maps is faster."""

ONE_FLIGHT_S, MAX_COMPARED = 600.0, 400
"""Images of one flight are so close in time; so many at most are compared with each."""

ROLLED_DEG = 45.0
ZONE_NS = 900 * SECOND_NS  # time zones are multiples of a quarter of an hour


class ImagesSource:
    """The stills of one folder in order of time; unreadable ones are skipped with a warning."""

    def __init__(self, folder: Path, interval_s: float | None) -> None:
        """Read the tags of every still; ``interval_s`` sets times by name instead of by tags."""
        self.description = str(folder)
        self.is_live = False
        self.start_monotonic_ns: int | None = None
        self.warnings: list[str] = []
        tagged = self._headings(self._same_lens(self._same_size(self._read(folder))))
        times, self.epoch_unix_ns = self._times(tagged, interval_s)
        tagged = self._places(tagged, times)
        order = sorted(range(len(tagged)), key=lambda i: (times[i], i))
        self._stills = [(*tagged[i], times[i]) for i in order]
        stored = tagged[0][1].size_px
        self.turned_deg = self._turn(tagged)
        self.size_px = stored[::-1] if self.turned_deg % 180 else stored
        self.lens = tagged[0][1].lens
        self.camera = (
            None if self.lens is None else turned(self.lens.camera(stored), self.turned_deg)
        )
        span_s = (self._stills[-1][2] - self._stills[0][2]) / 1e9
        self.fps = (len(self._stills) - 1) / span_s if span_s > 0 else None

    def __iter__(self) -> Iterator[CameraFrame]:
        """Yield the stills that decode."""
        seq = 0
        for path, tags, time_ns in self._stills:
            image = _load(path, tags.size_px, self.turned_deg)
            if image is None or image.shape[:2] != (self.size_px[1], self.size_px[0]):
                self._warn(f"{path.name} cannot be decoded; skipped")
                continue
            yield CameraFrame(image, time_ns, seq, tags.geotag, path.name)
            seq += 1

    @property
    def images(self) -> int:
        """Number of stills."""
        return len(self._stills)

    def middle(self, count: int) -> ImagesSource:
        """The same source with ``count`` stills at most, about the middle one."""
        some, skip = copy(self), max(self.images - count, 0) // 2
        some._stills = self._stills[skip : skip + count]
        return some

    @property
    def times(self) -> dict[str, int]:
        """ns since the first still, by file name."""
        return {path.name: time_ns for path, _, time_ns in self._stills}

    def close(self) -> None:
        """Nothing is open."""

    def _read(self, folder: Path) -> list[tuple[Path, Tags]]:
        paths = sorted(
            (
                p
                for p in folder.iterdir()
                if p.suffix.lower() in SUFFIXES and p.name[0] != "." and p.is_file()
            ),
            key=natural_key,
        )
        tagged = []
        for path in paths:
            try:
                tagged.append((path, read_tags(path)))
            except OSError as error:
                why = " ".join(str(error).split())[:120] or type(error).__name__
                self._warn(f"{path.name} is not a readable image ({why}); skipped")
        if not tagged:
            raise InputError(f"{folder} contains no images (jpg, png, tif); give their folder")
        return tagged

    def _same_size(self, tagged: list[tuple[Path, Tags]]) -> list[tuple[Path, Tags]]:
        """Stills of the size taken at most moments: a camera model is for one size.

        Of sizes taken about as often it is the largest: a drone takes thermal or spectral images
        with those in colour.
        """
        moments: dict[tuple[int, int], set[object]] = {}
        for path, tags in tagged:
            moment = tags.local_ns or tags.gps_unix_ns or path
            moments.setdefault(tags.size_px, set()).add(moment)
        usual = AS_OFTEN * max(map(len, moments.values()))
        size_px = max((s for s, m in moments.items() if len(m) >= usual), key=math.prod)
        kept = [(path, tags) for path, tags in tagged if tags.size_px == size_px]
        if len(kept) < len(tagged):
            self._warn(
                f"{len(tagged) - len(kept)} images are not {size_px[0]}x{size_px[1]} like the "
                "others; skipped"
            )
        return kept

    def _same_lens(self, tagged: list[tuple[Path, Tags]]) -> list[tuple[Path, Tags]]:
        """Stills of the most frequent focal length: a camera model is for one zoom."""
        focal = [0.0 if tags.lens is None else tags.lens.focal for _, tags in tagged]
        known = Counter(f for f in focal if f)
        if not known:
            return tagged
        alike = {f: sum(known[g] for g in known if abs(f / g - 1) < ZOOM) for f in known}
        usual = max(alike, key=alike.__getitem__)
        kept = [t for t, f in zip(tagged, focal, strict=True) if f and abs(f / usual - 1) < ZOOM]
        if len(kept) < len(tagged):
            self._warn(
                f"{len(tagged) - len(kept)} images were not taken with the focal length of the "
                "others; skipped"
            )
        return kept

    def _headings(self, tagged: list[tuple[Path, Tags]]) -> list[tuple[Path, Tags]]:
        """The stills without headings that the aircraft's own contradict."""
        pans = [abs(tags.pan_deg) for _, tags in tagged if tags.pan_deg is not None]
        if not pans or median(pans) <= MAX_PAN_DEG:
            return tagged
        self._warn(
            f"the images head {median(pans):.0f} degrees off the aircraft's nose: their headings "
            "are not used"
        )
        return [
            (path, replace(tags, geotag=tags.geotag and replace(tags.geotag, is_yaw_known=False)))
            for path, tags in tagged
        ]

    def _places(
        self, tagged: list[tuple[Path, Tags]], times_ns: list[int]
    ) -> list[tuple[Path, Tags]]:
        """The stills without positions from which no aircraft reaches most of its flight in time.

        A receiver that has just been switched on may say where it was last.
        """
        from service.georeference import LocalFrame

        fixes = {
            i: (tags.geotag.lat_deg, tags.geotag.lon_deg, 0.0)
            for i, (_, tags) in enumerate(tagged)
            if tags.geotag is not None and tags.geotag.lat_deg is not None
        }
        if not fixes:
            return tagged
        places = np.array(list(fixes.values()), np.float64)
        enu_m, at_s = LocalFrame(*places[0]).to_enu(places), 1e-9 * np.array(times_ns)[list(fixes)]
        few = slice(None, None, len(fixes) // MAX_COMPARED + 1)
        apart_m = np.linalg.norm(enu_m[:, None] - enu_m[few], axis=2)
        apart_s = np.abs(at_s[:, None] - at_s[few])
        is_near = apart_s < ONE_FLIGHT_S
        is_far = is_near & (apart_m > NEAR_M + FASTEST_M_S * apart_s)
        most = np.count_nonzero(is_near, axis=1) / 2
        wild = {i for i, far in zip(fixes, is_far.sum(axis=1) > most, strict=True) if far}
        if wild:
            self._warn(f"{len(wild)} positions are far off all others: not used")
        return [
            (path, replace(tags, geotag=replace(tags.geotag, lat_deg=None, lon_deg=None)))
            if i in wild and tags.geotag is not None
            else (path, tags)
            for i, (path, tags) in enumerate(tagged)
        ]

    def _turn(self, tagged: list[tuple[Path, Tags]]) -> int:
        """Rotation in degrees clockwise for all stills, by their tags.

        A camera that looks down has no defined upper side: where the tags differ, or the gimbal
        itself was rolled, the images stay as stored.
        """
        turns = {tags.turned_deg for _, tags in tagged}
        rolls = [
            abs(tags.geotag.ypr_deg[2])
            for _, tags in tagged
            if tags.geotag is not None and tags.geotag.ypr_deg is not None
        ]
        if rolls and median(rolls) > ROLLED_DEG:
            return 0
        if len(turns) > 1:
            self._warn("the images' tags have different orientations: used as stored")
            return 0
        return turns.pop()

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
            self._warn("the images state no time zone: their local time is taken as UTC")
            return _from_first(spread(local, tags)), min(local)
        if interval_s is None:
            missing = sum(t.local_ns is None and t.name_unix_ns is None for t in tags)
            self._warn(
                f"{missing} of {len(tags)} images have no time; ordered by name, one per second "
                "(set it with images:DIR?interval_s=2)"
            )
        step_ns = round((interval_s or 1.0) * SECOND_NS)
        return [i * step_ns for i in range(len(tags))], unix[0]

    def _warn(self, text: str) -> None:
        """Warn once, however often the stills are read."""
        if text in self.warnings:
            return
        self.warnings.append(text)
        log.warning("%s: %s", self.description, text)


def open_images(rest: str, options: Mapping[str, str]) -> ImagesSource:
    """The stills in folder ``rest``; option ``interval_s`` sets their interval."""
    reject_options("images", options, ("interval_s",))
    folder = Path(rest)
    if not folder.is_dir():
        raise InputError(f"no such folder of images: {folder}")
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
    """Camera's clock minus UTC: as written, otherwise from GPS times; None without either.

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
    """The same times, with stills within one whole second spread evenly over that second.

    Some cameras state no more than whole seconds as fractions, too.
    """
    same = Counter(times_ns)
    is_finer = any(tag.sub_second and (tag.local_ns or 0) % SECOND_NS for tag in tags)
    taken: Counter[int] = Counter()
    out = []
    for time_ns, tag in zip(times_ns, tags, strict=True):
        step = 1 if is_finer and tag.sub_second else SECOND_NS // same[time_ns]
        out.append(time_ns + taken[time_ns] * step)
        taken[time_ns] += 1
    return out


def _from_first(times_ns: list[int]) -> list[int]:
    first = min(times_ns)
    return [t - first for t in times_ns]


def _load(path: Path, stored_px: tuple[int, int], turned_deg: int) -> U8 | None:
    """(H, W, 3) BGR, turned clockwise by ``turned_deg``.

    None when the file does not decode, or its size is no longer ``stored_px`` (W, H). MemoryError
    without memory for it, which is no fault of the file.
    """
    import cv2

    try:
        if read_tags(path).size_px != stored_px:
            return None
        data = np.fromfile(path, np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except OSError:
        return None
    except cv2.error as error:
        if error.code == cv2.Error.StsNoMem:
            raise MemoryError(f"no memory for {path.name}") from error
        return None
    if image is None:
        return None
    return np.ascontiguousarray(np.rot90(image, -(turned_deg // 90)), dtype=np.uint8)
