"""Meshes against closed forms and the true house, read back by trimesh."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from typer.testing import CliRunner

from recon.surface.meshing import Mesh, height_mesh, poisson_mesh
from recon.surface.raster import Grid, Raster, smoothed
from recon.types import F32, PointCloud
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


def test_a_plane_becomes_a_sheet_of_its_area_facing_up() -> None:
    _, cols = np.mgrid[0:20, 0:30]
    mesh = height_mesh(raster((0.25 * cols).astype(np.float32)))
    assert len(mesh.faces) == 2 * 19 * 29
    a, b, c = (mesh.vertices_m[mesh.faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    assert (normals[:, 2] > 0).all()
    slope = 0.5  # 0.25 m per cell of 0.5 m
    expected = (19 * 0.5) * (29 * 0.5) * np.sqrt(1 + slope**2)
    assert 0.5 * np.linalg.norm(normals, axis=1).sum() == pytest.approx(expected, rel=1e-5)
    np.testing.assert_allclose(mesh.vertices_m[0], [10.25, 49.75, 0.0])


def test_unknown_cells_are_holes_and_lone_cells_are_gone() -> None:
    height = np.full((10, 10), np.nan, np.float32)
    height[2:5, 2:5] = 1.0
    height[8, 8] = 3.0
    mesh = height_mesh(raster(height))
    assert len(mesh.vertices_m) == 9
    assert len(mesh.faces) == 8
    with pytest.raises(ValueError, match="four known cells"):
        height_mesh(raster(np.full((5, 5), np.nan, np.float32)))


def test_many_faces_are_simplified_without_leaving_the_surface() -> None:
    pytest.importorskip("open3d", exc_type=ImportError)
    rows, cols = np.mgrid[0:120, 0:120].astype(float)
    height = (2.0 * np.sin(cols / 20) * np.cos(rows / 25)).astype(np.float32)
    mesh = height_mesh(raster(height), largest_faces=3000)
    assert 1500 < len(mesh.faces) <= 3000
    col, row = (mesh.vertices_m[:, 0] - 10.25) / 0.5, (49.75 - mesh.vertices_m[:, 1]) / 0.5
    truth = 2.0 * np.sin(col / 20) * np.cos(row / 25)
    assert np.abs(mesh.vertices_m[:, 2] - truth).max() < 0.1


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


def test_poisson_finds_a_sphere() -> None:
    pytest.importorskip("open3d", exc_type=ImportError)
    rng = np.random.default_rng(2)
    n = 20_000
    out = rng.normal(size=(n, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    xyz = (5.0 * out).astype(np.float32)
    cloud = PointCloud(
        xyz, np.full((n, 3), 90, np.uint8), np.full(n, 0.05, np.float32), np.ones(n, np.uint8)
    )
    mesh = poisson_mesh(cloud, 50.0 * out, spacing_m=0.15)
    radius = np.linalg.norm(mesh.vertices_m, axis=1)
    assert np.abs(radius - 5.0).max() < 0.1
    a, b, c = (mesh.vertices_m[mesh.faces[:, k]] for k in range(3))
    outward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a)
    assert (outward > 0).mean() > 0.99
    assert mesh.rgb is not None and np.abs(mesh.rgb.astype(int) - 90).max() <= 2
    with pytest.raises(ValueError, match="too few"):
        poisson_mesh(
            PointCloud(xyz[:9], cloud.rgb[:9], cloud.sigma_m[:9], cloud.views[:9]), out[:9], 1.0
        )


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


@pytest.mark.parametrize("method", ["height", "poisson"])
def test_the_command_meshes_the_house(tmp_path: Path, house: HouseFlight, method: str) -> None:
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("open3d", exc_type=ImportError)
    house.flown(tmp_path).close()
    done = CliRunner().invoke(app, ["mesh", str(tmp_path), "--method", method, "--json"])
    assert done.exit_code == 0, done.exception
    figures = json.loads(done.stdout.splitlines()[-1])
    assert figures["method"] == method and figures["tiles"] == 1
    assert figures["seen"] > 0.8
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
    failed = run(app, ["mesh", str(tmp_path), "--method", "magic"])
    assert isinstance(failed.exception, InputError)
    failed = run(app, ["mesh", str(tmp_path), "--voxel-m", "-2"])
    assert isinstance(failed.exception, InputError)
