"""``skyrelief export-model``: the dense stage as an ONNX file for a board without us."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.errors import InputError, OutsideError


def export_model(
    out: Annotated[Path, typer.Option(help="where the model goes (.onnx)")],
    size: Annotated[str, typer.Option(help="of the rectified pair, WIDTHxHEIGHT")] = "320x180",
    labels: Annotated[int, typer.Option(help="number of disparities")] = 16,
    min_disparity: Annotated[int, typer.Option(help="the smallest disparity, px")] = 0,
    iterations: Annotated[int, typer.Option(help="of belief propagation, per level")] = 5,
    guide: Annotated[
        str | None, typer.Option(help="export the upsampling to this WIDTHxHEIGHT instead")
    ] = None,
) -> None:
    """Write the stereo stage, or with --guide the upsampling, as ONNX with fixed iterations.

    Stereo: left, right (h, w) uint8 to px, confidence (h, w) float32. Upsampling: px,
    confidence (h, w) float32, taps (h, w, 3) and guide (H, W, 3) uint8 to fine_px,
    fine_confidence (H, W).
    """
    shape = parse_size(size)
    fine = parse_size(guide) if guide else None
    if not 2 <= labels <= 1024:
        raise InputError(f"--labels {labels}: give 2 to 1024")
    if out.suffix != ".onnx" or not out.parent.is_dir():
        raise InputError(f"{out}: give a name that ends in .onnx, in a folder that exists")
    try:
        from recon.backends.onnx_dense import stereo_model, upsampling_model
    except ImportError as error:
        raise OutsideError(f"export needs the onnx package: {error}") from error
    from recon.stereo.belief_propagation import BeliefPropagationConfig
    from recon.stereo.upsampling import UpsamplingConfig

    try:
        if fine is None:
            config = BeliefPropagationConfig(iterations=iterations, min_disparity=min_disparity)
            model = stereo_model(shape, labels, config)
        else:
            model = upsampling_model(shape, fine, UpsamplingConfig())
        out.write_bytes(model)
    except ValueError as error:
        raise InputError(f"export-model: {error}") from error
    except OSError as error:
        raise OutsideError(f"{out}: cannot be written: {error.strerror}") from error
    print(f"{out}: {len(model) / 1e6:.1f} MB")


def parse_size(text: str) -> tuple[int, int]:
    """(height, width) of ``WIDTHxHEIGHT``; InputError for anything else."""
    width, cross, height = text.partition("x")
    if not (cross and width.isdecimal() and height.isdecimal()):
        raise InputError(f"size {text!r}: give WIDTHxHEIGHT, such as 320x180")
    if not (8 <= int(width) <= 8192 and 8 <= int(height) <= 8192):
        raise InputError(f"size {text!r}: sides are 8 to 8192")
    return int(height), int(width)
