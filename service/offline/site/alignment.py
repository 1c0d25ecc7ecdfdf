"""``skyrelief site align``: several scans moved onto each other, in a folder of their own."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from recon import se3
from recon.camera_model import rays
from recon.posegraph.records import Loop
from recon.similarity import umeyama
from recon.survey.ground_control import (
    KeyframeTrack,
    adjust,
    supported,
)
from recon.survey.site_alignment import SiteAlignment, Tie, align, alike
from recon.types import F64, Keyframe
from service.errors import InputError
from service.offline.exports.clouds import VOXELS_MARGIN_M, points_of
from service.offline.exports.view import USUAL, ExportOptions, ScanView
from service.offline.refine.revisions import NEWEST, Revisions
from service.offline.refine.stored_loops import BREAK_S, stored_loops
from service.offline.site import SITE
from service.offline.site.gather import Member, gather
from service.offline.site.start import SIGMA_SCALE as START_SCALE
from service.offline.site.start import KnownSite, Pair
from service.progress import Progress
from service.scans.folder import resolution_m, write_deliverables
from service.scans.fused_cloud import TiledCloud
from service.scans.track import local_frame
from service.scans.writing import write_whole
from service.small_file import read_json
from service.stream.records import Repose
from service.stream.store import ScanStore

ALIGNED = 1
"""Revision of the poses by the alignment; 0 are the scans' own."""

MIN_TIES = 3
"""Between two scans; fewer may be chance."""

MIN_SIGMA, MAX_SIGMA = np.array([0.003] * 3 + [0.05] * 3 + [0.003]), 1e4
"""Sigmas of a scan's own heading, position and scale: rad, m, share."""

SIGMA_SCALE = 0.01
"""Sigma of the scale of a scan that states none."""

SAME_SCALE = 1e-5
"""Sigma of the scale along a scan: what a flight's scale varies by is shift of its keyframes."""

MAX_SITE_BYTES = 100_000_000
KEPT = 128
"""Keyframes held in memory while ties are sought."""

CORNERS = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])
"""Places of a view, in shares of it, that a tie holds."""


@dataclass(frozen=True, slots=True, eq=False)
class AlignedSite:
    """A site's folder and what is known of its parts."""

    folder: Path
    members: list[Member]
    alignment: SiteAlignment
    document: dict[str, Any]  # the content of site.json


def align_site(
    folders: Sequence[Path], out: Path, deliver: bool = True,
    starts: Mapping[Path, list[Pair]] | None = None, progress: Progress | None = None,
    options: ExportOptions = USUAL,
) -> AlignedSite:  # fmt: skip
    """Gather the scans into the folder ``out``, align them, and write the site's files.

    The scans of a site that lies there already come first; its earlier alignments stay listed.
    ``starts`` place scans without georeference, by their folders; ``options`` are those of the
    site's cloud. Waits while another process aligns this site.
    Raises InputError for scans that make no site, and when ``out`` holds anything else.
    """
    _known(out)
    progress = progress or Progress()
    with _locked(out):
        site = _align(folders, out, starts or {}, progress)
        if deliver:
            write_files(out, options, progress)
    return site


