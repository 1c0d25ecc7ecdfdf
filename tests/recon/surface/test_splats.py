"""3D Gaussians from depth images, against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon import se3
from recon.camera_model import rays
from recon.surface.meshing import Mesh
from recon.surface.splats import (
    COVERED,
    LOW_PASS_PX2,
    MAX_OPACITY,
    SINGLE,
    WIDTH,
    Splats,
    gaussians,
    of_depth,
    rendered,
    splats_of,
)
from recon.surface.texture_views import TextureView
from recon.types import F64, U8, DepthMap, Keyframe, Pose

pytestmark = pytest.mark.slow  # compiles

K = np.array([[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]])
SIZE = (64, 48)
DOWN = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])


def expected(splats: Splats, T: F64) -> tuple[F64, F64]:
    """The image by the formula: covariances through a numerical derivative of the projection."""

    def to_image(xyz: F64) -> F64:
        x, y, z = se3.transform(se3.inverse(T), xyz[None])[0]
        return np.array([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]])

    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    image, left = np.zeros((SIZE[1], SIZE[0], 3)), np.ones((SIZE[1], SIZE[0]))
    xyz = splats.xyz_m.astype(np.float64)
    depth = se3.transform(se3.inverse(T), xyz)[:, 2]
    for n in np.argsort(depth):
        R = Rotation.from_quat(splats.q_wxyz[n, [1, 2, 3, 0]]).as_matrix()
        steps = 1e-4 * np.eye(3)
        J = np.stack([(to_image(xyz[n] + s) - to_image(xyz[n] - s)) / 2e-4 for s in steps], axis=1)
        S = J @ R @ np.diag(splats.sigma_m[n].astype(np.float64) ** 2) @ R.T @ J.T
        S += LOW_PASS_PX2 * np.eye(2)
        off = np.stack([u, v], axis=-1) - to_image(xyz[n])
        power = np.einsum("hwi,ij,hwj->hw", off, np.linalg.inv(S), off)
        alpha = np.minimum(splats.opacity[n] * np.exp(-0.5 * power), 0.99)
        alpha[alpha < 1.0 / 255.0] = 0.0
        image += (alpha * left)[..., None] * splats.rgb[n]
        left *= 1.0 - alpha
    return image, 1.0 - left


def test_an_image_follows_the_formula() -> None:
    rng = np.random.default_rng(3)
    T = se3.compose(DOWN, np.array([0.5, -0.3, 20.0]))
    splats = Splats(
        rng.uniform([-6.0, -5.0, -2.0], [6.0, 5.0, 2.0], (12, 3)).astype(np.float32),
        Rotation.random(12, random_state=1).as_quat()[:, [3, 0, 1, 2]].astype(np.float32),
        rng.uniform(0.1, 1.2, (12, 3)).astype(np.float32),
        rng.uniform(0.3, 0.95, 12).astype(np.float32),
        rng.uniform(0.0, 255.0, (12, 3)).astype(np.float32),
    )
    image, opacity = rendered(splats, K, SIZE, T)
    true, covered = expected(splats, T)
    assert covered.max() > 0.9
    # Where little light is left, the rest is not drawn.
    assert np.abs(image - true).max() < 0.5
    assert np.abs(opacity - covered).max() < 2e-3


def test_a_gaussian_beside_the_camera_is_not_drawn_all_over_the_image() -> None:
    beside = np.array([[30.0, 10.0, 0.2]], np.float32)
    splats = Splats(
        beside,
        np.array([[1.0, 0.0, 0.0, 0.0]], np.float32),
        np.full((1, 3), 0.1, np.float32),
        np.full(1, 0.9, np.float32),
        np.full((1, 3), 200.0, np.float32),
    )
    assert rendered(splats, K, SIZE, np.eye(4))[1].max() == 0.0


@pytest.mark.parametrize(("middle_px", "hidden"), [((-9968.0, 10024.0), 0.0), ((32.0, 24.0), 0.9)])
def test_a_needle_next_to_the_camera_hides_what_lies_behind_it_only(
    middle_px: tuple[float, float], hidden: float
) -> None:
    # Half the square of the sigmas to a pixel may be more than an integer of 32 bits holds.
    tele = np.array([[1000.0, 0.0, 32.0], [0.0, 1000.0, 24.0], [0.0, 0.0, 1.0]])
    along = Rotation.from_euler("z", 45, degrees=True).as_quat()[[3, 0, 1, 2]]
    places = rays(tele, np.array([middle_px])) * 0.2
    needle = Splats(
        places.astype(np.float32),
        along[None].astype(np.float32),
        np.array([[2.0, 1e-4, 1e-4]], np.float32),
        np.full(1, 0.9, np.float32),
        np.full((1, 3), 200.0, np.float32),
    )
    opacity = rendered(needle, tele, (64, 48), np.eye(4))[1]
    v, u = np.mgrid[:48, :64]
    off_px = abs((u - middle_px[0]) - (v - middle_px[1])) / np.sqrt(2)
    assert opacity[off_px > 4].max() == 0.0
    assert opacity[24, 32] == pytest.approx(hidden, abs=0.01)


def test_of_gaussians_that_are_equally_near_the_first_hides_the_others() -> None:
    count = 400
    splats = Splats(
        np.column_stack([np.zeros((count, 2)), 22 - np.arange(count) % 3]).astype(np.float32),
        np.tile(np.array([[1.0, 0.0, 0.0, 0.0]], np.float32), (count, 1)),
        np.full((count, 3), 2.0, np.float32),
        np.full(count, 0.95, np.float32),
        np.linspace(250.0, 0.0, 3 * count, dtype=np.float32).reshape(count, 3),
    )
    middle = np.array([[30.0, 0.0, 8.0], [0.0, 30.0, 8.0], [0.0, 0.0, 1.0]])
    image, _ = rendered(splats, middle, (17, 17), np.eye(4))
    first, second, third = splats.rgb[2:9:3].astype(np.float64)  # 0.95 of what comes through each
    assert np.abs(image[8, 8] - (0.95 * first + 0.0475 * second + 0.002375 * third)).max() < 0.2


def slope(T: F64, up: F64, sigma_m: float = 0.05) -> DepthMap:
    """The exact view of the plane through the origin with normal ``up``."""
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    ways = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], axis=-1)
    depth = -(T[:3, 3] @ up) / (ways @ (T[:3, :3].T @ up))
    shape = depth.shape
    views = np.full(shape, 2, np.uint8)
    return DepthMap(depth.astype(np.float32), np.full(shape, sigma_m, np.float32), views, K, T)


def painted(depth: DepthMap) -> TextureView:
    """What a camera sees of a plane that is painted in waves of some pixels."""
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    z = depth.depth_m.astype(np.float64)
    local = np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], axis=-1)
    x, y, _ = se3.transform(depth.T_world_camera, local.reshape(-1, 3)).T
    waves = [120 + 90 * np.sin(1.3 * x), 120 + 90 * np.cos(1.1 * y), 120 + 60 * np.sin(x + y)]
    bgra = np.full((*z.shape, 4), 255, np.uint8)
    bgra[..., :3] = np.rint(np.stack(waves, axis=-1)).reshape(*z.shape, 3)
    return TextureView(bgra, K, depth.T_world_camera)


def test_axes_lie_in_the_surface_and_sizes_are_those_of_a_pixel() -> None:
    up = np.array([0.0, np.sin(0.6), np.cos(0.6)])
    T = se3.compose(DOWN, np.array([0.0, 0.0, 20.0]))
    depth = slope(T, up)
    splats = of_depth(depth, np.ones(SIZE[::-1], np.bool_), painted(depth))
    assert len(splats) == SIZE[0] * SIZE[1]
    inner = np.abs(splats.xyz_m[:, :2]).max(axis=1) < 4.0
    R = Rotation.from_quat(splats.q_wxyz[inner][:, [1, 2, 3, 0]]).as_matrix()
    assert np.abs(splats.xyz_m[inner] @ up).max() < 1e-3
    assert np.allclose(R[:, :, 2] @ up, 1.0, atol=1e-4)
    middle = np.argmin(np.linalg.norm(splats.xyz_m, axis=1))
    pixel_m = 20.0 / 60.0
    along = pixel_m / np.cos(0.6)
    assert splats.sigma_m[middle] == pytest.approx([WIDTH * along, WIDTH * pixel_m, 0.05], rel=0.03)
    assert splats.opacity[middle] == pytest.approx(MAX_OPACITY - (MAX_OPACITY - SINGLE) / 2)


def keyframe(seq: int, depth: DepthMap) -> Keyframe:
    """A keyframe of such a view."""
    pose = Pose(depth.T_world_camera, np.eye(6) * 1e-4)
    fresh = np.isfinite(depth.depth_m)
    return Keyframe(seq, seq, depth, painted(depth).bgra[..., :3].copy(), pose, fresh)


def test_a_view_from_elsewhere_shows_the_surface() -> None:
    """Three images of a painted slope, one with a hole, against the fourth's own view."""
    up = np.array([0.0, 0.1, 0.995])
    depths = [
        slope(se3.compose(DOWN, np.array([x, 0.0, 20.0])), up / np.linalg.norm(up))
        for x in (-1.5, 0.0, 1.5)
    ]
    views = [painted(d) for d in depths]
    keyframes = [keyframe(n, d) for n, d in enumerate(depths)]
    hole = np.s_[20:28, 25:40]
    for one in keyframes:
        one.depth.depth_m[hole], one.fresh[hole] = np.nan, False
    corners = np.array([[-30.0, -30.0], [30.0, -30.0], [30.0, 30.0], [-30.0, 30.0]])
    plane = np.column_stack([corners, -corners[:, 1] * 0.1 / 0.995])
    surface = Mesh(plane, np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    splats = splats_of(keyframes, views, lambda: surface)
    assert len(splats) < 0.7 * 3 * SIZE[0] * SIZE[1]  # places that several show have one
    T = se3.compose(DOWN, np.array([0.7, 0.4, 20.0]))
    image, opacity = rendered(splats, K, SIZE, T)
    true = painted(slope(T, up / np.linalg.norm(up))).bgra[..., 2::-1].astype(np.float64)
    inner = np.s_[6:-6, 6:-6]
    assert (opacity[inner] >= COVERED).all()
    error = np.sqrt(np.mean((image[inner] - true[inner]) ** 2))
    assert 20.0 * np.log10(255.0 / error) > 30.0


def test_a_wall_that_no_image_shows_is_closed_in_colours_that_run_on() -> None:
    """Ground below a camera that looks straight down, and north of its image a wall of eight
    metres."""
    depth = slope(se3.compose(DOWN, np.array([0.0, 0.0, 20.0])), np.array([0.0, 0.0, 1.0]))
    along, x = np.meshgrid(np.arange(-6.0, 17.5, 0.5), np.arange(-8.0, 8.5, 0.5), indexing="ij")
    sheet = np.stack([x, np.minimum(along, 9.0), np.maximum(along - 9.0, 0.0)], axis=2)
    rows, cols = (n.ravel() for n in np.mgrid[: len(along) - 1, : along.shape[1] - 1])
    a = rows * along.shape[1] + cols
    b, c, d = a + 1, a + along.shape[1] + 1, a + along.shape[1]
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    roof: U8 = np.full((along.size, 3), 250, np.uint8)
    bare = Mesh(sheet.reshape(-1, 3), faces.astype(np.int32))
    view, one = painted(depth), keyframe(0, depth)
    view.bgra[..., :3] = 60
    without = splats_of([one], [view], lambda: bare)
    splats = splats_of([one], [view], lambda: replace(bare, rgb=roof))
    added = splats.at(np.arange(len(without), len(splats)))
    assert added.xyz_m[:, 1].min() > 6.5 and added.xyz_m[:, 2].max() > 7.0
    added = added.at(added.xyz_m[:, 2] > 1e-3)
    R = Rotation.from_quat(added.q_wxyz[:, [1, 2, 3, 0]]).as_matrix()
    assert np.allclose(R[:, :, 2], [0.0, -1.0, 0.0], atol=1e-3)
    low, high = added.xyz_m[:, 2] < 2.0, added.xyz_m[:, 2] > 7.0
    assert added.rgb[low].min() > 55.0 and added.rgb[low].max() < 80.0 < added.rgb[high].min()
    north = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    looks = se3.compose(north, np.array([0.0, -11.0, 4.0]))
    half = np.s_[SIZE[1] // 2 - 7 : SIZE[1] // 2 + 7, SIZE[0] // 2 - 18 : SIZE[0] // 2 + 18]
    shown, before = (rendered(s, K, SIZE, looks)[1][half] for s in (splats, without))
    assert (shown >= COVERED).all() and (before < COVERED).mean() > 0.8


def test_a_surface_under_wide_gaussians_gets_no_more_of_them() -> None:
    up = np.array([0.3, 0.2, 1.0]) / np.linalg.norm([0.3, 0.2, 1.0])
    depth = slope(se3.compose(DOWN, np.array([0.0, 0.0, 20.0])), up)
    one, view = keyframe(0, depth), painted(depth)
    view.bgra[..., :3] = 60
    x, y = np.array([[-5.0, -5.0], [5.0, -5.0], [5.0, 5.0], [-5.0, 5.0]]).T
    corners = np.column_stack([x, y, -(up[0] * x + up[1] * y) / up[2]])
    rgb: U8 = np.full((4, 3), 200, np.uint8)
    plane = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), rgb=rgb)
    coloured, plain = (
        len(splats_of([one], [view], lambda s=s: s, detail_levels=4))  # type: ignore[misc]
        for s in (plane, replace(plane, rgb=None))
    )
    assert plain <= coloured < plain + 9  # at its border
    assert coloured < 0.15 * SIZE[0] * SIZE[1]  # squares of up to eight pixels


