"""Segments of the track: keyframes tracked without interruption, and their place in the world."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np

from recon.posegraph import alignment
from recon.posegraph.alignment import Scale
from recon.posegraph.alignment_readings import Alignment, ReadingNoise
from recon.posegraph.ground import GUESSED_SHARE, guessed_at
from recon.posegraph.records import Loop, Node
from recon.posegraph.sensor_noise import Noise
from recon.posegraph.sensor_offsets import Constants, Offsets, constants, offsets
from recon.types import F64, PosePrior

REFIT_GROWTH, SETTLED_GROWTH = 1.3, 1.6
"""A segment's similarity is fitted again when its keyframes have grown by so much: at first,
and once it has settled."""

MIN_KEYFRAMES = 3  # before telemetry places a segment: two leave the turn about their line open
SETTLED = 100  # keyframes from which on a segment's similarity changes little
HEADING_KNOWN_RAD, HEIGHT_KNOWN_M = 1.0, 20.0  # sigmas of heading and height that place a segment


HEIGHTS_AGREE_M = 5.0
"""Sigma of a segment's height against the largest one's, below which fixes lay it on that one."""

SCALE_KNOWN = 0.2
"""Sigma of a segment's scale, by its fixes, below which they lay it on another: depths of unknown
length are no surface beside others."""


@dataclass(slots=True, eq=False)
class Segment:
    """Keyframes tracked without interruption: what they share, and where they are in the world.
    Vision gives them a frame and a unit of their own; ``similarity`` brings both to the world."""

    number: int
    nodes: list[Node] = field(default_factory=list)  # keyframes in the graph, in order
    keyframes: int = 0  # in the graph or not
    similarity: Alignment | None = None  # once telemetry or a loop gives it
    constants: Constants = field(default_factory=Constants)  # errors it was fitted with
    offsets: Offsets | None = None  # of its sensors from the similarity
    boresight: tuple[F64, F64] | None = None  # normal equations of what its attitudes show of it
    is_tied_by_loop: bool = False
    fitted: int = 0  # keyframes when the similarity was fitted last
    surface: list[int] = field(default_factory=list)  # its keyframes with depth
    agreement: int = 0  # views whose depth is plausible, less those whose pairs contradict
    points: int = 0  # new surface points of them
    is_fixed: bool = False  # one of them has a fix of known height, and a heading

    @property
    def first(self) -> int:
        """Number of the first keyframe with depth; -1 without any."""
        return self.surface[0] if self.surface else -1

    @property
    def is_false(self) -> bool:
        """True where as many of its views contradict themselves as not: all share one motion."""
        return self.agreement <= 0

    def judge(self, is_plausible: bool) -> bool:
        """Count a view by its depth; True where that can be used."""
        self.agreement += 1 if is_plausible else -1
        return is_plausible and not self.is_false

    @property
    def to_world(self) -> Alignment:
        """The similarity; until there is one, the first attitude turns its own frame."""
        if self.similarity is not None:
            return self.similarity
        first = self.nodes[0]
        R = first.prior.R_world_camera
        turn = np.eye(3) if R is None else R @ first.T_odom_camera[:3, :3].T
        return Alignment(1.0, turn, np.zeros(3))

    @property
    def fix_noise(self) -> tuple[Noise, Noise, Noise] | None:
        """How its fixes err, by axis; None where that is not measured."""
        noise = self.to_world.noise
        return None if noise is None else noise.fixes

    @property
    def rests_on_fixes(self) -> bool:
        return self.similarity is not None and "gnss" in self.similarity.sources

    @property
    def is_tied(self) -> bool:
        """True when a loop places it, or fixes that measure its scale."""
        is_scaled = self.rests_on_fixes and self.to_world.sigma_scale < GUESSED_SHARE
        return self.is_tied_by_loop or is_scaled

    def forget(self) -> None:
        self.similarity = self.offsets = None
        self.constants, self.fitted, self.is_tied_by_loop = Constants(), 0, False

    def corrected(self, node: Node) -> PosePrior:
        """A node's prior without the constants and offsets of its sensors, its fix brought to the
        camera."""
        prior = self.constants.without(node.prior)
        if self.offsets is not None:
            prior = self.offsets.without(prior, node.time_s, node.slant)
        return self.at_camera(replace(node, prior=prior))

    def at_camera(self, node: Node) -> PosePrior:
        """The prior of a node of it, with its fix brought to where the camera is."""
        prior, to_world = node.prior, self.to_world
        if prior.fix_offset is None or prior.position_m is None:
            return prior
        off = to_world.scale * (to_world.R @ node.T_odom_camera[:3, :3]) @ prior.fix_offset
        return replace(prior, position_m=prior.position_m - off, fix_offset=None)

    def add_surface(self, seq: int, points: int, prior: PosePrior) -> None:
        """Count the new points of a keyframe with depth."""
        self.surface.append(seq)
        self.points += points
        sigma = prior.sigma_position_m
        has_fix = sigma is not None and sigma[2] < HEIGHT_KNOWN_M
        self.is_fixed |= has_fix and prior.sigma_yaw_rad < HEADING_KNOWN_RAD


class Segments:
    """The segments of one flight, by number; each begins when it is asked for first."""

    def __init__(self) -> None:
        self._all: dict[int, Segment] = {}

    def __getitem__(self, number: int) -> Segment:
        if number not in self._all:
            self._all[number] = Segment(number)
        return self._all[number]

    def __iter__(self) -> Iterator[Segment]:
        """Those that have nodes, in order."""
        return (segment for segment in self._all.values() if segment.nodes)

    def with_surface(self) -> list[Segment]:
        """Those that keyframes with depth belong to, in order."""
        return [segment for segment in self._all.values() if segment.surface]

    def false(self) -> list[Segment]:
        """Those with surface that contradicts itself."""
        return [segment for segment in self.with_surface() if segment.is_false]

    def add(self, node: Node) -> Segment:
        segment = self[node.segment]
        segment.nodes.append(node)
        segment.keyframes += 1
        return segment

    def thin(self, nodes: Iterable[Node]) -> None:
        """Keep only these nodes, and what is known of their segments."""
        for segment in self._all.values():
            segment.nodes = []
        for node in nodes:
            self._all[node.segment].nodes.append(node)
        for segment in self._all.values():
            if not segment.nodes:
                is_tied = segment.is_tied
                segment.forget()
                segment.keyframes, segment.is_tied_by_loop = 0, is_tied

    def _placed(self) -> list[tuple[Segment, Alignment]]:
        return [(s, s.similarity) for s in self._all.values() if s.similarity is not None]

    def largest(self) -> Segment | None:
        """The one with the most keyframes, of those that readings place where some do."""
        size = {s.number: (bool(found.sources), s.keyframes) for s, found in self._placed()}
        number = max(size, key=size.__getitem__, default=None)
        return None if number is None else self._all[number]

    def _usual_noise(self) -> ReadingNoise | None:
        """That of the fixes of the largest segment which shows it."""
        known = [segment for segment, _ in self._placed() if segment.fix_noise]
        largest = max(known, key=lambda segment: segment.keyframes, default=None)
        return None if largest is None else largest.to_world.noise

    def sigma_height_m(self, number: int) -> float:
        """Sigma of a segment's height against the largest one of known heights: what all fixes of
        a flight err by is no part of it. Infinite where none is known."""
        known = {s.number: found.heights for s, found in self._placed() if found.heights}
        if number not in known:
            return float("inf")
        main = max(known, key=lambda one: self._all[one].keyframes)
        if number == main:
            return 0.0
        (sigma_m, time_s, _), (main_m, main_s, drift_m_s) = known[number], known[main]
        drift_m = abs(time_s - main_s) * drift_m_s  # that the largest segment shows
        return float(np.sqrt(sigma_m**2 + main_m**2 + drift_m**2))

    def apart(self, loops: Sequence[Loop]) -> list[tuple[int, int]]:
        """First and last keyframe of the segments that nothing ties to the scan's main piece. The
        main piece is the one that fixes place; without fixes, that with most points."""
        # Loads scipy.spatial, which a flight does without until its end.
        from scipy.cluster.hierarchy import DisjointSet

        known = [segment for segment in self.with_surface() if not segment.is_false]
        pieces = DisjointSet([segment.number for segment in known])
        looped: set[int] = set()
        for loop in loops:
            a, b = (_segment_of(known, seq) for seq in loop.ends)
            if a is not None and b is not None:
                pieces.merge(a, b)
                looped |= {a, b}
        # Of those that fixes place, the sigma of the height there.
        heights = {s.number: s.to_world.covariance[5, 5] ** 0.5 for s in known if s.rests_on_fixes}
        unsure = {number for number, sigma_m in heights.items() if sigma_m > HEIGHT_KNOWN_M}
        main_segment = self.largest()
        of_any_size = {
            number
            for number in heights
            if self[number] is not main_segment and self[number].to_world.sigma_scale >= SCALE_KNOWN
        }
        loose = {n for n in unsure if self.sigma_height_m(n) >= HEIGHTS_AGREE_M} | of_any_size
        placed = {segment.number for segment in known if segment.is_fixed} - of_any_size
        fixed = [
            number for number in pieces if number in placed or number in heights.keys() - loose
        ]
        for number in fixed[1:]:
            pieces.merge(fixed[0], number)
        if fixed:
            main = pieces.subset(fixed[0])
        else:
            main = max(
                pieces.subsets(), key=lambda p: sum(self[n].points for n in p), default=set()
            )
        return [
            (segment.surface[0], segment.surface[-1])
            for segment in known
            # A long flight forgets loops, and not which segments they tied.
            if segment.number not in main
            and (segment.number in looped or segment.number in loose or not segment.is_tied)
        ]

    def tie(self, number: int, scale: float, R: F64, t: F64) -> None:
        """Place a segment by a loop, for good."""
        segment = self._all[number]
        placed, before = Alignment(scale, R, t), segment.similarity
        if before is not None:  # mount and drift are not of the place
            placed = replace(
                placed, covariance=before.covariance, sources=before.sources,
                mount_rad=before.mount_rad, drift_m=before.drift_m, span_s=before.span_s,
            )  # fmt: skip
        known = (found for _, found in self._placed() if found.sigma_fixes is not None)
        other = next(known, placed)  # one receiver places all that loops join
        placed = replace(placed, sigma_fixes=other.sigma_fixes, sigma_counted=other.sigma_counted)
        segment.similarity, segment.is_tied_by_loop = placed, True
        # Its sensors' own constants were those from the similarity before.
        readings = self._without_constants(segment, segment.constants)
        segment.offsets = offsets(readings, placed)

    def refit(self, segment: Segment) -> bool:
        """True when the segment's similarity was fitted again, which is due as the segment grows.

        Without fixes and loops its place in the world means nothing; the graph has it by dead
        reckoning.
        """
        growth = REFIT_GROWTH if segment.fitted < SETTLED else SETTLED_GROWTH
        due = max(MIN_KEYFRAMES, int(growth * segment.fitted))
        if segment.keyframes < due:
            return False
        segment.fitted = segment.keyframes
        fresh = self._newest_constants(segment)
        readings = self._without_constants(segment, fresh)
        found = alignment.fit(readings, fresh.slow_share, self._usual_noise())
        if found is None:
            return False
        found = replace(found, bend_rad=_bend_rad(segment.nodes))
        if found.sigma_fixes is not None:
            over = 1.0 if found.noise is None else found.noise.over_claim[2]
            most = np.array([np.inf, np.inf, fresh.sigma_up_m * over])
            found = replace(found, sigma_fixes=np.minimum(found.sigma_fixes, most))
        before = segment.similarity
        if before is not None and segment.is_tied_by_loop:  # which alone says where it is
            found = replace(
                before, mount_rad=found.mount_rad, drift_m=found.drift_m, span_s=found.span_s
            )
        segment.similarity, segment.constants = found, fresh
        segment.offsets = offsets(readings, found)
        return True

    def _newest_constants(self, segment: Segment) -> Constants:
        """By all segments, of which this one has grown: the sensors stay the same."""
        segment.boresight = alignment.boresight(segment.nodes)
        nodes = [node for one in self for node in one.nodes]
        span_s = (nodes[-1].time_ns - nodes[0].time_ns) * 1e-9
        shown = [one.boresight for one in self if one.boresight]
        return constants([node.prior for node in nodes], span_s, shown)

    def altitude_offset(self) -> float | None:
        """Altitude less world z over the keyframes that fixes place, else over those of the first
        segment, from which all is reckoned; None without any."""
        known = [one for one in self if one.rests_on_fixes]
        known = known or [one for one in islice(self, 1) if one.similarity is not None]
        apart = [
            n.prior.altitude_m - segment.to_world.pose(n.T_odom_camera)[2, 3]
            for segment in known
            for n in segment.nodes
            if n.prior.altitude_m is not None
        ]
        return float(np.median(apart)) if apart else None

    def largest_scales(self) -> tuple[Scale | None, Scale | None]:
        """The largest segment's scale by fixes alone and by heights alone."""
        segment = self.largest()
        if segment is None:
            return None, None
        return alignment.scales(
            self._without_constants(segment, segment.constants), segment.to_world
        )

    def _without_constants(self, segment: Segment, known: Constants) -> list[Node]:
        """A segment's nodes without these errors; an assumed height is that of the flight."""
        height_m = self._usual_height_m()
        return [
            replace(n, prior=guessed_at(height_m, known.without(n.prior))) for n in segment.nodes
        ]

    def _usual_height_m(self) -> float | None:
        """Height above ground of the largest segment, if its scale is measured."""
        segment = self.largest()
        if segment is None or segment.to_world.sigma_scale >= GUESSED_SHARE:
            return None
        heights = [n.height for n in segment.nodes if n.height is not None]
        return segment.to_world.scale * float(np.median(heights)) if heights else None


def _bend_rad(nodes: list[Node]) -> float:
    """Sigma of the turn of a segment's part against its mean, about each axis. A random walk of
    variance v from end to end has v / 6 about its mean."""
    return float(np.sqrt(sum(np.trace(n.covariance[:3, :3]) for n in nodes[1:]) / 18.0))


def _segment_of(known: Sequence[Segment], seq: int) -> int | None:
    at = bisect_right(known, seq, key=lambda one: one.first) - 1
    return known[at].number if at >= 0 and seq <= known[at].surface[-1] else None
