"""``skyrelief stereo LEFT RIGHT`` and ``export-model``: the stereo stage alone, here or as ONNX."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.commands import BACKENDS, AsJson, choices, parse_size
from service.compute.rectified_pair import matching_config, read_gray
from service.errors import InputError, OutsideError
from service.packages import needing
from service.scans.writing import check_writable

if TYPE_CHECKING:
    from recon.backends import Backend
    from recon.types import F32, U8


def stereo(
    left: Annotated[Path, typer.Argument(help="left image, rectified")],
    right: Annotated[Path, typer.Argument(help="right image, of the same size")],
    labels: Annotated[int, typer.Option(help="number of disparities")],
    out: Annotated[Path, typer.Option(help="float32 (h, w) pixels, NaN = unknown (.npy)")],
    min_disparity: Annotated[int, typer.Option(help="the smallest disparity, px")] = 0,
    iterations: Annotated[int, typer.Option(help="of belief propagation, per level")] = 5,
    backend: Annotated[
        str, typer.Option(help="auto, cpu, torch or onnx", autocompletion=choices(BACKENDS))
    ] = "auto",
    model: Annotated[
        Path | None, typer.Option(help="TOML file of a learned model to use instead")
    ] = None,
    checked: Annotated[
        bool, typer.Option("--checked", help="keep only verified disparities")
    ] = False,
    image: Annotated[
        Path | None, typer.Option("--image", "--picture", help="also write it in colour (.png)")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compute the disparity of a rectified pair: left pixel (u, v) matches right pixel (u - d, v).

    Surface hidden from the right image takes the disparity of the surface behind it; blank areas
    and surface outside the right image are unknown. --checked keeps only verified disparities,
    as in flight.
    """
    gray_left, gray_right = read_gray(left), read_gray(right)
    if gray_left.shape != gray_right.shape:
        raise InputError(
            f"{left} is {_size(gray_left)} but {right} is {_size(gray_right)}: "
            "a rectified pair has one size"
        )
    _check_labels(labels)
    config = matching_config(iterations, min_disparity, checked)
    check_output(out, ".npy")
    if image is not None:
        check_output(image, ".png")
    chosen = open_matcher(backend, model)
    start = time.perf_counter()
    try:
        found = chosen.belief_propagation(gray_left, gray_right, labels, config)
    except ValueError as error:
        raise InputError(f"stereo: {error}") from error
    seconds = time.perf_counter() - start
    write(out, image, found.px + config.min_disparity, labels, min_disparity)
    known = float((found.px == found.px).mean())
    if as_json:
        report = {"out": str(out), "known_share": known, "backend": chosen.name}
        print(json.dumps(report | {"seconds": seconds, "size_px": gray_left.shape[::-1]}))
    else:
        print(f"{out}: {_size(gray_left)}, {100 * known:.1f} % known, {chosen.name}")


def open_matcher(backend: str, model: Path | None) -> Backend:
    """The backend of that name, or the operator's learned model."""
    from service.compute.backend_choice import choose_backend, load_learned_model

    return choose_backend(backend) if model is None else load_learned_model(model)


def check_output(path: Path, suffix: str) -> None:
    """InputError unless a file of this kind can go there."""
    if path.suffix.lower() != suffix:
        raise InputError(f"{path}: the name must end in {suffix}")
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}")
    check_writable(path)


def write(out: Path, image: Path | None, px: F32, labels: int, min_disparity: int) -> None:
    """The disparity as an array and, when asked, as an image (black = unknown)."""
    import cv2
    import numpy as np

    try:
        np.save(out, px.astype(np.float32))
        if image is not None:
            known = np.isfinite(px)
            level = np.where(known, (px - min_disparity) * (255 / (labels - 1)), 0)
            colour = cv2.applyColorMap(level.astype(np.uint8), cv2.COLORMAP_TURBO)
            colour[~known] = 0
            image.write_bytes(cv2.imencode(".png", colour)[1].tobytes())
    except OSError as error:
        raise OutsideError(f"{out}: cannot be written: {error.strerror}") from error


def _check_labels(labels: int) -> None:
    if not 2 <= labels <= 1024:
        raise InputError(f"--labels {labels}: give 2 to 1024")


def _size(image: U8) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def export_model(
    out: Annotated[Path, typer.Option(help="model file to write (.onnx)")],
    size: Annotated[str, typer.Option(help="size of the rectified pair, WIDTHxHEIGHT")] = "320x180",
    labels: Annotated[int, typer.Option(help="number of disparities")] = 16,
    min_disparity: Annotated[int, typer.Option(help="the smallest disparity, px")] = 0,
    iterations: Annotated[int, typer.Option(help="of belief propagation, per level")] = 5,
) -> None:
    """Write belief propagation as an ONNX model, and its declaration (.toml) for compute.model.

    The model takes left, right (1, 1, h, w) float32 gray levels and gives disparity (1, 1, h, w),
    px.
    """
    height, width = _shape(size, "--size")
    _check_labels(labels)
    check_output(out, ".onnx")
    config = matching_config(iterations, min_disparity, checked=False)
    with needing("export-model"):
        from recon.backends.exported_stereo import export_stereo
    declaration = out.with_suffix(".toml")
    try:
        with out.open("wb") as file:
            export_stereo(file, (height, width), labels, config)
        declaration.write_text(
            f'model = "{out.name}"\nheight = {height}\nwidth = {width}\n'
            "channels = 1\nscale = 1.0\n",
            encoding="utf-8",
        )
    except OSError as error:
        raise OutsideError(f"{out}: cannot be written: {error.strerror}") from error
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB; use it with compute.model = {declaration}")


def _shape(text: str, option: str) -> tuple[int, int]:
    """(height, width) of ``WIDTHxHEIGHT``."""
    width, height = parse_size(text, option)
    if not (8 <= width <= 8192 and 8 <= height <= 8192):
        raise InputError(f"{option} {text!r}: sides are 8 to 8192")
    return height, width
