"""``skyrelief stereo LEFT RIGHT`` and ``export-model``: the stereo stage alone, here or as ONNX."""

from __future__ import annotations

import io
import json
import logging
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.commands import AsJson, BackendName, parse_size
from service.errors import InputError, refusing
from service.packages import needing
from service.scans.writing import check_writable, write_whole, writing

if TYPE_CHECKING:
    from recon.backends import Backend
    from recon.stereo.belief_propagation import BeliefPropagationConfig
    from recon.types import F32, U8, DisparityMap

log = logging.getLogger(__name__)

MIN_SIDE_PX = 8

LABEL_BYTES, FREE_SHARE = 3.2, 0.5
"""Costs and messages of one label of one pixel, and how much of the free memory they may take."""

Labels = Annotated[int, typer.Option(help="number of disparities")]
MinDisparity = Annotated[int, typer.Option(help="the smallest disparity, px")]
Iterations = Annotated[int, typer.Option(help="of belief propagation, per level")]


def stereo(
    left: Annotated[Path, typer.Argument(help="left image, rectified")],
    right: Annotated[Path, typer.Argument(help="right image, of the same size")],
    labels: Labels,
    out: Annotated[Path, typer.Option(help="float32 (h, w) pixels, NaN = unknown (.npy)")],
    min_disparity: MinDisparity = 0,
    iterations: Iterations = 5,
    backend: Annotated[str, BackendName] = "auto",
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
    as in flight. Rows that lie apart, by a calibration a little off, are brought together;
    where one image is blurred, the other is blurred as much, and a little are both where noise
    hides what they show; dark images are stretched. Images too large for the memory are matched at
    half their size, or a quarter, and upsampled.
    """
    import psutil  # type: ignore[import-untyped]

    from recon.calibration.row_alignment import (
        features_apart,
        in_rows,
        range_missed,
        rows_aligned,
        rows_apart,
        rows_missed,
    )
    from recon.image_quality import alike, stretch
    from service.compute.backend_choice import choose_backend, load_learned_model

    gray_left, gray_right = read_pair(left, right)
    if gray_left.shape != gray_right.shape:
        raise InputError(
            f"{left} is {_size(gray_left)} but {right} is {_size(gray_right)}: "
            "a rectified pair has one size"
        )
    if min(gray_left.shape) < MIN_SIDE_PX:
        raise InputError(f"{left} is {_size(gray_left)}: sides are {MIN_SIDE_PX} px at least")
    config = matching_config(labels, iterations, min_disparity, checked)
    check_output(out, ".npy")
    if image is not None:
        check_output(image, ".png")
    chosen = choose_backend(backend) if model is None else load_learned_model(model)
    looked_for = min_disparity, min_disparity + labels
    there, features = features_apart(gray_left, gray_right)
    _warn_of_rows(rows_missed(features, len(gray_left)))
    is_in_row = in_rows(features, len(gray_left))
    there, features = there[is_in_row], features[is_in_row]
    apart = rows_apart(gray_left.shape, there, features, looked_for)
    missed = range_missed(features, looked_for)
    if missed is not None:
        low, high = missed
        log.warning(
            "Most features have disparities of %.0f to %.0f px, not %d to %d: set "
            "--min-disparity and --labels%s", low, high, *looked_for,
            ", or give the images in the other order" if high <= 0 else "",
        )  # fmt: skip
    if apart is not None:
        gray_right = rows_aligned(gray_right, apart)
    gray_left, gray_right, *blurs_px = alike(stretch(gray_left), stretch(gray_right))
    start = time.perf_counter()
    with refusing("stereo"):
        free = psutil.virtual_memory().available if model is None else math.inf
        found = matched(chosen, gray_left, gray_right, labels, config, free)
    seconds = time.perf_counter() - start
    write(out, image, found.px + config.min_disparity, labels, min_disparity)
    known = float((found.px == found.px).mean())
    middle = (1.0, 0.5 * gray_left.shape[1], 0.5 * gray_left.shape[0])
    off_px = 0.0 if apart is None else float(apart @ middle)
    if as_json:
        report = {"out": str(out), "known_share": known, "backend": chosen.name, "rows_px": off_px}
        report |= {"blurs_px": blurs_px, "seconds": seconds, "size_px": gray_left.shape[::-1]}
        print(json.dumps(report))
    else:
        said = "" if apart is None else f", rows {off_px:.1f} px apart: aligned"
        if all(blurs_px):
            said += ", both images noisy: blurred"
        elif any(blurs_px):
            said += f", {'left' if blurs_px[0] else 'right'} image sharper: blurred like the other"
        print(f"{out}: {_size(gray_left)}, {100 * known:.1f} % known, {chosen.name}{said}")


def matched(
    backend: Backend, left: U8, right: U8, labels: int, config: BeliefPropagationConfig,
    free_bytes: float,
) -> DisparityMap:  # fmt: skip
    """Labels (h, w) of the left image by belief propagation.

    A pair that would need more memory is matched on images of half the size, or a quarter, and
    brought back by joint bilateral upsampling.
    """
    import cv2
    import numpy as np

    from recon.types import DisparityMap

    shrink, (h, w) = 1, left.shape
    while LABEL_BYTES * h * w * labels / shrink**3 > FREE_SHARE * free_bytes:
        shrink *= 2
    if shrink == 1 or min(h, w) < shrink * MIN_SIDE_PX:
        return backend.belief_propagation(left, right, labels, config)
    size = w // shrink, h // shrink
    needed, free = (n / 2**30 for n in (LABEL_BYTES * h * w * labels, free_bytes))
    log.warning(
        "%d labels of %s need %.1f GiB, %.1f are free: matched on %dx%d and upsampled",
        labels, _size(left), needed, free, *size,
    )  # fmt: skip
    few = replace(config, min_disparity=config.min_disparity // shrink)
    count = -(-(config.min_disparity + labels) // shrink) - few.min_disparity + 1
    a, b = (cv2.resize(one, size, interpolation=cv2.INTER_AREA) for one in (left, right))
    found = backend.belief_propagation(np.asarray(a), np.asarray(b), count, few)
    fine = backend.upsample(found, np.repeat(left[..., None], 3, axis=2))
    px = (fine.px + few.min_disparity) * np.float32(w / size[0]) - config.min_disparity
    return DisparityMap(np.clip(px, 0.0, labels - 1.0), fine.confidence)


def _warn_of_rows(lower_px: float | None) -> None:
    if lower_px is None:
        return
    if lower_px == lower_px:
        log.warning(
            "The right image shows most features %.0f px lower than the left one: rectify the pair",
            lower_px,
        )
    else:
        log.warning(
            "What matches in the two images does not lie in the same rows: do both show the same "
            "scene, rectified, and neither mirrored nor turned?"
        )


def matching_config(
    labels: int, iterations: int, min_disparity: int, checked: bool
) -> BeliefPropagationConfig:
    """How one pair is matched, densely unless ``checked``; InputError for numbers out of range."""
    from recon.stereo.belief_propagation import BeliefPropagationConfig

    if not 2 <= labels <= 1024:
        raise InputError(f"--labels {labels}: give 2 to 1024")
    with refusing("stereo"):
        config = BeliefPropagationConfig(iterations=iterations, min_disparity=min_disparity)
    if checked:
        return config
    return replace(config, min_evidence=0.05, min_contrast=0.3, fill_occluded=True)


def read_pair(left: Path, right: Path) -> tuple[U8, U8]:
    """Two gray 8-bit images, of those with more bits the levels that they use; InputError when
    there is none."""
    import numpy as np

    images = read_gray(left), read_gray(right)
    if all(image.dtype == np.uint8 for image in images):
        return images
    from service.cameras.images import black_and_white, ends_of, levels

    low_high = black_and_white(ends_of(image) for image in images if image.dtype != np.uint8)
    a, b = (image if image.dtype == np.uint8 else levels(image, low_high) for image in images)
    return a, b


def read_gray(path: Path) -> Any:
    """A gray image (h, w) of as many bits as it has; InputError when there is none."""
    import numpy as np

    if not path.is_file():
        raise InputError(f"{path}: no such file")
    data = np.fromfile(path, np.uint8)
    image = _decoded(data) if len(data) else None
    if image is None:
        raise InputError(f"{path}: not an image that can be read; give PNG, JPEG or TIFF")
    return image


TIFF = b"II*\0", b"MM\0*"


def _decoded(data: U8) -> Any:
    """A gray image of a file's bytes; None when there is none."""
    import cv2
    import numpy as np

    if data[:4].tobytes() in TIFF:  # OpenCV reads colours of floats as they are alone
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
        if image is not None and image.ndim == 3 and image.dtype == np.float32:
            has_alpha = image.shape[2] == 4
            return cv2.cvtColor(image, cv2.COLOR_BGRA2GRAY if has_alpha else cv2.COLOR_BGR2GRAY)
    return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)


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

    array = io.BytesIO()
    np.save(array, px.astype(np.float32))
    write_whole(out, array.getvalue())
    if image is not None:
        known = np.isfinite(px)
        level = np.where(known, (px - min_disparity) * (255 / (labels - 1)), 0)
        colour = cv2.applyColorMap(level.astype(np.uint8), cv2.COLORMAP_TURBO)
        colour[~known] = 0
        write_whole(image, cv2.imencode(".png", colour)[1].tobytes())


