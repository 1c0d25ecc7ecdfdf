"""Exported files under the validators of their formats, each skipped by name where it is missing.

The validators of STAC and 3D Tiles fetch their schemas: here they are in data/schemas.json.
"""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import laspy
import numpy as np
import pytest
from paths import DATA

from service.ground.http import PAGE
from service.offline.exports.view import ExportOptions, ScanView, export

if TYPE_CHECKING:
    from house_flight import HouseFlight

GLTF = PAGE.parent / "node_modules/gltf-validator"
SCRIPT = """require(process.argv[1])
  .validateBytes(new Uint8Array(require('fs').readFileSync(process.argv[2])))
  .then(r => console.log(JSON.stringify(r.issues)))"""


@pytest.fixture(scope="module")
def scan_dir(tmp_path_factory: pytest.TempPathFactory, house: HouseFlight) -> Path:
    folder = tmp_path_factory.mktemp("scan")
    house.flown(folder).close()
    return folder


def written(folder: Path, kind: str) -> Path:
    with ScanView(folder) as scan:
        return export(scan, kind, None, ExportOptions())


@pytest.mark.parametrize("kind", ["dsm", "dtm", "ortho", "coverage"])
def test_rasters_are_cloud_optimised(scan_dir: Path, kind: str) -> None:
    pytest.importorskip("rasterio", exc_type=ImportError)
    validator = pytest.importorskip("rio_cogeo.cogeo")
    assert validator.cog_validate(written(scan_dir, kind), strict=True) == (True, [], [])


@pytest.mark.skipif(not GLTF.is_dir(), reason="needs gltf-validator (npm ci in service/ground/web)")
@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
@pytest.mark.parametrize("kind", ["glb", "3dtiles-mesh"])
def test_meshes_are_valid_gltf(scan_dir: Path, kind: str) -> None:
    pytest.importorskip("open3d", exc_type=ImportError)
    path = written(scan_dir, kind)
    for one in sorted(path.glob("*.glb")) if path.is_dir() else [path]:
        node = ["node", "-e", SCRIPT, str(GLTF), str(one)]
        issues = json.loads(subprocess.run(node, check=True, capture_output=True).stdout)
        assert issues["numErrors"] == issues["numWarnings"] == 0, issues["messages"]


@pytest.mark.parametrize("kind", ["laz", "copc"])
def test_clouds_follow_las(scan_dir: Path, kind: str) -> None:
    """The header's bytes after LAS 1.4 R15, against the points."""
    if kind == "copc":
        pytest.importorskip("copclib")
    path = written(scan_dir, kind)
    las = laspy.read(path)
    head = path.read_bytes()[: 375 + 58]
    signature, _, encoding = struct.unpack_from("<4sHH", head)
    assert (signature, head[24:26], encoding & 0b10001) == (b"LASF", b"\x01\x04", 0b10001)
    size, start, records = struct.unpack_from("<HII", head, 94)
    assert size == 375 and start > size + 54 * records and records >= 1
    form, length, *legacy = struct.unpack_from("<BH6I", head, 104)
    assert form & 0x3F == 7 and length == 36 + 4 + 4 + 1 and legacy == [0] * 6
    scales = np.array(struct.unpack_from("<3d", head, 131))
    extents = np.array(struct.unpack_from("<6d", head, 179)).reshape(3, 2)[:, ::-1]
    true = np.stack([las.xyz.min(axis=0), las.xyz.max(axis=0)], axis=1)
    assert np.abs(extents - true).max() < scales.max()
    count, first, *others = struct.unpack_from("<16Q", head, 247)
    assert count == first == len(las) and others == [0] * 14
    assert set(las.return_number) == set(las.number_of_returns) == {1}
    if kind == "copc":  # its own record comes first
        assert (
            head[375 + 2 : 375 + 6] == b"copc" and head[375 + 18 : 375 + 22] == b"\x01\x00\xa0\x00"
        )


SCHEMAS = json.loads((DATA / "schemas.json").read_text())
STAC = "https://schemas.stacspec.org/v1.0.0/item-spec/json-schema/item.json"
TILES = "https://3d-tiles/"


