"""The chunk codec: errors within the promised rounding, layers that stand alone, any bytes."""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace

import cv2
import imagecodecs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon import se3
from recon.types import Bool, DepthMap, Keyframe, Pose
from service.stream import codec, plane_coders, planes
from service.stream.codec import decode, encode, pack, unpack
from service.stream.records import (
    PoseRecord,
    Repose,
    pack_pose,
    pack_repose,
    unpack_pose,
    unpack_repose,
)

W, H = 320, 180


def keyframe(fresh: Bool | None = None, w: int = W, h: int = H, near_m: float = 55.0) -> Keyframe:
    rng = np.random.default_rng(3)
    v, u = np.mgrid[:h, :w].astype(np.float64)
    relief = near_m + 6 * np.sin(u / 40) + 5 * np.cos(v / 30) + 0.04 * rng.normal(size=(h, w))
    depth_m = np.where((u > 0.6 * w) & (v < 0.5 * h), relief - 15, relief).astype(np.float32)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (h, w)), (0, 0), 2)[..., None]
    bgr = np.clip(128 + np.array([4.0, 5.0, 5.0]) * (texture - 128), 0, 255).astype(np.uint8)
    T = se3.exp(np.array([0.3, -0.2, 1.0, 10.0, -200.0, 60.0]))
    A = rng.normal(size=(6, 6))
    pose = Pose(T, A @ A.T * 1e-3, ("vision", "gnss"))
    K = np.array([[260.0, 0, 159.5], [0, 261.0, 89.5], [0, 0, 1]])
    views = np.where(u < w / 2, 2, 5).astype(np.uint8)
    depth = DepthMap(depth_m, (0.002 * depth_m).astype(np.float32), views, K, T)
    return Keyframe(11, 7, depth, bgr, pose, np.ones((h, w), bool) if fresh is None else fresh)


def stripe(share: float) -> Bool:
    v, u = np.mgrid[:H, :W]
    return np.asarray(u + 0.3 * v > (1 - share) * W)


def test_depth_error_is_the_promised_rounding() -> None:
    frame = keyframe()
    back = decode(encode(frame, 99))
    assert back is not None and back.seq == 11 and back.time_ns == 99
    error = back.depth.depth_m.astype(np.float64) - frame.depth.depth_m
    at_60 = error * (60.0 / frame.depth.depth_m) ** 2
    assert float(np.sqrt(np.mean(at_60**2))) == pytest.approx(0.004, rel=0.05)
    assert float(np.abs(at_60).max()) < 0.004 * 12**0.5 / 2 * 1.01


def test_both_depth_methods_carry_the_same() -> None:
    frame = keyframe(stripe(0.3))
    layer = encode(frame, 0)[-1]
    opened = unpack(layer)
    assert opened is not None
    head, (mask, depth, *rest) = opened
    known = plane_coders.decode_mask(mask, *head.box[2:])
    codes = plane_coders.decode_codes(depth, known)
    assert codes is not None and codes.max() > 255
    image = bytes(imagecodecs.jpegls_encode(codes))
    a = decode([pack(replace(head, method=planes.METHOD_JPEG_LS), (mask, image, *rest))])
    b = decode([layer])
    assert a is not None and b is not None
    np.testing.assert_array_equal(a.depth.depth_m, b.depth.depth_m)


def test_pose_and_camera_survive() -> None:
    frame = keyframe()
    back = decode(encode(frame, 99))
    assert back is not None
    np.testing.assert_allclose(back.depth.T_world_camera, frame.depth.T_world_camera, atol=1e-12)
    np.testing.assert_allclose(back.depth.K, frame.depth.K, rtol=1e-7)
    np.testing.assert_allclose(back.pose.covariance, frame.pose.covariance, rtol=1e-6)
    assert back.pose.sources == ("vision", "gnss")


