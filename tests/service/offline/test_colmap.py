"""COLMAP: full-size frames, the scan's poses, tracks that a bundle adjustment goes on from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from house_flight import HouseFlight
from painted_ground import SIZE, K
from painted_strips import flown, made
from scipy.spatial.transform import Rotation

from recon import se3
from service.errors import InputError
from service.offline.exports.view import ExportOptions, ScanView, export
from service.stream.codec import encode_image, whole_bgr
from service.stream.store import ScanStore


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("colmap")
    with ScanView(made(folder, flown())) as scan:
        return export(scan, "colmap", None, ExportOptions(video=folder / "stills"))


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same of three stills."""
    folder = tmp_path_factory.mktemp("few")
    with ScanView(made(folder, flown()[:3])) as scan:
        return export(scan, "colmap", None, ExportOptions(video=folder / "stills"))


Images = dict[int, tuple[Any, Any, Any, str]]
Points = dict[int, tuple[Any, Any, float]]


def read(model: Path) -> tuple[Images, Points]:
    """Images (R, t, rows of u, v, point; name) and points (xyz; image, place pairs; error)."""
    lines = (model / "sparse/0/images.txt").read_text().splitlines()
    images = {}
    for first, second in zip(lines[::2], lines[1::2], strict=True):
        n, w, x, y, z, tx, ty, tz, camera, name = first.split()
        assert camera == "1"
        R = Rotation.from_quat([float(v) for v in (x, y, z, w)]).as_matrix()
        t = np.array([float(tx), float(ty), float(tz)])
        images[int(n)] = R, t, np.array(second.split(), float).reshape(-1, 3), name
    points = {}
    for line in (model / "sparse/0/points3D.txt").read_text().splitlines():
        words = line.split()
        xyz, track = np.array(words[1:4], float), np.array(words[8:], int).reshape(-1, 2)
        points[int(words[0])] = xyz, track, float(words[7])
    return images, points


@pytest.mark.slow
def test_the_images_are_the_frames_at_full_size(model: Path) -> None:
    images, _ = read(model)
    assert len(images) == 10
    for number, (_, _, _, name) in images.items():
        frame = cv2.imread(str(model.parent.parent / "stills" / f"{number - 1}.png"))
        image = cv2.imread(str(model / "images" / name))
        assert frame is not None and image is not None and image.shape == (SIZE[1], SIZE[0], 3)
        assert np.abs(image.astype(int) - frame).mean() < 3.0
    words = (model / "sparse/0/cameras.txt").read_text().split()
    assert words[1] == "PINHOLE" and words[2:4] == [str(s) for s in SIZE]
    np.testing.assert_allclose(
        [float(v) for v in words[4:]], [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5], atol=1e-4
    )


@pytest.mark.slow
def test_tracks_name_each_other_and_are_seen_where_the_truth_is(model: Path) -> None:
    images, points = read(model)
    assert len(points) > 500
    sightings = 0
    for number, (_, track, _) in points.items():
        assert len(track) >= 2
        for image, row in track:
            assert images[image][2][row, 2] == number
        sightings += len(track)
    assert sightings == sum(len(rows) for _, _, rows, _ in images.values())
    # what two views show of a place is one place on the ground, by the poses that are true
    truth, apart = flown(), []
    for _, track, _ in points.values():
        places = []
        for image, row in track:
            u, v = images[image][2][row, :2] - 0.5
            T = truth[image - 1]
            way = T[:3, :3] @ [(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], 1.0]
            places.append(T[:3, 3] - way * T[2, 3] / way[2])
        apart.append(np.ptp(np.array(places), axis=0).max())
    assert np.median(apart) < 0.05


def test_poses_are_those_of_the_scan(few: Path) -> None:
    images, points = read(few)
    assert len(points) > 100
    with ScanView(few.parent) as scan:
        for seq in scan.store.seqs():
            keyframe = scan.store.keyframe(seq)
            assert keyframe is not None
            T = se3.inverse(keyframe.depth.T_world_camera)
            R, t, rows, _ = images[seq + 1]
            np.testing.assert_allclose(R, T[:3, :3], atol=1e-6)
            np.testing.assert_allclose(t, T[:3, 3], atol=1e-6)
    for xyz, track, error in points.values():
        off = []
        for image, row in track:
            R, t, rows, _ = images[image]
            x, y, z = R @ xyz + t
            uv = [K[0, 0] * x / z + K[0, 2] + 0.5, K[1, 1] * y / z + K[1, 2] + 0.5]
            off.append(np.linalg.norm(uv - rows[row, :2]))
        assert error == pytest.approx(np.mean(off), abs=0.02)


def test_colmap_reads_it(few: Path) -> None:
    images, points = read(few)
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction(few / "sparse/0")
    assert model.num_reg_images() == len(images) and model.num_points3D() == len(points)
    means = [error for _, _, error in points.values()]
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() == pytest.approx(np.mean(means), abs=0.02)


def test_without_the_recording_it_is_refused_in_one_line(
    tmp_path: Path, house: HouseFlight
) -> None:
    house.flown(tmp_path / "s").close()
    with ScanView(tmp_path / "s") as scan:
        with pytest.raises(InputError, match=r"needs whole frames.*--video"):
            export(scan, "colmap", None, ExportOptions())
        assert not list((tmp_path / "s").glob("*colmap*"))


@pytest.mark.slow
def test_without_the_recording_the_whole_stored_images_serve(tmp_path: Path) -> None:
    scan_dir = made(tmp_path, flown(), size=(240, 180), new_px=4)
    with ScanStore.open(scan_dir / "scan.db") as store:
        for seq in store.seqs():
            frame = cv2.imread(str(tmp_path / "stills" / f"{seq}.png"))
            keyframe = store.keyframe(seq)
            assert frame is not None and keyframe is not None
            image = encode_image(np.asarray(frame, np.uint8))
            assert whole_bgr(keyframe, None) is keyframe.bgr
            assert whole_bgr(keyframe, b"no JPEG") is keyframe.bgr
            shown = whole_bgr(keyframe, image)
            np.testing.assert_array_equal(shown[:, :4], keyframe.bgr[:, :4])
            true = cv2.resize(frame, (240, 180), interpolation=cv2.INTER_AREA)
            assert cv2.PSNR(shown[:, 4:], true[:, 4:]) > 25.0
            store.add_keyframe(seq, [], image)
    with ScanView(scan_dir) as scan:
        folder = export(scan, "colmap", None, ExportOptions(stored=True))
    images, points = read(folder)
    assert len(images) == 10 and len(points) > 50
    assert (folder / "sparse/0/cameras.txt").read_text().split()[2:4] == ["240", "180"]