def test_flat_areas_have_few_gaussians_and_edges_all() -> None:
    """A view whose right half is of one colour, on a ground with a step; the left half is waves."""
    depth = slope(se3.compose(DOWN, np.array([0.0, 0.0, 20.0])), np.array([0.0, 0.0, 1.0]))
    depth.depth_m[:16, 40:] -= 3.0
    view = painted(depth)
    view.bgra[:, 32:, :3] = 90
    one = keyframe(0, depth)
    corners = np.array([[-30.0, -30.0, 0.0], [30.0, -30.0, 0.0], [30.0, 30.0, 0.0]])
    surface = Mesh(corners, np.array([[0, 1, 2]], np.int32))
    splats = splats_of([one], [view], lambda: surface, detail_levels=4)
    side = np.rint(splats.sigma_m[:, 1] / WIDTH * 60.0 / -(splats.xyz_m[:, 2] - 20.0)).astype(int)
    u = 31.5 + 60.0 * splats.xyz_m[:, 0] / (20.0 - splats.xyz_m[:, 2])
    assert np.unique(side).tolist() == [1, 2, 4, 8]
    assert (side[u < 24] == 1).mean() > 0.9
    assert (side[u > 36] > 1).mean() > 0.2
    assert gaussians(one, view, 4) < 0.75 * gaussians(one, view, 0)
    assert gaussians(one, view, 0) == SIZE[0] * SIZE[1]
    image, opacity = rendered(splats, K, SIZE, depth.T_world_camera)
    inner = np.s_[2:-2, 2:-2]
    assert (opacity[inner] >= COVERED).all()
    error = np.sqrt(np.mean((image[inner] - view.bgra[..., 2::-1].astype(np.float64)[inner]) ** 2))
    assert 20.0 * np.log10(255.0 / error) > 30.0


