"""The lossless plane coder: exact, blind to holes, smaller than JPEG-LS, safe on any bytes."""

from __future__ import annotations

import zlib

import imagecodecs
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.types import U16
from service.stream.plane_coders import WEIGHTS, decode_codes, encode_codes


def bumpy(h: int, w: int, noise: float) -> U16:
    v, u = np.mgrid[:h, :w]
    rng = np.random.default_rng(1)
    plane = 2000 + 300 * np.sin(u / 25) + 200 * np.cos(v / 17) + noise * rng.normal(size=(h, w))
    return np.asarray(np.rint(plane), np.uint16)


@settings(max_examples=60)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_any_plane_with_any_holes_comes_back(h: int, w: int, seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    codes = rng.integers(0, 65536, (h, w), np.uint16)
    known = rng.random((h, w)) < share
    back = decode_codes(encode_codes(codes, known), known)
    assert back is not None
    np.testing.assert_array_equal(back, np.where(known, codes, 0))


def test_smaller_than_jpeg_ls_on_noisy_surface_and_far_smaller_with_holes() -> None:
    codes = bumpy(180, 320, 4.0)
    everything = np.ones(codes.shape, bool)
    plain = len(imagecodecs.jpegls_encode(codes))
    assert len(encode_codes(codes, everything)) < 0.97 * plain
    holes = np.random.default_rng(2).random(codes.shape) > 0.4
    filled = np.where(holes, codes, 0).astype(np.uint16)
    assert len(encode_codes(codes, holes)) < 0.6 * len(imagecodecs.jpegls_encode(filled))


def test_holes_do_not_show_in_the_bytes() -> None:
    codes = bumpy(60, 80, 2.0)
    known = np.random.default_rng(3).random(codes.shape) > 0.5
    other = np.where(known, codes, 54321).astype(np.uint16)
    assert encode_codes(codes, known) == encode_codes(other, known)


@settings(max_examples=100)
@given(st.binary(max_size=200))
def test_any_bytes_give_none_or_a_plane(data: bytes) -> None:
    known = np.ones((7, 9), bool)
    back = decode_codes(data, known)
    assert back is None or back.shape == (7, 9)
    back = decode_codes(bytes(2 * WEIGHTS) + zlib.compress(data), known)
    assert back is None or back.shape == (7, 9)


def test_a_bomb_is_not_unpacked() -> None:
    bomb = bytes(2 * WEIGHTS) + zlib.compress(bytes(10_000_000))
    assert decode_codes(bomb, np.ones((4, 4), bool)) is None