def test_only_fresh_known_pixels_travel_with_their_sigma_and_views() -> None:
    frame = keyframe(stripe(0.3))
    frame.depth.depth_m[100:120, 280:300] = np.nan
    back = decode(encode(frame, 0))
    assert back is not None
    expected = frame.fresh & np.isfinite(frame.depth.depth_m)
    np.testing.assert_array_equal(back.fresh, expected)
    np.testing.assert_array_equal(np.isfinite(back.depth.depth_m), expected)
    ratio = back.depth.sigma_m[expected] / frame.depth.sigma_m[expected]
    assert ratio.min() > 0.75 and ratio.max() < 1.35
    assert (back.depth.views[expected] <= frame.depth.views[expected]).all()
    assert np.mean(back.depth.views[expected] == frame.depth.views[expected]) > 0.95


def test_colour_is_close() -> None:
    frame = keyframe()
    back = decode(encode(frame, 0))
    assert back is not None
    error = back.bgr.astype(np.float64) - frame.bgr
    assert 10 * np.log10(255**2 / np.mean(error**2)) > 30


def test_coarse_layer_stands_alone_on_the_same_surface() -> None:
    frame = keyframe()
    coarse_bytes, fine_bytes = encode(frame, 0)
    assert encode(frame, 0, is_coarse_enough=True) == (coarse_bytes,)
    assert len(coarse_bytes) <= 0.1 * (len(coarse_bytes) + len(fine_bytes))
    coarse = decode([coarse_bytes])
    assert coarse is not None and coarse.depth.depth_m.shape == (45, 80)
    v, u = np.mgrid[:45, :80]
    fx, _, cx = coarse.depth.K[0]
    column = ((u - cx) / fx * 260.0 + 159.5).round().astype(int)
    row = ((v - coarse.depth.K[1, 2]) / coarse.depth.K[1, 1] * 261.0 + 89.5).round().astype(int)
    error = coarse.depth.depth_m - frame.depth.depth_m[row, column]
    assert float(np.median(np.abs(error))) < 0.1
    assert float(np.mean(np.abs(error) < 1.0)) > 0.98
    fine = decode([fine_bytes])
    both = decode([fine_bytes, coarse_bytes])
    assert fine is not None and both is not None
    np.testing.assert_array_equal(fine.depth.depth_m, both.depth.depth_m)


def test_masking_saves_in_proportion() -> None:
    whole = sum(map(len, encode(keyframe(), 0)))
    part = sum(map(len, encode(keyframe(stripe(0.2)), 0)))
    assert part < 0.4 * whole


def test_nothing_fresh_is_a_small_valid_layer() -> None:
    layers = encode(keyframe(np.zeros((H, W), bool)), 0)
    assert all(len(data) == codec.HEADER_BYTES for data in layers)
    back = decode(layers)
    assert back is not None and not back.fresh.any() and back.depth.depth_m.shape == (H, W)


@pytest.mark.parametrize("near_m", [2.0, 300.0])
def test_other_altitudes(near_m: float) -> None:
    frame = keyframe(near_m=near_m + 30)
    frame.depth.depth_m[:] *= np.float32(near_m / (near_m + 30))
    back = decode(encode(frame, 0))
    assert back is not None
    error = np.abs(back.depth.depth_m - frame.depth.depth_m) / frame.depth.depth_m**2
    inverse = 1 / frame.depth.depth_m
    step = max(0.004 * 12**0.5 / 60**2, float(inverse.max() - inverse.min()) / 65534)
    assert float(np.nanmax(error)) < 0.51 * step
    assert back.fresh.all()


@pytest.mark.parametrize("size", [(1, 1), (17, 3), (640, 360), (81, 45)])
def test_any_size(size: tuple[int, int]) -> None:
    w, h = size
    frame = keyframe(w=w, h=h)
    back = decode(encode(frame, 0))
    assert back is not None
    np.testing.assert_allclose(back.depth.depth_m, frame.depth.depth_m, atol=0.02)


def test_refuses_what_cannot_be_coded() -> None:
    with pytest.raises(ValueError, match="fresh"):
        encode(keyframe(np.ones((3, 3), bool)), 0)
    with pytest.raises(ValueError, match="5000x2"):
        encode(keyframe(w=5000, h=2), 0)