def _size(image: U8) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def export_model(
    out: Annotated[Path, typer.Option(help="model file to write (.onnx)")],
    size: Annotated[str, typer.Option(help="size of the rectified pair, WIDTHxHEIGHT")] = "320x180",
    labels: Labels = 16,
    min_disparity: MinDisparity = 0,
    iterations: Iterations = 5,
) -> None:
    """Write belief propagation as an ONNX model, and its declaration (.toml) for compute.model.

    The model takes left, right (1, 1, h, w) float32 gray levels and gives disparity (1, 1, h, w),
    px.
    """
    width, height = parse_size(size)
    if not all(MIN_SIDE_PX <= side <= 8192 for side in (width, height)):
        raise InputError(f"--size {size!r}: sides are {MIN_SIDE_PX} to 8192")
    check_output(out, ".onnx")
    config = matching_config(labels, iterations, min_disparity, checked=False)
    with needing("export-model"):
        from recon.backends.exported_stereo import export_stereo
    declaration = out.with_suffix(".toml")
    with writing(out) as part, part.open("wb") as file:
        export_stereo(file, (height, width), labels, config)
    shape = f"height = {height}\nwidth = {width}\nchannels = 1\nscale = 1.0\n"
    write_whole(declaration, f'model = "{out.name}"\n{shape}')
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB; use it with compute.model = {declaration}")
