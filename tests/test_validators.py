"""Exported files under the validators of their formats, each skipped by name where it is missing.

STAC is left out: its validators fetch schemas from the network (docs/reports/accuracy.md).
"""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING

import laspy
import numpy as np
import pytest

from service.ground.http import PAGE
from service.offline.exports.view import ExportOptions, ScanView, export

if TYPE_CHECKING:
    from conftest import HouseFlight

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
    assert form & 0x3F == 7 and length == 36 + 4 + 1 and legacy == [0] * 6
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
