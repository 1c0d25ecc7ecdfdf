"""Stills without times: in the order of names where those count up, else along a path."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from service.cameras.images import ImagesSource
from service.cameras.still_order import by_likeness, shortest_path

N, STEP_PX = 10, 110


@pytest.fixture(scope="module")
def strip() -> list[np.ndarray]:
    """Images along a strip of ground, each with most of what the one before it shows."""
    rng = np.random.default_rng(5)
    ground = np.zeros((240, 320 + N * STEP_PX), np.float32)
    for cell_px in (4, 8, 16, 32):
        small = rng.random((240 // cell_px + 1, ground.shape[1] // cell_px + 1), np.float32)
        ground += cv2.resize(small, ground.shape[::-1], interpolation=cv2.INTER_CUBIC)
    gray = np.clip(255 * (ground - ground.min()) / np.ptp(ground), 0, 255).astype(np.uint8)
    return [gray[:, STEP_PX * k : STEP_PX * k + 320] for k in range(N)]


def write(folder: Path, images: list[np.ndarray], names: list[str]) -> None:
    for image, name in zip(images, names, strict=True):
        cv2.imwrite(str(folder / name), image)


def test_random_names_give_the_order_of_flight(strip: list[np.ndarray], tmp_path: Path) -> None:
    names = [f"{k}.png" for k in np.random.default_rng(7).permutation(100)[:N]]
    write(tmp_path, strip, names)
    source = ImagesSource(tmp_path)
    found = [frame.name for frame in source]
    assert found in (names, names[::-1])
    assert [frame.time_ns for frame in source] == [k * 10**9 for k in range(N)]
    assert any("ordered by likeness" in text for text in source.warnings)


def test_names_that_count_up_are_kept_across_a_break(
    strip: list[np.ndarray], tmp_path: Path
) -> None:
    """Two flights: the second one begins next to the first one's start."""
    names = [f"IMG_{k}.png" for k in range(N)]
    write(tmp_path, [*strip[6:], *strip[:6]], names)
    source = ImagesSource(tmp_path)
    assert [frame.name for frame in source] == names
    assert any("ordered by name" in text for text in source.warnings)


def test_an_interval_keeps_the_names(strip: list[np.ndarray], tmp_path: Path) -> None:
    write(tmp_path, strip, sorted(f"{k}.png" for k in range(N, 2 * N))[::-1])
    source = ImagesSource(tmp_path, interval_s=2.0)
    assert [frame.name for frame in source] == [f"{k}.png" for k in range(N, 2 * N)]


def test_positions_order_stills(strip: list[np.ndarray], tmp_path: Path) -> None:
    order = np.random.default_rng(9).permutation(N)
    names = [f"{k:02d}.png" for k in order]
    write(tmp_path, [strip[0]] * N, names)
    rows = [f"{name} 8.{k + 10:05d} 47.1 450" for k, name in enumerate(names)]
    (tmp_path / "geo.txt").write_text("EPSG:4326\n" + "\n".join(rows) + "\n")
    source = ImagesSource(tmp_path)
    assert [frame.name for frame in source] in (names, names[::-1])
    assert any("ordered by place" in text for text in source.warnings)


def test_a_still_that_does_not_decode_orders_none(strip: list[np.ndarray], tmp_path: Path) -> None:
    names = [f"{k}.png" for k in np.random.default_rng(7).permutation(100)[:N]]
    write(tmp_path, strip, names)
    whole = (tmp_path / names[4]).read_bytes()
    (tmp_path / names[4]).write_bytes(whole[:200])
    found = [frame.name for frame in ImagesSource(tmp_path)]
    rest = [name for name in names if name != names[4]]
    assert found in (rest, rest[::-1])


@pytest.mark.parametrize("n", [0, 1, 2, 3, 40])
def test_a_path_visits_each_once(n: int) -> None:
    apart = np.random.default_rng(n).random((n, n))
    assert sorted(shortest_path(apart + apart.T)) == list(range(n))


def test_the_path_of_a_survey_grid_is_its_legs() -> None:
    """Legs of ten shots, 5 m apart, with 20 m between them: no shorter way visits all."""
    at = np.array([(20.0 * leg, 5.0 * k) for leg in range(5) for k in range(10)])
    at = at[np.random.default_rng(1).permutation(len(at))]
    apart = np.linalg.norm(at[:, None] - at, axis=2)
    order = shortest_path(apart)
    length = apart[order[:-1], order[1:]].sum()
    assert length <= 1.1 * (5 * 45.0 + 4 * 20.0)


def test_an_image_of_a_size_that_is_refused_comes_at_an_end(
    strip: list[np.ndarray], tmp_path: Path
) -> None:
    names = [f"{k}.png" for k in range(2, N + 2)]
    write(tmp_path, strip, names)
    image = bytearray((tmp_path / "2.png").read_bytes())
    image[16:24] = struct.pack(">II", 100_000, 100_000)
    image[29:33] = struct.pack(">I", zlib.crc32(image[12:29]))
    (tmp_path / "1.png").write_bytes(image)
    assert 0 in np.array(by_likeness([tmp_path / name for name in ["1.png", *names]]))[[0, -1]]
