"""Bits per point, time and error of the chunk codec and its peers.

All code the same synthetic keyframes (depth 50 to 95 m, noise 2 cm white and 8 cm
correlated). Ours carries mask, sigma, views and a coarse layer too; the peers do not.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from recon.types import F32, U8, Keyframe
from service.bench import BenchOptions, BenchResult
from service.bench.codec import LAZ, SIZE_PX, by_thread, encode_laz, one_core, points
from service.bench.keyframes import make_keyframe, strip
from service.stream import codec

FRAMES = 3


class Coded(NamedTuple):
    """A codec on one keyframe; infinite or zero where nothing is lost."""

    encode: Callable[[], bytes]
    points: int
    rms_at_60_m_m: float
    psnr_db: float


def run(options: BenchOptions) -> list[BenchResult]:
    """Bits per point against every peer, encoding time, error, masking and coarse share."""
    frames = [make_keyframe(k, SIZE_PX, seed=1 + k) for k in range(FRAMES)]
    figures = {}
    for name, codec_of in CODECS.items():
        with contextlib.suppress(ImportError):
            figures[name] = _figures([codec_of(frame) for frame in frames])
    bits, encode_ms, rms_cm, psnr = figures.pop("skyrelief")
    results = []
    for name, (peer_bits, peer_ms, peer_cm, _) in figures.items():
        error = f"error at 60 m {rms_cm:.2f} cm against {peer_cm:.2f} cm"
        results += [
            BenchResult("size with colour", bits, "bits per point", 0.0, name, peer_bits,
                        note=error),
            BenchResult("encode 320x180, both layers, one core", encode_ms, "ms", 0.0, name,
                        peer_ms),
        ]  # fmt: skip
    parts = [replace(f, fresh=strip(SIZE_PX, 20 + k)) for k, f in enumerate(frames)]
    whole, new = ([codec.encode(frame, 0) for frame in some] for some in (frames, parts))
    points = sum(int(frame.fresh.sum()) for frame in parts)
    return [
        *results,
        BenchResult("depth error at 60 m", rms_cm, "cm rms"),
        BenchResult("colour", psnr, "dB PSNR"),
        BenchResult("sent of a keyframe at 80 % overlap", 100 * _size(new) / _size(whole), "%"),
        BenchResult("size of such keyframes", 8 * _size(new) / points, "bits per point"),
        BenchResult("coarse layer of their bytes", 100 * _coarse_share(new), "%"),
        BenchResult("coarse layer of a whole keyframe", 100 * _coarse_share(whole), "%"),
    ]


def _figures(coded: list[Coded]) -> tuple[float, float, float, float]:
    """Bits per point, milliseconds to encode, centimetres at 60 m, dB PSNR."""
    with one_core():
        encode_ms = [by_thread("", one.encode, BenchOptions()).value for one in coded]
    bits = [8 * len(one.encode()) / one.points for one in coded]
    rms, psnr = np.array([one[2:] for one in coded]).T
    return (
        float(np.mean(bits)), float(np.median(encode_ms)), 100 * float(np.sqrt(np.mean(rms**2))),
        float(np.mean(psnr)),
    )  # fmt: skip


def _size(frames: Sequence[Sequence[bytes]]) -> int:
    return sum(len(layer) for layers in frames for layer in layers)


def _coarse_share(frames: Sequence[Sequence[bytes]]) -> float:
    """Share of the bytes that the coarse layer takes."""
    return sum(len(layers[0]) for layers in frames) / _size(frames)


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
    return Coded(lambda: b"".join(codec.encode(frame, 0)), points, rms, _psnr(back.bgr, frame))


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
    psnr = _psnr(np.asarray(image, np.uint8), frame)
    return Coded(lambda: b"".join(coded()), codes.size, rms, psnr)


def _draco(frame: Keyframe) -> Coded:
    """Draco at 14 bits, where its error of position is about ours."""
    import DracoPy  # type: ignore[import-not-found, unused-ignore]

    xyz, rgb = points(frame)

    def encode() -> bytes:
        return bytes(DracoPy.encode(xyz, colors=rgb, quantization_bits=14, compression_level=7))

    extent = float((xyz.max(axis=0) - xyz.min(axis=0)).max())
    return Coded(encode, len(xyz), extent / (1 << 14) / 12**0.5, np.inf)


def _laz(frame: Keyframe) -> Coded:
    xyz, rgb = points(frame)
    return Coded(lambda: encode_laz(xyz, rgb), len(xyz), 0.01 / 12**0.5, np.inf)


def _raw(frame: Keyframe) -> Coded:
    """Three floats and three bytes."""
    xyz, rgb = points(frame)
    return Coded(lambda: xyz.tobytes() + rgb.tobytes(), len(xyz), 0.0, np.inf)


CODECS: dict[str, Callable[[Keyframe], Coded]] = {
    "skyrelief": _ours,
    "JPEG-LS 12 bit + JPEG 80": _jpeg_ls,
    "Draco 14 bit": _draco,
    LAZ: _laz,
    "raw float32": _raw,
}