def test_a_flat_area_that_an_image_does_not_show_has_no_gaussian() -> None:
    depth = slope(se3.compose(DOWN, np.array([0.0, 0.0, 20.0])), np.array([0.0, 0.0, 1.0]))
    view = painted(depth)
    view.bgra[:, 32:] = 0
    shown = SIZE[0] * SIZE[1] // 2
    assert 0 < gaussians(keyframe(0, depth), view, 4) <= shown
    assert gaussians(keyframe(0, depth), view, 0) == shown
    view.bgra[:] = 0
    assert gaussians(keyframe(0, depth), view, 4) == 0


def test_what_other_views_see_through_is_left_out() -> None:
    up = np.array([0.0, 0.0, 1.0])
    places = [-1.5, 0.0, 1.5, 3.0]
    depths = [slope(se3.compose(DOWN, np.array([x, 0.0, 20.0])), up) for x in places]
    views = [painted(d) for d in depths]
    depths[0].depth_m[20:26, 30:36] = 12.0  # invented
    keyframes = [keyframe(n, d) for n, d in enumerate(depths)]
    corners = np.array([[-30.0, -30.0, 0.0], [30.0, -30.0, 0.0], [30.0, 30.0, 0.0]])
    surface = Mesh(corners, np.array([[0, 1, 2]], np.int32))
    splats = splats_of(keyframes, views, lambda: surface)
    assert np.abs(splats.xyz_m[:, 2]).max() < 1.0