LAYERS = encode(keyframe(stripe(0.4)), 1)


@given(st.binary(max_size=600))
def test_any_bytes_never_raise(data: bytes) -> None:
    assert decode([data]) is None
    assert unpack_pose(data) is None and unpack_repose(data) is None


def resealed(data: bytes) -> bytes:
    """``data`` with a checksum that holds, so that damage reaches the decoders behind it."""
    at = codec.HEADER_BYTES - 4
    crc = zlib.crc32(data[at + 4 :], zlib.crc32(data[:at]))
    return data[:at] + struct.pack("<I", crc) + data[at + 4 :]


@settings(max_examples=150)
@given(
    st.sampled_from(LAYERS),
    st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=8),
    st.booleans(),
)
def test_damage_behind_a_valid_checksum_never_raises(
    data: bytes, hits: list[tuple[float, int]], in_header: bool
) -> None:
    damaged = bytearray(data)
    reach = codec.HEADER_BYTES + 60 if in_header else len(data)
    for where, value in hits:
        damaged[min(int(where * reach), len(data) - 1)] = value
    back = decode([resealed(bytes(damaged))])
    if back is not None:
        assert back.depth.depth_m.size <= codec.MAX_PIXELS


def test_an_embedded_image_that_lies_about_its_size_is_not_opened() -> None:
    colour = planes.encode_colour(
        planes.Planes(
            np.ones((8, 8), np.float32),
            np.ones((8, 8), np.float32),
            np.ones((8, 8), np.uint8),
            np.zeros((8, 8, 3), np.uint8),
            np.ones((8, 8), bool),
        ),
        50,
    )
    at = colour.index(b"\xff\xc0")
    lying = colour[: at + 5] + b"\xff\xff\xff\xff" + colour[at + 9 :]
    assert planes.image_size(colour) == (8, 8)
    assert planes.image_size(lying) == (65535, 65535)
    assert planes.decode_colour(lying, 8, 8) is None


@settings(max_examples=60)
@given(st.integers(1, 30), st.integers(1, 30), st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_any_mask_comes_back(h: int, w: int, seed: int, share: float) -> None:
    known = np.random.default_rng(seed).random((h, w)) < share
    known[0, 0] = True
    np.testing.assert_array_equal(
        plane_coders.decode_mask(plane_coders.encode_mask(known), w, h), known
    )


@given(st.binary(max_size=100))
def test_any_bytes_are_some_mask(data: bytes) -> None:
    assert plane_coders.decode_mask(data, 13, 9).shape == (9, 13)


def test_a_ragged_mask_costs_less_than_zlib() -> None:
    noise = cv2.GaussianBlur(np.random.default_rng(1).normal(size=(180, 320)), (0, 0), 4)
    known = noise > 0
    packed = zlib.compress(np.packbits(known, axis=1).tobytes(), 9)
    assert len(plane_coders.encode_mask(known)) < 0.7 * len(packed)


def test_records_round_trip() -> None:
    T = se3.exp(np.array([0.1, 0.2, -3.0, 4.0, 5.0, -6.0]))
    pose = PoseRecord(
        17, T, np.diag(np.arange(1.0, 7.0)), lat_deg=47.25, agl_m=61.5, roll_rad=0.25,
        distance_m=1234.5, sources=("altitude", "exif"), sigma_m=0.5, keyframe_seq=0,
    )  # fmt: skip
    back = unpack_pose(pack_pose(pose))
    assert back is not None
    np.testing.assert_allclose(back.T_world_camera, T, atol=1e-12)
    assert (back.lat_deg, back.lon_deg, back.agl_m) == (47.25, None, 61.5)
    assert (back.sources, back.keyframe_seq) == (("altitude", "exif"), 0)
    repose = Repose(4, 2, T, 1.25, np.eye(6))
    again = unpack_repose(pack_repose(repose))
    assert again is not None and (again.seq, again.revision, again.scale) == (4, 2, 1.25)
