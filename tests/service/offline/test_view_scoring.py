"""``score --views``: frames that took no part, drawn at their poses and compared."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from house_flight import HouseFlight
from typer.testing import CliRunner

from recon import se3
from recon.camera_model import rays, scaled
from recon.surface.raster import Grid, Raster
from recon.types import F64, U8, Bool, Camera, Keyframe
from service.cli import app
from service.errors import InputError
from service.offline.exports.view import ScanView
from service.offline.view_scoring import (
    by_rays,
    depth_grids,
    frame_scores,
    looks_inside,
    means,
    placed,
)
from service.scans.main_piece import main_keyframes
from service.scans.track import camera_of
from service.stream.codec import encode
from service.stream.records import ScanHeader
from service.stream.store import ScanStore

pytestmark = [
    pytest.mark.slow,
    pytest.mark.usefixtures("mesh_libraries"),
    pytest.mark.skipif(find_spec("skimage") is None, reason="scikit-image is not installed"),
]

STEP_M = 2.5


def flown(folder: Path, house: HouseFlight, off_m: float | None = 0.0, late_ns: int = 0) -> Path:
    """Nine stills a second apart, every other a keyframe; poses of the others err by ``off_m``,
    or are not known. The scan began ``late_ns`` after the first of them."""
    camera = {"width": 160, "height": 90, "K": house.K.ravel().tolist(), "distortion": [0.0] * 5}
    lat, lon, alt = house.origin
    header = ScanHeader(
        "test-1", "drone-1", house.start_ns + late_ns, camera=camera, origin_lat_deg=lat,
        origin_lon_deg=lon, origin_alt_amsl_m=alt, georeference="gnss",
    )  # fmt: skip
    (folder / "stills").mkdir(parents=True)
    with ScanStore.create(folder / "scan" / "scan.db", header) as store:
        for k in range(9):
            keyframe = house.keyframe(k, STEP_M * k)
            assert cv2.imwrite(str(folder / "stills" / f"{k}.png"), keyframe.bgr)
            record = house.record(k, STEP_M * k)
            if k % 2 == 0:
                store.add_keyframe(k, encode(keyframe, keyframe.time_ns))
            elif off_m is None:
                continue
            else:
                T = house.pose(STEP_M * k + off_m)
                record = replace(record, T_world_camera=T, keyframe_seq=None)
            store.add_pose(record)
        store.finish({"frames": 9})
    return folder / "scan"


def scored(scan: Path, *more: str) -> dict[str, dict[str, float]]:
    command = ["score", str(scan), str(scan.parent / "stills"), "--views", "--json", *more]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.exception
    figures: dict[str, dict[str, float]] = json.loads(done.stdout.splitlines()[-1])
    return figures


def test_each_product_is_drawn_at_the_poses_of_the_others(
    tmp_path: Path, house: HouseFlight
) -> None:
    scan = flown(tmp_path, house)
    images = tmp_path / "images"
    assert set(scored(scan)) == {"points", "surface"}
    done = CliRunner().invoke(app, ["mesh", str(scan), "--stored"])
    assert done.exit_code == 0, done.exception
    found = scored(scan, "--images", str(images))
    assert set(found) == {"points", "surface", "mesh"}
    for name, figures in found.items():
        assert figures["covered"] > (0.98 if name == "mesh" else 0.9), name
        assert figures["psnr_db"] > 20.0 and 0.5 < figures["ssim"] <= 1.0, name
    assert found["surface"]["psnr_on_grids_db"] == found["surface"]["psnr_db"]
    (image,) = images.glob("*.png")
    drawn = cv2.imread(str(image))
    assert drawn is not None and drawn.shape == (90, 4 * 160, 3)


def test_products_are_compared_on_the_pixels_that_the_depth_images_cover(
    tmp_path: Path, house: HouseFlight
) -> None:
    with ScanView(flown(tmp_path, house)) as scan:
        grids = by_rays(depth_grids(list(main_keyframes(scan.store))), camera_of(scan.store.header))

        def over_blue(T: F64) -> tuple[U8, Bool]:
            drawn, covered = grids(T)
            drawn[~covered] = (255, 0, 0)
            return drawn, np.ones_like(covered)

        found = means(frame_scores(scan, tmp_path / "stills", others={"over blue": over_blue}))
    assert found["over blue"]["psnr_db"] < found["surface"]["psnr_db"] - 1.0
    assert found["over blue"]["psnr_on_grids_db"] == found["surface"]["psnr_on_grids_db"]


def test_a_depth_image_drawn_at_its_own_pose_is_its_own_image(house: HouseFlight) -> None:
    keyframe = house.keyframe(0, 0.0)
    h, w = keyframe.bgr.shape[:2]
    camera = Camera(keyframe.depth.K, np.zeros(5), (w, h))
    drawn, covered = by_rays(depth_grids([keyframe]), camera)(keyframe.depth.T_world_camera)
    assert covered[1:-1, 1:-1].mean() > 0.9
    off = np.abs(drawn[covered].astype(float) - keyframe.bgr[covered])
    assert np.quantile(off, 0.9) <= 1.0


def test_the_outline_is_that_of_sloping_ground() -> None:
    grid = Grid(-20.0, 20.0, 0.1, (400, 400))
    at = grid.centres(*np.indices(grid.shape).reshape(2, -1))
    height_m = (0.3 * at[:, 0]).reshape(grid.shape).astype(np.float32)
    height_m[:, :20] = np.nan  # the map begins at 18 m west
    flat = np.zeros(grid.shape, np.float32)
    raster = Raster(grid, height_m, flat, np.zeros((*grid.shape, 3), np.uint8))
    scan: Any = SimpleNamespace(raster=lambda _: raster, frame=None)
    camera = Camera(np.array([[60, 0, 40], [0, 60, 30], [0, 0, 1.0]]), np.zeros(5), (80, 60))
    ahead = np.array([-0.6, 0.0, -0.8])  # to the west, down the slope
    T = se3.compose(
        np.column_stack([[0, 1.0, 0], np.cross(ahead, [0, 1.0, 0]), ahead]),
        np.array([0.0, 0.0, 20.0]),
    )
    v, u = np.indices((60, 80))
    ways = rays(camera.K, np.column_stack([u.ravel(), v.ravel()]).astype(float)) @ T[:3, :3].T
    far = -20.0 / (ways[:, 2] - 0.3 * ways[:, 0])
    x, y = (ways * far[:, None])[:, :2].T
    expected = (x > -18.0) & (x < 20.0) & (np.abs(y) < 20.0)
    assert 0.2 < expected.mean() < 0.9
    assert (looks_inside(scan)(camera, T).ravel() == expected).mean() > 0.98


def test_a_wrong_pose_is_seen(tmp_path: Path, house: HouseFlight) -> None:
    right, wrong = scored(flown(tmp_path / "a", house)), scored(flown(tmp_path / "b", house, 2.0))
    for name in right:
        assert wrong[name]["psnr_db"] < right[name]["psnr_db"] - 3.0


def test_another_video_is_refused(tmp_path: Path, house: HouseFlight) -> None:
    scan = flown(tmp_path, house)
    (tmp_path / "other").mkdir()
    cv2.imwrite(str(tmp_path / "other" / "0.png"), np.zeros((48, 64, 3), np.uint8))
    done = CliRunner().invoke(app, ["score", str(scan), str(tmp_path / "other"), "--views"])
    assert isinstance(done.exception, InputError) and "160x90" in str(done.exception)


def test_stills_that_the_scan_does_not_know_are_placed_by_its_surface(
    tmp_path: Path, house: HouseFlight
) -> None:
    known = scored(flown(tmp_path / "a", house))
    placed = scored(flown(tmp_path / "b", house, None), "--images", str(tmp_path / "images"))
    assert len(list((tmp_path / "images").glob("*.png"))) == 4  # all, not one of ten
    for name, figures in placed.items():
        assert abs(figures["covered"] - known[name]["covered"]) < 0.1
        assert figures["psnr_db"] > known[name]["psnr_db"] - 1.5, name


def test_stills_whose_times_count_from_another_first_one_are_not_said_to_take_no_part(
    tmp_path: Path, house: HouseFlight
) -> None:
    scan = flown(tmp_path, house, None, late_ns=400_000_000)
    command = ["score", str(scan), str(tmp_path / "stills"), "--views"]
    done = CliRunner().invoke(app, command)
    assert isinstance(done.exception, InputError) and "which took part" in str(done.exception)


@pytest.mark.parametrize("finer", [1, 9])  # a mapping camera's stills: 5472 px, keyframes 640
def test_a_still_is_placed_however_much_finer_than_the_keyframes_it_is(
    house: HouseFlight, finer: int
) -> None:
    keyframes = [house.keyframe(k, STEP_M * k) for k in range(0, 9, 2)]
    seen = house.keyframe(3, STEP_M * 3)
    h, w = seen.bgr.shape[:2]
    camera = scaled(Camera(house.K, np.zeros(5), (w, h)), (finer * w, finer * h))
    image = cv2.resize(seen.bgr, camera.size_px, interpolation=cv2.INTER_CUBIC)
    T = placed(np.asarray(image, np.uint8), seen.time_ns, keyframes, camera)
    assert T is not None
    off_m = np.linalg.norm(T[:3, 3] - seen.depth.T_world_camera[:3, 3])
    assert off_m < 0.01 * float(np.nanmedian(seen.depth.depth_m))


def test_a_still_between_two_strips_is_placed_by_both(house: HouseFlight) -> None:
    """What its own strip shows first is a stripe at the edge, whose depth is off."""
    far = [house.keyframe(k, 4.0 + 0.1 * k) for k in range(12)]
    flown = [house.keyframe(k, 0.8 * k) for k in range(12)]
    stripe = np.zeros(far[0].fresh.shape, np.bool_)
    stripe[:, :60] = True
    near = [
        replace(k, time_ns=k.time_ns + 10**12, fresh=stripe, depth=k.depth.scaled(1.1, pose(k)))
        for k in flown
    ]
    still = house.keyframe(7, 4.5)
    camera = Camera(house.K, np.zeros(5), (still.bgr.shape[1], still.bgr.shape[0]))
    off_m = []
    for keyframes in (near, [*far, *near]):
        T = placed(still.bgr, near[7].time_ns, keyframes, camera)
        assert T is not None
        off_m.append(np.linalg.norm(T[:3, 3] - pose(still)[:3, 3]))
    assert off_m[1] < 0.25 and off_m[0] > 1.0


def pose(keyframe: Keyframe) -> F64:
    return keyframe.depth.T_world_camera