def test_a_place_that_two_images_show_has_one_gaussian() -> None:
    depth = slope(se3.compose(DOWN, np.array([0.0, 0.0, 20.0])), np.array([0.0, 0.0, 1.0]))
    view, corners = (
        painted(depth),
        np.array([[-30.0, -30.0, 0.0], [30.0, -30.0, 0.0], [30.0, 30.0, 0.0]]),
    )
    surface = Mesh(corners, np.array([[0, 1, 2]], np.int32))
    one, two = (
        len(splats_of([keyframe(k, depth) for k in range(n)], [view] * n, lambda: surface))
        for n in (1, 2)
    )
    assert one > 0.9 * depth.depth_m.size and two == pytest.approx(one, rel=0.1)


def test_nothing_hangs_alone_in_the_air() -> None:
    depth = slope(se3.compose(DOWN, np.array([0.0, 0.0, 20.0])), np.array([0.0, 0.0, 1.0]))
    view = painted(depth)
    depth.depth_m[20:26, 30:36] = 12.0  # invented, and no other view looks there
    corners = np.array([[-30.0, -30.0, 0.0], [30.0, -30.0, 0.0], [30.0, 30.0, 0.0]])
    surface = Mesh(corners, np.array([[0, 1, 2]], np.int32))
    splats = splats_of([keyframe(0, depth)], [view], lambda: surface)
    assert np.abs(splats.xyz_m[:, 2]).max() < 1.0


def test_the_surface_is_asked_for_once_the_depth_images_are_done() -> None:
    depth = slope(se3.compose(DOWN, np.array([0.0, 0.0, 20.0])), np.array([0.0, 0.0, 1.0]))
    corners = np.array([[-30.0, -30.0, 0.0], [30.0, -30.0, 0.0], [30.0, 30.0, 0.0]])
    steps: list[str] = []

    def surface() -> Mesh:
        steps.append("surface")
        return Mesh(corners, np.array([[0, 1, 2]], np.int32))

    splats_of([keyframe(0, depth)], [painted(depth)], surface, steps.append)
    assert steps.count("surface") == 1 and steps.index("surface") >= 2
