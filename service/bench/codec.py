"""``skyrelief bench codec``: bits per point, time and error of the chunk codec and its peers.

All code the same synthetic keyframes (depth 50 to 95 m, noise 2 cm white and 8 cm
correlated). Ours carries mask, sigma, views and a coarse layer too; the peers do not.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from recon.mapping.cloud_fusion import cloud_of
from recon.types import F32, U8, Keyframe
from service.bench import BenchOptions, BenchResult
from service.bench.keyframes import make_keyframe, strip
from service.stream import codec

SIZE_PX = (320, 180)
REPEATS = 30
FRAMES = 3


class CodecFigures(NamedTuple):
    """A codec's result on the keyframes; infinite or zero where nothing is lost."""

    bits_per_point: float
    encode_ms: float
    rms_at_60_m_m: float
    psnr_db: float


Coded = tuple[Callable[[], bytes], int, float, float]
"""Encodes a keyframe; its points, the depth's error at 60 m, and the colour's PSNR."""


def measure() -> dict[str, CodecFigures]:
    """Our codec first, then every peer that is installed."""
    frames = [make_keyframe(k, SIZE_PX, seed=1 + k) for k in range(FRAMES)]
    found = {}
    for name, codec_of in CODECS.items():
        with contextlib.suppress(ImportError):
            found[name] = _figures([codec_of(frame) for frame in frames])
    return found


def _figures(coded: list[Coded]) -> CodecFigures:
    with _one_core():
        encode_ms = [_median_ms(encode) for encode, *_ in coded]
    bits = [8 * len(encode()) / points for encode, points, *_ in coded]
    rms, psnr = np.array([lost for _, _, *lost in coded]).T
    return CodecFigures(
        float(np.mean(bits)), float(np.median(encode_ms)), float(np.sqrt(np.mean(rms**2))),
        float(np.mean(psnr)),
    )  # fmt: skip


def run(options: BenchOptions) -> list[BenchResult]:
    """Bits per point against every peer, encoding time, error, masking and coarse share."""
    figures = measure()
    ours = figures.pop("skyrelief")
    results = []
    for name, peer in figures.items():
        error = f"{ours.rms_at_60_m_m * 100:.2f} cm against {peer.rms_at_60_m_m * 100:.2f} cm"
        results += [
            BenchResult("size with colour", ours.bits_per_point, "bits per point", 0.0,
                        name, peer.bits_per_point, note=f"error at 60 m {error}"),
            BenchResult("encode 320x180, both layers, one core", ours.encode_ms, "ms", 0.0,
                        name, peer.encode_ms),
        ]  # fmt: skip
    saved, bits = masking()
    return [
        *results,
        BenchResult("depth error at 60 m", ours.rms_at_60_m_m * 100, "cm rms"),
        BenchResult("colour", ours.psnr_db, "dB PSNR"),
        BenchResult("sent of a keyframe at 80 % overlap", 100 * (1 - saved), "%"),
        BenchResult("size of such keyframes", bits, "bits per point"),
        BenchResult("encode one of them", strip_ms(), "ms"),
        BenchResult("decode a whole keyframe", decode_ms(), "ms"),
        BenchResult("coarse layer of their bytes", 100 * coarse_share(), "%"),
        BenchResult("coarse layer of a whole keyframe", 100 * coarse_share(False), "%"),
    ]


def masking() -> tuple[float, float]:
    """Share of the bytes saved by sending only new surface at 80 % overlap, and the bits per point
    of such keyframes."""
    whole = sum(_size(make_keyframe(k, SIZE_PX, seed=1 + k)) for k in range(FRAMES))
    fresh = [strip(SIZE_PX, 20 + k) for k in range(FRAMES)]
    frames = [make_keyframe(k, SIZE_PX, f, seed=1 + k) for k, f in enumerate(fresh)]
    part = sum(map(_size, frames))
    return 1 - part / whole, part * 8 / sum(int(f.sum()) for f in fresh)


def strip_ms() -> float:
    """Milliseconds to encode a keyframe at 80 % overlap, both layers, on one core."""
    frame = make_keyframe(0, SIZE_PX, strip(SIZE_PX, 20), seed=1)
    with _one_core():
        return _median_ms(lambda: codec.encode(frame, 0))


def decode_ms() -> float:
    """Milliseconds to decode the fine layer of a whole keyframe, on one core."""
    layers = codec.encode(make_keyframe(0, SIZE_PX, seed=1), 0)
    with _one_core():
        return _median_ms(lambda: codec.decode(layers[-1:]))


def coarse_share(masked: bool = True) -> float:
    """Share of the bytes that the coarse layer takes, at 80 % overlap or of whole keyframes."""
    fresh = [strip(SIZE_PX, 20 + k) if masked else None for k in range(FRAMES)]
    layers = [
        codec.encode(make_keyframe(k, SIZE_PX, fresh[k], seed=1 + k), 0) for k in range(FRAMES)
    ]
    return sum(len(x[0]) for x in layers) / sum(len(x[0]) + len(x[1]) for x in layers)


