"""The dense stage as ONNX models of fixed shapes: the same numbers as the compiled backend.

Integers are held exactly in float32, as in :mod:`recon.backends.torch_stereo`, and as there a
model may be larger than the pair that it is fed: its true size is then one more input. Tensors
are (labels, h, w), messages (4, labels, h, w).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from onnx import TensorProto

from recon.backends.onnx_graph import Graph, Value, join
from recon.backends.room import pyramid_levels
from recon.stereo.belief_propagation import NOISE, RADIUS, SURE_EVIDENCE, BeliefPropagationConfig
from recon.stereo.matching_cost import CENSUS_RADIUS, COST_UNIT
from recon.stereo.message_passing import FULL_WEIGHT
from recon.stereo.upsampling import MIN_CONFIDENCE, RANGE_FLOOR, UpsamplingConfig, window
from recon.types import Array

FAR = 1.0e6


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """Height, width and labels of the pair itself, each (1,) float32, and the room for them."""

    h: Value
    w: Value
    labels: Value
    size: tuple[int, int]  # room for h and w
    room: int  # for labels

    def half(self) -> _Pair:
        """Of the next coarser level."""
        h, w = (((n + 1.0) * 0.5).floor() for n in (self.h, self.w))
        size = (self.size[0] + 1) // 2, (self.size[1] + 1) // 2
        return _Pair(h, w, self.labels, size, self.room)

    def inside(self) -> Value:
        """(h, w) 1 on the pair, else 0."""
        rows, columns = (np.arange(n, dtype=np.float32) for n in self.size)
        return self.h.above(rows[:, None]).numbers() * self.w.above(columns[None, :]).numbers()

    def ours(self) -> Value:
        """(L, 1, 1) True for labels of the pair."""
        return self.labels.above(np.arange(self.room, dtype=np.float32)[:, None, None])


def stereo_model(
    size: tuple[int, int], labels: int, config: BeliefPropagationConfig, levels: int | None = None
) -> bytes:
    """An ONNX file: ``left`` and ``right`` (h, w) uint8 to ``px`` and ``confidence`` (h, w).

    Iterations and levels are written out. With ``levels`` of the pyramid given the model serves
    every pair up to its size: ``true`` (3,) int64 is height, width and labels of the pair,
    whose last row and column are repeated beyond. The results are those before
    :func:`recon.stereo.belief_propagation.drop_unreliable`.
    """
    graph = Graph()
    left = graph.input("left", TensorProto.UINT8, size).numbers()
    right = graph.input("right", TensorProto.UINT8, size).numbers()
    if levels is None:
        own = [graph.constant(np.array([n], np.float32)) for n in (*size, labels)]
        levels = pyramid_levels(*size, config)
    else:
        true = graph.input("true", TensorProto.INT64, (3,)).numbers()
        own = [true.part(0, k, k + 1) for k in range(3)]
    pair = _Pair(own[0], own[1], own[2], size, labels)
    cost = _matching_cost(left, right, pair, config)
    belief = _propagate(cost, left, levels, pair, config)
    px, confidence = _select(belief, cost, pair, config)
    graph.output(px, "px", size)
    graph.output(confidence, "confidence", size)
    return graph.model(f"belief propagation, {labels} labels, {config}")


def _census(image: Value, size: tuple[int, int]) -> Value:
    """(24, h, w): 1 where the neighbour is darker."""
    h, w = size
    r = CENSUS_RADIUS
    padded = image.pad([r, r], [r, r], None)
    bits = []
    for j in range(2 * r + 1):
        for i in range(2 * r + 1):
            if (j, i) != (r, r):
                darker = padded.part(0, j, j + h).part(1, i, i + w).less(image).numbers()
                bits.append(darker.lift(0))
    return join(bits)


def _matching_cost(
    left: Value, right: Value, pair: _Pair, config: BeliefPropagationConfig
) -> Value:
    """(L, h, w), 0 beyond the pair, as :func:`recon.stereo.matching_cost.matching_cost`."""
    c = config.cost
    h, w = pair.size
    bits_left, bits_right = (_census(image, pair.size) for image in (left, right))
    gray_left, gray_right = left.lift(0), right.lift(0)
    layers = []
    for label in range(pair.room):
        shift = label + config.min_disparity
        first, last = min(max(0, shift), w), max(min(w, w + shift), 0)
        if first >= last:
            layers.append(left.graph.constant(np.full((1, h, w), FAR, np.float32)))
            continue
        here, there = (first, last), (first - shift, last - shift)
        bits = (bits_left.part(2, *here) - bits_right.part(2, *there)).abs().sum(0)
        gray = (gray_left.part(2, *here) - gray_right.part(2, *there)).abs()
        seen = bits.at_most(float(c.census_truncation)) * float(round(c.census_weight * COST_UNIT))
        seen = seen + gray.at_most(float(c.difference_truncation)) * float(
            round(c.difference_weight * COST_UNIT)
        )
        partner = np.arange(first - shift, last - shift, dtype=np.float32)
        known = pair.w.above(partner) & pair.labels.above(float(label))
        seen = known.where(seen, FAR)
        layers.append(seen.pad([0, 0, first], [0, 0, w - last], FAR))
    cost = join(layers)
    best = cost.min(0)
    unseen = best.less(FAR).where(best + float(round(c.unseen * COST_UNIT)), 0.0)
    return cost.less(FAR).where(cost, unseen) * pair.inside()


def _edge_weights(image: Value, pair: _Pair, config: BeliefPropagationConfig) -> list[Value]:
    """Weight of the edge above and to the left, two (h, w)."""
    fall = (1 - config.edge_floor) / config.edge_contrast
    weights = []
    for axis, length in enumerate(pair.size):
        step = (image.part(axis, 1, length) - image.part(axis, 0, length - 1)).abs()
        step = step.pad([1 - axis, axis], [0, 0])
        share = (step * -fall + 1.0).at_least(config.edge_floor)
        weights.append((share * float(FULL_WEIGHT)).round())
    return _bounded(weights, pair)


def _bounded(edges: list[Value], pair: _Pair) -> list[Value]:
    """The last edges along the border of the pair repeated, and no edge across it."""
    rows, columns = (np.arange(n, dtype=np.float32) for n in pair.size)
    last_row = (pair.h - 1.0).at_most(rows).cast(TensorProto.INT64)
    last_column = (pair.w - 1.0).at_most(columns).cast(TensorProto.INT64)
    above, before = (e.gather(last_row, 0).gather(last_column, 1) for e in edges)
    below = pair.h.above(rows[:, None]).numbers()
    return [above * below, before * pair.w.above(columns).numbers()]


def _propagate(
    cost: Value, image: Value, levels: int, pair: _Pair, config: BeliefPropagationConfig
) -> Value:
    """(L, h, w) beliefs (Eq. 1)."""
    graph, ours = cost.graph, pair.ours()
    pyramid, pairs = [_cut(cost, ours, config)], [pair]
    edges = [_edge_weights(image, pair, config)]
    while len(pyramid) < levels:
        h, w = pairs[-1].size
        lifted = pyramid[-1].pad([0] * 3, [0, h % 2, w % 2]).lift(0)
        pooled = graph.op("AveragePool", lifted, kernel_shape=[2, 2], strides=[2, 2]) * 4.0
        pyramid.append(_cut(pooled.drop(), ours, config))
        pairs.append(pairs[-1].half())
        edges.append(_bounded(_coarser_weights(edges[-1], h, w), pairs[-1]))
    messages = graph.constant(np.zeros((4, pair.room, *pairs[-1].size), np.float32))
    for level in range(len(pyramid) - 1, -1, -1):
        h, w = size = pairs[level].size
        if level < len(pyramid) - 1:
            messages = messages.gather(np.arange(h) // 2, 2).gather(np.arange(w) // 2, 3)
            messages = messages * pairs[level].inside()
        slope = _per_direction(edges[level], size, COST_UNIT)
        cut = _per_direction(edges[level], size, config.truncation)
        colour = np.add.outer(np.arange(h), np.arange(w)) % 2
        for t in range(config.iterations):
            fresh = _outgoing(pyramid[level], messages, slope, cut, pairs[level], config)
            messages = graph.constant(colour == t % 2).where(fresh, messages)
    return pyramid[0] + _arriving(messages, pair.size).sum(0).drop()


def _cut(data: Value, ours: Value, config: BeliefPropagationConfig) -> Value:
    """Above the pixel's best, at most what can win; a label that is not of the pair cannot."""
    top = 4.0 * config.truncation
    least = ours.where(data, FAR).min(0)
    return ours.where((data - least).at_most(top), top)


