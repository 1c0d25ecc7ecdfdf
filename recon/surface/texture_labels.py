"""One view per triangle: fine where it can be had, and the same as the neighbours'.

A Markov random field over the triangles (Waechter et al. 2014, section 4.1): the data term
is the loss of resolution against the triangle's finest view, the smoothness term a Potts
penalty per shared edge. Minimised by min-sum belief propagation over each triangle's few
candidates, then by iterated conditional modes.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from recon.surface.texture_views import Sightings
from recon.types import F32

I32 = npt.NDArray[np.int32]

PENALTY = 0.6
"""Cost of an edge between triangles of different views; all resolution lost costs 1."""

ITERATIONS = 30
DAMPING = 0.5


def face_neighbours(faces: I32) -> I32:
    """(F, 3) the triangle across each edge (corner k to k + 1), -1 at the border.

    Where more than two triangles share an edge, they are taken in pairs.
    """
    count = len(faces)
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2).astype(np.int64)
    key = ends.min(axis=1) * (int(faces.max(initial=0)) + 1) + ends.max(axis=1)
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(key[order][1:] == key[order][:-1])
    if len(same):  # of three in a row take the first two
        run = np.r_[True, np.diff(same) > 1]
        position = np.arange(len(same)) - np.maximum.accumulate(
            np.where(run, np.arange(len(same)), 0)
        )
        same = same[position % 2 == 0]
    out = np.full(3 * count, -1, np.int32)
    first, second = order[same], order[same + 1]
    out[first], out[second] = second // 3, first // 3
    return out.reshape(count, 3)


def choose(found: Sightings, neighbours: I32, penalty: float = PENALTY) -> I32:
    """(F,) the slot of ``found`` chosen for each triangle; -1 where no view sees it."""
    best = np.maximum(found.px_per_m[:, :1], 1e-9)
    cost = np.where(found.view >= 0, 1.0 - found.px_per_m / best, np.float32(1e6))
    return np.asarray(
        _propagated(found.view, cost.astype(np.float32), neighbours, penalty, ITERATIONS)
    )


def energy(found: Sightings, neighbours: I32, slot: I32, penalty: float = PENALTY) -> float:
    """What :func:`choose` makes small: data costs plus ``penalty`` per edge between views."""
    seen = slot >= 0
    rows = np.flatnonzero(seen)
    best = found.px_per_m[rows, 0]
    data = float((1.0 - found.px_per_m[rows, slot[rows]] / best).sum())
    label = np.where(seen, found.view[np.arange(len(slot)), slot], -1)
    across = label[neighbours]
    cut = (neighbours >= 0) & (across >= 0) & (label[:, None] >= 0) & (across != label[:, None])
    return data + 0.5 * penalty * float(cut.sum())


@njit(cache=True, nogil=True)
def _propagated(view: I32, cost: F32, neighbours: I32, penalty: float, iterations: int) -> I32:
    """Slots after belief propagation and iterated conditional modes."""
    faces, slots = view.shape
    back = np.full((faces, 3), -1, np.int32)  # which of the neighbour's edges leads here
    for f in range(faces):
        for e in range(3):
            g = neighbours[f, e]
            if g >= 0:
                for d in range(3):
                    if neighbours[g, d] == f:
                        back[f, e] = d
    message = np.zeros((faces, 3, slots), np.float32)  # to (f) over its edge e
    belief = np.empty(slots, np.float32)
    for iteration in range(iterations):
        forward = iteration % 2 == 0
        for n in range(faces):
            f = n if forward else faces - 1 - n
            if view[f, 0] < 0:
                continue
            for e in range(3):
                g = neighbours[f, e]
                if g < 0 or view[g, 0] < 0:
                    continue
                least = np.float32(np.inf)
                for k in range(slots):
                    belief[k] = cost[f, k]
                    for d in range(3):
                        if d != e:
                            belief[k] += message[f, d, k]
                    if view[f, k] >= 0 and belief[k] < least:
                        least = belief[k]
                for j in range(slots):
                    if view[g, j] < 0:
                        break
                    value = np.float32(penalty)
                    for k in range(slots):
                        if view[f, k] == view[g, j]:
                            value = min(value, belief[k] - least)
                    old = message[g, back[f, e], j]
                    message[g, back[f, e], j] = DAMPING * old + (1.0 - DAMPING) * value
    out = np.full(faces, -1, np.int32)
    for f in range(faces):
        best = np.float32(np.inf)
        for k in range(slots):
            total = cost[f, k] + message[f, 0, k] + message[f, 1, k] + message[f, 2, k]
            if view[f, k] >= 0 and total < best:
                best, out[f] = total, k
    _settle(view, cost, neighbours, penalty, out)
    return out


@njit(cache=True, nogil=True)
def _settle(view: I32, cost: F32, neighbours: I32, penalty: float, slot: I32) -> None:
    """Iterated conditional modes: each triangle takes its best view as its neighbours stand."""
    faces, slots = view.shape
    for _ in range(20):
        changed = 0
        for f in range(faces):
            best, chosen = np.inf, slot[f]
            for k in range(slots):
                if view[f, k] < 0:
                    break
                total = float(cost[f, k])
                for e in range(3):
                    g = neighbours[f, e]
                    if g >= 0 and slot[g] >= 0 and view[g, slot[g]] != view[f, k]:
                        total += penalty
                if total < best - 1e-6:
                    best, chosen = total, np.int32(k)
            if chosen != slot[f]:
                slot[f] = chosen
                changed += 1
        if changed == 0:
            return
