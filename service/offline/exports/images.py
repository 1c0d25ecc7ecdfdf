"""The images that a mesh is textured from: the stored keyframes', or the video's own."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from recon.camera_model import Undistorter, scaled_K
from recon.surface.texture_views import TextureView
from recon.types import U8, Array, Keyframe
from service.cameras import CAMERAS, open_camera
from service.cameras.images import ImagesSource
from service.cameras.source import CameraSource
from service.cameras.video import VideoSource
from service.errors import InputError, SkyreliefError
from service.offline.exports.view import ExportOptions, ScanView
from service.progress import Progress
from service.scans.main_piece import main_keyframes
from service.scans.track import camera_of
from service.scans.writing import SUMMARY
from service.stream.records import ScanHeader

log = logging.getLogger(__name__)

SAME_TIME_NS = 5_000_000


def stored_images(keyframes: Sequence[Keyframe]) -> list[TextureView]:
    """A view per keyframe from the store: where it holds depth, at the depth's resolution."""
    return [
        TextureView(_bgra(k.bgr, np.where(k.fresh, 255, 0)), k.depth.K, k.depth.T_world_camera)
        for k in keyframes
    ]


def _bgra(bgr: U8, alpha: Array) -> U8:
    """(h, w, 4) image; many times as fast as numpy.dstack."""
    out = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2BGRA), np.uint8)
    out[..., 3] = alpha
    return out


@dataclass(frozen=True, slots=True)
class Recording:
    """Where the images of a mesh come from; without a path from the scan's own store."""

    path: Path | None
    words: str  # for the operator
    is_lost: bool = False  # the scan names one, and it is not there or no longer the same


def recording_of(folder: Path, header: ScanHeader, within: Path | None = None) -> Recording:
    """The video or folder of stills that a scan was made from, when it still is where it was.

    ``scan.json`` names it (``run.source``). A relative path is tried from the working directory,
    the scan folder and its parent. The scan may be a stranger's: only what has that name in the
    folder ``within``, and is no link, is taken where that is given. Never raises.
    """
    stored = "textures from the scan's own images, at the depth's resolution"
    try:
        named = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))["run"]["source"]
        path = Path(named)
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return Recording(None, f"{stored}: the scan does not name a recording; give --video")
    places = [path, folder / path, folder.parent / path]
    if within is not None:
        own = within / path.name
        places = [own] if path.name not in ("", "..") and not os.path.islink(own) else []
    found = next((p for p in places if os.path.isfile(p) or os.path.isdir(p)), None)
    if found is None:
        words = f"{stored}: {named[:200]!r} is not there; give the flight's --video"
        is_live = named.partition(":")[0] in CAMERAS.keys() - {"file", "images"}
        return Recording(None, words, is_lost=not is_live)
    try:
        camera, source = camera_of(header), open_camera(str(found))
        size_px = source.size_px
        source.close()
    except SkyreliefError as error:
        return Recording(None, f"{stored}: {error}", is_lost=True)
    if size_px != camera.size_px:
        words = f"{stored}: {found} is another recording; give the flight's --video"
        return Recording(None, words, is_lost=True)
    return Recording(found, f"textures from {found}, which the scan was made from")


def recording_for(scan: ScanView, options: ExportOptions) -> Recording:
    """What images are taken from: the named recording, or else the scan's own where it is there."""
    if options.video is not None or options.stored:
        return Recording(options.video, "")
    return recording_of(scan.folder, scan.store.header)


def shared_images(scan: ScanView, options: ExportOptions) -> list[TextureView]:
    """A view per keyframe of the main piece, by :func:`recording_for`; read once for all products.

    Raises InputError or OutsideError when the named recording cannot be used.
    """

    def read() -> list[TextureView]:
        keyframes, header = list(main_keyframes(scan.store)), scan.store.header
        found, epoch_ns = recording_for(scan, options), options.video_epoch_ns
        if found.is_lost:
            log.warning("%s", found.words)
        elif found.words:
            scan.progress(found.words)
        if found.path is None:
            return stored_images(keyframes)
        try:
            return video_images(keyframes, header, found.path, epoch_ns, scan.progress)
        except SkyreliefError as error:
            if options.video is not None:
                raise
            log.warning("Textures from the scan's own images after all: %s", error)
            return stored_images(keyframes)

    return scan.shared(("images", images_key(options)), read)


