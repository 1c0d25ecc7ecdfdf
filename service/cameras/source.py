"""What every camera hands over, whatever it is: pictures with a time and what is known of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from recon.types import U8


@dataclass(frozen=True, slots=True)
class GeoTag:
    """Where a picture was taken, as the camera itself wrote it (EXIF, XMP)."""

    lat_deg: float
    lon_deg: float
    alt_amsl_m: float | None = None  # as written; consumer cameras drift by tens of metres
    sigma_h_m: float = 5.0  # 1 sigma, horizontal; the default when the tag does not say
    ypr_deg: tuple[float, float, float] | None = None
    """Yaw from true north, pitch, roll of the gimbal head (FRD in NED); pitch -90 looks down."""
    relative_alt_m: float | None = None  # above the take-off point


@dataclass(frozen=True, slots=True, eq=False)
class CameraFrame:
    """One picture as the source gave it."""

    image: U8  # (H, W, 3) BGR
    time_ns: int  # presentation time, ns since the start of the stream
    seq: int  # 0, 1, 2 … of the pictures that came out
    geotag: GeoTag | None
    name: str  # file name of a still, else "frame <seq>"


@runtime_checkable
class CameraSource(Protocol):
    """An open camera: iterate once for its pictures, in order of time, then close it."""

    description: str  # for a log line and scan.json
    size_px: tuple[int, int]  # (W, H)
    epoch_unix_ns: int | None  # UTC of time_ns = 0, when the source tells
    start_monotonic_ns: int | None  # this machine's monotonic clock at time_ns = 0, if live
    fps: float | None  # mean pictures per second, when the source tells
    is_live: bool  # True: pictures that are not fetched in time are lost
    warnings: list[str]  # one line each; grows while pictures are fetched

    def __iter__(self) -> Iterator[CameraFrame]:
        """Yield the pictures, oldest first; ends with the recording."""
        ...

    def close(self) -> None:
        """Let go of the file or device; safe to call twice."""
        ...
