"""Meshes against closed forms and the true house, read back by trimesh."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from sheets import height_mesh
from typer.testing import CliRunner

from recon.surface.meshing import Mesh, coarser, edges, largest_parts, reduced, repaired
from recon.surface.raster import Grid, Raster, smoothed
from recon.types import F32
from service.cli import app
from service.errors import InputError
from service.offline.exports.model import glb

if TYPE_CHECKING:
    from house_flight import HouseFlight


def raster(height: F32, sigma_m: float = 0.05) -> Raster:
    rgb = np.zeros((*height.shape, 3), np.uint8)
    rgb[..., 0] = np.arange(height.shape[1])[None] % 256
    sigma = np.where(np.isfinite(height), np.float32(sigma_m), np.float32(np.nan))
    return Raster(Grid(10.0, 50.0, 0.5, height.shape), height, sigma, rgb)


def test_many_faces_are_merged_without_leaving_the_surface() -> None:
    pytest.importorskip("fast_simplification")
    rows, cols = np.mgrid[0:120, 0:120].astype(float)
    whole = height_mesh(raster((2.0 * np.sin(cols / 20) * np.cos(rows / 25)).astype(np.float32)))
    utm = np.array([4.1e5, 5.2e6, 0.0])
    vertices, faces = reduced(whole.vertices_m + utm, whole.faces, 3000)
    assert 1500 < len(faces) <= 3000
    x, y, z = (vertices - utm).T
    truth = 2.0 * np.sin((x - 10.25) / 0.5 / 20) * np.cos((49.75 - y) / 0.5 / 25)
    assert np.abs(z - truth).max() < 0.1


@pytest.mark.parametrize("largest", [2, 500])
def test_a_mesh_of_few_faces_keeps_them(largest: int) -> None:
    """As a small scan, or the corner of a tile, has."""
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.3]])
    mesh = Mesh(corners, np.array([[0, 1, 2], [1, 3, 2]], np.int32), None, None)
    few = coarser(mesh, largest)
    assert np.array_equal(few.vertices_m, corners) and np.array_equal(few.faces, mesh.faces)


def test_sheets_that_touch_at_an_edge_are_taken_apart() -> None:
    """Two boxes share an edge of four triangles."""
    box = np.array(list(np.ndindex(2, 2, 2)), np.float64)
    sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    one = np.array([t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))], np.int32)
    both = np.vstack([box, box + np.array([1.0, 1.0, 0.0])])
    both, place = np.unique(both, axis=0, return_inverse=True)
    faces = place[np.vstack([one, one + 8])].astype(np.int32)
    assert edges(faces)[2].max() == 4
    vertices, faces = repaired(both, faces)
    assert set(edges(faces)[2]) == {2}
    corners = vertices[faces]
    volume = np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert abs(volume) == pytest.approx(2.0, abs=0.7)
    same = repaired(box, one)
    assert same[0] is box and same[1] is one


def test_parts_that_float_go() -> None:
    whole = height_mesh(raster(np.zeros((40, 40), np.float32)))
    vertices = np.vstack([whole.vertices_m[:3] + 5.0, whole.vertices_m])
    faces = np.vstack([[[0, 1, 2]], whole.faces + 3]).astype(np.int32)
    kept = largest_parts(vertices, faces, 0.01)
    np.testing.assert_array_equal(kept[0], whole.vertices_m)
    np.testing.assert_array_equal(kept[1], whole.faces)


def test_smoothing_takes_noise_and_keeps_steps() -> None:
    rng = np.random.default_rng(1)
    height = np.zeros((60, 60), np.float32)
    height[:, 30:] = 5.0
    noisy = (height + rng.normal(0, 0.05, height.shape)).astype(np.float32)
    noisy[10, 10] = np.nan
    smooth = smoothed(raster(noisy))
    assert np.isnan(smooth.height_m[10, 10])
    error = smooth.height_m - height
    assert np.nanstd(error) < 0.5 * 0.05
    assert np.nanmax(np.abs(error[:, 28:32])) < 0.2


def test_glb_is_read_by_trimesh(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    mesh = height_mesh(raster(np.ones((12, 16), np.float32)))
    mesh = replace(mesh, uv=np.full((len(mesh.vertices_m), 2), 0.5, np.float32))
    texture = np.full((12, 16, 3), (200, 100, 50), np.uint8)
    (tmp_path / "a.glb").write_bytes(glb([(mesh, texture)], {"scan": "x"}))
    read = trimesh.load(tmp_path / "a.glb", force="mesh")
    assert read.faces.shape == mesh.faces.shape
    np.testing.assert_allclose(read.vertices[:, 1], 1.0, atol=1e-6)  # y is up
    np.testing.assert_allclose(-read.vertices[:, 2], mesh.vertices_m[:, 1], atol=1e-5)
    image = np.asarray(read.visual.material.baseColorTexture)
    np.testing.assert_allclose(image.reshape(-1, 3).mean(axis=0), [200, 100, 50], atol=4)
    coloured = Mesh(mesh.vertices_m, mesh.faces, None, np.full((len(mesh.vertices_m), 3), 128))
    (tmp_path / "b.glb").write_bytes(glb([(coloured, None)], {}))
    # 128 in sRGB is 0.2159 of full light.
    o3d = pytest.importorskip("open3d", exc_type=ImportError)
    colours = np.asarray(o3d.io.read_triangle_mesh(str(tmp_path / "b.glb")).vertex_colors)
    np.testing.assert_allclose(colours, 0.2159, atol=2e-3)


def test_the_command_meshes_the_house(tmp_path: Path, house: HouseFlight) -> None:
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("open3d", exc_type=ImportError)
    house.flown(tmp_path).close()
    done = CliRunner().invoke(app, ["mesh", str(tmp_path), "--json"])
    assert done.exit_code == 0, done.exception
    figures = json.loads(done.stdout.splitlines()[-1])
    assert figures["tiles"] == 1 and 0.5 < figures["measured"] < 1.0
    assert figures["seen"] > 0.75  # straight down no view shows the walls
    mesh = trimesh.load(tmp_path / "mesh.glb", force="mesh")
    x, y, z = mesh.vertices[:, 0], -mesh.vertices[:, 2], mesh.vertices[:, 1]
    from_wall = np.maximum(np.abs(x - 10) - 6.0, np.abs(y - 2) - 4.0)
    clear = np.abs(from_wall) > 1.2
    error = np.abs(z[clear] - house.roof_m(x, y)[clear])
    assert np.median(error) < 0.02
    assert np.quantile(error, 0.98) < 0.3
    assert ((z > 5.5) & clear).sum() > 50
    atlas = np.asarray(mesh.visual.material.baseColorTexture)[..., :3]
    uv = np.clip(mesh.visual.uv, 0, 0.9999) * [[1, -1]] + [[0, 1]]
    at = (uv * [atlas.shape[1], atlas.shape[0]]).astype(int)
    colour = atlas[np.minimum(at[:, 1], atlas.shape[0] - 1), at[:, 0]].astype(int)
    roof = (z > 5.5) & (from_wall < -1.0)
    assert np.median(colour[roof], axis=0) == pytest.approx([200, 40, 40], abs=15)
    ground = (z < 0.5) & (from_wall > 1.0)
    assert (colour[ground, 1] > colour[ground, 0]).mean() > 0.95  # grass, not roof


def test_bad_requests_are_refused(tmp_path: Path, house: HouseFlight) -> None:
    house.flown(tmp_path).close()
    run = CliRunner().invoke
    failed = run(app, ["mesh", str(tmp_path), "--voxel-m", "-2"])
    assert isinstance(failed.exception, InputError)
