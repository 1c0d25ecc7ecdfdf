"""Rendered frames: exact lens, exact depth, consistent light; against OpenCV and brute force."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from recon import se3
from recon.rolling_shutter import row_times_s
from recon.types import F64, Camera, Shutter
from service.sim import ground_texture, scene, shapes
from service.sim.noise import fractal2, hash01, normal
from service.sim.render import Look, Renderer, camera_rays
from service.sim.scene import Area

CAMERA = Camera(
    np.array([[240.0, 0, 161.0], [0, 241.0, 88.0], [0, 0, 1]]),
    np.array([-0.2, 0.05, 0.001, -0.002, 0.0]),
    (320, 180),
)
QUIET = Look(noise=0.0, vignette=0.0)


@cache
def place() -> scene.Scene:
    return scene.make(Area(-45.0, -45.0, 45.0, 45.0), 6.0, 1.0, 7)


@cache
def renderer() -> Renderer:
    return Renderer(place(), ground_texture.make(place(), 0.12), CAMERA)


def looking_down(x: float, y: float, z: float, tilt: F64 | None = None) -> F64:
    R = np.diag([1.0, -1.0, -1.0])
    return se3.compose(R if tilt is None else R @ se3.so3_exp(tilt), np.array([x, y, z]))


def test_rays_are_those_of_the_distorted_lens() -> None:
    rays = camera_rays(CAMERA).reshape(-1, 3)
    uv, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), CAMERA.K, CAMERA.distortion)
    u, v = np.meshgrid(np.arange(320), np.arange(180))
    np.testing.assert_allclose(uv[:, 0], np.column_stack([u.ravel(), v.ravel()]), atol=1e-6)


def test_lens_that_folds_over_is_refused() -> None:
    folding = Camera(CAMERA.K, np.array([-0.9, 0.0, 0.0, 0.0, 0.0]), CAMERA.size_px)
    with pytest.raises(ValueError, match="invert"):
        camera_rays(folding)


def test_depth_agrees_with_brute_force() -> None:
    T = looking_down(3.0, -4.0, 40.0, np.array([0.2, -0.1, 0.3]))
    depth = renderer().depth(T)
    assert depth.dtype == np.float32 and depth.shape == (180, 320)
    rng = np.random.default_rng(0)
    p, e1, e2 = (place().grid.corners[:, i : i + 3] for i in (0, 3, 6))
    for u, v in zip(rng.integers(0, 320, 40), rng.integers(0, 180, 40), strict=True):
        ray = T[:3, :3] @ np.array([(u - 161.0) / 240.0, (v - 88.0) / 241.0, 1.0])
        h, from_p = np.cross(ray, e2), T[:3, 3] - p  # Cramer's rule: a e1 + b e2 - t ray = from_p
        q, det = np.cross(from_p, e1), (e1 * h).sum(axis=1)
        solvable = np.abs(det) > 1e-12
        sides = np.stack([(from_p * h).sum(axis=1), q @ ray, (e2 * q).sum(axis=1)])
        a, b, t = sides[:, solvable] / det[solvable]
        hit = (np.minimum(a, b) >= -1e-9) & (a + b <= 1 + 1e-9) & (t > 0)
        want = t[hit].min()  # t counts camera z, as the ray's z is 1
        assert depth[v, u] == pytest.approx(want, rel=1e-5)


def test_frames_depth_and_poses_belong_together() -> None:
    """One frame, taken to another by true depth and pose, shows the same image."""
    T_a, T_b = (
        looking_down(0.0, 0.0, 40.0),
        looking_down(4.0, 2.0, 41.0, np.array([0.05, 0.03, 0.1])),
    )
    a, b = (renderer().frame(T, 0, QUIET) for T in (T_a, T_b))
    straight = cv2.undistort(a, CAMERA.K, CAMERA.distortion).astype(np.float64)
    depth = renderer().depth(T_a).astype(np.float64)
    u, v = np.meshgrid(np.arange(320.0), np.arange(180.0))
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(CAMERA.K).T
    points = (rays * depth[..., None]).reshape(-1, 3)
    T_ba = se3.inverse(T_b) @ T_a
    uv, _ = cv2.projectPoints(
        points, cv2.Rodrigues(T_ba[:3, :3])[0], T_ba[:3, 3], CAMERA.K, CAMERA.distortion
    )
    grid = uv.reshape(180, 320, 2).astype(np.float32)
    there = cv2.remap(b, grid[..., 0], grid[..., 1], cv2.INTER_LINEAR, borderValue=-1.0)
    inner = np.zeros((180, 320), bool)
    inner[30:-30, 40:-40] = True
    x, y = straight[inner].ravel(), there[inner].astype(np.float64).ravel()
    assert np.corrcoef(x, y)[0, 1] > 0.98
    assert np.median(np.abs(x - y)) < 4.0
    shifted = np.roll(there, 2, axis=1)[inner].astype(np.float64).ravel()
    assert np.corrcoef(x, shifted)[0, 1] < np.corrcoef(x, y)[0, 1] - 0.06


def test_frames_have_detail_at_every_scale() -> None:
    image = renderer().frame(looking_down(0.0, 0.0, 40.0), 0, QUIET)
    gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32)
    for sigma in (0.7, 1.5, 3.0, 6.0, 12.0):
        band = cv2.GaussianBlur(gray, (0, 0), sigma) - cv2.GaussianBlur(gray, (0, 0), 2 * sigma)
        assert band.std() > 2.5
    corners = cv2.goodFeaturesToTrack(gray.astype(np.uint8), 2000, 0.01, 5)
    cells = np.zeros((6, 10), bool)
    cells[(corners[:, 0, 1] // 30).astype(int), (corners[:, 0, 0] // 32).astype(int)] = True
    assert cells.mean() > 0.95


def test_same_frame_twice_and_noise_by_index() -> None:
    T = looking_down(0.0, 0.0, 40.0)
    noisy = Look(noise=4.0, vignette=0.0)
    first, again, other = (renderer().frame(T, k, noisy) for k in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    change = first.astype(np.float64) - other.astype(np.float64)
    assert change.std() == pytest.approx(4.0 * np.sqrt(2), rel=0.1)
    assert abs(change.mean()) < 0.05


def test_exposure_and_vignette() -> None:
    T = looking_down(0.0, 0.0, 40.0)
    plain = renderer().frame(T, 0, QUIET).astype(np.float64)
    half = renderer().frame(T, 0, Look(0.0, 0.0, 0.5)).astype(np.float64)
    assert np.abs(half - 0.5 * plain).max() <= 1.0
    dark = renderer().frame(T, 0, Look(0.0, 0.4)).astype(np.float64)
    assert dark[:20, :20].mean() < 0.75 * plain[:20, :20].mean()
    assert dark[85:95, 155:165].mean() > 0.98 * plain[85:95, 155:165].mean()


def test_shadows_fall_away_from_the_sun() -> None:
    """Ground just north-west of a house is darker than just south-east of it."""
    blocks = place().blocks
    houses = blocks[np.isin(blocks[:, shapes.KIND], [shapes.FLAT, shapes.GABLED])]
    sun = ground_texture.sun_direction()
    drop = []
    pyramid = ground_texture.make(place(), 0.25)
    _, rows, cols = pyramid.levels[0]
    image = pyramid.bgr[: rows * cols].reshape(rows, cols, 3).mean(axis=2)
    for house in houses:
        away = 0.75 * np.hypot(house[shapes.HALF_L], house[shapes.HALF_W]) + 1.0
        values = []
        for side in (-1.0, 1.0):
            x, y = house[[shapes.X, shapes.Y]] + side * away * sun[:2] / np.hypot(*sun[:2])
            i, j = int((x - pyramid.x0) / 0.25), int((y - pyramid.y0) / 0.25)
            if 2 <= i < cols - 2 and 2 <= j < rows - 2:
                values.append(image[j - 2 : j + 3, i - 2 : i + 3].mean())
        if len(values) == 2:
            drop.append(values[0] / values[1])
    assert len(drop) >= 3 and np.median(drop) < 0.85


def test_open_country_has_no_houses_and_the_mesh_is_closed_to_rays_from_above() -> None:
    bare = scene.make(Area(-20.0, -20.0, 20.0, 20.0), 3.0, 0.0, 1)
    assert not np.isin(bare.blocks[:, shapes.KIND], [shapes.FLAT, shapes.GABLED]).any()
    for s in (bare, place()):
        area = s.area
        x, y = np.meshgrid(
            np.linspace(area.x0 + 0.1, area.x1 - 0.1, 150),
            np.linspace(area.y0 + 0.1, area.y1 - 0.1, 150),
        )
        origins = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 100.0)])
        t, m = s.grid.cast(origins, np.tile([0.0, 0.0, -1.0], (x.size, 1)))
        assert np.isfinite(t).all()
        assert (s.grid.normals()[m, 2] > 0).all()  # upper sides only


def test_houses_do_not_overlap() -> None:
    blocks = place().blocks
    houses = blocks[np.isin(blocks[:, shapes.KIND], [shapes.FLAT, shapes.GABLED])]
    assert len(houses) >= 3
    covered = np.zeros((900, 900), np.uint8)
    total = 0.0
    for house in houses:
        cells = np.round((shapes.footprint(house) + 45.0) * 10).astype(np.int32)
        before = int(covered.sum())
        cv2.fillConvexPoly(covered, cells, 1)
        added = (int(covered.sum()) - before) / 100.0
        total = 4 * house[shapes.HALF_L] * house[shapes.HALF_W]
        assert added > 0.95 * total


def test_noise_is_uniform_normal_and_does_not_repeat() -> None:
    values = np.array([hash01(i, j, 3) for i in range(100) for j in range(100)])
    np.testing.assert_allclose(np.histogram(values, 10, (0, 1))[0], 1000, atol=130)
    draws = np.array([normal(i, j, 3) for i in range(100) for j in range(100)])
    assert abs(draws.mean()) < 0.04 and draws.std() == pytest.approx(1.0, rel=0.03)
    line = np.array([fractal2(0.37 * k, 11.0, 4.0, 4, 0.7, 1) for k in range(4000)])
    line -= line.mean()
    spectrum = np.fft.rfft(line, 8000)
    correlation = np.fft.irfft(np.abs(spectrum) ** 2)[:3000]
    assert correlation[100:].max() < 0.35 * correlation[0]


def test_water_covers_what_lies_below_it_and_never_holds_still() -> None:
    """A level look: the horizon crosses the middle, with sky above and waves below."""
    level = looking_down(0.0, 0.0, 30.0)
    level[:3, :3] = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # to the north
    wet = Look(noise=0.0, vignette=0.0, water_m=20.0)
    early, later = (renderer().frame(level, 0, wet, t).astype(int) for t in (0.0, 1.0))
    assert np.array_equal(early, renderer().frame(level, 7, wet, 0.0))
    assert early[:80].min() > 150 and early[140:, :, 2].max() < 150  # bright sky, dark sea
    assert np.abs(later - early)[140:].mean() > 3.0
    shallow = looking_down(0.0, 0.0, 40.0)
    covered = np.isnan(renderer().depth(shallow, 20.0))
    ground = 40.0 - renderer().depth(shallow)  # the height of what is seen
    np.testing.assert_array_equal(covered, ~(ground >= 20.0))
    assert np.isfinite(renderer().depth(shallow, -20.0)).all()


@pytest.mark.parametrize("direction", ["down", "left"])
def test_each_row_is_rendered_at_its_own_pose(direction: str) -> None:
    """A row of a rolling shutter is that row of the whole image taken from the row's pose."""
    camera = replace(CAMERA, shutter=Shutter(0.03, direction))
    sideways = direction == "left"
    n = camera.size_px[0] if sideways else camera.size_px[1]
    times = row_times_s(camera)
    assert times.shape == (n,) and times.sum() == pytest.approx(0.0, abs=1e-12)
    assert np.ptp(times) == pytest.approx(0.03 * (n - 1) / n)
    assert (times[0] < 0) == (direction == "down")
    poses = np.array(
        [looking_down(3.0 + 20 * t, 1.0, 40.0, np.array([2 * t, t, 0])) for t in times]
    )
    rolling = Renderer(place(), renderer().texture, camera).frame(poses, 0, QUIET)
    for k in (0, n // 3, n - 1):
        whole = renderer().frame(poses[k], 0, QUIET)
        ours, row = (rolling[:, k], whole[:, k]) if sideways else (rolling[k], whole[k])
        # Outlines are smoothed by what the neighbouring rows see, a little elsewhere.
        assert (ours == row).all(axis=-1).mean() > 0.97
    assert (rolling != renderer().frame(poses[n // 2], 0, QUIET)).mean() > 0.2
