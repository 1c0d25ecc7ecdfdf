"""The image of a keyframe's stages, from kept arrays and from the store alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from recon.types import Array, DepthMap, Keyframe
from service.cli import app
from service.errors import InputError
from service.scans.drawing import (
    STAGES,
    anaglyph,
    coloured,
    debug_panels,
    debug_path,
    load_debug,
    middle_keyframe,
    save_debug,
    sheet,
)
from service.stream.store import ScanStore

if TYPE_CHECKING:
    from house_flight import HouseFlight


def stages() -> dict[str, Array]:
    rng = np.random.default_rng(0)
    out: dict[str, Array] = {}
    for name, (dims, *_) in STAGES.items():
        if dims == 3:
            out[name] = rng.integers(0, 255, (72, 128, 3), dtype=np.uint8)
        elif name.startswith("rect"):
            out[name] = rng.integers(0, 255, (90, 160), dtype=np.uint8)
        else:
            out[name] = rng.uniform(1, 9, (90, 160)).astype(np.float32)
            out[name][:45] = np.nan
    return out


def test_kept_stages_come_back_and_each_has_its_panel(tmp_path: Path) -> None:
    kept = stages()
    assert save_debug(tmp_path, 7, kept | {"other": np.zeros(3)}) == debug_path(tmp_path, 7)
    arrays = load_debug(debug_path(tmp_path, 7))
    assert arrays is not None
    assert set(arrays) == set(STAGES)
    np.testing.assert_array_equal(arrays["depth_m"], kept["depth_m"])
    panels = debug_panels(arrays)
    assert [p.title.split(",")[0].split(" ")[0] for p in panels] == [
        "raw",
        "raw",
        "rectified",
        "rectified",
        "anaglyph",
        "belief",
        "upsampled",
        "depth",
        "sigma",
        "colour",
    ]
    image = sheet(panels, "heading")
    assert image.shape[1] == 3 * 480 + 40
    assert load_debug(debug_path(tmp_path, 8)) is None


def test_red_is_left_and_cyan_is_right() -> None:
    left, right = np.full((4, 4), 200, np.uint8), np.full((4, 4), 30, np.uint8)
    np.testing.assert_array_equal(anaglyph(left, right)[0, 0], [30, 30, 200])


def test_colours_follow_values_and_titles_say_the_range() -> None:
    values = np.linspace(10, 20, 400, dtype=np.float32).reshape(20, 20)
    values[0, 0] = np.nan
    panel = coloured("depth", values, "m")
    assert panel.title.startswith("depth 10.1") and "19.9" in panel.title
    assert "100 % known" in panel.title
    first, last = panel.image[0, 1].astype(int), panel.image[-1, -1].astype(int)
    assert first[0] > first[2] and last[2] > last[0]  # blue is near, red is far
    assert "no data" in coloured("depth", values * np.nan, "m").title
    assert coloured("pairs", values, "").title.startswith("pairs 10 to 20,")


@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04broken"])
def test_broken_files_are_said_in_one_line(tmp_path: Path, content: bytes) -> None:
    path = debug_path(tmp_path, 1)
    path.parent.mkdir()
    path.write_bytes(content)
    with pytest.raises(InputError, match="keep_debug"):
        load_debug(path)


def test_wrong_arrays_are_refused(tmp_path: Path) -> None:
    save_debug(tmp_path, 1, {"depth_m": np.zeros((2, 2, 2))})
    with pytest.raises(InputError, match="depth_m"):
        load_debug(debug_path(tmp_path, 1))
    np.savez(debug_path(tmp_path, 2), depth_m=np.array([[object()]], dtype=object))
    with pytest.raises(InputError, match="cannot be read"):
        load_debug(debug_path(tmp_path, 2))


def test_the_keyframe_shown_is_one_with_points(tmp_path: Path) -> None:
    def keyframe(seq: int) -> Mock:
        depth_m = np.full(30, np.nan)
        depth_m[: seq if seq < 17 else 0] = 40.0
        return Mock(Keyframe, depth=Mock(DepthMap, depth_m=depth_m))

    store = Mock(ScanStore, keyframe=keyframe)
    assert middle_keyframe(tmp_path, store, range(30)) == 16
    assert middle_keyframe(tmp_path, store, range(3)) == 2
    assert middle_keyframe(tmp_path, store, []) is None
    save_debug(tmp_path, 4, stages())
    assert middle_keyframe(tmp_path, store, range(30)) == 4


def test_the_command(tmp_path: Path, house: HouseFlight) -> None:
    house.flown(tmp_path).close()
    run = CliRunner().invoke
    done = run(app, ["inspect", str(tmp_path), "--json"])
    assert done.exit_code == 0, done.exception
    figures = json.loads(done.stdout.splitlines()[-1])
    assert figures["keyframe"] == 0 and not figures["stages"]
    assert figures["depth_median_m"] == pytest.approx(40.0, abs=0.05)
    assert cv2.imread(figures["picture"]) is not None
    save_debug(tmp_path, 1, stages())
    done = run(app, ["inspect", str(tmp_path), "--out", str(tmp_path / "x.png"), "--json"])
    figures = json.loads(done.stdout.splitlines()[-1])
    assert figures["keyframe"] == 1 and figures["stages"]
    assert (tmp_path / "x.png").is_file()
    assert "keep_debug" in run(app, ["inspect", str(tmp_path), "--keyframe", "3"]).stdout
    failed = run(app, ["inspect", str(tmp_path), "--keyframe", "99"])
    assert isinstance(failed.exception, InputError)
    assert "0 to 4" in str(failed.exception)
