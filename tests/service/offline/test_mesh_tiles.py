"""A site in tiles: covered once, the same here and on a Dask cluster, sharper from its video."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import Mock

import av
import cv2
import numpy as np
import pytest
from spied import spied
from typer.testing import CliRunner

from recon.surface import triangle_grid
from recon.surface.meshing import Mesh
from recon.surface.texture_views import TextureView
from service.cli import app
from service.errors import InputError, OutsideError
from service.georeference import LocalFrame
from service.offline.exports import images, model
from service.offline.exports.model import TilePart, mesh_part
from service.offline.exports.view import ExportOptions, ProductJob, ScanView, export, make_part
from service.offline.tiles import Tile, run_tiles, tile_boxes
from service.progress import Progress
from service.scans.fused_cloud import EVERYWHERE, Extent
from service.stream.records import ScanHeader
from service.stream.store import ScanStore

if TYPE_CHECKING:
    from house_flight import HouseFlight

pytestmark = pytest.mark.usefixtures("mesh_libraries")


def noting(said: list[str]) -> Progress:
    """Appends every text to ``said``."""
    return Progress(lambda now: said.append(now.text))


def jobs(folder: Path, count: int = 2) -> list[ProductJob]:
    edges = [-np.inf, *np.linspace(0, 20, count + 1)[1:-1], np.inf]
    each = [
        Tile(
            str(folder), (west, -np.inf, east, np.inf), (west - 7.5, -np.inf, east + 7.5, np.inf),
            (0, 1, 2, 3, 4),
        )
        for west, east in pairwise(edges)
    ]  # fmt: skip
    make = partial(mesh_part, largest_faces=60_000, largest_px=2048)
    return [ProductJob(tile, make, ExportOptions(voxel_m=0.3)) for tile in each]


def made(some: list[ProductJob], scheduler: str | None, progress: Progress) -> list[TilePart]:
    return [one for one in run_tiles(make_part, some, scheduler, progress) if one is not None]


def same(a: list[TilePart], b: list[TilePart]) -> None:
    assert len(a) == len(b)
    for one, other in zip(a, b, strict=True):
        np.testing.assert_array_equal(one.mesh.vertices_m, other.mesh.vertices_m)
        np.testing.assert_array_equal(one.mesh.faces, other.mesh.faces)
        np.testing.assert_array_equal(one.mesh.uv, other.mesh.uv)
        np.testing.assert_array_equal(one.image, other.image)


def test_boxes_cover_the_site_once_and_hold_no_more_than_asked() -> None:
    prints = [
        Extent(n, 1000, 0.2, (10.0 * n, 5.0 * n, 10.0 * n + 30, 5.0 * n + 20)) for n in range(20)
    ]
    assert tile_boxes(prints, 100_000) == [EVERYWHERE]
    assert tile_boxes([Extent(0, 3, 0.2, (1.0, 2.0, 1.0, 5.0))], 100_000) == [EVERYWHERE]
    boxes = tile_boxes(prints, 3000)
    assert len(boxes) > 6
    rng = np.random.default_rng(0)
    for p in prints:
        for x, y in rng.uniform(p.box[:2], p.box[2:], (50, 2)):
            assert sum(w <= x < e and s <= y < n for w, s, e, n in boxes) == 1
    for west, south, east, north in boxes:
        held = 0.0
        for p in prints:
            over = max(0.0, min(p.box[2], east) - max(p.box[0], west))
            over *= max(0.0, min(p.box[3], north) - max(p.box[1], south))
            held += p.points * over / 600.0
        assert held <= 3000.0 + 1e-6


def test_tiles_together_are_the_whole(tmp_path: Path, house: HouseFlight) -> None:
    house.flown(tmp_path).close()
    (whole,) = made(jobs(tmp_path, 1), None, Progress())
    parts = made(jobs(tmp_path, 2), None, Progress())
    assert len(parts) == 2
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-15, 35, 60), np.linspace(-10, 10, 40)))
    origins = np.column_stack([x, y, np.full(len(x), 100.0)])
    down = np.tile([0.0, 0.0, -1.0], (len(x), 1))

    def heights(part: TilePart) -> Any:
        grid = triangle_grid.build(part.mesh.vertices_m, part.mesh.faces)
        return 100.0 - grid.cast(origins, down)[0]

    one, two = (heights(part) for part in parts)
    assert (np.isfinite(one) ^ np.isfinite(two)).mean() > 0.99
    together, alone = np.where(np.isfinite(one), one, two), heights(whole)
    clear = np.abs(np.maximum(np.abs(x - 10) - 6.0, np.abs(y - 2) - 4.0)) > 1.0
    assert np.nanmax(np.abs(together - alone)[clear]) < 0.1
    assert (np.isfinite(together) == np.isfinite(alone)).mean() > 0.99


@pytest.fixture
def cluster() -> Iterator[Any]:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as one:
        yield one


@pytest.mark.slow
def test_the_same_mesh_comes_from_a_cluster(
    tmp_path: Path, house: HouseFlight, cluster: Any
) -> None:
    house.flown(tmp_path).close()
    reported: list[str] = []
    here = made(jobs(tmp_path), None, Progress())
    there = made(jobs(tmp_path), cluster.scheduler_address, noting(reported))
    assert [t for t in reported if "came from the cluster" in t] == [
        "tile 1 of 2 came from the cluster",
        "tile 2 of 2 came from the cluster",
    ]
    same(here, there)


@pytest.mark.slow
def test_a_scheduler_that_goes_away_is_said_and_the_rest_made_here(
    tmp_path: Path, house: HouseFlight, cluster: Any
) -> None:
    house.flown(tmp_path).close()
    here = made(jobs(tmp_path), None, Progress())
    reported: list[str] = []

    def say(now: Progress) -> None:
        reported.append(now.text)
        if now.text.startswith("tile 1 of 2 came"):
            cluster.close()

    same(here, made(jobs(tmp_path), cluster.scheduler_address, Progress(say)))
    assert len([t for t in reported if "disconnected" in t]) == 1


def test_a_scheduler_that_is_not_there_ends_in_one_line(tmp_path: Path, house: HouseFlight) -> None:
    pytest.importorskip("distributed")
    house.flown(tmp_path).close()
    with pytest.raises(OutsideError, match="no Dask scheduler answers"):
        next(run_tiles(make_part, jobs(tmp_path), "tcp://127.0.0.1:9", Progress(), connect_s=0.5))


@pytest.mark.slow
def test_the_command_cuts_a_large_site(tmp_path: Path, house: HouseFlight) -> None:
    trimesh = pytest.importorskip("trimesh")
    house.flown(tmp_path).close()
    done = CliRunner().invoke(app, ["mesh", str(tmp_path), "--tile-points", "30000", "--json"])
    assert done.exit_code == 0, done.exception
    figures = json.loads(done.stdout.splitlines()[-1])
    assert figures["tiles"] > 1 and len(figures["texture_px"]) == figures["tiles"]
    scene = trimesh.load(tmp_path / "mesh.glb")
    assert len(scene.geometry) == figures["tiles"]
    assert sum(len(g.faces) for g in scene.geometry.values()) == figures["faces"]
    data = (tmp_path / "mesh.glb").read_bytes()
    tree = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    uses = [view.get("target") for view in tree["bufferViews"]]  # indices, vertices, images
    assert uses.count(34963) == figures["tiles"] and uses.count(None) == len(tree["images"])


def filmed(path: Path, house: HouseFlight, size_px: tuple[int, int] = (320, 180)) -> Path:
    """A video without losses, twice as fine as the keyframes, one image at each one's second."""
    with av.open(str(path), "w", format="matroska") as container:
        stream = container.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = *size_px, "yuv420p"
        for n in range(9):
            seen = house.keyframe(n // 2, 2.5 * n).bgr
            big = cv2.resize(seen, size_px, interpolation=cv2.INTER_AREA)
            frame = av.VideoFrame.from_ndarray(np.asarray(big, np.uint8), format="bgr24")
            frame.pts, frame.time_base = 5 * n, Fraction(1, 10)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def is_open(path: Path) -> bool:
    """Whether this process holds the file."""
    return any(one.resolve() == path for one in Path("/proc/self/fd").iterdir())


def test_images_come_from_the_video_at_the_keyframes_times(
    tmp_path: Path, house: HouseFlight
) -> None:
    video = filmed(tmp_path / "flight.mkv", house)
    with house.flown(tmp_path) as store:
        keyframes = list(store.keyframes())
        K = np.array([[280.0, 0, 159.5], [0, 280.0, 89.5], [0, 0, 1]])
        camera = {"K": K.ravel().tolist(), "distortion": [0.0] * 5, "width": 320, "height": 180}
        header = replace(store.header, camera=camera)

    def views_of(header: ScanHeader, epoch_ns: int | None = None, **how: Any) -> list[TextureView]:
        return images.video_images(keyframes, header, video, epoch_ns, **how)

    views = views_of(header)
    assert len(views) == 5 and not is_open(video)
    for view, keyframe in zip(views, keyframes, strict=True):
        assert view.bgra.shape == (180, 320, 4) and (view.bgra[..., 3] == 255).all()
        np.testing.assert_array_equal(view.T_world_camera, keyframe.depth.T_world_camera)
        np.testing.assert_allclose(view.K, K)
    late = views_of(header, header.started_unix_ns + 3 * 10**9)
    assert [v.bgra.shape[0] for v in late] == [90, 90, 90, 180, 180]  # the rest from the store
    small = views_of(header, max_bytes=5 * 4 * 160 * 90)
    assert {v.bgra.shape[:2] for v in small} == {(90, 160)}
    np.testing.assert_allclose(small[0].K[0, 0], 140.0)
    with pytest.raises(InputError, match="--video-epoch"):
        views_of(header, 0)
    with pytest.raises(InputError, match="no camera model"):
        views_of(replace(header, camera={}))
    filmed(video, house, (640, 360))
    with pytest.raises(InputError, match="640x360"):
        views_of(header)


def test_the_file_names_no_path_of_this_machine(
    tmp_path: Path, house: HouseFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("trimesh")
    house.flown(tmp_path / "scan").close()
    corner = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float64)
    mesh = Mesh(corner, np.array([[0, 1, 2]], np.int32), rgb=np.full((3, 3), 90, np.uint8))
    figures = {"faces": 1, "vertices": 3, "seen": 1.0, "measured": 1.0, "texture_px": [1, 1]}
    part = Mock(mesh=mesh, image=None, figures=figures)
    monkeypatch.setattr(model, "in_parts", lambda *_, **__: iter([part]))
    monkeypatch.setattr(model, "opened", lambda *_: Mock())
    options = ExportOptions(video=tmp_path / "flight.mp4")
    with ScanView(tmp_path / "scan") as scan:
        said = model.write_mesh(scan, tmp_path / "mesh.glb", model.LARGEST_FACES, options)
    written = (tmp_path / "mesh.glb").read_bytes()
    assert said["pictures"] == str(tmp_path / "flight.mp4")
    assert b'"pictures":"video"' in written and str(tmp_path).encode() not in written


def test_an_empty_scan_is_refused(tmp_path: Path) -> None:
    ScanStore.create(tmp_path / "scan.db", ScanHeader("x", "d", 0)).close()
    failed = CliRunner().invoke(app, ["mesh", str(tmp_path)])
    assert isinstance(failed.exception, InputError)


@pytest.mark.slow
def test_the_recording_that_a_scan_names_is_found(tmp_path: Path, house: HouseFlight) -> None:
    folder = tmp_path / "scan"
    with house.flown(folder) as store:
        camera = {"K": [1.0] * 9, "distortion": [0.0] * 5, "width": 320, "height": 180}
        header = replace(store.header, camera=camera)

    def found() -> images.Recording:
        return images.recording_of(folder, header)

    assert found().path is None  # no scan.json yet

    def name(source: object) -> images.Recording:
        (folder / "scan.json").write_text(json.dumps({"run": {"source": source}}))
        return found()

    lost = name("flight.mp4")
    assert lost.path is None and "is not there" in lost.words and lost.is_lost
    assert not name("rtsp://camera/live").is_lost  # none was made
    video = filmed(tmp_path / "flight.mp4", house)
    assert name("flight.mp4").path == video  # next to the scan folder
    assert name(str(video)).path == video
    for source in ("flight.mp4", str(video), "../flight.mp4"):
        name(source)
        bounded = images.recording_of(folder, header, within=folder)
        assert bounded.path is None and "is not there" in bounded.words
    (folder / "link.mp4").symlink_to(video)
    name("link.mp4")
    assert images.recording_of(folder, header, within=folder).path is None
    shutil.copy(video, folder / "own.mp4")
    for source in ("own.mp4", "flights/own.mp4", "/gone/own.mp4"):
        name(source)
        bounded = images.recording_of(folder, header, within=folder)
        assert bounded.path == folder / "own.mp4"
    for source in ("", ".", "..", "/", "link.mp4/..", "a\0b"):
        name(source)
        assert images.recording_of(folder, header, within=folder).path is None
    for unfit in (None, 7, ["x"]):
        assert "does not name" in name(unfit).words
    assert "is not there" in name("x" * 5000).words
    (folder / "scan.json").write_text("[" * 100_000)
    assert "does not name" in found().words
    filmed(video, house, (640, 360))
    assert name("flight.mp4").path is None and "another recording" in name("flight.mp4").words
    bare = replace(header, camera={})
    assert images.recording_of(folder, bare).path is None


def test_a_recording_found_by_itself_that_does_not_fit_is_left(
    tmp_path: Path, house: HouseFlight, caplog: pytest.LogCaptureFixture
) -> None:
    """The scan names a video of another time: the mesh is made from the store, and says so."""
    video = filmed(tmp_path / "flight.mkv", house)
    camera = {"K": house.K.ravel().tolist(), "distortion": [0.0] * 5, "width": 320, "height": 180}
    with house.flown(tmp_path) as store:
        store.update_header(camera=camera, started_unix_ns=store.header.started_unix_ns - 10**12)
    (tmp_path / "scan.json").write_text(json.dumps({"run": {"source": str(video)}}))
    job, *_ = jobs(tmp_path)
    assert make_part(job, noting([])) is not None
    assert "after all" in caplog.text
    with pytest.raises(InputError, match="no frame was taken at the time of a keyframe"):
        make_part(replace(job, options=ExportOptions(video=video)), noting([]))


def test_models_share_surface_images_and_texture(
    tmp_path: Path, house: HouseFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The finest mesh is textured once; only tiles have levels of less detail."""
    pytest.importorskip("trimesh")
    house.flown(tmp_path).close()
    volume = spied(monkeypatch, model, "volume_mesh")
    read = spied(monkeypatch, images, "stored_images")
    texture = spied(monkeypatch, model, "texture")
    options = ExportOptions(voxel_m=1.0, stored=True)
    with ScanView(tmp_path, 1.0) as scan:
        export(scan, "splat", None, options)
        export(scan, "glb", None, options)
        export(scan, "obj", None, options)
        assert texture.call_count == 1
        export(scan, "3dtiles-mesh", None, options)
    assert texture.call_count == model.LEVELS
    assert volume.call_count == read.call_count == 1


def test_the_mesh_lies_on_the_globe_as_3d_tiles(tmp_path: Path, house: HouseFlight) -> None:
    """Vertices of the glTF files, turned to z up and placed by the tileset, against PROJ."""
    trimesh = pytest.importorskip("trimesh")
    from pyproj import Transformer

    house.flown(tmp_path).close()
    with ScanView(tmp_path, 0.3) as scan:
        folder = export(scan, "3dtiles-mesh", None, ExportOptions(voxel_m=0.3, stored=True))
    tileset = json.loads((folder / "tileset.json").read_text())
    assert tileset["asset"]["version"] == "1.1"
    root = tileset["root"]
    T = np.array(root["transform"]).reshape(4, 4).T
    assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
    assert tileset["geometricError"] > root["geometricError"] > 0.0
    globe = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    levels, tiles = [], root["children"]
    while tiles:
        (tile,) = tiles
        levels.append(tile)
        tiles = tile.get("children", [])
    sizes = [(folder / tile["content"]["uri"]).stat().st_size for tile in levels]
    assert len(levels) == 3 and sizes == sorted(sizes)  # the coarsest first
    errors = [root["geometricError"], *(tile["geometricError"] for tile in levels)]
    assert errors == sorted(errors, reverse=True) and errors[-1] == 0.0 < errors[-2]
    for tile in levels:
        scene = trimesh.load(folder / tile["content"]["uri"])
        xyz = np.concatenate([g.vertices for g in scene.geometry.values()])
        up = np.column_stack([xyz[:, 0], -xyz[:, 2], xyz[:, 1]])
        for box in (tile["boundingVolume"]["box"], root["boundingVolume"]["box"]):
            middle, half = np.array(box[:3]), np.diag(np.array(box[3:]).reshape(3, 3))
            assert (np.abs(up - middle) <= half + 1e-3).all()
        lon, lat, height = globe.transform(*(up @ T[:3, :3].T + T[:3, 3]).T)
        enu = LocalFrame(*house.origin).to_enu(np.column_stack([lat, lon, height]))
        assert np.abs(enu - up).max() < 1e-3
        assert up[:, 2].max() == pytest.approx(6.0, abs=0.5)  # the roof


@pytest.mark.slow
def test_the_mesh_as_obj_lies_in_its_utm_zone_with_its_texture(
    tmp_path: Path, house: HouseFlight
) -> None:
    """Read by trimesh: vertices plus the offset, by PROJ, and uv are those of the glTF."""
    trimesh = pytest.importorskip("trimesh")
    from pyproj import CRS, Transformer

    house.flown(tmp_path).close()
    options = ExportOptions(voxel_m=0.3, stored=True)
    with ScanView(tmp_path, 0.3) as scan:
        folder = export(scan, "obj", None, options)
        glb = export(scan, "glb", None, options)
    read = trimesh.load(folder / "mesh.obj", force="mesh", process=False)
    offset = np.array((folder / "mesh_offset.xyz").read_text().split(), float)
    utm = CRS.from_wkt((folder / "mesh.prj").read_text())
    lon, lat = Transformer.from_crs(utm, 4326, always_xy=True).transform(
        *(read.vertices + offset)[:, :2].T
    )
    height = read.vertices[:, 2] + offset[2]
    enu = LocalFrame(*house.origin).to_enu(np.column_stack([lat, lon, height]))
    should = trimesh.load(glb, force="mesh", process=False)
    up = np.column_stack([should.vertices[:, 0], -should.vertices[:, 2], should.vertices[:, 1]])
    middle, faces = enu[read.faces].mean(axis=1), up[should.faces].mean(axis=1)
    assert middle.shape == faces.shape and np.abs(middle - faces).max() < 2e-3
    assert read.visual.material.image.size == should.visual.material.baseColorTexture.size
    uv, uv_glb = (m.visual.uv[m.faces].mean(axis=1) for m in (read, should))
    assert np.abs(uv - uv_glb).max() < 1e-5
