"""A finished scan adjusted as a whole: telemetry, every loop, ground control, all at once.

The unrefined state is the input, however often a scan was refined, so the same input gives
the same result. What comes out are new poses of the same chunks, appended to the store, and
the deliverables written again.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from recon.calibration.flight import SelfCalibrated, SelfCalibrationConfig
from recon.parallel import run_parallel
from recon.posegraph.alignment import boresight
from recon.posegraph.records import Loop, Node
from recon.posegraph.sensor_offsets import constants
from recon.survey.ground_control import (
    SIGMA_SCALE,
    Adjusted,
    KeyframeTrack,
    Mark,
    Survey,
    adjust,
    map_position,
    supported,
)
from recon.types import Camera, Keyframe, PosePrior
from service.cameras.camera_file import save_camera
from service.cameras.rig import Rig
from service.config import Config
from service.errors import InputError, refusing
from service.georeference import LocalFrame
from service.offline.refine import own_camera
from service.offline.refine.by_images import (
    ImageNetwork,
    adjusted,
    as_seen,
    carried_marks,
    crossing_marks,
    marked_frames,
    network_of,
    stretches_untied,
)
from service.offline.refine.control_points import (
    Candidate,
    ScanImages,
    candidates_of,
    clustered,
    place_by_survey,
    screen,
)
from service.offline.refine.refinement_figures import figures_of, in_words, off_by
from service.offline.refine.revisions import (
    Revisions,
    copy_store,
    finished_store,
    grown,
    moved_frames,
)
from service.offline.refine.stored_loops import loose, stored_loops
from service.offline.refine.survey_file import SurveyPoint, at_times, read_survey
from service.progress import Progress
from service.scans.folder import write_deliverables
from service.scans.track import camera_of, local_frame
from service.scans.trust import BY_SURVEY
from service.scans.writing import check_writable, filling_folder
from service.stream.records import ScanHeader, unpack_covariance, unpack_motion
from service.stream.store import ScanStore

log = logging.getLogger(__name__)

LINK_LOG = "link.tlog"
"""The flight's telemetry that the daemon keeps next to a scan."""

MATCHING, SEARCHING, ADJUSTING = 0.7, 0.7, 0.5
"""Shares of the remaining refinement that its steps take."""

MIN_SIGMA_SCALE = 0.003
MIN_OTHERS = 3
"""Control points that hold a scan without one of them."""

MAX_REFUSALS = 0.4
"""Of the control points; when more contradict the rest, it is not known which half is right."""


@dataclass(frozen=True, slots=True)
class RefineOptions:
    gcp: Path | None = None
    telemetry: Path | None = None
    out: Path | None = None
    loops: bool = True
    video: Path | None = None
    marks: Path | None = None  # of the points in gcp, as Pix4D has them


def refine(
    folder: Path, options: RefineOptions, progress: Progress | None = None
) -> dict[str, Any]:
    """Adjust the scan in ``folder`` and write its deliverables again; the figures of it.

    Raises InputError, in one line, for a scan that is not finished or holds fewer than two
    keyframes, and for bad control points.
    """
    if options.gcp is not None:
        read_survey(options.gcp, options.marks)  # refused before the work
    with _target(folder, options.out) as target:
        with ScanStore.open(target / "scan.db") as store:
            store.hold_decoded()
            figures = _Refinement(folder, store, options, progress, target).run()
        return _deliver(target, figures) | {"scan_folder": str(options.out or folder)}


def undo(folder: Path) -> dict[str, Any]:
    """Bring back the unrefined state, as a further revision, and write the deliverables again."""
    _check_finished(folder)
    with ScanStore.open(folder / "scan.db") as store:
        revisions = Revisions(store)
        if not revisions.refined:
            raise InputError(f"{folder} was never refined; there is nothing to undo")
        states = revisions.states()
        revisions.append(states.reposes(), revisions.frames(), revisions.header, {"undone": True})
    return _deliver(folder, {"undone": True, "keyframes": len(states)})


