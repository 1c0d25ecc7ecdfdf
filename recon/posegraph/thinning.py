"""A pose graph's keyframes thinned out: fewer nodes over the same track.

A keyframe that stops being a node hands its motion to the next one, its loops to the node before
it, and its fix to the mean of the next node's (docs/pose-graph.md, Thinning). Its other readings
go; those that stay weigh more, by how many there are in the time flown.

Where segments are so many and short that this finds too few, whole segments are dropped, those
first that leave the smallest holes. Their keyframes stay where they were published; their
readings and loops are gone.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import groupby, pairwise

import numpy as np

from recon import se3
from recon.posegraph.pose_priors import averaged, without_fixes
from recon.posegraph.records import Loop, Node
from recon.types import F64

NEWEST_SHARE = 0.25  # of the newest nodes, which stay: the next motions and loops start from them
GONE_SHARE = 0.25  # share of the nodes removed at once, so that rebuilding is rare


def thin(
    nodes: Sequence[Node], refused: Collection[int], poses: Mapping[int, F64]
) -> tuple[list[Node], dict[int, Loop], set[int]]:
    """The nodes that stay, with keys that follow each other; by number the motions to the others,
    which are marginalised, from the nodes before them; and the numbers of those dropped with their
    whole segment.

    The nodes have these ``poses`` (4, 4) T_world_camera, the newest perhaps none yet; the fixes of
    the ``refused`` are left out.
    """
    nodes = without_fixes(nodes, refused)
    gone = surplus(nodes)
    kept, marginalised = thinned(nodes, gone)
    return over_gaps(kept, poses), marginalised, gone - marginalised.keys()


def surplus(nodes: Sequence[Node]) -> set[int]:
    """Numbers of those that can go: from where nodes stand closest, never two neighbours.

    The first and the last of each segment stay, and so do the newest. When those are too many,
    whole segments go.
    """
    found, wanted = [], GONE_SHARE * len(nodes)
    old = len(nodes) - max(2, int(NEWEST_SHARE * len(nodes)))
    for i in range(1, old):
        before, node, after = nodes[i - 1 : i + 2]
        if before.segment == node.segment == after.segment:
            found.append((node.weight + after.weight, i))
    gone: set[int] = set()
    for _, i in sorted(found):
        if len(gone) >= wanted:
            break
        if i - 1 not in gone and i + 1 not in gone:
            gone.add(i)
    for segment in _smallest_holes_first(nodes, old):
        if len(gone) >= wanted:
            break
        if segment[0] - 1 not in gone and segment[-1] + 1 not in gone:
            gone.update(segment)
    return {nodes[i].seq for i in gone}


def thinned(nodes: Sequence[Node], gone: set[int]) -> tuple[list[Node], dict[int, Loop]]:
    """The nodes that stay, with keys that follow each other, and by number the motions to the
    others; none to those of segments of which nothing stays."""
    kept: list[Node] = []
    marginalised: dict[int, Loop] = {}
    left: Node | None = None
    for node in nodes:
        if node.seq in gone:
            last = kept[-1]
            if node.segment != last.segment:
                continue
            T = se3.inverse(last.T_odom_camera) @ node.T_odom_camera
            marginalised[node.seq] = Loop(last.seq, node.seq, T, node.covariance)
            left = node
            continue
        if left is not None:
            T = marginalised[left.seq].T_a_b
            node = replace(
                node,
                covariance=left.covariance + se3.left_covariance(T, node.covariance),
                prior=averaged(
                    (node.T_odom_camera, node.prior),
                    (left.T_odom_camera, left.prior),
                    node.weight / (node.weight + left.weight),
                ),
                weight=left.weight + node.weight,
            )
        kept.append(replace(node, key=len(kept)))
        left = None
    return kept, marginalised


def over_gaps(nodes: Sequence[Node], poses: Mapping[int, F64]) -> list[Node]:
    """The nodes, those that begin a segment with the motion since the node before as the ``poses``
    (4, 4) have it: from now on it does not depend on nodes that may be thinned out."""
    out = list(nodes[:1])
    for last, node in pairwise(nodes):
        if node.segment != last.segment and node.seq in poses:
            node = replace(node, T_prev_segment=se3.inverse(poses[last.seq]) @ poses[node.seq])
        out.append(node)
    return out


def moved_loops(
    loops: Sequence[Loop], marginalised: Mapping[int, Loop], dropped: Collection[int], most: int
) -> list[Loop]:
    """Loops between nodes that stay: the surest of several between the same two, and of more than
    ``most`` every second of the older half."""
    best: dict[tuple[int, int], Loop] = {}
    for loop in loops:
        if loop.a in dropped or loop.b in dropped:
            continue
        moved = moved_loop(loop, marginalised)
        if moved.a >= moved.b:
            continue
        known = best.get(moved.ends)
        if known is None or _spread(moved) < _spread(known):
            best[moved.ends] = moved
    out = list(best.values())
    while len(out) > most:
        half = len(out) // 2
        out = out[:half:2] + out[half:]
    return out


def moved_loop(loop: Loop, marginalised: Mapping[int, Loop]) -> Loop:
    """The loop with its ends at the nodes before those that are marginalised."""
    if (one := marginalised.get(loop.a)) is not None:
        covariance = one.covariance + se3.left_covariance(one.T_a_b, loop.covariance)
        loop = replace(loop, a=one.a, T_a_b=one.T_a_b @ loop.T_a_b, covariance=covariance)
    if (other := marginalised.get(loop.b)) is not None:
        T = se3.inverse(other.T_a_b)
        own = se3.in_units(se3.left_covariance(T, other.covariance), loop.ratio)
        T[:3, 3] *= loop.ratio
        covariance = loop.covariance + se3.left_covariance(loop.T_a_b, own)
        loop = replace(loop, b=other.a, T_a_b=loop.T_a_b @ T, covariance=covariance)
    return loop


def _smallest_holes_first(nodes: Sequence[Node], old: int) -> list[list[int]]:
    """Indices of the segments among the first ``old`` nodes that may go whole; the first segment,
    from which all is carried on, may not."""
    groups = [list(group) for _, group in groupby(range(old), lambda i: nodes[i].segment)]
    if groups and nodes[old].segment == nodes[old - 1].segment:
        groups.pop()
    return sorted(groups[1:], key=lambda group: nodes[group[-1] + 1].seq - nodes[group[0] - 1].seq)


def _spread(loop: Loop) -> float:
    return float(np.trace(loop.covariance))
