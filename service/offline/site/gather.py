"""The keyframes of several scans in one store, in one frame of reference.

A site's folder is a scan folder: its ``scan.db`` holds every keyframe of its scans under a new
number, so whatever works on a scan works on a site. The scans themselves are only read.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from recon import se3
from recon.similarity import Similarity
from service.errors import InputError
from service.georeference import LocalFrame, between_frames
from service.offline.refine.revisions import finished_store
from service.offline.site import DRONE
from service.offline.site.start import Pair, placing
from service.scans.main_piece import main_seqs
from service.scans.track import local_frame
from service.stream import codec
from service.stream.records import Repose, ScanHeader
from service.stream.store import ScanStore
from service.version import software

MAX_DISTANCE_M = 20_000.0
"""Between the origins of two scans of one site: their tangent planes still agree there."""


@dataclass(frozen=True, slots=True, eq=False)
class Member:
    """One scan of a site and its place in the site's store."""

    name: str
    folder: Path
    header: ScanHeader
    move: Similarity  # to the site, by the two origins or by points alone
    first: int  # its keyframes' numbers in the site's store
    last: int
    start: list[Pair] | None = None  # points that place it

    @property
    def seqs(self) -> range:
        return range(self.first, self.last + 1)


def gather(
    folders: Sequence[Path], path: Path, name: str, starts: Mapping[Path, list[Pair]] | None = None
) -> tuple[list[Member], list[str]]:
    """Copy the keyframes of the scans in ``folders`` into a new store; its members, and notes.

    A scan without surface, or without georeference and points in ``starts``, is left out with a
    note, and so is one given twice. Raises InputError for a folder without a finished scan, for
    scans too far apart, for points that place no scan, and where nothing is left.
    """
    starts = starts or {}
    with ExitStack() as stack:
        stores = [stack.enter_context(finished_store(folder, "align")) for folder in folders]
        chosen, origin, notes = _chosen(folders, stores, starts)
        header = _site_header(name, [s.header for _, s in chosen], origin)
        members: list[Member] = []
        with ScanStore.create(path, header) as site:
            names = _names([folder for folder, _ in chosen])
            for (folder, store), title in zip(chosen, names, strict=True):
                first = members[-1].last + 1 if members else 0
                members.append(_copied(store, site, origin, title, folder, first, starts))
            _copy_poses([s for _, s in chosen], site, members, origin)
            assumed = {w for _, s in chosen for w in (s.summary or {}).get("assumed") or []}
            summary = {"assumed": sorted(assumed), "scans": list(names)}
            site.finish(summary)
    return members, notes


def _chosen(
    folders: Sequence[Path], stores: Sequence[ScanStore], starts: Mapping[Path, list[Pair]]
) -> tuple[list[tuple[Path, ScanStore]], LocalFrame, list[str]]:
    """The scans that can be part of a site, its origin, and why others cannot."""
    chosen: list[tuple[Path, ScanStore]] = []
    notes: list[str] = []
    for folder, store in zip(folders, stores, strict=True):
        twin = next((f for f, s in chosen if _is_same_flight(s, store)), None)
        if twin is not None:
            notes.append(f"{folder.name} is the same flight as {twin.name}: counted once")
        elif local_frame(store.header) is None and folder.resolve() not in starts:
            notes.append(
                f"{folder.name} has no georeference: left out; refine it with --gcp, or place it "
                "with --start"
            )
        elif not main_seqs(store):
            notes.append(f"{folder.name} contains no surface: left out")
        else:
            chosen.append((folder, store))
    chosen.sort(key=lambda one: local_frame(one[1].header) is None)
    frames = [(folder, local_frame(store.header)) for folder, store in chosen]
    located = [(folder, frame) for folder, frame in frames if frame is not None]
    if not located:
        raise InputError("; ".join(["no usable scan with a georeference for a site", *notes]))
    origin = located[0][1]
    for folder, frame in located:
        if folder.resolve() in starts:
            raise InputError(f"{folder} has a georeference; --start is for scans without one")
        away = float(np.linalg.norm(between_frames(origin, frame)[:3, 3]))
        if away > MAX_DISTANCE_M:
            raise InputError(f"{folder} lies {away / 1e3:.0f} km from {chosen[0][0]}: not one site")
    zones = {frame.epsg for _, frame in located}
    if len(zones) > 1:
        notes.append(f"scans of several zones {sorted(zones)}: the site takes EPSG {origin.epsg}")
    return chosen, origin, notes