def _coarser_weights(fine: list[Value], h: int, w: int) -> list[Value]:
    above, before = (edge.pad([0, 0], [h % 2, w % 2], None) for edge in fine)
    rows, columns = above.every(0, 0, 2), before.every(1, 0, 2)
    return [
        ((rows.every(1, 0, 2) + rows.every(1, 1, 2)) * 0.5).floor(),
        ((columns.every(0, 0, 2) + columns.every(0, 1, 2)) * 0.5).floor(),
    ]


def _per_direction(edges: list[Value], size: tuple[int, int], unit: int) -> Value:
    """(4, 1, h, w) smoothness of the edge that a message up, down, left and right crosses."""
    h, w = size
    above, before = ((edge * (unit / FULL_WEIGHT)).floor() for edge in edges)
    below = above.part(0, 1, h).pad([0, 0], [1, 0])
    after = before.part(1, 1, w).pad([0, 0], [0, 1])
    return join([edge.lift(0, 1) for edge in (above, below, before, after)])


def _arriving(messages: Value, size: tuple[int, int]) -> Value:
    """(4, L, h, w) from below, above, right and left; zero from beyond the border."""
    h, w = size
    one = [messages.part(0, k, k + 1) for k in range(4)]
    return join(
        [
            one[0].part(2, 1, h).pad([0] * 4, [0, 0, 1, 0]),
            one[1].part(2, 0, h - 1).pad([0, 0, 1, 0], [0] * 4),
            one[2].part(3, 1, w).pad([0] * 4, [0, 0, 0, 1]),
            one[3].part(3, 0, w - 1).pad([0, 0, 0, 1], [0] * 4),
        ]
    )