def violations(document: Any, uri: str) -> list[str]:
    """What a document has against the schema at ``uri``; never asks the network."""
    jsonschema = pytest.importorskip("jsonschema")
    referencing = pytest.importorskip("referencing")
    schemas = {name: schema for name, schema in SCHEMAS.items() if name != "about"}
    registry = referencing.Registry().with_contents(schemas.items())
    validator = jsonschema.validators.validator_for(schemas[uri])
    check = validator({"$ref": uri}, registry=registry, format_checker=validator.FORMAT_CHECKER)
    return [f"{e.json_path}: {e.message}" for e in check.iter_errors(document)]


def test_the_item_follows_stac_and_its_projection_extension(scan_dir: Path) -> None:
    pytest.importorskip("rasterio", exc_type=ImportError)
    for kind in ("dsm", "ortho"):
        written(scan_dir, kind)
    item = json.loads(written(scan_dir, "stac").read_text())
    (extension,) = item["stac_extensions"]
    assert len(item["assets"]) >= 2
    assert violations(item, STAC) == violations(item, extension) == []
    wrong = item | {"properties": item["properties"] | {"proj:epsg": "32632", "datetime": 1}}
    assert len(violations(wrong, STAC)) and len(violations(wrong, extension))


def tiles_of(tileset: Path) -> Iterator[tuple[dict[str, Any], dict[str, Any] | None, Path]]:
    """Tile, parent and folder of all tiles, those of tilesets within tilesets included."""

    def below(tile: dict[str, Any], parent: dict[str, Any] | None, path: Path) -> Any:
        yield tile, parent, path.parent
        for child in tile.get("children", ()):
            yield from below(child, tile, path)
        uri = tile.get("content", {}).get("uri", "")
        if uri.endswith(".json"):
            inner = path.parent / uri
            yield from below(read(inner)["root"], tile, inner)

    def read(path: Path) -> dict[str, Any]:
        document: dict[str, Any] = json.loads(path.read_text())
        assert violations(document, TILES + "tileset.schema.json") == [], path
        return document

    yield from below(read(tileset)["root"], None, tileset)


TILESET = shutil.which("3d-tiles-validator")


@pytest.mark.skipif(TILESET is None, reason="needs 3d-tiles-validator (npm i -g ...)")
@pytest.mark.parametrize("kind", ["3dtiles", "3dtiles-mesh"])
def test_cesium_finds_nothing_in_tilesets(scan_dir: Path, tmp_path: Path, kind: str) -> None:
    pytest.importorskip("open3d", exc_type=ImportError)
    tileset, report = written(scan_dir, kind) / "tileset.json", tmp_path / "report.json"
    assert TILESET is not None
    names = ["--tilesetFile", str(tileset), "--reportFile", str(report)]
    subprocess.run([TILESET, *names], check=True, capture_output=True)
    found = json.loads(report.read_text())
    assert found["numErrors"] == found["numWarnings"] == 0, found["issues"]


@pytest.mark.parametrize("kind", ["3dtiles", "3dtiles-mesh"])
def test_tilesets_follow_3d_tiles(scan_dir: Path, kind: str) -> None:
    pytest.importorskip("py3dtiles" if kind == "3dtiles" else "open3d", exc_type=ImportError)
    contents = 0
    for tile, parent, folder in tiles_of(written(scan_dir, kind) / "tileset.json"):
        assert parent is None or tile["geometricError"] <= parent["geometricError"]
        if "content" not in tile:
            continue
        contents += 1
        path = folder / tile["content"]["uri"]
        assert path.is_relative_to(folder) and path.is_file()
        data = path.read_bytes()
        if path.suffix == ".pnts":
            magic, version, length, head, body = struct.unpack_from("<4s4I", data)
            assert (magic, version, length) == (b"pnts", 1, len(data))
            assert (28 + head) % 8 == (28 + head + body) % 8 == length % 8 == 0
            table = json.loads(data[28 : 28 + head])
            ends = [table[name]["byteOffset"] + table["POINTS_LENGTH"] * size
                    for name, size in (("POSITION", 12), ("RGB", 3))]  # fmt: skip
            assert max(ends) <= body and table["POINTS_LENGTH"] > 0
    assert contents
    assert violations({"asset": {"version": "1.1"}}, TILES + "tileset.schema.json")
