"""A small way to write an ONNX graph as array expressions."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

OPSET = 17
IR_VERSION = 8


class Value:
    """A tensor in a graph that is being built; arithmetic adds nodes."""

    def __init__(self, graph: Graph, name: str) -> None:
        self.graph = graph
        self.name = name

    def __add__(self, other: Any) -> Value:
        return self.graph.op("Add", self, other)

    def __sub__(self, other: Any) -> Value:
        return self.graph.op("Sub", self, other)

    def __mul__(self, other: Any) -> Value:
        return self.graph.op("Mul", self, other)

    def __truediv__(self, other: Any) -> Value:
        return self.graph.op("Div", self, other)

    def __and__(self, other: Value) -> Value:
        return self.graph.op("And", self, other)

    def __or__(self, other: Value) -> Value:
        return self.graph.op("Or", self, other)

    def __invert__(self) -> Value:
        return self.graph.op("Not", self)

    def where(self, yes: Any, no: Any) -> Value:
        """``yes`` where this is true, else ``no``."""
        return self.graph.op("Where", self, yes, no)

    def lift(self, *axes: int) -> Value:
        """With an axis of length 1 at each of ``axes``."""
        return self.graph.op("Unsqueeze", self, np.array(axes, np.int64))

    def drop(self) -> Value:
        """Without the first axis, whose length is 1."""
        return self.graph.op("Squeeze", self, np.array([0], np.int64))

    def abs(self) -> Value:
        """Magnitude."""
        return self.graph.op("Abs", self)

    def floor(self) -> Value:
        """The whole number below."""
        return self.graph.op("Floor", self)

    def round(self) -> Value:
        """The nearest whole number, halves to even."""
        return self.graph.op("Round", self)

    def at_least(self, other: Any) -> Value:
        """The larger of the two."""
        return self.graph.op("Max", self, other)

    def at_most(self, other: Any) -> Value:
        """The smaller of the two."""
        return self.graph.op("Min", self, other)

    def less(self, other: Any) -> Value:
        """Boolean."""
        return self.graph.op("Less", self, other)

    def above(self, other: Any) -> Value:
        """Boolean."""
        return self.graph.op("Greater", self, other)

    def min(self, axis: int) -> Value:
        """Least along an axis, which stays with length 1."""
        return self.graph.op("ReduceMin", self, axes=[axis], keepdims=1)

    def sum(self, axis: int) -> Value:
        """Sum along an axis, which stays with length 1."""
        return self.graph.op("ReduceSum", self, np.array([axis], np.int64), keepdims=1)

    def cast(self, kind: int) -> Value:
        """As another type of ``onnx.TensorProto``."""
        return self.graph.op("Cast", self, to=kind)

    def numbers(self) -> Value:
        """As float32."""
        return self.cast(TensorProto.FLOAT)

    def part(self, axis: int, first: int, last: int) -> Value:
        """From ``first`` up to ``last`` along an axis."""
        ends = [np.array([n], np.int64) for n in (first, last, axis)]
        return self.graph.op("Slice", self, *ends)

    def every(self, axis: int, first: int, step: int) -> Value:
        """Each ``step``-th from ``first`` along an axis."""
        ends = [np.array([n], np.int64) for n in (first, 2**31 - 1, axis, step)]
        return self.graph.op("Slice", self, *ends)

    def gather(self, index: Any, axis: int) -> Value:
        """The entries of an int64 ``index`` (N,), given or computed, along an axis."""
        return self.graph.op("Gather", self, index, axis=axis)

    def pad(self, before: list[int], after: list[int], value: float | None = 0.0) -> Value:
        """Wider at each axis: by a constant, or by the border when ``value`` is None."""
        widths = np.array([*before, *after], np.int64)
        if value is None:
            return self.graph.op("Pad", self, widths, mode="edge")
        return self.graph.op("Pad", self, widths, np.float32(value), mode="constant")


def join(parts: list[Value]) -> Value:
    """The parts one after the other along the first axis."""
    return parts[0].graph.op("Concat", *parts, axis=0)


class Graph:
    """The graph that is being built."""

    def __init__(self) -> None:
        self._nodes: list[Any] = []
        self._inputs: list[Any] = []
        self._outputs: list[Any] = []
        self._constants: dict[Any, Any] = {}

    def input(self, name: str, kind: int, shape: tuple[int, ...]) -> Value:
        """A tensor that is fed; ``kind`` is of ``onnx.TensorProto``."""
        self._inputs.append(helper.make_tensor_value_info(name, kind, list(shape)))
        return Value(self, name)

    def output(self, value: Value, name: str, shape: tuple[int, ...]) -> None:
        """Make ``value`` the float32 result called ``name``."""
        self._nodes.append(helper.make_node("Identity", [value.name], [name]))
        self._outputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, list(shape)))

    def constant(self, array: Any) -> Value:
        """A constant; Python floats and float64 become float32."""
        array = np.asarray(array)
        if array.dtype == np.float64 or (array.ndim == 0 and array.dtype == np.int64):
            array = array.astype(np.float32)
        key = (array.dtype.str, array.shape, array.tobytes())
        if key not in self._constants:
            name = f"c{len(self._constants)}"
            self._constants[key] = numpy_helper.from_array(array, name)
        return Value(self, self._constants[key].name)

    def op(self, kind: str, *operands: Any, **attributes: Any) -> Value:
        """One node with one result."""
        names = [(v if isinstance(v, Value) else self.constant(v)).name for v in operands]
        name = f"v{len(self._nodes)}"
        self._nodes.append(helper.make_node(kind, names, [name], **attributes))
        return Value(self, name)

    def model(self, description: str) -> bytes:
        """The graph as a checked ONNX file."""
        graph = helper.make_graph(
            self._nodes, "skyrelief", self._inputs, self._outputs, list(self._constants.values())
        )
        model = helper.make_model(
            graph,
            producer_name="skyrelief",
            doc_string=description,
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
        )
        onnx.checker.check_model(model)
        return bytes(model.SerializeToString())