def _size(frame: Keyframe) -> int:
    return sum(map(len, codec.encode(frame, 0)))


def _median_ms(work: Callable[[], object]) -> float:
    """Milliseconds of one core: processor time of this thread, so a busy machine counts less."""
    work()
    times = []
    for _ in range(REPEATS):
        began = time.thread_time()
        work()
        times.append(time.thread_time() - began)
    return float(np.median(times)) * 1e3


@contextlib.contextmanager
def _one_core() -> Iterator[None]:
    """OpenCV without threads of its own."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


def _rms_at_60(frame: Keyframe, depth_m: F32) -> float:
    truth = frame.depth.depth_m.astype(np.float64)
    error = (depth_m - truth) * (60.0 / truth) ** 2
    return float(np.sqrt(np.nanmean(error**2)))


def _psnr(a: U8, frame: Keyframe) -> float:
    return float(10 * np.log10(255**2 / np.mean((a.astype(float) - frame.bgr) ** 2)))


def _ours(frame: Keyframe) -> Coded:
    back = codec.decode(codec.encode(frame, 0))
    assert back is not None
    rms = _rms_at_60(frame, back.depth.depth_m)
    points = int(frame.fresh.sum())
    return lambda: b"".join(codec.encode(frame, 0)), points, rms, _psnr(back.bgr, frame)


def _jpeg_ls(frame: Keyframe) -> Coded:
    """12-bit inverse depth between nearest and farthest in JPEG-LS, and JPEG quality 80."""
    import imagecodecs

    inverse = 1.0 / frame.depth.depth_m.astype(np.float64)
    low, step = inverse.min(), (inverse.max() - inverse.min()) / 4095

    def coded() -> tuple[bytes, bytes]:
        codes = np.rint((1.0 / frame.depth.depth_m - low) / step).astype(np.uint16)
        colour = cv2.imencode(".jpg", frame.bgr, [cv2.IMWRITE_JPEG_QUALITY, 80])[1]
        return bytes(imagecodecs.jpegls_encode(codes)), colour.tobytes()

    depth, colour = coded()
    codes = imagecodecs.jpegls_decode(depth)
    image = cv2.imdecode(np.frombuffer(colour, np.uint8), cv2.IMREAD_COLOR)
    rms = _rms_at_60(frame, (1.0 / (low + step * codes)).astype(np.float32))
    return lambda: b"".join(coded()), codes.size, rms, _psnr(np.asarray(image, np.uint8), frame)


def _points(frame: Keyframe) -> tuple[F32, U8]:
    cloud = cloud_of(replace(frame.depth, T_world_camera=np.eye(4)), frame.bgr, frame.fresh)
    return cloud.xyz_m.astype(np.float32), np.ascontiguousarray(cloud.rgb)


def _draco(frame: Keyframe) -> Coded:
    """Draco at 14 bits, where its error of position is about ours."""
    import DracoPy  # type: ignore[import-not-found, unused-ignore]

    xyz, rgb = _points(frame)

    def encode() -> bytes:
        return bytes(DracoPy.encode(xyz, colors=rgb, quantization_bits=14, compression_level=7))

    extent = float((xyz.max(axis=0) - xyz.min(axis=0)).max())
    return encode, len(xyz), extent / (1 << 14) / 12**0.5, np.inf


def _laz(frame: Keyframe) -> Coded:
    """LAZ, point format 7, 1 cm."""
    import io

    import laspy

    xyz, rgb = _points(frame)

    def encode() -> bytes:
        las = laspy.create(point_format=7, file_version="1.4")
        las.header.scales = np.full(3, 0.01)
        las.x, las.y, las.z = xyz[:, 0], xyz[:, 1], xyz[:, 2]
        las.red, las.green, las.blue = (rgb[:, k].astype(np.uint16) * 257 for k in range(3))
        out = io.BytesIO()
        las.write(out, do_compress=True, laz_backend=laspy.LazBackend.Lazrs)
        return out.getvalue()

    return encode, len(xyz), 0.01 / 12**0.5, np.inf


def _raw(frame: Keyframe) -> Coded:
    """Three floats and three bytes."""
    xyz, rgb = _points(frame)
    return lambda: xyz.tobytes() + rgb.tobytes(), len(xyz), 0.0, np.inf


CODECS: dict[str, Callable[[Keyframe], Coded]] = {
    "skyrelief": _ours,
    "JPEG-LS 12 bit + JPEG 80": _jpeg_ls,
    "Draco 14 bit": _draco,
    "LAZ 1 cm": _laz,
    "raw float32": _raw,
}