def _outgoing(
    data: Value, messages: Value, slope: Value, cut: Value, pair: _Pair,
    config: BeliefPropagationConfig,
) -> Value:  # fmt: skip
    """Lower envelope of all other news."""
    labels, arriving = pair.room, _arriving(messages, pair.size)
    rest = data + arriving.sum(0) - arriving.gather(np.array([1, 0, 3, 2]), 0)
    steps = min(math.ceil(config.truncation / COST_UNIT) + 1, labels - 1)
    wide = rest.pad([0, steps, 0, 0], [0, steps, 0, 0], FAR)
    best = rest
    for k in range(1, steps + 1):
        ahead = wide.part(1, steps + k, steps + k + labels)
        behind = wide.part(1, steps - k, steps - k + labels)
        best = best.at_most(ahead.at_most(behind) + slope * float(k))
    return (best - rest.min(1)).at_most(cut)


def _select(
    belief: Value, cost: Value, pair: _Pair, config: BeliefPropagationConfig
) -> tuple[Value, Value]:
    """Labels and confidence (h, w), as :func:`recon.stereo.belief_propagation.select`."""
    graph, w = cost.graph, pair.size[1]
    index = np.arange(pair.room, dtype=np.float32)[:, None, None]
    partner = np.arange(w, dtype=np.float32)[None, None, :] - index - config.min_disparity
    left_of = pair.w.above(np.where(partner >= 0, partner, np.inf).astype(np.float32))
    seen = (left_of & pair.ours()).numbers()
    belief = pair.ours().where(belief, FAR)
    last = pair.labels - 1.0
    winner = graph.op("ArgMin", belief, axis=0, keepdims=1)
    best = winner.numbers()
    adjacent = (best * -1.0 + graph.constant(index)).abs().less(1.5)
    second = adjacent.where(FAR, belief).min(0)
    area = (2 * RADIUS + 1) ** 2
    pooled = graph.op(
        "AveragePool", cost.lift(0), kernel_shape=[2 * RADIUS + 1] * 2, pads=[RADIUS] * 4,
        count_include_pad=1,
    )  # fmt: skip
    box = (pooled.drop() * float(area)).round()
    mean = (box * seen).sum(0) / seen.sum(0).at_least(1.0)
    here, a, b = (
        graph.op(
            "GatherElements",
            box,
            (best + float(step)).at_least(0.0).at_most(last).cast(TensorProto.INT64),
            axis=0,
        )
        for step in (0, -1, 1)
    )
    a, b = a - here, b - here
    steep = a.at_least(b)
    offset = ((a - b) / (steep.at_least(1.0) * 2.0)).at_least(-0.5).at_most(0.5)
    edge = best.less(0.5) | best.above(last - 0.5)
    px = best + (edge | steep.less(0.5)).where(0.0, offset)
    evidence = (mean - here) / (mean + area * NOISE)
    margin = (second - belief.min(0)) / (2.0 * config.truncation)
    accepted = margin.above(0.0)
    if config.min_evidence > 0:
        accepted = accepted & ~evidence.less(config.min_evidence)
    sure = (evidence.at_least(0.01) / SURE_EVIDENCE).at_most(1.0)
    column = np.arange(w, dtype=np.float32)[None, None, :] - config.min_disparity
    there = best * -1.0 + column
    outside = there.less(-0.5) | there.above(pair.w - 0.5) | pair.inside().less(0.5)
    confidence = (accepted & ~outside).where(margin.at_most(1.0) * sure, 0.0)
    return outside.where(math.nan, px).drop(), confidence.drop()


