"""All that a pose graph knows but the solver's state, to make the same graph again elsewhere."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from recon.graph.records import Loop, Node, PoseGraphConfig
from recon.graph.segment_frames import SegmentFrames
from recon.graph.thinning import Ridden


@dataclass(frozen=True, slots=True, eq=False)
class GraphMemory:
    """What a pose graph knows, without the solver's state."""

    config: PoseGraphConfig
    nodes: list[Node]
    ridden: dict[int, Ridden]
    let_go: set[int]
    segments: SegmentFrames
    taken: list[Loop]
    pending: list[Loop]
    book_counts: Counter[str]
    kept_counts: Counter[str]
    entered: int
    generation: int
    thin_at: int
