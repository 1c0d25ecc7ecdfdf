"""Texturing against brute force, known exposures and the true pattern of the house's ground."""

from __future__ import annotations

from itertools import product

import cv2
import numpy as np
import pytest
from sheets import height_mesh

from recon.surface import triangle_grid
from recon.surface.meshing import Mesh, cut, face_neighbours
from recon.surface.raster import Grid, Raster
from recon.surface.texture_atlas import BORDER_PX, fill, images_of, lay_out, pack
from recon.surface.texture_views import (
    TextureView,
    TriangleViews,
    consistent,
    look,
    steady_normals,
)
from recon.surface.texturing import (
    PENALTY,
    by_angle,
    choose,
    faded_steps,
    fading,
    levels,
    spread_colours,
    texture,
)
from recon.types import F32, F64, U8, Array

NADIR = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
K = np.array([[200.0, 0.0, 159.5], [0.0, 200.0, 119.5], [0.0, 0.0, 1.0]])


def sheet(step_m: float = 0.0, cells: int = 40, cell_m: float = 0.5) -> Mesh:
    """A square about the origin; its eastern half stands ``step_m`` higher."""
    height = np.zeros((cells, cells), np.float32)
    height[:, cells // 2 :] = step_m
    half = 0.5 * cells * cell_m
    rgb = np.full((cells, cells, 3), 128, np.uint8)
    raster = Raster(Grid(-half, half, cell_m, height.shape), height, height * 0 + 0.1, rgb)
    mesh = height_mesh(raster)
    return Mesh(mesh.vertices_m, mesh.faces, None, np.full((len(mesh.vertices_m), 3), 9, np.uint8))


def pattern(x: Array, y: Array) -> Array:
    """(..., 3) smooth RGB of the ground."""
    waves = [np.sin(0.5 * x), np.cos(0.4 * y), np.sin(0.3 * (x + y))]
    return 128.0 + 60.0 * np.stack(waves, axis=-1)


def image(eye: F64, gain: float = 1.0, offset: float = 0.0) -> TextureView:
    """A nadir view of the pattern on level ground at height 0."""
    v, u = np.mgrid[0:240, 0:320].astype(float)
    x = eye[0] + (u - K[0, 2]) / K[0, 0] * eye[2]
    y = eye[1] - (v - K[1, 2]) / K[1, 1] * eye[2]
    bgr = np.clip(gain * pattern(x, y)[..., ::-1] + offset, 0, 255)
    bgra: U8 = np.full((240, 320, 4), 255, np.uint8)
    bgra[..., :3] = np.rint(bgr)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = NADIR, eye
    return TextureView(bgra, K, T)


def shown(textured: Mesh, atlas: U8) -> tuple[F64, F64]:
    """Middles of the triangles and the atlas's colours there, by an own nearest look-up."""
    assert textured.uv is not None
    h, w = atlas.shape[:2]
    uv = textured.uv[textured.faces].mean(axis=1)
    at = np.clip((uv * [w, h]).astype(int), 0, [w - 1, h - 1])
    return textured.vertices_m[textured.faces].mean(axis=1), atlas[at[:, 1], at[:, 0]].astype(float)


def test_the_texture_shows_the_ground_where_it_is() -> None:
    mesh = sheet()
    views = [image(np.array([x, y, 14.0])) for x in (-5.0, 5.0) for y in (-5.0, 5.0)]
    said = list[str]()
    done = texture(mesh, views, progress=said.append)
    assert said.count("which triangles each view sees") > 1  # a step has no share of its own
    assert not any("%" in text for text in said)
    assert done.seen_share > 0.99 and done.views_used == 4
    middle, colour = shown(done.mesh, done.image)
    inner = np.abs(middle[:, :2]).max(axis=1) < 9.0
    error = np.abs(colour - pattern(middle[:, 0], middle[:, 1]))[inner]
    assert np.median(error) < 2.0
    assert error.max() < 12.0
    whole = np.linalg.norm(np.cross(*edges(mesh)), axis=1).sum()
    assert np.linalg.norm(np.cross(*edges(done.mesh)), axis=1).sum() == pytest.approx(whole)


def edges(mesh: Mesh) -> tuple[F64, F64]:
    a, b, c = (mesh.vertices_m[mesh.faces[:, k]] for k in range(3))
    return b - a, c - a


def test_differently_exposed_views_leave_no_step_at_their_seam() -> None:
    mesh = sheet()
    views = [image(np.array([-4.0, 0, 14.0])), image(np.array([4.0, 0, 14.0]), 0.7, 12.0)]
    done = texture(mesh, views)
    middle, colour = shown(done.mesh, done.image)
    inner = np.abs(middle[:, :2]).max(axis=1) < 8.0
    truth = pattern(middle[inner, 0], middle[inner, 1])
    for channel in range(3):  # one gain and offset fit all of it: no step is left inside
        line = np.polyfit(truth[:, channel], colour[inner, channel], 1)
        assert np.abs(np.polyval(line, truth[:, channel]) - colour[inner, channel]).max() < 8.0


def test_views_that_are_brighter_in_one_part_leave_no_step() -> None:
    mesh = sheet()
    views = [image(np.array([x, 0.0, 14.0])) for x in (-6.0, 0.0, 6.0)]
    shade = np.linspace(1.15, 0.85, 320)[:, None]  # no gain of a whole image removes it
    for view in views:
        view.bgra[..., :3] = np.clip(view.bgra[..., :3] * shade, 0, 255)
    found = look(mesh, views)
    fields, after = faded_steps(*middles(mesh), views, found, as_they_are(3))
    both = found.view[:, 1] >= 0
    before_apart, apart = (np.abs(o.bgr[both, 0] - o.bgr[both, 1]).mean() for o in (found, after))
    assert before_apart > 5.0 and apart < 0.4 * before_apart
    images = images_of(views, np.zeros((3, 3, 2), np.float32), fields)
    seen = images.pixels.reshape(3, 240, 320, 4)[:, 40:200, 40:280].astype(float)
    x = np.arange(40, 280)
    for view, factor in zip(views, seen[..., :3].mean(axis=(1, 3)), strict=True):
        own = view.bgra[40:200, 40:280, :3].mean(axis=(0, 2))
        assert np.polyfit(x, factor / own, 1)[0] > 0.0  # against the shade


def middles(mesh: Mesh) -> tuple[F64, F64]:
    """(F, 3) of the triangles of a sheet, all of one size."""
    return mesh.vertices_m[mesh.faces].mean(axis=1), np.ones(len(mesh.faces))


def as_they_are(views: int) -> F32:
    """Gains that change nothing."""
    return np.tile(np.array([1.0, 0.0], np.float32), (views, 3, 1))


def test_what_stood_before_one_image_leaves_the_brightness_of_the_others() -> None:
    mesh = sheet()
    views = [image(np.array([x, 0.0, 14.0])) for x in (-2.0, -1.0, 0.0, 1.0, 2.0)]
    views[2].bgra[60:180, 80:240, :3] = 255  # left out by the next line
    found = consistent(look(mesh, views))
    fields, _ = faded_steps(*middles(mesh), views, found, as_they_are(5))
    for number in (0, 1, 3, 4):
        assert np.abs(fields[number] - 1.0).max() < 0.02


def test_an_image_that_no_other_overlaps_stays_as_it_is() -> None:
    mesh = sheet()
    for eyes in ([0.0], [-60.0, 0.0, 60.0]):
        views = [image(np.array([x, 0.0, 14.0])) for x in eyes]
        fields, after = faded_steps(
            *middles(mesh), views, look(mesh, views), as_they_are(len(views))
        )
        assert all((field == 1.0).all() for field in fields)
        assert (after.bgr == look(mesh, views).bgr).all()


@pytest.mark.parametrize(("level", "offset"), [(100, -30.0), (20, -40.0), (0, 20.0)])
def test_a_field_and_the_gain_after_it_end_at_the_mean(level: int, offset: float) -> None:
    mesh = sheet()
    views = [image(np.array([x, 0.0, 14.0])) for x in (-0.5, 0.5)]
    for view in views:
        view.bgra[..., :3] = level
    gains = as_they_are(2)
    gains[1, :, 1] = offset
    found = look(mesh, views)
    fields, after = faded_steps(*middles(mesh), views, found, gains)
    assert np.min(fields) >= 0.5 and np.max(fields) <= 2.0
    images = images_of(views, gains, fields)
    shows = images.pixels.reshape(2, 240, 320, 4)[:, 120, 160, :3] + gains[:, :, 1]
    both = (found.view[:, 1] >= 0) & (np.abs(mesh.vertices_m[mesh.faces]).max(axis=(1, 2)) < 2.0)
    for number in range(2):
        colours = after.bgr[both][found.view[both] == number]
        np.testing.assert_allclose(colours, np.broadcast_to(shows[number], colours.shape), atol=1.5)
    if level == 100:
        np.testing.assert_allclose(shows, 85.0, atol=1.5)


def test_a_triangle_narrower_than_a_texel_has_colours_all_along() -> None:
    thin = np.array([[0.0, 0.0, 0.0], [3.0, 1.3, 0.0], [3.0, 1.31, 0.0]])
    faces = np.array([[0, 1, 2]], np.int32)
    done = texture(
        Mesh(thin, faces, None, np.zeros((3, 3), np.uint8)), [image(np.array([0, 0, 14.0]))]
    )
    assert done.seen_share == 1.0 and done.mesh.uv is not None
    along = np.linspace(0.0, 1.0, 60)[:, None]
    weights = np.hstack([1.0 - along, 0.5 * along, 0.5 * along])
    h, w = done.image.shape[:2]
    u, v = ((weights @ done.mesh.uv[done.mesh.faces[0]]) * [w, h] - 0.5).astype(np.float32).T
    seen = cv2.remap(done.image, u, v, cv2.INTER_LINEAR).reshape(-1, 3)
    place = weights @ done.mesh.vertices_m[done.mesh.faces[0]]
    assert np.abs(seen - pattern(place[:, 0], place[:, 1])).max() < 4.0


def test_a_sliver_has_the_normal_of_the_surface_around_it_and_a_wall_its_own() -> None:
    mesh = sheet(step_m=3.0, cells=20)
    faces, vertices = mesh.faces.tolist(), mesh.vertices_m.tolist()
    inner = np.abs(mesh.vertices_m[mesh.faces].mean(axis=1) - [-3.0, 0.0, 0.0]).sum(axis=1)
    a, b, c = faces.pop(int(inner.argmin()))  # gets a sliver along an edge, out of its plane
    low = 0.49 * (np.add(vertices[a], vertices[b])) + 0.02 * np.array(vertices[c]) + [0, 0, 0.05]
    vertices.append(low.tolist())
    n = len(vertices) - 1
    faces += [[a, b, n], [b, c, n], [c, a, n]]
    found = np.array(faces, np.int32)
    corners = np.array(vertices)[found]
    area, normal = steady_normals(corners, face_neighbours(found))
    own = (
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / (2 * area)[:, None]
    )
    assert own[-3, 2] < 0.5 < 0.97 < normal[-3, 2]
    walls = np.abs(own[:, 2]) < 0.2
    walls[-3:] = False
    assert walls.any() and (np.einsum("ij,ij->i", own, normal)[walls] > 0.85).all()


def test_visibility_is_that_of_exact_rays() -> None:
    pytest.importorskip("open3d", exc_type=ImportError)  # without it the truth would be itself
    mesh = sheet(step_m=10.0)
    view = image(np.array([6.0, 0.0, 30.0]))  # the step hides ground to its west
    found = look(mesh, [view])
    grid = triangle_grid.build(mesh.vertices_m, mesh.faces)
    middle = mesh.vertices_m[mesh.faces].mean(axis=1)
    eye = view.T_world_camera[:3, 3]
    t, hit = grid.cast(eye, middle - eye)
    seen = found.view[:, 0] == 0
    assert 0.5 < seen.mean() < 0.95
    assert (t[seen] > 0.97).all()
    local = (middle - eye) @ NADIR
    px = local[:, :2] / local[:, 2:] * 200.0 + K[:2, 2]
    well_inside = (px > 12).all(axis=1) & (px < np.array([307, 227])).all(axis=1)
    level = np.abs(np.cross(*edges(mesh))[:, 2]) > 0.2
    missed = well_inside & level & (hit == np.arange(len(hit))) & ~seen
    near_edge = np.abs(middle[:, 0] - 0.0) < 2.0
    assert not (missed & ~near_edge).any()


def test_resolution_falls_with_distance_and_slant() -> None:
    found = look(sheet(), [image(np.array([0.0, 0.0, h])) for h in (28.0, 14.0)])
    row = int(np.argmin(np.abs(sheet().vertices_m[sheet().faces].mean(axis=1)).sum(axis=1)))
    assert found.view[row, :2].tolist() == [1, 0]  # the nearer first
    np.testing.assert_allclose(found.px_per_m[row, :2], [200 / 14, 200 / 28], rtol=0.02)


def test_of_images_from_one_height_the_steepest_is_chosen() -> None:
    mesh = sheet()
    views = [image(np.array([x, 0.0, 14.0])) for x in (-5.0, 5.0)]
    middle, _ = middles(mesh)
    found = by_angle(middle, views, look(mesh, views))
    slot = choose(found, face_neighbours(mesh.faces))
    clear = (found.view[:, 1] >= 0) & (np.abs(middle[:, 0]) > 0.5)
    chosen = found.view[np.arange(len(slot)), slot]
    assert clear.any() and ((chosen == 1) == (middle[:, 0] > 0))[clear].all()
    down = np.degrees(np.arccos(14.0 / np.linalg.norm(middle - [-5.0, 0.0, 14.0], axis=1)))
    sees = found.view == 0
    px_per_m = np.where(sees, found.px_per_m, 0.0).max(axis=1)[sees.any(axis=1)]
    expected = 200.0 / 14.0 * np.cos(np.radians(down[sees.any(axis=1)])) ** 1.5
    np.testing.assert_allclose(px_per_m, expected, rtol=1e-3)


def rows(view: list[list[int]], px: list[list[float]]) -> TriangleViews:
    count = len(view)
    out = TriangleViews.none(count)
    for n in range(count):
        out.view[n, : len(view[n])] = view[n]
        out.px_per_m[n, : len(px[n])] = px[n]
    return out


def energy(found: TriangleViews, neighbours: Array, slot: Array) -> float:
    """The energy of :func:`choose`: data costs plus ``PENALTY`` per edge between views."""
    seen = slot >= 0
    rows = np.flatnonzero(seen)
    best = found.px_per_m[rows, 0]
    data = float((1.0 - found.px_per_m[rows, slot[rows]] / best).sum())
    label = np.where(seen, found.view[np.arange(len(slot)), slot], -1)
    across = label[neighbours]
    cut = (neighbours >= 0) & (across >= 0) & (label[:, None] >= 0) & (across != label[:, None])
    return data + 0.5 * PENALTY * float(cut.sum())


@pytest.mark.parametrize("seed", range(6))
def test_labels_reach_the_min_energy_found_by_trying_all(seed: int) -> None:
    rng = np.random.default_rng(seed)
    strip = np.array([[k, k + 1, k + 2] for k in range(8)], np.int32)
    neighbours = face_neighbours(strip)
    view, px = [], []
    for _ in range(8):
        order = rng.permutation(4)[:3]
        view.append([int(v) for v in order])
        px.append(sorted((float(p) for p in rng.uniform(3, 10, 3)), reverse=True))
    found = rows(view, px)
    slot = choose(found, neighbours)
    least = min(
        energy(found, neighbours, np.array(s, np.int32)) for s in product(range(3), repeat=8)
    )
    assert energy(found, neighbours, slot) == pytest.approx(least, abs=1e-5)


def test_neighbours_share_an_edge() -> None:
    mesh = sheet(cells=6)
    neighbours = face_neighbours(mesh.faces)
    for f, row in enumerate(neighbours):
        for e, g in enumerate(row):
            edge = {mesh.faces[f, e], mesh.faces[f, (e + 1) % 3]}
            others = [h for h in range(len(mesh.faces)) if h != f and edge <= set(mesh.faces[h])]
            assert others == ([g] if g >= 0 else [])


def test_gains_and_offsets_are_found() -> None:
    rng = np.random.default_rng(3)
    count = 4000
    true = rng.uniform(40, 200, (count, 3))
    gain, offset = np.array([1.0, 0.8, 1.2]), np.array([0.0, 10.0, -8.0])
    view = np.array([rng.permutation(3) for _ in range(count)])
    found = rows(view.tolist(), [[3.0, 2.0, 1.0]] * count)
    for k in range(3):
        found.bgr[:, k] = true * gain[view[:, k], None] + offset[view[:, k], None]
    found.bgr[:: count // 40, 0] += 60.0  # something moved
    fixed = levels(found, 3)
    gray = np.linspace(50, 180, 5)
    seen = gray[None] * gain[:, None] + offset[:, None]
    for channel in range(3):
        flat = fixed[:, channel, :1] * seen + fixed[:, channel, 1:]
        assert np.ptp(flat, axis=0).max() < 3.0
    alone = levels(rows([[0], [1]], [[1.0], [1.0]]), 2)
    np.testing.assert_array_equal(alone[..., 0], 1.0)


def test_two_bright_images_of_ten_leave_the_others_as_they_are() -> None:
    rng = np.random.default_rng(4)
    true = rng.uniform(40.0, 150.0, (6000, 3))
    gain = np.ones(10)
    gain[[3, 7]] = 1.4
    view = np.array([rng.permutation(10)[:3] for _ in range(len(true))])
    found = rows(view.tolist(), [[3.0, 2.0, 1.0]] * len(true))
    for k in range(3):
        found.bgr[:, k] = true * gain[view[:, k], None] + rng.normal(0.0, 3.0, true.shape)
    fixed = levels(found, 10).astype(np.float64)
    shown = fixed[..., :1] * gain[:, None, None] * 100.0 + fixed[..., 1:]
    assert np.abs(shown - 100.0).max() < 2.0


@pytest.mark.parametrize("is_sudden", [True, False])
def test_a_block_that_darkens_on_the_way_has_no_steps(is_sudden: bool) -> None:
    """Eight lines of ten views, flown to and fro: in the end under a cloud, or at dusk."""
    rng = np.random.default_rng(5)
    number = np.arange(80)
    line, along = number // 10, number % 10
    along = np.where(line % 2, 9 - along, along)
    gain = np.where(line < 4, 1.0, 0.7) if is_sudden else np.linspace(1.0, 0.6, 80)
    place = rng.uniform([-0.3, -0.3], [7.3, 9.3], (20_000, 2))
    apart = np.hypot(place[:, :1] - line, place[:, 1:] - along)
    view = np.argsort(apart + rng.uniform(0, 0.6, apart.shape), axis=1)[:, :3]
    found = rows(view.tolist(), [[3.0, 2.0, 1.0]] * len(view))
    true = rng.uniform(40.0, 150.0, (len(view), 1, 1))
    found.bgr[:, :3] = true * gain[view][..., None] + rng.normal(0.0, 3.0, (len(view), 3, 3))
    fixed = levels(found, 80).astype(np.float64)
    shown = fixed[..., 0] * gain[:, None] * 100.0 + fixed[..., 1]
    assert np.abs(shown[view[:, 0]] - shown[view[:, 1]]).max() < 4.0
    assert shown.min() > 55.0 and shown.max() < 105.0


def test_images_of_two_white_balances_become_grey_by_one_of_them_or_between() -> None:
    rng = np.random.default_rng(6)
    gain = np.where(np.arange(10)[:, None] % 2, [0.7, 1.0, 1.0], [1.0, 1.0, 0.7])
    view = np.array([rng.permutation(10)[:3] for _ in range(6000)])
    found = rows(view.tolist(), [[3.0, 2.0, 1.0]] * len(view))
    true = rng.uniform(40.0, 150.0, (len(view), 1, 1))
    found.bgr[:, :3] = true * gain[view] + rng.normal(0.0, 3.0, (len(view), 3, 3))
    fixed = levels(found, 10).astype(np.float64)
    blue, _, red = (fixed[..., 0] * gain * 100.0 + fixed[..., 1]).mean(axis=0)
    assert blue + red == pytest.approx(167.0, abs=4.0)  # 165 of the mean, 170 of either half


def test_a_car_in_one_of_five_views_is_left_out() -> None:
    found = rows([[0, 1, 2, 3, 4]], [[5.0, 4.0, 3.0, 2.0, 1.0]])
    found.bgr[0, :5] = 100.0
    found.bgr[0, 0] = 220.0
    assert consistent(found).view[0].tolist() == [1, 2, 3, 4, -1, -1]


def test_outliers_differ_from_the_median_of_their_row() -> None:
    rng = np.random.default_rng(8)
    seen = rng.integers(1, 7, 300)
    found = rows([[*rng.permutation(9)[:n]] for n in seen], rng.random((300, 6)).tolist())
    found.bgr[:] = rng.uniform(80.0, 120.0, (300, 1, 3)) + rng.normal(0.0, 4.0, (300, 6, 3))
    found.bgr[rng.random((300, 6)) < 0.15] += 60.0
    out = consistent(found)
    dropped = 0
    for n, (view, px, bgr) in enumerate(zip(found.view, found.px_per_m, found.bgr, strict=True)):
        colour = bgr[: seen[n]]
        off = np.abs(colour - np.median(colour, axis=0)).max(axis=1, initial=0.0)
        is_kept = (off <= 25.0 + 4.0 * np.median(off)) | (len(off) < 4)
        kept = np.flatnonzero(is_kept)
        dropped += len(off) - len(kept)
        assert (out.view[n, len(kept) :] == -1).all()
        np.testing.assert_array_equal(out.view[n, : len(kept)], view[kept])
        np.testing.assert_array_equal(out.px_per_m[n, : len(kept)], px[kept])
        np.testing.assert_array_equal(out.bgr[n, : len(kept)], bgr[kept])
    assert dropped > 50


def test_weights_fade_across_a_seam() -> None:
    mesh = sheet(cells=30)
    middle = mesh.vertices_m[mesh.faces].mean(axis=1)
    label = np.where(middle[:, 0] < 0, 0, 1).astype(np.int32)
    view, share = fading(mesh.faces, label, len(mesh.vertices_m), 2)
    np.testing.assert_allclose(share.sum(axis=1), 1.0, atol=1e-5)
    of_one = np.where(view == 1, share, 0).sum(axis=1)
    x = mesh.vertices_m[:, 0]
    means = [of_one[np.abs(x - at) < 0.01].mean() for at in np.unique(np.round(x, 3))]
    assert means[0] == 0.0 and means[-1] == 1.0
    assert (np.diff(means) >= -1e-6).all() and np.diff(means).max() < 0.35


def test_both_sides_of_a_thin_wall_that_no_view_sees_have_their_own_texels() -> None:
    vertices = np.array(
        [[0.0, 0, 0], [0, 2, 0], [0.1, 0, 0], [0.1, 2, 0], [0.05, 0, 2], [0.05, 2, 2]]
    )
    faces = np.array([[0, 4, 1], [1, 4, 5], [2, 3, 4], [3, 5, 4]], np.int32)
    rgb = np.full((6, 3), 128, np.uint8)
    mesh, unseen = Mesh(vertices, faces, None, rgb), np.full(4, -1, np.int32)
    chart = lay_out(mesh, [], unseen, face_neighbours(faces), 64).chart
    assert chart[0] == chart[1] != chart[2] == chart[3]


def test_charts_do_not_overlap_and_fit() -> None:
    rng = np.random.default_rng(4)
    size = rng.integers(3, 60, (300, 2))
    place, (w, h) = pack(size, np.zeros(300))
    used = np.zeros((h, w), int)
    for (x, y), (dx, dy) in zip(place.astype(int), size, strict=True):
        used[y : y + dy, x : x + dx] += 1
    assert used.max() == 1
    assert used.mean() > 0.7
    mesh = sheet()
    view = image(np.array([0.0, 0.0, 14.0]))
    label = np.where(np.arange(len(mesh.faces)) % 7 == 0, -1, 0).astype(np.int32)
    layout = lay_out(mesh, [view], label, face_neighbours(mesh.faces), 128)
    assert max(layout.size_px) <= 128 and layout.scale < 1.0
    assert layout.uv_px.min() >= 0 and (layout.uv_px.max(axis=(0, 1)) <= layout.size_px).all()
    assert BORDER_PX >= 1


def test_what_no_view_sees_keeps_the_colours_of_the_vertices() -> None:
    pytest.importorskip("open3d", exc_type=ImportError)
    done = texture(sheet(cells=6), [])
    assert done.seen_share == 0.0
    assert (shown(done.mesh, done.image)[1] == 9).all()
    with pytest.raises(ValueError, match="colours at its vertices"):
        texture(Mesh(sheet().vertices_m, sheet().faces), [])


def test_triangles_without_a_view_take_the_colours_of_those_around_them() -> None:
    mesh = sheet(cells=60)
    assert mesh.rgb is not None
    middle = mesh.vertices_m[mesh.faces].mean(axis=1)
    unseen = (np.hypot(middle[:, 0], middle[:, 1]) < 2.0) | (middle[:, 0] > 3.0)
    slot = np.where(unseen, -1, 0).astype(np.int32)
    found = TriangleViews.none(len(mesh.faces))
    found.view[:, 0] = 0
    # A dark line across, as wide as a triangle, leads to the border of what is seen.
    found.bgr[:, 0] = np.where(np.abs(middle[:, 1, None] - 4.0) < 0.3, 0.0, [21.0, 41.0, 61.0])
    rgb = spread_colours(mesh.faces, mesh.rgb, found, slot)
    x, y = mesh.vertices_m[:, :2].T
    inside = rgb[np.hypot(x, y) < 2.0].astype(int)
    np.testing.assert_allclose(inside, np.broadcast_to([61, 41, 21], inside.shape), atol=8)
    beside, beyond = rgb[(x > 3.2) & (x < 3.8), 0], rgb[(x > 4.5) & (x < 5.0) & (y < 7.0), 0]
    assert 3 * int(np.ptp(beyond)) < int(np.ptp(beside))  # no streaks
    assert (rgb[x > x.max() - 0.5, 0] < beyond.min()).all()  # towards their own


def test_cutting_divides_triangles_at_the_border() -> None:
    mesh = sheet(step_m=3.0)
    west = cut(mesh, (-np.inf, -np.inf, 1.3, np.inf))
    east = cut(mesh, (1.3, -np.inf, np.inf, np.inf))
    total = sum(0.5 * np.linalg.norm(np.cross(*edges(m)), axis=1).sum() for m in (west, east))
    assert total == pytest.approx(0.5 * np.linalg.norm(np.cross(*edges(mesh)), axis=1).sum())
    assert west.vertices_m[:, 0].max() == pytest.approx(1.3)
    assert east.vertices_m[:, 0].min() == pytest.approx(1.3)
    border = [m.vertices_m[np.abs(m.vertices_m[:, 0] - 1.3) < 1e-9] for m in (west, east)]
    one, two = (b[np.argsort(b[:, 1])] for b in border)
    np.testing.assert_allclose(one, two)
    for part in (west, east):
        assert (np.cross(*edges(part))[:, 2] > -1e-9).all() and part.rgb is not None
    assert len(cut(mesh, (50.0, 50.0, 60.0, 60.0)).faces) == 0


def test_the_atlas_has_the_colours_of_the_charts_around_where_there_is_no_chart() -> None:
    image, done = np.zeros((301, 40, 3), np.uint8), np.zeros((301, 40), bool)
    done[2:-5, 5:9] = done[100, 30] = True
    image[:, 5:9], image[100, 30] = [10, 20, 30], [200, 200, 200]
    before = image.copy()
    fill(image, done)
    assert (image[done] == before[done]).all()
    assert (image[200:, :20] == [10, 20, 30]).all()
    assert (image[98:102, 28:32] == 200).all()
    assert image.min() >= 10
    empty = np.zeros((3, 3, 3), np.uint8)
    fill(empty, np.zeros((3, 3), bool))
    assert not empty.any()


def test_from_afar_small_charts_keep_their_brightness() -> None:
    rng = np.random.default_rng(5)
    size = rng.integers(5, 12, (20_000, 2))
    brightness = rng.uniform(0.0, 255.0, len(size))
    place, (w, h) = pack(size, brightness)
    image, done = np.zeros((h, w, 3), np.uint8), np.zeros((h, w), np.bool_)
    for (x, y), (dx, dy), level in zip(place.astype(int), size, brightness, strict=True):
        image[y : y + dy - 1, x : x + dx - 1] = level
        done[y : y + dy - 1, x : x + dx - 1] = True
    fill(image, done)
    h, w = h // 16 * 16, w // 16 * 16
    coarse = image[:h, :w, 0].reshape(h // 16, 16, w // 16, 16).mean(axis=(1, 3))  # mip level 4
    middle = ((place + size / 2)[:, ::-1] / 16).astype(int)
    inside = (middle < coarse.shape).all(axis=1)
    off = np.abs(coarse[tuple(middle[inside].T)] - brightness[inside])
    assert np.median(off) < 5.0 and np.percentile(off, 99) < 30.0
