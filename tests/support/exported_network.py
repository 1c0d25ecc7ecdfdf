"""A small network with weights, as an exporter writes a learned stereo model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

onnx: Any = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")


def write_network(
    path: Path, value: float, names: tuple[str, str, str] = ("left", "right", "disparity"),
    size: tuple[int, int] = (96, 192),
) -> None:  # fmt: skip
    """A network that gives ``value`` everywhere, with these names of its inputs and its output."""
    from onnx import TensorProto, helper, numpy_helper

    def image(name: str, channels: int) -> Any:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, channels, *size])

    left, right, disparity = names
    nodes = [
        helper.make_node("Concat", [left, right], ["both"], axis=1),
        helper.make_node("Conv", ["both", "weight", "bias"], ["mixed"]),
        helper.make_node("Sigmoid", ["mixed"], ["share"]),
        helper.make_node("Mul", ["share", "value"], [disparity]),
    ]
    weights = {
        "weight": np.ones((1, 6, 1, 1), np.float32),
        "bias": np.full(1, 100.0, np.float32),  # the sigmoid is 1
        "value": np.full(1, value, np.float32),
    }
    graph = helper.make_graph(
        nodes, "network", [image(left, 3), image(right, 3)], [image(disparity, 1)],
        [numpy_helper.from_array(array, name) for name, array in weights.items()],
    )  # fmt: skip
    opset = [helper.make_opsetid("", 17)]
    onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=8), path)
