"""Binary glTF 2.0 of one mesh, shadeless: the pictures carry the light of the day flown."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from recon.surface.meshing import Mesh
from recon.types import U8, Array

FLOAT, UNSIGNED_BYTE, UNSIGNED_INT = 5126, 5121, 5125
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
LARGEST_TEXTURE_PX = 8192


def glb(parts: Sequence[tuple[Mesh, U8 | None]], extras: dict[str, Any]) -> bytes:
    """The file's bytes: one mesh per part, each with its picture.

    A picture is (h, w, 3) RGB for the mesh's uv; without one its rgb is used. glTF has y up:
    x stays east, y is up, z is south. ``extras`` go into the asset.
    """
    blocks = _Blocks()
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "skyrelief", "extras": extras},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": list(range(len(parts)))}],
        "nodes": [{"mesh": n, "name": f"surface {n}"} for n in range(len(parts))],
        "materials": [],
        "meshes": [],
    }
    for mesh, picture in parts:
        _add(document, blocks, mesh, picture)
    document["accessors"], document["bufferViews"] = blocks.accessors, blocks.views
    document["buffers"] = [{"byteLength": len(blocks.data)}]
    return _container(document, bytes(blocks.data))


def _add(document: dict[str, Any], blocks: _Blocks, mesh: Mesh, picture: U8 | None) -> None:
    """One mesh with its material into the document."""
    material: dict[str, Any] = {
        "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
        "extensions": {"KHR_materials_unlit": {}},
        "doubleSided": True,
    }
    xyz = mesh.vertices_m[:, [0, 2, 1]] * np.array([1.0, 1.0, -1.0])
    attributes = {
        "POSITION": blocks.accessor(xyz.astype("<f4"), FLOAT, "VEC3", ARRAY_BUFFER, bounds=True)
    }
    if picture is not None and mesh.uv is not None:
        attributes["TEXCOORD_0"] = blocks.accessor(
            mesh.uv.astype("<f4"), FLOAT, "VEC2", ARRAY_BUFFER
        )
        images = document.setdefault("images", [])
        images.append({"bufferView": blocks.view(_jpeg(picture)), "mimeType": "image/jpeg"})
        textures = document.setdefault("textures", [])
        textures.append({"source": len(images) - 1, "sampler": 0})
        document["samplers"] = [{"wrapS": 33071, "wrapT": 33071, "minFilter": 9987}]
        material["pbrMetallicRoughness"]["baseColorTexture"] = {"index": len(textures) - 1}
    elif mesh.rgb is not None:
        rgba = np.column_stack([_linear(mesh.rgb), np.full(len(mesh.rgb), 255, np.uint8)])
        attributes["COLOR_0"] = blocks.accessor(
            rgba, UNSIGNED_BYTE, "VEC4", ARRAY_BUFFER, normalised=True
        )
    indices = blocks.accessor(
        mesh.faces.astype("<u4").ravel(), UNSIGNED_INT, "SCALAR", ELEMENT_ARRAY_BUFFER
    )
    primitive = {
        "attributes": attributes,
        "indices": indices,
        "material": len(document["materials"]),
    }
    document["meshes"].append({"primitives": [primitive]})
    document["materials"].append(material)


class _Blocks:
    """The binary part, growing, with the views and accessors into it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, content: bytes, target: int | None = None) -> int:
        """Number of a new buffer view with ``content``, aligned to four bytes."""
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)}
        if target is not None:
            view["target"] = target
        self.data += content + b"\0" * (-len(content) % 4)
        self.views.append(view)
        return len(self.views) - 1

    def accessor(
        self,
        array: Array,
        component: int,
        kind: str,
        target: int,
        bounds: bool = False,
        normalised: bool = False,
    ) -> int:
        """Number of a new accessor over ``array``'s rows."""
        entry: dict[str, Any] = {
            "bufferView": self.view(np.ascontiguousarray(array).tobytes(), target),
            "componentType": component,
            "count": len(array),
            "type": kind,
        }
        if normalised:
            entry["normalized"] = True
        if bounds:
            entry["min"] = [float(v) for v in array.min(axis=0)]
            entry["max"] = [float(v) for v in array.max(axis=0)]
        self.accessors.append(entry)
        return len(self.accessors) - 1


def _linear(rgb: U8) -> U8:
    """Vertex colours are linear in glTF; pictures are sRGB (IEC 61966-2-1)."""
    s = np.arange(256) / 255.0
    table = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    return np.asarray(np.rint(255.0 * table).astype(np.uint8)[rgb])


def _jpeg(rgb: U8) -> bytes:
    """The texture as JPEG, at most LARGEST_TEXTURE_PX a side."""
    scale = LARGEST_TEXTURE_PX / max(rgb.shape[:2])
    if scale < 1.0:
        size = (round(rgb.shape[1] * scale), round(rgb.shape[0] * scale))
        rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
    ok, data = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
    if not ok:
        raise ValueError("OpenCV cannot write JPEG on this machine")
    return data.tobytes()


def _container(document: dict[str, Any], binary: bytes) -> bytes:
    """Header and the two chunks of a .glb file."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