def images_key(options: ExportOptions) -> tuple[Path | None, bool, int | None]:
    """What of the options decides which images are read."""
    video = None if options.video is None else options.video.resolve()
    return video, options.stored, options.video_epoch_ns


def opened(header: ScanHeader, video: Path) -> CameraSource:
    """The open video; InputError when it is missing or its images have another size."""
    if not video.exists():
        raise InputError(f"{video}: no such file or folder; give the flight's video")
    camera, source = camera_of(header), open_camera(str(video))
    if source.size_px != camera.size_px:
        source.close()
        raise InputError(
            f"{video}: {source.size_px[0]}x{source.size_px[1]} images, but the scan's camera "
            f"is {camera.size_px[0]}x{camera.size_px[1]}; give the video that was flown"
        )
    return source


def frames_at(
    times_ns: Sequence[int],
    header: ScanHeader,
    video: Path,
    epoch_ns: int | None,
    progress: Progress | None = None,
) -> Iterator[tuple[int, U8]]:
    """Place of each time in ``times_ns`` (unix), and the frame of ``video`` taken then.

    Frames are (H, W, 3) BGR with the lens's distortion; ``video`` is a file or a folder.
    ``epoch_ns`` is unix time of the video's start; by default the scan's start. Times without
    a frame are left out. Raises InputError when the video is of another size, or has no frame of
    these times.
    """
    source = opened(header, video)
    start = header.started_unix_ns if epoch_ns is None else epoch_ns
    say = (progress or Progress()).counting(len(times_ns))
    is_any = False
    for nearest, image in frames_near(source, [t - start for t in times_ns], SAME_TIME_NS):
        is_any = True
        yield nearest, image
        say("reading the images")
    if not is_any:
        raise InputError(
            f"{video}: no frame was taken at the time of a keyframe; give the --video-epoch "
            "that the scan was made with"
        )


def frames_near(
    source: CameraSource, times_ns: Sequence[int], within_ns: int
) -> Iterator[tuple[int, U8]]:
    """Place of each time in ``times_ns``, by the source's own clock, and the frames taken within
    ``within_ns`` of it, until each has one. The source is closed."""
    times = np.array(times_ns, np.int64)
    found = set[int]()
    if isinstance(source, VideoSource | ImagesSource):
        source.only_near(times.tolist(), within_ns)
    with closing(source):
        for frame in source:
            nearest = int(np.abs(times - frame.time_ns).argmin())
            if abs(int(times[nearest]) - frame.time_ns) <= within_ns:
                found.add(nearest)
                yield nearest, frame.image
            if len(found) == len(times) or frame.time_ns > times.max() + within_ns:
                break


def video_images(
    keyframes: Sequence[Keyframe],
    header: ScanHeader,
    video: Path,
    epoch_ns: int | None,
    progress: Progress | None = None,
    max_bytes: int = 1_500_000_000,
) -> list[TextureView]:
    """A view per keyframe by :func:`frames_at`, without distortion; all of them together are no
    larger than ``max_bytes``.

    Keyframes without a frame keep their stored image.
    """
    camera = camera_of(header)
    undistort = Undistorter(camera)
    shrink = min(1.0, (max_bytes / (4.0 * np.prod(camera.size_px) * len(keyframes))) ** 0.5)
    found: dict[int, TextureView] = {}
    times = [k.time_ns for k in keyframes]
    for n, image in frames_at(times, header, video, epoch_ns, progress):
        bgra = _bgra(undistort.image(image), undistort.valid)
        whole = TextureView(bgra, camera.K, keyframes[n].depth.T_world_camera)
        found[n] = resized(whole, shrink)
    return [found.get(n) or stored_images([k])[0] for n, k in enumerate(keyframes)]


def resized(view: TextureView, shrink: float) -> TextureView:
    """The same view with its sides ``shrink`` (0 to 1) times as long."""
    if shrink == 1.0:
        return view
    h, w = view.bgra.shape[:2]
    size = max(2, round(w * shrink)), max(2, round(h * shrink))
    small = np.asarray(cv2.resize(view.bgra, size, interpolation=cv2.INTER_AREA), np.uint8)
    return TextureView(small, scaled_K(view.K, size[0] / w, size[1] / h), view.T_world_camera)
