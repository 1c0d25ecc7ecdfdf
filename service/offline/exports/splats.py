"""The surface as 3D Gaussians: PLY in the layout of 3D Gaussian splatting, or SPZ."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from recon import se3
from recon.parallel import run_parallel
from recon.surface.splat_training import trained
from recon.surface.splats import Splats, gaussians, joined, splats_of, steps
from recon.types import F32, F64, Bool
from service.errors import InputError, OutsideError, refusing
from service.offline.exports.clouds import VOXELS_MARGIN_M, ply_head
from service.offline.exports.images import resized, shared_images
from service.offline.exports.model import LARGEST_FACES, closed_surface
from service.offline.exports.view import ExportOptions, ScanView, in_parts
from service.packages import needing
from service.scans.fused_cloud import EVERYWHERE, Box
from service.scans.main_piece import main_keyframes
from service.scans.writing import writing

LARGEST_SPLATS = 6_000_000
"""Of all views of one tile together, before they are merged."""

SHRINK = 0.8
"""What would be more is made of images that are smaller by so much; beyond that, flat areas lose
detail first: images at half their size lose it at edges too, and 3 dB with it."""

DETAILS, COUNTED = (0, 2, 3, 4, 6, 8), 8
"""Levels of colour that are taken for detail, from all to what shows; views it is tried on."""

Y_DOWN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""ENU to east, down and north, as viewers take a PLY of Gaussians."""

Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""ENU to east, up and south, the axes of SPZ."""

SPZ_REACH_M = 2048.0
"""Of SPZ's coordinates: 24 bits, of which 12 are below the metre."""

SH0 = 0.28209479177387814
"""The spherical harmonic of degree 0; colours are stored as its factor."""

FIELDS = (
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1",
    "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
)  # fmt: skip
"""Of a vertex, single precision each (Kerbl et al. 2023); the normals are zero."""

LONGEST_HEADER = 4096