def upsampling_model(
    coarse: tuple[int, int], fine: tuple[int, int], config: UpsamplingConfig, fixed: bool = True
) -> bytes:
    """An ONNX file of Eq. 2 with every tap.

    Inputs ``px`` and ``confidence`` (h, w) float32, ``taps`` (h, w, 3) and ``guide`` (H, W, 3)
    uint8; results ``fine_px`` and ``fine_confidence`` (H, W). Unless ``fixed`` the taps of each
    row and column are inputs as well, see :func:`tap_windows`, and images may be smaller.
    """
    graph = Graph()
    px = graph.input("px", TensorProto.FLOAT, coarse)
    confidence = graph.input("confidence", TensorProto.FLOAT, coarse)
    taps = graph.input("taps", TensorProto.UINT8, (*coarse, 3)).numbers()
    guide = graph.input("guide", TensorProto.UINT8, (*fine, 3)).numbers()
    windows = {
        name: graph.constant(array)
        if fixed
        else graph.input(name, _KINDS[array.dtype.kind], array.shape)
        for name, array in tap_windows(coarse, fine, fine, config).items()
    }
    unknown = graph.op("IsNaN", px)
    trust = unknown.where(0.0, confidence.at_least(MIN_CONFIDENCE))
    value = unknown.where(0.0, px) * trust
    known = unknown.where(0.0, np.ones(coarse, np.float32))
    lifted = [v.lift(0) for v in (trust, value, known)]
    layers = join([graph.op("Transpose", taps, perm=[2, 0, 1]), *lifted])
    image = graph.op("Transpose", guide, perm=[2, 0, 1])
    everything = graph.constant(np.zeros((1, *fine), np.float32))
    sums = graph.constant(np.zeros((3, *fine), np.float32))
    for j in range(config.diameter_px):
        rows = layers.gather(windows["rows"].part(0, j, j + 1).drop(), 1)
        near_y = windows["near_rows"].part(0, j, j + 1).lift(2)
        for i in range(config.diameter_px):
            tap = rows.gather(windows["columns"].part(0, i, i + 1).drop(), 2)
            step = image - tap.part(0, 0, 3)
            tonal = (step * step).sum(0) * (-0.5 / config.range_sigma**2)
            alike = graph.op("Exp", tonal.at_least(RANGE_FLOOR * math.log(2)))
            near_x = windows["near_columns"].part(0, i, i + 1).lift(1)
            weight = alike * near_y * near_x
            everything = everything + weight
            sums = sums + weight * tap.part(0, 3, 6)
    good = sums.part(0, 2, 3).above(everything * config.min_support)
    fine_px = good.where(sums.part(0, 1, 2) / sums.part(0, 0, 1), math.nan)
    sure = good.where(sums.part(0, 0, 1) / everything, 0.0)
    graph.output(fine_px.drop(), "fine_px", fine)
    graph.output(sure.drop(), "fine_confidence", fine)
    return graph.model(f"joint bilateral upsampling, {config}")


_KINDS = {"i": TensorProto.INT64, "f": TensorProto.FLOAT}


def tap_windows(
    coarse: tuple[int, int],
    fine: tuple[int, int],
    fine_room: tuple[int, int],
    config: UpsamplingConfig,
) -> dict[str, Array]:
    """Taps of each fine row and column: ``rows`` (D, H) int64, ``near_rows`` (D, H) float32,
    and the same of columns; weights are zero outside and beyond ``fine`` in its room.
    """
    tables: dict[str, Array] = {}
    for name, axis in (("rows", 0), ("columns", 1)):
        n = coarse[axis]
        first, log = window(n, fine[axis], config)
        index = first[:, None] + np.arange(config.diameter_px)
        near = np.where((index >= 0) & (index < n), np.exp2(log), 0)
        beyond = ((0, 0), (0, fine_room[axis] - fine[axis]))
        tables[name] = np.pad(np.clip(index, 0, n - 1).T, beyond).astype(np.int64)
        tables[f"near_{name}"] = np.pad(near.T, beyond).astype(np.float32)
    return tables