def _is_same_flight(a: ScanStore, b: ScanStore) -> bool:
    """True for one scan, or for two replays of one recording."""
    if a.header.identity == b.header.identity:
        return True
    here, there = local_frame(a.header), local_frame(b.header)
    if here is None or there is None or a.header.started_unix_ns != b.header.started_unix_ns:
        return False
    one, two = (s.poses()[:1] for s in (a, b))
    if not one or not two or one[0].time_unix_ns != two[0].time_unix_ns:
        return False
    T = between_frames(here, there)
    apart = se3.inverse(one[0].T_world_camera) @ T @ two[0].T_world_camera
    return float(np.linalg.norm(apart[:3, 3])) < 5.0 and bool(np.trace(apart[:3, :3]) > 2.97)


def _site_header(name: str, headers: Sequence[ScanHeader], origin: LocalFrame) -> ScanHeader:
    first = headers[0]
    identities = repr(sorted(h.identity for h in headers)).encode()
    return replace(
        first, scan_id=name, drone=DRONE, software=software(), notes=(),
        started_unix_ns=min(h.started_unix_ns for h in headers),
        origin_lat_deg=origin.lat_deg, origin_lon_deg=origin.lon_deg,
        origin_alt_amsl_m=origin.alt_amsl_m, epsg=origin.epsg,
        run_id=hashlib.sha256(identities).hexdigest()[:32],
    )  # fmt: skip


def _names(folders: Sequence[Path]) -> list[str]:
    """A name for each scan: its folder's, with its drone's where several are called alike."""
    names = [f.resolve().name for f in folders]
    return [
        n if names.count(n) == 1 else f"{f.resolve().parent.name}-{n}-{k + 1}"
        for k, (n, f) in enumerate(zip(names, folders, strict=True))
    ]


def _copied(
    store: ScanStore, site: ScanStore, origin: LocalFrame, title: str, folder: Path, first: int,
    starts: Mapping[Path, list[Pair]],
) -> Member:  # fmt: skip
    """Copy the layers of one scan's main piece under new numbers, from ``first`` on."""
    frame, spread, start = local_frame(store.header), None, None
    if frame is not None:
        T = between_frames(origin, frame)
        move = Similarity(1.0, T[:3, :3], T[:3, 3])
    else:
        start = starts[folder.resolve()]
        move, spread = placing(start, origin)
    reposes, new = [], first
    for seq in main_seqs(store):
        repose = store.repose(seq)
        layers = []
        for layer in range(codec.MAX_LAYERS):
            opened = codec.unpack(store.chunk(seq, layer) or b"")
            if opened is not None:
                head, sections = opened
                T = head.T_world_camera if repose is None else repose.T_world_camera
                head = replace(head, seq=new, T_world_camera=move.pose(T))
                layers.append(codec.pack(head, sections))
        if not layers:
            continue  # only tiles of the narrow radio
        site.add_keyframe(new, layers, store.image(seq))
        if spread is not None:
            T, scale = head.T_world_camera, 1.0 if repose is None else repose.scale
            around = se3.about(-T[:3, 3], spread)
            reposes.append(Repose(new, 0, T, move.scale * scale, around))
        elif repose is not None:
            T = move.pose(repose.T_world_camera)
            reposes.append(Repose(new, 0, T, repose.scale, repose.covariance))
        new += 1
    site.add_reposes(reposes)
    return Member(title, folder, store.header, move, first, new - 1, start)


def _copy_poses(
    stores: Sequence[ScanStore], site: ScanStore, members: Sequence[Member], origin: LocalFrame
) -> None:
    """The trajectories one after the other; none where drones flew at the same time."""
    tracks = [(s.poses(), k) for k, s in enumerate(stores)]
    tracks = sorted((t for t in tracks if t[0]), key=lambda t: t[0][0].time_unix_ns)
    ends = [(t[0][0].time_unix_ns, t[0][-1].time_unix_ns) for t in tracks]
    if any(after[0] <= before[1] for before, after in pairwise(ends)):
        return
    for track, k in tracks:
        placed = []
        for pose in track:
            T = members[k].move.pose(pose.T_world_camera)
            geodetic: Sequence[float | None] = origin.place(T[:3, 3])
            if not np.isfinite(np.array(geodetic)).all():
                geodetic = None, None, None
            lat, lon, alt = geodetic
            placed.append(replace(pose, T_world_camera=T, lat_deg=lat, lon_deg=lon, alt_amsl_m=alt))
        site.add_poses(placed)