def write_files(
    folder: Path, options: ExportOptions = USUAL, progress: Progress | None = None
) -> None:
    """Write the files of the site in ``folder``, the cloud of a large one in tiles.

    Errors as of :func:`write_deliverables`.
    """
    with ScanStore.open(folder / "scan.db") as store, ScanView(folder, None, progress) as view:
        options = replace(options, voxel_m=resolution_m(store.header))
        cut, tiled = view.tiling(options, VOXELS_MARGIN_M), None
        if len(cut.tiles) > 1:
            tiled = TiledCloud(
                points_of(view, options, is_classified=False), options.voxel_m or cut.sample_m,
                cut.sample_m, len(cut.prints), sum(p.points for p in cut.prints), cut.bounds,
            )  # fmt: skip
        write_deliverables(folder, store, tiled=tiled)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder, when it is free; the folder is made."""
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as stack:
            try:
                handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
                stack.callback(os.close, handle)
                fcntl.flock(handle, fcntl.LOCK_EX)
                is_there = os.path.samestat(os.fstat(handle), os.stat(folder))
            except FileNotFoundError:
                is_there = False
            if is_there:
                yield
                return
            # The process that held the lock has removed the folder.


def _align(
    folders: Sequence[Path], out: Path, starts: Mapping[Path, list[Pair]], progress: Progress
) -> AlignedSite:
    known = _known(out)
    earlier = [Path(scan.folder) for scan in known.scans]
    gone = [f for f in earlier if not (f / "scan.db").is_file()]
    folders = [*(f for f in earlier if f not in gone), *folders]
    unique = list(dict.fromkeys(f.resolve() for f in folders))
    known_starts = {Path(s.folder): s.start for s in known.scans if s.start is not None}
    starts = known_starts | {folder.resolve(): start for folder, start in starts.items()}
    strange = [str(folder) for folder in starts if folder not in unique]
    fresh = out / ".scan.db.new"
    _remove(fresh)
    try:
        if strange:
            raise InputError(f"--start names {strange[0]}, which is none of the scans")
        members, notes = gather(unique, fresh, out.resolve().name, starts)
        notes += [f"{f} is no longer there: left out" for f in gone]
        with ScanStore.open(fresh) as store:
            found, centres_m, ties, adjusted = _aligned(store, members, progress)
            store.add_reposes(_reposes(store, members, found, adjusted))
            document = _document(store, members, found, centres_m, ties, notes, known)
            store.update_header(notes=tuple(document["notes"]))
        write_whole(out / SITE, json.dumps(document, indent=1) + "\n")
        _remove(out / "scan.db")
        os.replace(fresh, out / "scan.db")
    finally:
        _remove(fresh)
        if not any(out.iterdir()):
            out.rmdir()
    return AlignedSite(out, members, found, document)


def _known(out: Path) -> KnownSite:
    """The earlier alignment in ``out``; InputError when it is another folder."""
    if (out / SITE).is_file():
        return read_json(out / SITE, KnownSite, MAX_SITE_BYTES, "a site; remove the folder")
    if not out.exists() or (out.is_dir() and all(path.name[0] == "." for path in out.iterdir())):
        return KnownSite([])  # empty, or left by a process that was killed
    raise InputError(f"{out} exists and is not a site; choose another folder")


def _remove(path: Path) -> None:
    for suffix in ("", "-wal", "-shm"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)


# ---- alignment ---------------------------------------------------------------------------------


def _aligned(
    store: ScanStore, members: Sequence[Member], progress: Progress
) -> tuple[SiteAlignment, F64, list[Tie], dict[int, tuple[F64, F64]]]:
    """The motions of the scans, their centres (S, 3), the ties, and each keyframe's pose and
    covariance."""
    track, seqs, scans = _joined(store, members)
    keyframe = lru_cache(maxsize=KEPT)(lambda k: store.keyframe(seqs[k]))
    ties, kept = [], []
    if len(members) > 1:
        with progress.part("seeking ties", 0.9):
            loops = stored_loops(track, keyframe, progress, scans, min_gap=1)
        for loop in supported(loops, track.poses):
            one = keyframe(loop.b)
            assert one is not None
            ends = scans[loop.a], scans[loop.b]
            if members[ends[0]].start is None and members[ends[1]].start is None:
                loop = replace(loop, ratio=1.0)  # noise: their scales are known better
            ties.append(tie(loop, ends, track.poses[loop.a], track.poses[loop.b], corners(one)))
            kept.append(loop)
    own = [np.array(scans) == k for k in range(len(members))]
    centres_m, sigma = placing([(track.poses[k], track.covariances[k]) for k in own])
    is_started = np.array([member.start is not None for member in members])
    sigma[is_started, 6] = START_SCALE
    if not is_started.all():
        sigma[~is_started] = alike(sigma[~is_started])
    found = align(ties, centres_m, sigma)
    bent = zip(*_bent(track, scans, found, kept, ties), strict=True)
    return found, centres_m, ties, dict(zip(seqs, bent, strict=True))


def _bent(
    track: KeyframeTrack, scans: Sequence[int], found: SiteAlignment, loops: Sequence[Loop],
    ties: Sequence[Tie],
) -> tuple[F64, F64]:  # fmt: skip
    """Poses and covariances after the motions of the scans, adjusted to the ties.

    Errors of the receiver and of vision that change along a flight bend its track; the ties show
    where.
    """
    moved = np.array([found.moves[s].pose(T) for s, T in zip(scans, track.poses, strict=True)])
    closures = []
    for loop, tie, used in zip(loops, ties, found.used, strict=True):
        if used:
            at_a, at_b = found.moves[tie.a].points(tie.at_a), found.moves[tie.b].points(tie.at_b)
            fit = umeyama(at_b, at_a)
            assert fit is not None  # four corners of a view
            D = se3.compose(fit.R, at_a.mean(axis=0) - fit.R @ at_b.mean(axis=0))
            T = se3.inverse(moved[loop.a]) @ D @ moved[loop.b]
            closures.append(replace(loop, T_a_b=T))
    if not closures:
        return moved, track.covariances
    whole = KeyframeTrack(moved, track.times_s, track.covariances, loops=closures)
    try:
        adjusted = adjust(whole, sigma_scale=SAME_SCALE, sigma_scale_walk=SAME_SCALE)
    except RuntimeError as error:  # so the solver says that the system is ill-posed
        raise InputError("the poses of these scans contradict each other too much") from error
    return adjusted.poses, adjusted.covariances


def _joined(
    store: ScanStore, members: Sequence[Member]
) -> tuple[KeyframeTrack, list[int], list[int]]:
    """All keyframes one scan after the other, their numbers in the store, and their scans."""
    states = Revisions(store).states(NEWEST)
    order = np.argsort(states.seqs)
    seqs = np.array(states.seqs)[order]
    scans = np.searchsorted([member.last for member in members], seqs)
    times_s = np.zeros(len(seqs))
    for k in range(len(members)):
        own_ns = states.times_ns[order][scans == k]
        if len(own_ns):  # scans may have been flown at once
            begun_s = times_s.max() + 10.0 * BREAK_S
            times_s[scans == k] = begun_s + (own_ns - own_ns[0]) * 1e-9
    track = KeyframeTrack(states.poses[order], times_s, states.covariances[order])
    return track, seqs.tolist(), scans.tolist()


def corners(one: Keyframe) -> F64:
    """(4, 3) m places of a keyframe's ground in its camera's frame."""
    h, w = one.depth.depth_m.shape
    return rays(one.depth.K, CORNERS * [w, h]) * float(np.nanmedian(one.depth.depth_m))


def tie(loop: Loop, scans: tuple[int, int], T_a: F64, T_b: F64, here: F64) -> Tie:
    """The places ``here`` (N, 3) in the loop's second camera, as it has them in both scans.

    ``T_a`` and ``T_b`` are the (4, 4) poses of the loop's cameras in the site.
    """
    there = se3.transform(loop.T_a_b, here)
    there += (loop.ratio - 1.0) * (there - there.mean(axis=0))
    J = np.concatenate([-se3.hat(there), np.tile(np.eye(3), (len(there), 1, 1))], axis=2)
    spread = T_a[:3, :3] @ (J @ loop.covariance @ J.transpose(0, 2, 1)) @ T_a[:3, :3].T
    count = len(there) * 3 / 6.0  # a motion has six numbers, four places twelve
    return Tie(*scans, se3.transform(T_a, there), se3.transform(T_b, here), count * spread)


def placing(scans: Sequence[tuple[F64, F64]]) -> tuple[F64, F64]:
    """Centres (S, 3) of scans and how sure their own poses (N, 4, 4) place them, with left
    covariances (N, 6, 6): sigmas (S, 7) in rad, m and share."""
    centres_m = np.array([poses[:, :3, 3].mean(axis=0) for poses, _ in scans])
    sigma = np.full((len(scans), 7), SIGMA_SCALE)
    for k, (_, covariances) in enumerate(scans):
        spread = se3.about(centres_m[k], covariances.mean(axis=0))
        sigma[k, :6] = np.sqrt(np.maximum(np.diag(spread), 0.0))
    return centres_m, np.clip(sigma, MIN_SIGMA, MAX_SIGMA)


def _reposes(
    store: ScanStore, members: Sequence[Member], found: SiteAlignment,
    adjusted: dict[int, tuple[F64, F64]],
) -> list[Repose]:  # fmt: skip
    out = []
    for member, move in zip(members, found.moves, strict=True):
        for seq in member.seqs:
            if seq in adjusted:
                now = store.repose(seq)
                scale = move.scale * (1.0 if now is None else now.scale)
                out.append(Repose(seq, ALIGNED, adjusted[seq][0], scale, adjusted[seq][1]))
    return out


# ---- the document ------------------------------------------------------------------------------


def _document(
    store: ScanStore, members: Sequence[Member], found: SiteAlignment,
    centres_m: F64, ties: Sequence[Tie], notes: Sequence[str], known: KnownSite,
) -> dict[str, Any]:  # fmt: skip
    frame = local_frame(store.header)
    assert frame is not None
    pairs = _pairs(members, found, ties)
    notes = list(notes)
    for k, member in enumerate(members):
        if len(members) > 1 and not any(member.name in (p["a"], p["b"]) for p in pairs):
            notes.append(
                f"{member.name} is tied to no other scan: it stays where its {_by(member)} put it"
            )
        elif found.groups[k] != found.groups[0]:
            notes.append(f"{member.name} is not tied to {members[0].name}, nor through others")
    for pair in pairs:
        if pair["ties"] < MIN_TIES:
            notes.append(
                f"{pair['a']} and {pair['b']} share only {pair['ties']} tie(s): their alignment "
                "is not sure (little overlap, another season or light)"
            )
    revision = known.revision + 1
    scans = [_scan(m, found, centres_m, k) for k, m in enumerate(members)]
    moves = {s["name"]: s["T_site_scan"] for s in scans}
    return {
        "schema": 1,
        "site": store.header.scan_id,
        "revision": revision,
        "origin": asdict(frame),
        "epsg": frame.epsg,
        "scans": scans,
        "pairs": pairs,
        "notes": notes,
        "history": [*known.history, {"revision": revision, "T_site_scan": moves}],
    }


def _scan(member: Member, found: SiteAlignment, centres_m: F64, k: int) -> dict[str, Any]:
    move = found.moves[k]
    sigma = np.sqrt(np.diag(found.covariance)[7 * k : 7 * k + 7])
    tied = sum(g == found.groups[k] for g in found.groups) > 1
    centre = centres_m[k]
    moved = move.points(centre[None])[0] - centre
    return {
        "name": member.name,
        "folder": str(member.folder.resolve()),
        "drone": member.header.drone,
        "scan": member.header.scan_id,
        "started_unix_s": member.header.started_unix_ns / 1e9,
        "keyframes": [member.first, member.last],
        "placed": "aligned" if tied else f"by its {_by(member)}",
        "start": None if member.start is None else msgspec.to_builtins(member.start),
        "T_site_scan": np.round(move.pose(member.move.pose(np.eye(4))), 9).tolist(),
        "scale": round(member.move.scale * move.scale, 6),
        "moved_m": [round(float(v), 3) for v in moved],
        "turned_deg": round(float(np.degrees(np.linalg.norm(se3.so3_log(move.R)))), 4),
        "sigma_m": [round(float(v), 3) for v in sigma[3:6]],
    }


def _by(member: Member) -> str:
    return "fixes" if member.start is None else "points"


def _pairs(
    members: Sequence[Member], found: SiteAlignment, ties: Sequence[Tie]
) -> list[dict[str, Any]]:
    """One entry for each two scans that ties join."""
    out = []
    for a, b in sorted({(t.a, t.b) for t in ties}):
        mine = np.array([(t.a, t.b) == (a, b) for t in ties]) & found.used
        if not mine.any():
            continue
        out.append(
            {
                "a": members[a].name,
                "b": members[b].name,
                "ties": int(mine.sum()),
                "apart_before_m": round(float(np.median(found.before_m[mine])), 3),
                "apart_after_m": round(float(np.median(found.after_m[mine])), 3),
            }
        )
    return out
