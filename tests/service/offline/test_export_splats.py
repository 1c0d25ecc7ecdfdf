"""``export --to splat``: the files, and other readers of them."""

from __future__ import annotations

import csv
import shutil
import subprocess
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from house_flight import HouseFlight
from pyproj import Transformer

from recon.surface.splats import Splats
from service.errors import InputError, OutsideError
from service.georeference import HeightChange
from service.offline.exports.splats import FIELDS, SH0, origin_words, ply, read_splats
from service.offline.exports.view import ExportOptions, ScanView, export

pytestmark = pytest.mark.slow

pytest.importorskip("open3d", exc_type=ImportError)
pytest.importorskip("fast_simplification")


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory, house: HouseFlight) -> Path:
    """A scan with ``splat.ply``."""
    folder = tmp_path_factory.mktemp("splats")
    house.flown(folder).close()
    with ScanView(folder) as scan:
        export(scan, "splat", None, ExportOptions(stored=True))
    return folder


def test_the_file_is_a_ply_of_gaussians(flown: Path, house: HouseFlight) -> None:
    head, _, body = (flown / "splat.ply").read_bytes().partition(b"end_header\n")
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "x east, y down, z north" in lines[2] and "47.39" in lines[2]
    assert [x.split()[2] for x in lines if x.startswith("property float")] == list(FIELDS)
    rows = np.frombuffer(body, "<f4").reshape(-1, len(FIELDS))
    assert len(rows) == int(lines[3].split()[-1]) > 10_000
    assert np.isfinite(rows).all()
    x, down, north = rows[:, :3].T
    roof = (np.abs(x - 10.0) < 5.0) & (np.abs(north - 2.0) < 3.0)
    red = 255.0 * (SH0 * rows[:, 6] + 0.5)
    # The origin lies on the ground.
    assert np.median(down[roof]) == pytest.approx(-6.0, abs=0.1)
    assert np.median(down[north < -5.0]) == pytest.approx(0.0, abs=0.1)
    assert np.median(red[roof]) > 180.0


def test_what_is_written_is_read(flown: Path, tmp_path: Path) -> None:
    splats = read_splats(flown / "splat.ply")
    assert np.median(splats.xyz_m[:, 2]) == pytest.approx(0.0, abs=0.1)  # up again
    assert np.allclose(np.linalg.norm(splats.q_wxyz, axis=1), 1.0, atol=1e-5)
    assert splats.opacity.min() > 0.8 and splats.opacity.max() < 1.0
    for number, data in enumerate((b"", b"ply\n", (flown / "splat.ply").read_bytes()[:-3])):
        path = tmp_path / f"{number}.ply"
        path.write_bytes(data)
        with pytest.raises(InputError):
            read_splats(path)


def test_the_header_has_the_height_above_the_datum_that_it_names(flown: Path) -> None:
    lift = Transformer.from_pipeline("+proj=affine +zoff=45")
    with ScanView(flown) as scan:
        frame = scan.frame
        assert frame is not None
        lifted = Mock(wraps=scan, frame=replace(frame, heights=HeightChange("lift", lift)))
        words = origin_words(lifted, ExportOptions(vertical_datum="EGM96", to_datum="ellipsoid"))
    assert words.endswith(f" {frame.alt_amsl_m + 45.0:.3f} above ellipsoid")


@pytest.mark.parametrize("q", [0.0, np.nan])
def test_gaussians_without_an_attitude_are_refused(tmp_path: Path, q: float) -> None:
    one = np.ones((1, 3), np.float32)
    turns = np.full((1, 4), q, np.float32)
    half = np.full(1, 0.5, np.float32)
    path = tmp_path / "splat.ply"
    path.write_bytes(ply(Splats(one, turns, one, half, one), "x"))
    with pytest.raises(InputError, match="no PLY of Gaussians"):
        read_splats(path)


def test_an_ending_that_is_not_of_gaussians_is_refused(flown: Path, tmp_path: Path) -> None:
    with ScanView(flown) as scan, pytest.raises(InputError, match=r"\.ply or \.spz"):
        export(scan, "splat", tmp_path / "x.laz", ExportOptions(stored=True))


@pytest.mark.slow
def test_training_is_refused_before_the_work_where_it_cannot_run(
    flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch = pytest.importorskip("torch", exc_type=ImportError)
    options = ExportOptions(stored=True, train_steps=5)
    out = tmp_path / "x.ply"
    with ScanView(flown) as scan:
        if find_spec("gsplat") is None:
            with pytest.raises(OutsideError, match=r"gsplat; pip install 'skyrelief\[splat\]'"):
                export(scan, "splat", out, options)
            (tmp_path / "gsplat.py").touch()
            monkeypatch.syspath_prepend(tmp_path)
        if not torch.cuda.is_available():
            with pytest.raises(OutsideError, match="CUDA device"):
                export(scan, "splat", out, options)
    assert not out.exists()


def test_tiles_join_without_a_seam(flown: Path, tmp_path: Path) -> None:
    with ScanView(flown) as scan:
        path = export(scan, "splat", tmp_path / "tiled.ply",
                      ExportOptions(stored=True, tile_points=30_000))  # fmt: skip
    tiled, whole = read_splats(path), read_splats(flown / "splat.ply")
    assert abs(len(tiled) - len(whole)) < 0.05 * len(whole)


READER = shutil.which("splat-transform")


@pytest.mark.skipif(READER is None, reason="needs splat-transform (npm i -g @playcanvas/...)")
@pytest.mark.parametrize("ending", ["ply", "spz"])
def test_playcanvas_reads_it(flown: Path, tmp_path: Path, ending: str) -> None:
    """The reader turns both into the axes of a PLY."""
    if ending == "spz":
        pytest.importorskip("gaussforge")
    path = tmp_path / f"x.{ending}"
    with ScanView(flown) as scan:
        export(scan, "splat", path, ExportOptions(stored=True))
    assert READER is not None
    subprocess.run([READER, "-q", "-w", str(path), str(tmp_path / "x.csv")], check=True)
    with open(tmp_path / "x.csv", encoding="ascii") as file:
        rows = list(csv.DictReader(file))
    splats = read_splats(flown / "splat.ply")
    assert len(rows) == len(splats)
    read = np.array([[float(r[a]) for a in ("x", "y", "z")] for r in rows])
    true = splats.xyz_m[:, [0, 2, 1]] * [1.0, -1.0, 1.0]
    for axis in range(3):
        assert np.allclose(np.sort(read[:, axis]), np.sort(true[:, axis]), atol=2e-3)
    red = np.array([float(r["f_dc_0"]) for r in rows])
    true_red = (splats.rgb[:, 0] / 255.0 - 0.5) / SH0
    assert np.median(red) == pytest.approx(np.median(true_red), abs=0.05)
