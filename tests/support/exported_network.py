"""A small network with weights, exported by torch as a learned stereo model would be."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("onnxruntime")


class Network(torch.nn.Module):  # type: ignore[misc, name-defined]
    """``value`` everywhere, whatever the images are."""

    def __init__(self, value: float) -> None:
        super().__init__()
        self.mix = torch.nn.Conv2d(6, 1, 1)
        with torch.no_grad():
            self.mix.weight.fill_(1.0)
            self.mix.bias.fill_(100.0)
        self.value = value

    def forward(self, left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:  # type: ignore[name-defined]
        """(1, 1, h, w) of images (1, 3, h, w)."""
        return self.value * torch.sigmoid(self.mix(torch.cat([left, right], 1)))


def write_network(
    path: Path, value: float, names: tuple[str, str, str] = ("left", "right", "disparity"),
    size: tuple[int, int] = (96, 192),
) -> None:  # fmt: skip
    """Export it with these names of inputs and output."""
    image, file = torch.zeros((1, 3, *size)), io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            Network(value), (image, image), file, input_names=names[:2], output_names=names[2:],
            dynamo=False,
        )  # fmt: skip
    path.write_bytes(file.getvalue())