def write_splats(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """Gaussians of the images' pixels, in metres from the scan's origin.

    Raises InputError when there is nothing to make it of, or more ground than SPZ can hold;
    OutsideError where they are to be trained and there is no CUDA device.
    """
    if options.train_steps:
        with needing("--train-steps"):
            import gsplat  # noqa: F401
            import torch
        if not torch.cuda.is_available():
            raise OutsideError("--train-steps needs a CUDA device; leave it out")
    spz = out.suffix.lower() == ".spz"
    if spz:
        with needing("an SPZ file"):
            import gaussforge
    splats = joined(list(in_parts(scan, _made, options, VOXELS_MARGIN_M)))
    if spz and np.abs(splats.xyz_m).max() >= SPZ_REACH_M:
        raise InputError(f"{out}: SPZ reaches {SPZ_REACH_M:.0f} m from the origin; write .ply")
    scan.progress(f"writing {len(splats)} Gaussians")
    data = ply(turned(splats, Y_UP if spz else Y_DOWN), origin_words(scan, options))
    if spz:
        made = gaussforge.GaussForge().convert(data, "ply", "spz")
        if "data" not in made:
            raise InputError(f"{out}: gaussforge writes no SPZ: {made.get('error')}")
        data = made["data"]
    with writing(out) as part:
        part.write_bytes(data)


def _made(scan: ScanView, options: ExportOptions, box: Box) -> Splats | None:
    """The Gaussians of one tile, in ENU metres; None without any."""
    keyframes = list(main_keyframes(scan.store))
    progress = scan.progress
    with progress.part("reading images", 0.2):
        views = shared_images(scan, options)
    fused = scan.fused
    pairs = list(zip(keyframes, views, strict=True))
    tried = pairs[:: -(-len(pairs) // COUNTED)]
    for detail in DETAILS:
        found = run_parallel(*(partial(gaussians, k, v, detail) for k, v in tried))
        count = sum(found) * len(pairs) / len(tried)
        if count * SHRINK**2 <= LARGEST_SPLATS:
            break
    shrink = min(1.0, float(np.sqrt(LARGEST_SPLATS / max(count, 1.0))))
    coarser = fused.voxel_m / (fused.ground_sample_m or fused.voxel_m)
    if coarser > 1.05:
        shrink = min(shrink, keyframes[0].depth.K[0, 0] / (views[0].K[0, 0] * coarser))
    views = [resized(v, shrink) for v in views]
    with progress.part("Gaussians"), refusing(str(scan.folder)):
        surface = partial(closed_surface, scan, LARGEST_FACES)  # another product may make it now
        say = progress.counting(steps(len(keyframes)))
        splats = splats_of(keyframes, views, surface, say, detail)
    if options.train_steps:
        say = progress.counting(options.train_steps)
        splats = trained(splats, views, options.train_steps, say)
    if box != EVERYWHERE:
        splats = splats.at(_inside(scan, splats, box))
    return splats if len(splats) else None


def _inside(scan: ScanView, splats: Splats, box: Box) -> Bool:
    """(N,) whether each lies in a box of the map."""
    xyz_m = splats.xyz_m.astype(np.float64)
    if scan.frame is not None:
        xyz_m = scan.frame.to_utm(xyz_m)
    west, south, east, north = box
    x, y = xyz_m[:, 0], xyz_m[:, 1]
    return np.asarray((x >= west) & (x < east) & (y >= south) & (y < north))


def turned(splats: Splats, R: F64) -> Splats:
    """The Gaussians in other axes: R (3, 3) takes the old to the new."""
    w, x, y, z = se3.quaternion_from_rotation(R)
    turn = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    q = (splats.q_wxyz @ turn.T).astype(np.float32)
    return replace(splats, xyz_m=(splats.xyz_m @ R.T).astype(np.float32), q_wxyz=q)


def origin_words(scan: ScanView, options: ExportOptions) -> str:
    """Axes and origin, for the header."""
    axes = "x east, y down, z north, metres"
    frame = scan.frame
    if frame is None:
        return f"{axes} from the scan's origin"
    lat_deg, lon_deg, height_m = frame.to_geodetic(np.zeros((1, 3)))[0]
    where = f"{lat_deg:.8f} {lon_deg:.8f} {height_m:.3f}"
    return f"{axes} from latitude, longitude, height {where} {scan.above(options)}"


def ply(splats: Splats, comment: str) -> bytes:
    """A binary PLY in the layout of 3D Gaussian splatting; the file's axes are those given."""
    rows: F32 = np.zeros((len(splats), len(FIELDS)), "<f4")
    rows[:, 0:3] = splats.xyz_m
    rows[:, 6:9] = (splats.rgb / 255.0 - 0.5) / SH0
    rows[:, 9] = np.log(splats.opacity / (1.0 - splats.opacity))
    rows[:, 10:13] = np.log(splats.sigma_m)
    rows[:, 13:17] = splats.q_wxyz
    head = ply_head(comment, len(rows), [("float", name) for name in FIELDS])
    return b"".join([head, rows.data])  # of hundreds of megabytes one copy


def read_splats(path: Path) -> Splats:
    """The Gaussians of a file as :func:`write_splats` writes it, in ENU metres.

    Raises InputError for any other file.
    """
    data = path.read_bytes()
    end = data.find(b"end_header\n", 0, LONGEST_HEADER)
    head = data[: max(end, 0)].decode("ascii", "replace").split("\n")
    names = tuple(line.split()[-1] for line in head if line.startswith("property float "))
    body = data[end + len(b"end_header\n") :]
    fits = end >= 0 and names == FIELDS and bool(body) and len(body) % (4 * len(FIELDS)) == 0
    rows: F32 = np.frombuffer(body if fits else b"", "<f4").reshape(-1, len(FIELDS))
    if not (fits and np.isfinite(rows).all() and rows[:, 13:17].any(axis=1).all()):
        raise InputError(f"{path} is no PLY of Gaussians as export --to splat writes it")
    rgb = np.asarray(255.0 * (SH0 * rows[:, 6:9] + 0.5), np.float32)
    opacity = np.asarray(1.0 / (1.0 + np.exp(-rows[:, 9])), np.float32)
    sigma_m = np.asarray(np.exp(rows[:, 10:13]), np.float32)
    return turned(Splats(rows[:, 0:3], rows[:, 13:17], sigma_m, opacity, rgb), Y_DOWN.T)
