"""A folder of stills, as mapping drones store them: times and positions from the images' tags."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from copy import copy
from dataclasses import replace
from itertools import chain, islice, pairwise
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from recon.types import F64, U8, Array
from service.cameras import UNREAD, how_to_convert, reject_options
from service.cameras.exif import DEFAULT_SIGMA_H_M, Tags, read_tags
from service.cameras.geo_file import geo_file_of, read_geo
from service.cameras.lens import turned
from service.cameras.source import CameraFrame, CameraSource, GeoTag
from service.errors import InputError

SUFFIXES = frozenset((".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"))

MAX_ENTRIES = 2000  # entries of subfolders in which images are sought where a folder has none

SECOND_NS = 1_000_000_000
ZOOM = 0.03  # relative tolerance of the focal lengths of one camera
AS_OFTEN = 0.9  # of two cameras of one drone, one misses some images at times

FEW_PIXELS = 0.1
"""Share of another camera's pixels below which one does not count: a zoom camera has up to four
times as many as its wide one, and a thermal one a twelfth."""

SHOWN, WIDER, LOOKED_AT = (0.5, 99.5), 0.5, 5
"""Percentiles of the levels of a deep image, of 16 bits or floats, as thermal cameras write them,
that are shown; the share of those that is shown beyond them on each side; and how many images
tell."""

MAX_PER_S = 10  # stills that a drone takes in a second, at most
WIDE = 1 << 15  # where more levels of 16 bits are shown than these it is a photo, and all are

MAX_PAN_DEG = 30.0
"""Gimbals follow the nose: where images head further off it than that, their heading is wrong, as
that of a gimbal without a compass, which drifts; or turned on purpose, and the track shows it."""

NEAR_M, FASTEST_M_S = 1000.0, 100.0
"""Errors of fixes that the track corrects; and no aircraft that maps is faster."""

ONE_FLIGHT_S, MAX_COMPARED = 600.0, 400
"""Images of one flight are so close in time; so many at most are compared with each."""

ROLLED_DEG = 45.0
QUARTER_DEG = 270
"""Clockwise, undoes what a program did to an image of a camera held upright, where no tag states
it; the other way is as likely, and the same to a lens that is alike all around."""

ZONE_NS = 900 * SECOND_NS  # time zones are multiples of a quarter of an hour


Still = tuple[Path, Tags]  # a file and its tags


class ImagesSource(CameraSource):
    """The stills of one folder in order of time; unreadable ones are skipped with a warning."""

    def __init__(
        self,
        folder: Path,
        interval_s: float | None = None,
        camera: str = "",
        hemisphere: str = "",
        geo: Path | None = None,
    ) -> None:
        """Read the tags of every still.

        ``interval_s`` sets times by name instead of by tags, ``camera`` names that of several,
        ``hemisphere`` ("NW") is that of positions that state none. Positions in ``geo``, or in
        the ``geo.txt`` of the folder, replace those of the tags.
        """
        super().__init__(str(folder))
        self._hemisphere = hemisphere
        geo = geo_file_of(folder) if geo is None else geo
        tagged = self._one_camera(self._read(folder), camera)
        tagged = self._sources(tagged) if geo is None else self._surveyed(tagged, geo)
        tagged = self._headings(self._same_lens(self._same_size(tagged)))
        times, self.epoch_unix_ns = self._times(tagged, interval_s)
        tagged = self._places(tagged, times)
        stored = Counter(tags.size_px for _, tags in tagged).most_common(1)[0][0]
        self._stored_px = stored
        self.turned_deg = self._turn(tagged)
        tagged = [(path, self._as_used(tags)) for path, tags in tagged]
        order = sorted(range(len(tagged)), key=lambda i: (times[i], i))
        self._stills = [(*tagged[i], times[i]) for i in order]
        self._flights()
        self.size_px = stored[::-1] if self.turned_deg % 180 else stored
        self.lens = next(tags.lens for _, tags in tagged if tags.size_px == stored)
        self.camera = (
            None if self.lens is None else turned(self.lens.camera(stored), self.turned_deg)
        )
        self._some = [path for path, *_ in self._stills[:: 1 + len(self._stills) // LOOKED_AT]]
        self._black_white: tuple[float, float] | None = None  # of deep images, once known
        span_s = (self._stills[-1][2] - self._stills[0][2]) / 1e9
        self.fps = (len(self._stills) - 1) / span_s if span_s > 0 else None

    def __iter__(self) -> Iterator[CameraFrame]:
        seq = 0
        for path, tags, time_ns in self._stills:
            image = self._load(path, tags)
            if image is None or image.shape[:2] != (self.size_px[1], self.size_px[0]):
                self._warn(f"{path.name} cannot be decoded; skipped")
                continue
            yield CameraFrame(image, time_ns, seq, tags.geotag, path.name)
            seq += 1

    def _load(self, path: Path, tags: Tags) -> U8 | None:
        """(H, W, 3) BGR as it is used; None when the file does not decode, or its size is no longer
        that of its ``tags``."""
        try:
            if read_tags(path).size_px != tags.size_px:
                return None
        except OSError:
            return None
        image = _deep(path)
        if image is not None and image.dtype != np.uint8:
            image = self._eight_bits(image)
        if image is None:
            return None
        back = -(self._turned_deg(tags) // 90)
        return np.ascontiguousarray(np.rot90(image, back), dtype=np.uint8)

    def _eight_bits(self, image: Array) -> Array:
        """A deep image in 8 bits: of all levels, or of those that the stills have."""
        import cv2

        if self._black_white is None:
            some = (one for one in map(_deep, self._some) if one is not None)  # one is held
            ends = [ends_of(one) for one in some if one.dtype == image.dtype] or [ends_of(image)]
            self._black_white = black_and_white(ends)
            if not is_photo(image, self._black_white):
                low, high = self._black_white
                self._warn(f"levels of the images from {low:.5g} to {high:.5g} are black to white")
        shown = levels(image, self._black_white)
        return shown if shown.ndim == 3 else np.asarray(cv2.cvtColor(shown, cv2.COLOR_GRAY2BGR))

    @property
    def images(self) -> int:
        return len(self._stills)

    def only_near(self, times_ns: Iterable[int], within_ns: int) -> None:
        """Yield no other stills than those near ``times_ns``; others are not decoded."""
        wanted = np.fromiter(times_ns, np.int64)
        self._stills = [
            still for still in self._stills if (np.abs(wanted - still[2]) <= within_ns).any()
        ]

    def middle(self, count: int) -> ImagesSource:
        """The same source with ``count`` stills at most, about the middle one."""
        some, skip = copy(self), max(self.images - count, 0) // 2
        some._stills = self._stills[skip : skip + count]
        return some

    @property
    def times(self) -> dict[str, int]:
        """ns since the first still, by file name."""
        return {path.name: time_ns for path, _, time_ns in self._stills}

    def _read(self, folder: Path) -> list[Still]:
        files = [p for p in folder.iterdir() if p.name[0] != "." and p.is_file()]
        paths = sorted((p for p in files if p.suffix.lower() in SUFFIXES), key=natural_key)
        stems = {path.stem for path in paths}  # a camera may store each still twice
        unread = [p for p in files if p.suffix.lower() in UNREAD and p.stem not in stems]
        tagged = []
        for path in paths:
            try:
                tagged.append((path, read_tags(path, self._hemisphere)))
            except OSError as error:
                why = " ".join(str(error).split())[:120] or type(error).__name__
                self._warn(f"{path.name} is not a readable image ({why}); skipped")
        if unread:
            if not tagged:
                raise InputError(f"{folder}: {how_to_convert(unread[0])}")
            of_all = f"{len(unread)} of {len(unread) + len(tagged)}"
            self._warn(f"{of_all} images are left out: {how_to_convert(unread[0])}")
        if not tagged:
            raise InputError(
                f"{folder} contains no images (jpg, png, tif); give their folder{_inside(folder)}"
            )
        return tagged

    def _one_camera(self, tagged: list[Still], chosen: str) -> list[Still]:
        """Stills of the camera ``chosen`` by its name, size or model, else of the one that sees
        most."""
        cameras = by_camera(tagged, lambda tags: tags.camera)
        if chosen:
            named = by_camera(tagged, lambda t: t.model) | by_camera(tagged, size_of) | cameras
            if chosen in named:
                return named[chosen]
            known = ", ".join(filter(None, cameras | named))
            raise InputError(f"{self.description}: no images of camera {chosen!r}, but of {known}")
        if len(cameras) - ("" in cameras) < 2:
            return tagged
        used = widest(cameras)
        others = [name for name in cameras if name not in ("", used)]
        self._warn(
            f"the camera that sees most is used: {used or 'unnamed'}, {len(cameras[used])} of "
            f"{len(tagged)} images; images:DIR?camera={others[0]} takes another "
            f"({', '.join(others)})"
        )
        return cameras[used]

    def _sources(self, tagged: list[Still]) -> list[Still]:
        """The same stills; a warning where two sources differ, or a hemisphere is missing."""
        apart: dict[str, list[float]] = {}
        for _, tags in tagged:
            for words, metres in tags.differences:
                apart.setdefault(words, []).append(metres)
        for words, far in apart.items():
            self._warn(f"{words} ({len(far)} of {len(tagged)} images, {median(far):.1f} m apart)")
        missing = sum(tags.is_hemisphere_missing for _, tags in tagged)
        if missing:
            self._warn(
                f"{missing} positions state no hemisphere (N or S, E or W): not used; "
                "images:DIR?hemisphere=NW gives it"
            )
        return self._one_datum(tagged)

    def _surveyed(self, tagged: list[Still], geo: Path) -> list[Still]:
        """The stills at the positions in ``geo``, and with none where it has none."""
        places, out, missing = read_geo(geo), [], 0
        for path, tags in tagged:
            at, own = places.get(path.name.lower(), places.get(path.stem.lower())), tags.geotag
            missing += at is None
            tag = at or (own and GeoTag(None, None))
            if tag is not None and own is not None:
                tag = replace(tag, ypr_deg=own.ypr_deg, relative_alt_m=own.relative_alt_m)
            out.append((path, replace(tags, geotag=tag)))
        if missing == len(tagged):
            raise InputError(f"{geo} names none of the images in {self.description}")
        self._warn(f"positions are those of {geo.name}: {len(tagged) - missing} of {len(tagged)}")
        if not any(tag.is_sigma_h_stated for tag in places.values()):
            self._warn(
                f"{geo.name} states no accuracies: its positions count as uncertain by "
                f"{DEFAULT_SIGMA_H_M:g} m; surveyed ones need theirs, across and up, in each row"
            )
        return out

    def _one_datum(self, tagged: list[Still]) -> list[Still]:
        """The stills without altitudes above another datum than most of them state."""
        known = [t.geotag.datum for _, t in tagged if t.geotag and t.geotag.alt_amsl_m is not None]
        if len(set(known)) < 2:
            return tagged
        usual = Counter(known).most_common(1)[0][0]
        self._warn(
            f"{len(known) - known.count(usual)} altitudes are above another datum than the others' "
            f"({usual or 'not stated'}): not used"
        )
        return without(tagged, lambda tag: tag.datum != usual, alt_amsl_m=None)

    def _same_size(self, tagged: list[Still]) -> list[Still]:
        """Stills of the size taken at most moments, as stored or turned by a quarter: a camera
        model is for one size.

        Of sizes taken about as often it is that of the camera that sees most: a drone takes
        thermal or spectral images with those in colour.
        """
        sizes = by_camera(tagged, lambda tags: "{}x{}".format(*sorted(tags.size_px)))
        used = sizes.pop(widest(sizes))
        size, *turned = (name for name, _ in Counter(size_of(t) for _, t in used).most_common())
        if turned:
            odd = sum(size_of(tags) != size for _, tags in used)
            self._warn(f"{odd} images are {turned[0]}: turned to {size} like the others")
        if sizes:
            other = size_of(max(sizes.values(), key=len)[0][1])
            self._warn(
                f"{len(tagged) - len(used)} images are not {size} like the others; skipped "
                f"(images:DIR?camera={other} takes those)"
            )
        return used

    def _turned_deg(self, tags: Tags) -> int:
        """Rotation of a still from how it is stored to how it is used, clockwise."""
        back = tags.turned_deg if tags.turned_deg % 180 else QUARTER_DEG
        return (self.turned_deg + back * (tags.size_px != self._stored_px)) % 360

    def _as_used(self, tags: Tags) -> Tags:
        """The tags of a still whose gimbal's angles are those of the image as it is used: of one
        that is used on its side they are of its upper side."""
        tag = tags.geotag
        if tag is None or tag.ypr_deg is None or tags.size_px == self._stored_px:
            return tags
        yaw, pitch, roll = tag.ypr_deg
        if abs(roll) > ROLLED_DEG:  # the gimbal's own turn
            return tags
        ypr_deg = yaw, pitch, roll - (self._turned_deg(tags) - tags.turned_deg)
        return replace(tags, geotag=replace(tag, ypr_deg=ypr_deg))

    def _same_lens(self, tagged: list[Still]) -> list[Still]:
        """Stills of the most frequent focal length, the shortest of those as frequent: a camera
        model is for one zoom."""
        focal = [0.0 if tags.lens is None else tags.lens.focal for _, tags in tagged]
        known = Counter(f for f in focal if f)
        if not known:
            return tagged
        alike = {f: sum(known[g] for g in known if abs(f / g - 1) < ZOOM) for f in known}
        most = max(alike.values())
        usual = min(f for f, times in alike.items() if times >= AS_OFTEN * most)
        kept = [t for t, f in zip(tagged, focal, strict=True) if f and abs(f / usual - 1) < ZOOM]
        if len(kept) < len(tagged):
            models = {tags.model for _, tags in kept}
            others = {tags.model for _, tags in tagged} - models - {""}
            takes = f" (images:DIR?camera={min(others)} takes those)" if others else ""
            self._warn(
                f"{len(tagged) - len(kept)} images were not taken with the focal length of the "
                f"others; skipped{takes}"
            )
        return kept

    def _headings(self, tagged: list[Still]) -> list[Still]:
        """The stills without headings that the aircraft's own contradict."""
        pans = [abs(tags.pan_deg) for _, tags in tagged if tags.pan_deg is not None]
        if not pans or median(pans) <= MAX_PAN_DEG:
            return tagged
        self._warn(
            f"the images head {median(pans):.0f} degrees off the aircraft's nose: their headings "
            "are not used"
        )
        return without(tagged, lambda tag: True, is_yaw_known=False)

    def _places(self, tagged: list[Still], times_ns: list[int]) -> list[Still]:
        """The stills without positions from which no aircraft reaches most of its flight in time. A
        receiver that has just been switched on may say where it was last."""
        from service.georeference import LocalFrame

        pairs = zip((tags.geotag for _, tags in tagged), times_ns, strict=True)
        fixes = [(tag, ns) for tag, ns in pairs if tag is not None and tag.lat_deg is not None]
        if not fixes:
            return tagged
        places = np.array([(tag.lat_deg, tag.lon_deg, 0.0) for tag, _ in fixes], np.float64)
        enu_m, at_s = LocalFrame(*places[0]).to_enu(places), 1e-9 * np.array([t for _, t in fixes])
        few = slice(None, None, len(fixes) // MAX_COMPARED + 1)
        apart_m = np.linalg.norm(enu_m[:, None] - enu_m[few], axis=2)
        apart_s = np.abs(at_s[:, None] - at_s[few])
        is_near = apart_s < ONE_FLIGHT_S
        is_far = is_near & (apart_m > NEAR_M + FASTEST_M_S * apart_s)
        most = np.count_nonzero(is_near, axis=1) / 2
        is_wild = is_far.sum(axis=1) > most
        wild = {id(tag) for (tag, _), far in zip(fixes, is_wild, strict=True) if far}
        if wild:
            self._warn(f"{len(wild)} positions are far off all others: not used")
        return without(tagged, lambda tag: id(tag) in wild, lat_deg=None, lon_deg=None)

    def _flights(self) -> None:
        """A warning where more time lies between two stills than within a flight."""
        longest_ns = ONE_FLIGHT_S * SECOND_NS
        first = [b for a, b in pairwise(self._stills) if b[2] - a[2] > longest_ns]
        if first:
            self._warn(
                f"the images are of {len(first) + 1} flights, the second from {first[0][0].name} "
                "on: one scan of all; of other places or days give each flight its own folder"
            )

    def _turn(self, tagged: list[Still]) -> int:
        """Rotation in degrees clockwise for all stills, by their tags.

        A camera that looks down has no defined upper side: where the tags differ, or the gimbal
        itself was rolled, the images stay as stored.
        """
        turns = {tags.turned_deg for _, tags in tagged if tags.size_px == self._stored_px}
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

    def _times(self, tagged: list[Still], interval_s: float | None) -> tuple[list[int], int | None]:
        """(ns since the first still, UTC of the first still when known) of every still."""
        tags = [t for _, t in tagged]
        offset_ns = clock_offset_ns(tags)
        unix = [utc_ns(t, offset_ns) for t in tags]
        known = differing(unix)
        if interval_s is None and len(known) == len(tags):
            return _from_first(spread(known, tags)), min(known)
        local = differing(t.local_ns for t in tags)
        if interval_s is None and len(local) == len(tags):
            self._warn("the images state no time zone: their local time is taken as UTC")
            return _from_first(spread(local, tags)), min(local)
        if interval_s is None:
            missing = sum(t.local_ns is None and t.name_unix_ns is None for t in tags)
            order, by = self._order(tagged)
            lack = (
                f"{missing} of {len(tags)} images have no time" if missing else "one time for all"
            )
            self._warn(
                f"{lack}; ordered by {by}, one per second "
                "(images:DIR?interval_s=2 orders them by name and sets it)"
            )
            first = unix[order[0]] or tags[order[0]].local_ns
            return [int(n) * SECOND_NS for n in np.argsort(order)], first
        step_ns = round((interval_s or 1.0) * SECOND_NS)
        return [i * step_ns for i in range(len(tags))], unix[0]

    def _order(self, tagged: list[Still]) -> tuple[list[int], str]:
        """Indices of stills without times in the order in which they are used, and by what."""
        from service.cameras import still_order
        from service.georeference import LocalFrame

        fixes = [(t.geotag.lat_deg, t.geotag.lon_deg, 0.0) for _, t in tagged if t.geotag]
        places = np.array(fixes, np.float64)  # None is NaN
        named = list(range(len(tagged)))
        if len(tagged) > still_order.MOST:
            order, by = named, "name"
        elif len(places) == len(tagged) and np.isfinite(places).all():
            order, by = still_order.by_place(LocalFrame(*places[0]).to_enu(places)), "place"
        else:
            order, by = still_order.by_likeness([path for path, _ in tagged]), "likeness"
        return (named, "name") if order == named else (order, by)


def open_images(rest: str, options: Mapping[str, str]) -> ImagesSource:
    """The stills in folder ``rest``; options as for :class:`ImagesSource`."""
    reject_options("images", options, ("interval_s", "camera", "hemisphere", "geo"))
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
    hemisphere = options.get("hemisphere", "").upper()
    if hemisphere not in ("", "NE", "NW", "SE", "SW"):
        raise InputError(f"images: hemisphere must be NE, NW, SE or SW, not {hemisphere!r}")
    geo = Path(options["geo"]) if "geo" in options else None
    return ImagesSource(folder, interval_s, options.get("camera", ""), hemisphere, geo)


def without(tagged: list[Still], is_meant: Callable[[GeoTag], bool], **values: Any) -> list[Still]:
    """The stills; those whose tag of place and attitude is meant have these values in it."""
    return [
        (path, replace(tags, geotag=replace(tags.geotag, **values)))
        if tags.geotag is not None and is_meant(tags.geotag)
        else (path, tags)
        for path, tags in tagged
    ]


def size_of(tags: Tags) -> str:
    return "{}x{}".format(*tags.size_px)


def by_camera(tagged: list[Still], name: Callable[[Tags], str]) -> dict[str, list[Still]]:
    """Stills by what tells cameras apart."""
    cameras: dict[str, list[Still]] = {}
    for still in tagged:
        cameras.setdefault(name(still[1]), []).append(still)
    return cameras


def widest(cameras: Mapping[str, list[Still]]) -> str:
    """The camera that sees most, of those that took about as many shots as any. Those with few
    pixels are thermal; without focal lengths the most pixels count."""
    moments = {
        name: len({tags.local_ns or tags.gps_unix_ns or path for path, tags in stills})
        for name, stills in cameras.items()
    }
    usual = [name for name in cameras if moments[name] >= AS_OFTEN * max(moments.values())]
    pixels = {name: median(math.prod(t.size_px) for _, t in cameras[name]) for name in usual}
    sharp = [name for name in usual if pixels[name] >= FEW_PIXELS * max(pixels.values())]
    focals = {n: [t.lens.focal for _, t in cameras[n] if t.lens is not None] for n in sharp}
    if all(focals.values()):
        return min(sharp, key=lambda name: (median(focals[name]), -pixels[name]))
    return max(sharp, key=pixels.__getitem__)


def _inside(folder: Path) -> str:
    """The folders in a folder that hold images, as on a camera's card, as words; few are read."""
    below = chain(*(islice(folder.glob(pattern), MAX_ENTRIES) for pattern in ("*/*", "*/*/*")))
    found = sorted({str(p.parent) for p in below if p.suffix.lower() in SUFFIXES})
    return f": {', '.join(found[:3])}" if found else ""


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
    """The same times, with stills within one whole second spread evenly over that second. Some
    cameras state no more than whole seconds as fractions, too."""
    same = Counter(times_ns)
    is_finer = any(tag.sub_second and (tag.local_ns or 0) % SECOND_NS for tag in tags)
    taken: Counter[int] = Counter()
    out = []
    for time_ns, tag in zip(times_ns, tags, strict=True):
        step = 1 if is_finer and tag.sub_second else SECOND_NS // same[time_ns]
        out.append(time_ns + taken[time_ns] * step)
        taken[time_ns] += 1
    return out


def differing(times_ns: Iterable[int | None]) -> list[int]:
    """The times that are known; none where more stills state one than a camera takes in a second:
    a tool wrote it."""
    known = [t for t in times_ns if t is not None]
    return [] if max(Counter(known).values(), default=0) > MAX_PER_S else known


def _from_first(times_ns: list[int]) -> list[int]:
    first = min(times_ns)
    return [t - first for t in times_ns]


def _deep(path: Path) -> Array | None:
    """The still as :func:`_decoded`, of as many bits as it has; one channel alone in floats."""
    import cv2

    image = _decoded(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if image is None and path.suffix.lower() in (".tif", ".tiff"):
        image = _decoded(path, cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH)
    return image


def _decoded(path: Path, flags: int) -> Array | None:
    """(H, W, 3) BGR as stored; None when the file does not decode. ``flags``: cv2.IMREAD_*.
    MemoryError without memory for it, which is no fault of the file."""
    import cv2

    try:
        data = np.fromfile(path, np.uint8)
        image: Array | None = cv2.imdecode(data, cv2.IMREAD_IGNORE_ORIENTATION | flags)
        return image
    except OSError:
        return None
    except cv2.error as error:
        if error.code == cv2.Error.StsNoMem:
            raise MemoryError(f"no memory for {path.name}") from error
        return None


def ends_of(image: Array) -> F64:
    """(2,) the darkest and the brightest level of a deep image that are shown; NaN without any.
    Infinity, as some write it where nothing is known, is no level."""
    few = image[::4, ::4].astype(np.float64)
    known = few[np.isfinite(few)]
    return np.percentile(known, SHOWN) if known.size else np.full(2, np.nan)


def black_and_white(ends: Iterable[F64]) -> tuple[float, float]:
    """The levels that 8 bits show as 0 and 255, of the ``ends`` of deep images."""
    found = np.array([end for end in ends if np.isfinite(end).all()] or [np.zeros(2)])
    low, high = float(found[:, 0].min()), float(found[:, 1].max())
    more = WIDER * max(high - low, 1e-3, 1e-6 * abs(low))
    return low - more, high + more


def is_photo(image: Array, low_high: tuple[float, float]) -> bool:
    """Whether a deep image uses so many levels that all are shown."""
    return image.dtype == np.uint16 and low_high[1] - low_high[0] > WIDE


def levels(image: Array, low_high: tuple[float, float]) -> U8:
    """A deep image in 8 bits: of all levels, or of those between black and white."""
    if is_photo(image, low_high):
        return np.asarray(image >> 8, np.uint8)
    low, high = low_high
    with np.errstate(over="ignore", invalid="ignore"):  # foreign floats may be any
        share = (image.astype(np.float32) - low) * (255.0 / (high - low))
    return np.asarray(np.nan_to_num(share).clip(0.0, 255.0), np.uint8)
