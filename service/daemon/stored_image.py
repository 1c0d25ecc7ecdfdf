"""Images on disk: JPEG files named by their time, a folder that ``skyrelief replay`` accepts."""

from __future__ import annotations

import errno
import os
import shutil
import time
from pathlib import Path

from mavlink.component.camera import KeyframeReport
from recon.types import U8
from service.scans.writing import sync

QUALITY = 90
MIN_FREE_MIB = 500.0  # no image is stored with less, and the self-test fails
GPS = 0x8825  # EXIF's directory of the position
BELOW_SEA = b"\1"


def store_image(path: Path, image: U8, tag: KeyframeReport | None = None) -> None:
    """Write ``image`` (H, W, 3) BGR with the position of ``tag`` in EXIF; OSError when the disk
    has no room.

    One with a ``tag`` is written through to the disk. Others come five times a second while the
    computer is overloaded: what waits for the disk then loses images.
    """
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    if shutil.disk_usage(path.parent).free < MIN_FREE_MIB * 2**20:
        raise OSError(errno.ENOSPC, "the disk is nearly full")
    exif = Image.Exif()
    exif[GPS] = {} if tag is None else _position(tag)
    part = path.with_suffix(".part")
    Image.fromarray(image[:, :, ::-1]).save(part, "JPEG", quality=QUALITY, exif=exif)
    if tag is not None:  # it is reported as taken; a power cut may not leave it empty
        sync(part)
    os.replace(part, path)
    if tag is not None:
        sync(path.parent)


def _position(tag: KeyframeReport) -> dict[int, object]:
    """EXIF 2.32, section 4.6.6; empty without a position."""
    if tag.lat_deg is None or tag.lon_deg is None:
        return {}
    north, east = "N" if tag.lat_deg >= 0.0 else "S", "E" if tag.lon_deg >= 0.0 else "W"
    position: dict[int, object] = {1: north, 2: _dms(tag.lat_deg), 3: east, 4: _dms(tag.lon_deg)}
    if tag.alt_amsl_m is not None:
        position |= {5: b"\0" if tag.alt_amsl_m >= 0.0 else BELOW_SEA, 6: abs(tag.alt_amsl_m)}
    return position


def _dms(degrees: float) -> tuple[float, float, float]:
    minutes, seconds = divmod(abs(degrees) * 3600.0, 60.0)
    whole, minutes = divmod(minutes, 60.0)
    return whole, minutes, seconds


def image_name(unix_ns: int) -> str:
    """A file name with the UTC time to the microsecond: 20261121130501123456Z.jpg."""
    seconds, rest_ns = divmod(unix_ns, 1_000_000_000)
    moment = time.strftime("%Y%m%d%H%M%S", time.gmtime(seconds))
    return f"{moment}{rest_ns // 1000:06d}Z.jpg"