def intrinsics(
    folder: Path,
    video: Path,
    telemetry: Path | None,
    out: Path | None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Find the camera from the flight's video and write its file next to the scan, or in ``out``.

    The scan itself stays as it is. Raises InputError, in one line, where the flight
    does not determine the camera.
    """
    _check_finished(folder)
    with ScanStore.open(folder / "scan.db") as store:
        job = _Refinement(folder, store, RefineOptions(telemetry=telemetry), progress)
        try:
            found, given = job.own_camera(video)
        except InputError as error:
            raise InputError(f"--intrinsics: {error}; nothing was changed") from error
    return own_camera.write(found, given, out or folder) | {"notes": job.notes}


def lens(folder: Path, images: Path, config: SelfCalibrationConfig) -> SelfCalibrated:
    """The camera by a scan's own images, a recording or a folder of stills.

    Raises InputError, in one line, where they do not determine it.
    """
    _check_finished(folder)
    with ScanStore.open(folder / "scan.db") as store:
        job = _Refinement(folder, store, RefineOptions())
        return job.own_camera(images, config)[0]


def _deliver(target: Path, figures: dict[str, Any]) -> dict[str, Any]:
    with ScanStore.open(target / "scan.db") as store:
        store.hold_decoded()
        write_deliverables(target, store)
    return figures | {"scan_folder": str(target)}


@contextmanager
def _target(folder: Path, out: Path | None) -> Iterator[Path]:
    """The folder to work in: the scan's own, or one with a copy of its store, which becomes
    ``out`` on success."""
    _check_finished(folder)
    if out is None or out.resolve() == folder.resolve():
        yield folder
        return
    if (out / "scan.db").exists():
        raise InputError(f"{out} exists and holds a scan; choose another, nothing was changed")
    check_writable(out, is_folder=True)
    with filling_folder(out) as part:
        copy_store(folder / "scan.db", part / "scan.db")
        yield part


def _check_finished(folder: Path) -> None:
    """Raise InputError for a folder without a finished scan of two keyframes or more."""
    with finished_store(folder, "refine", repairs=True) as store:
        count = len(store.seqs())
    if count < 2:
        raise InputError(f"{folder} holds {count} keyframe(s); refining takes two or more")


class _Refinement:
    def __init__(
        self,
        folder: Path,
        store: ScanStore,
        options: RefineOptions,
        progress: Progress | None = None,
        target: Path | None = None,
    ) -> None:
        self.folder, self.store, self.options = folder, store, options
        self.target = target or folder
        self.revisions = revisions = Revisions(store)
        self.progress = progress or Progress()
        self.header = revisions.header
        self.frame = local_frame(self.header)
        self.states = revisions.states()
        self.frames = revisions.frames()
        self.notes: list[str] = []
        self.grown = 1.0  # metres of the survey per metre of the flight's own scale
        self.images: ImageNetwork | None = None

    def keyframe(self, k: int) -> Keyframe | None:
        """The keyframe at place ``k`` of the states."""
        return self.revisions.keyframe(self.states, k)

    def run(self) -> dict[str, Any]:
        survey = self._survey()
        places_m = self.states.poses[:, :3, 3]
        if self.options.video is not None:
            with self.progress.part("matching the images again", MATCHING):
                self._match_again(self.options.video, survey)
        images = ScanImages(self.states, self.frames, self.header, self.keyframe, self.frame)
        candidates = candidates_of(survey, images, str(self.options.gcp))
        if self.images is not None:
            for one in candidates:
                crossing_marks(one, images.states.poses)
        if self.frame is None and candidates:
            self._place(candidates)
        if self.frame is not None:
            screen(candidates, self.frame)
            self._enough(candidates)
        elif self.options.telemetry is not None:
            raise InputError(f"{self.folder} has no georeference; replay it with its telemetry")
        track = self._track()
        verified = 0
        if self.options.loops and self.images is None:
            with self.progress.part("searching for loops", SEARCHING):
                track, verified = self._with_loops(track)
        with self.progress.part("adjusting all keyframes", ADJUSTING):
            found = self._adjusted(track, candidates)
        warning = clustered(candidates, track.poses[:, :3, 3])
        self.notes += [warning] if warning else []
        seqs = self.states.seqs
        if self.images is None or self.grown != 1.0:
            places_m = track.poses[:, :3, 3]
        figures = figures_of(seqs, track, found, candidates, verified, self._ahead_m(), places_m)
        if self.images is not None:
            figures["images"] = self.images.figures()
            fixed = np.asarray(np.isfinite(track.readings()[0]).all(axis=1))
            figures["apart"] = stretches_untied(seqs, self.images.seen, fixed)
        alone = self._left_out(track, candidates)
        for point in figures["points"]:
            point["left_out_m"] = alone.get(point["name"])
        figures["notes"] = self.notes
        header = replace(self.header, notes=(*self.header.notes, in_words(figures)))
        frames = moved_frames(self.frames, self.states, found, self.frame)
        self.progress.commit("writing the files of the scan")
        scales = self.states.scales * found.scales
        after = replace(
            self.states, poses=found.poses, covariances=found.covariances, scales=scales
        )
        changed = self.revisions.append(after.reposes(), frames, header, figures)
        return figures | {"changed": changed}

    def own_camera(
        self, video: Path, config: SelfCalibrationConfig = own_camera.START
    ) -> tuple[SelfCalibrated, Camera]:
        """The camera by the flight's own images, and the one that it was flown with."""
        track, given = self._track(), camera_of(self.header)
        times = self.states.times_ns.tolist()
        self.progress("reading the images of the keyframes")
        images = own_camera.images_at(video, self.header.started_unix_ns, times)
        self.progress(f"matching {len(images)} images, and fitting the camera")
        ahead = track.poses[:, :3, 2] * self._ahead_m()
        ground_m = float(np.median(track.poses[:, 2, 3] + ahead[:, 2]))
        fixes, sigma_fixes, *_ = track.readings()
        found = own_camera.found_camera(
            images, given, track.poses, ground_m, fixes, sigma_fixes, config
        )
        return found, given

    # ---- what goes in ------------------------------------------------------------------------

    def _survey(self) -> list[SurveyPoint]:
        """The surveyed points, with the times of the stills that they name.

        Marks in stills that vision did not place are left out.
        """
        path, video = self.options.gcp, self.options.video
        if path is None:
            return []
        start = self.header.started_unix_ns
        times = own_camera.times_of_stills(video, start) if video is not None else {}
        marks = self.options.marks
        survey = at_times(read_survey(path, marks), times, marks or path)
        if unseen := [point.name for point in survey if not point.sightings]:
            self.notes.append(f"points without marks are left out: {', '.join(unseen)}")
            survey = [point for point in survey if point.sightings]
            if not survey:
                raise InputError(
                    f"{path}: no point has a mark; mark them on the portal's page Control points, "
                    "or add keyframe_seq, u_px and v_px"
                )
        seen = [f.time_unix_ns for f in self.frames if "vision" in f.sources]
        placed = {_ms(t) for t in [*seen, *self.states.times_ns.tolist()]}
        lost = {
            mark.image
            for point in survey
            for mark in point.sightings
            if mark.image and _ms(1e9 * (mark.time_unix_s or 0.0)) not in placed
        }
        if lost:
            names = ", ".join(sorted(lost))
            self.notes.append(f"images without a pose, their marks are not used: {names}")
        return [
            replace(p, sightings=tuple(s for s in p.sightings if s.image not in lost))
            for p in survey
        ]

    def _match_again(self, video: Path, survey: Sequence[SurveyPoint]) -> None:
        """Tie the keyframes by their images, and take them as the images have them."""
        marked = marked_frames(survey, self.frames, self.states)
        images = network_of(video, self.header, self.states, marked, self._ahead_m())
        self.states, self.frames = as_seen(images, self.states, self.frames, marked, self.keyframe)
        self.images = images
        if images.doubt:
            self.notes.append(f"the given camera is kept: {images.doubt}")
            return
        path = self.target / own_camera.FILE
        save_camera(path, images.camera)
        self.notes.append(
            f"the camera found from the images: {path.name}; surfaces keep the "
            "flight's: to correct them, replay with --camera-model and that file"
        )

    def _with_loops(self, track: KeyframeTrack) -> tuple[KeyframeTrack, int]:
        """The track with its loops, and how many of them were verified."""

        def at(k: int) -> Keyframe | None:
            found = self.keyframe(k)
            if found is None:
                return None
            return replace(found, depth=replace(found.depth, T_world_camera=track.poses[k]))

        flown, closures = self._flown_loops(), stored_loops(track, at, self.progress)
        kept = [c for c in supported([*flown, *closures], track.poses) if c not in flown]
        return replace(track, loops=[*flown, *kept]), len(flown) + len(closures)

    def _place(self, candidates: Sequence[Candidate]) -> None:
        """Give a scan without a place, and without a sure scale, those of the survey."""
        self.frame, move = place_by_survey(candidates)
        if not any(c.has_height for c in candidates if c.usable):
            self.notes.append("no control point has a height: heights count from the scan's own 0")
        self.grown = scale = move.scale
        spread = np.diag([0.03**2] * 3 + [1.0] * 3)
        self.states = replace(
            self.states,
            poses=move.pose(self.states.poses),
            covariances=np.tile(spread, (len(self.states), 1, 1)),
            scales=self.states.scales * scale,
        )
        for one in candidates:
            if one.before_m is not None:
                one.before_m = move.points(one.before_m)
                one.sigma_before_m *= scale
            one.marks = [
                replace(
                    m,
                    depth_m=None if m.depth_m is None else scale * m.depth_m,
                    sigma_depth_m=scale * m.sigma_depth_m,
                    T_key_camera=grown(m.T_key_camera, scale),
                )
                for m in one.marks
            ]
        self.frames = [replace(f, T_world_camera=move.pose(f.T_world_camera)) for f in self.frames]
        if self.images is not None:
            poses, points = move.pose(self.images.poses), move.points(self.images.points)
            self.images = replace(self.images, poses=poses, points=points)
        f = self.frame
        self.header = replace(
            self.header, origin_lat_deg=f.lat_deg, origin_lon_deg=f.lon_deg,
            origin_alt_amsl_m=f.alt_amsl_m, epsg=f.epsg, georeference=BY_SURVEY,
            vertical_datum="",
        )  # fmt: skip

    def _enough(self, candidates: Sequence[Candidate]) -> None:
        """Raise InputError when control points were given and none, or too few, hold."""
        control = [c for c in candidates if not c.point.is_check]
        refused = [c for c in control if not c.usable]
        if control and len(refused) > MAX_REFUSALS * len(control):
            reasons = "; ".join(f"{c.point.name}: {c.why_not}" for c in refused[:4])
            raise InputError(
                f"{self.options.gcp}: {len(refused)} of {len(control)} control points do not "
                f"fit ({reasons}); nothing was changed"
            )

    def _track(self) -> KeyframeTrack:
        times, states = self.states.times_ns * 1e-9, self.states
        return KeyframeTrack(states.poses, times - times[0], states.covariances, self._priors())

    def _priors(self) -> list[PosePrior]:
        """The flight's telemetry at each keyframe; empty without a log."""
        path = self.options.telemetry or self.folder / LINK_LOG
        if self.frame is None or (self.options.telemetry is None and not path.is_file()):
            return []
        from mavlink.telemetry.logs import load_telemetry

        try:
            history = load_telemetry(path).history
        except ValueError as error:
            if self.options.telemetry is None:
                self.notes.append(f"{LINK_LOG} next to the scan was not used: {error}")
                return []
            raise InputError(str(error)) from error
        rig = _rig(self.header, self.frame)
        times = self.states.times_ns.tolist()
        states = [history.state_at(time_ns) for time_ns in times]
        if not any(s is not None and s.lat_deg is not None for s in states):
            self.notes.append(f"{path.name} gives no position of any keyframe: not used")
            return []
        priors = [PosePrior() if s is None else rig.prior(s, None) for s in states]
        nodes = [
            Node(k, time_ns, 0, T, np.zeros((6, 6)), prior)
            for k, (time_ns, T, prior) in enumerate(
                zip(times, self.states.poses, priors, strict=True)
            )
        ]
        known = constants(priors, (times[-1] - times[0]) * 1e-9, [boresight(nodes)])
        return [known.without(prior) for prior in priors]

    # ---- loops -------------------------------------------------------------------------------

    def _flown_loops(self) -> list[Loop]:
        """The loops that the flight accepted, with whole images at hand."""
        graph = (self.store.summary or {}).get("graph") or {}
        at = {seq: k for k, seq in enumerate(self.states.seqs)}
        out = []
        for a, b, motion, upper in (graph.get("loops") or {}).get("motions", []):
            T = unpack_motion(motion)
            if a in at and b in at and T is not None and len(upper) == 21:
                T = grown(T, self.grown)
                units = np.array([1.0] * 3 + [self.grown] * 3)
                spread = unpack_covariance(upper) * np.outer(units, units)
                out.append(Loop(at[a], at[b], T, loose(T, spread)))
        return out

    def _ahead_m(self) -> float:
        """Usual distance of the ground; 0 without any surface."""
        few = range(0, len(self.states), max(1, len(self.states) // 16))
        some = run_parallel(*(partial(self.keyframe, k) for k in few))
        depths = [one.depth.depth_m for one in some if one is not None]
        known = [float(np.nanmedian(z)) for z in depths if np.isfinite(z).any()]
        return float(np.median(known)) if known else 0.0

    def _sigma_scale(self) -> float:
        """How sure the scan's scale is, as the scan states."""
        scale = (self.store.summary or {}).get("scale")
        sigma = scale.get("sigma") if isinstance(scale, dict) else None
        if not sigma or self.header.georeference == BY_SURVEY:
            return SIGMA_SCALE
        return max(float(sigma), MIN_SIGMA_SCALE)

    # ---- adjustment --------------------------------------------------------------------------

    def _adjusted(self, track: KeyframeTrack, candidates: Sequence[Candidate]) -> Adjusted:
        """The adjustment; control points that stay off are left out one by one, and named."""
        survey = _survey(candidates)
        most = int(MAX_REFUSALS * sum(not c.point.is_check for c in candidates))
        while True:
            used = [c for c in candidates if c.is_control]
            marks = [m for c in used for m in c.marks]
            try:
                found, images = self._solved(track, survey, marks)
            except RuntimeError as error:  # so the solver says that the system is ill-posed
                raise InputError(
                    "the poses of this scan contradict each other too much to be adjusted"
                ) from error
            for one in candidates:
                one.marks = self._carried(one, images)
            self.images = images
            worst, by = None, 1.0
            for one in used:
                after = map_position(found.poses, found.scales, one.marks)
                if after is None or one.surveyed_m is None:
                    continue
                off = float(np.linalg.norm(one.off_m(after[0])))
                ratio = off / (5.0 * one.tolerance_m(after[1]) + 0.3)
                if ratio > by:
                    worst, by, far = one, ratio, off
            refused = sum(not c.usable and not c.point.is_check for c in candidates)
            if worst is None or refused >= most:
                return found
            worst.why_not = f"stays {far:.2f} m off after the adjustment"

    def _solved(
        self, track: KeyframeTrack, survey: Survey, marks: Sequence[Mark]
    ) -> tuple[Adjusted, ImageNetwork | None]:
        """The adjustment, and where images are matched again their network after it."""
        if self.images is None:
            return adjust(track, survey, marks, self._sigma_scale()), None
        return adjusted(self.images, track, survey, marks, self.keyframe)

    def _carried(self, one: Candidate, after: ImageNetwork | None) -> list[Mark]:
        """A point's marks, which move with the images."""
        if self.images is None or after is None:
            return one.marks
        return carried_marks(one, self.images, after)

    def _left_out(
        self, track: KeyframeTrack, candidates: Sequence[Candidate]
    ) -> dict[str, list[float | None] | None]:
        """How far each control point is off where the others alone put it, by name.

        Empty for fewer than four control points: three are needed without it.
        """
        used = [c for c in candidates if c.is_control]
        if len(used) <= MIN_OTHERS:
            return {}
        survey = _survey(candidates)
        out: dict[str, list[float | None] | None] = {}
        for one in used:
            marks = [m for c in used if c is not one for m in c.marks]
            found, images = self._solved(track, survey, marks)
            place = map_position(found.poses, found.scales, self._carried(one, images))
            if place is not None:
                out[one.point.name] = off_by(one, place[0])
        return out


def _survey(candidates: Sequence[Candidate]) -> Survey:
    """The surveyed points of ``candidates``, numbered alike."""
    places = [np.zeros(3) if c.surveyed_m is None else c.surveyed_m for c in candidates]
    sigmas = [c.sigma_m for c in candidates]
    return np.reshape(places, (-1, 3)), np.reshape(sigmas, (-1, 3))


def _ms(time_ns: float) -> int:
    return round(time_ns / 1e6)


def _rig(header: ScanHeader, frame: LocalFrame) -> Rig:
    """The rig that the scan was flown with, about the scan's own origin."""
    kept = {name: header.configuration.get(name) or {} for name in ("camera", "scan", "fusion")}
    with refusing(f"scan {header.scan_id}, its configuration"):
        flown = msgspec.convert(kept, Config)
    rig = Rig(flown.camera, flown.scan, flown.fusion)
    rig.local_frame = frame
    return rig
