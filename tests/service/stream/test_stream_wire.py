"""The test vectors of ``docs/wire.md``, read by our decoder and by one written from the page."""

from __future__ import annotations

import io
import json
import struct
import zlib
from typing import Any

import imagecodecs
import numpy as np
import pytest
from paths import DATA
from PIL import Image

from service.stream import codec
from service.stream.messages import (
    Ask,
    Assembler,
    Head,
    Held,
    pack,
    parse,
    split,
    unpack,
)
from service.stream.radio_messages import pack_announce, pack_tile, unpack_announce, unpack_tile
from service.stream.radio_messages import pack_pose as pack_radio_pose
from service.stream.radio_messages import unpack_pose as unpack_radio_pose
from service.stream.records import (
    header_from_json,
    pack_pose,
    pack_repose,
    unpack_pose,
    unpack_repose,
)

VECTORS = json.loads((DATA / "wire_v1.json").read_text())
LAYERS = VECTORS["layers"]


# A decoder in plain Python that follows the page and shares no code with the product.


def read_mask(data: bytes, w: int, h: int) -> list[list[int]]:
    if not data:
        return [[1] * w for _ in range(h)]
    near = [(0, -1), (0, -2), (0, -3), (-1, -2), (-1, -1), (-1, 0), (-1, 1), (-1, 2),
            (-2, -1), (-2, 0), (-2, 1), (-3, 0)]  # fmt: skip
    mask = [[0] * w for _ in range(h)]
    chance = [2048] * 4096
    stream = iter(data)
    code = int.from_bytes(bytes(next(stream, 0) for _ in range(4)), "big")
    span = 2**32 - 1
    for v in range(h):
        for u in range(w):
            context = 0
            for k, (dv, du) in enumerate(near):
                if v + dv >= 0 and 0 <= u + du < w:
                    context |= mask[v + dv][u + du] << k
            bound = (span >> 12) * chance[context]
            if code < bound:
                span = bound
                chance[context] += (4096 - chance[context]) >> 4
            else:
                code -= bound
                span -= bound
                chance[context] -= chance[context] >> 4
                mask[v][u] = 1
            while span < 2**24:
                span <<= 8
                code = (code << 8 | next(stream, 0)) % 2**32
    return mask


def read_predicted(data: bytes, mask: list[list[int]]) -> dict[tuple[int, int], int]:
    weights = struct.unpack("<9h", data[:18])
    stream = zlib.decompress(data[18:])
    pixels = [(v, u) for v, row in enumerate(mask) for u, bit in enumerate(row) if bit]
    escapes = iter(struct.iter_unpack("<H", stream[len(pixels) :]))
    near = [(-1, 0), (-1, -1), (-1, 1), (0, -2), (-2, 0), (-2, -1), (-2, 1), (-1, 2), (-1, -2)]
    codes: dict[tuple[int, int], int] = {}
    last = 0
    for (v, u), z in zip(pixels, stream, strict=False):
        if z == 255:
            (z,) = next(escapes)
        r = z // 2 if z % 2 == 0 else -(z + 1) // 2
        around = [codes.get((v + dv, u + du)) for dv, du in near]
        first = [codes.get((v, u - 1)), around[0], around[2], around[1], last]
        b = next(c for c in first if c is not None)
        total = sum(k * (c - b) for k, c in zip(weights, around, strict=True) if c is not None)
        guess = min(max(b + (total + 2048) // 4096, 0), 65535)
        last = codes[v, u] = (guess + r) % 65536
    return codes


def read_layer(data: bytes) -> dict[str, Any]:
    assert data[:5] == b"SRKF\x01"
    assert zlib.crc32(data[:218] + data[222:]) == struct.unpack_from("<I", data, 218)[0]
    full_w, full_h, factor, method, x, y, w, h = struct.unpack_from("<HHBB4H", data, 20)
    low, step, fx, fy, cx, cy = struct.unpack_from("<6f", data, 34)
    sections, at = [], 222
    for size in struct.unpack_from("<5I", data, 198):
        sections.append(data[at : at + size])
        at += size
    assert at == len(data)
    mask = read_mask(sections[0], w, h)
    if method == 2:
        codes = read_predicted(sections[1], mask)
    else:
        image = imagecodecs.jpegls_decode(sections[1])
        codes = {(v, u): int(image[v, u]) for v in range(h) for u in range(w) if mask[v][u]}
    sigma = imagecodecs.jpegls_decode(sections[2])
    views = imagecodecs.jpegls_decode(sections[3]) if sections[3] else np.ones((h, w), int)
    colour = np.asarray(Image.open(io.BytesIO(sections[4])))
    pixels = {
        (x + u, y + v): (
            1.0 / (low + step * c),
            0.001 * 2.0 ** ((int(sigma[v // 4, u // 4]) - 1) / 4),
            int(views[v // 2, u // 2]),
            colour[v, u, ::-1].tolist(),
        )
        for (v, u), c in codes.items()
    }
    q = np.array(struct.unpack_from("<4d", data, 82))
    return {
        "seq": struct.unpack_from("<I", data, 8)[0],
        "time_unix_ns": struct.unpack_from("<q", data, 12)[0],
        "grid_px": [-(-full_w // factor), -(-full_h // factor)],
        "K": [
            [fx / factor, 0, (cx + 0.5) / factor - 0.5],
            [0, fy / factor, (cy + 0.5) / factor - 0.5],
            [0, 0, 1],
        ],
        "position": struct.unpack_from("<3d", data, 58),
        "quaternion": q / np.linalg.norm(q),
        "pixels": pixels,
    }


@pytest.mark.parametrize("vector", LAYERS, ids=["coarse-1", "fine-1", "coarse-2", "fine-2"])
def test_a_decoder_written_from_the_page_reads_a_layer(vector: dict[str, Any]) -> None:
    layer = read_layer(bytes.fromhex(vector["hex"]))
    for name in ("seq", "time_unix_ns", "grid_px"):
        assert layer[name] == vector[name]
    np.testing.assert_allclose(layer["K"], vector["K"], rtol=1e-6)
    T = np.array(vector["T_world_camera"])
    np.testing.assert_allclose(layer["position"], T[:3, 3], rtol=1e-12)
    assert 4 * layer["quaternion"][0] ** 2 - 1 == pytest.approx(np.trace(T[:3, :3]), abs=1e-9)
    assert len(layer["pixels"]) == vector["known"]
    for pixel in vector["pixels"]:
        depth, sigma, views, bgr = layer["pixels"][pixel["u"], pixel["v"]]
        assert depth == pytest.approx(pixel["depth_m"], rel=1e-6)
        assert sigma == pytest.approx(pixel["sigma_m"], rel=1e-6)
        assert views == pixel["views"]
        np.testing.assert_allclose(bgr, pixel["bgr"], atol=4)


@pytest.mark.parametrize("vector", LAYERS, ids=["coarse-1", "fine-1", "coarse-2", "fine-2"])
def test_our_decoder_reads_the_same(vector: dict[str, Any]) -> None:
    frame = codec.decode([bytes.fromhex(vector["hex"])])
    assert frame is not None
    assert (frame.seq, frame.time_ns) == (vector["seq"], vector["time_unix_ns"])
    assert int(frame.fresh.sum()) == vector["known"]
    assert list(frame.pose.sources) == vector["sources"]
    np.testing.assert_allclose(frame.depth.K, vector["K"])
    np.testing.assert_allclose(frame.depth.T_world_camera, vector["T_world_camera"], atol=1e-12)
    for pixel in vector["pixels"]:
        at = pixel["v"], pixel["u"]
        assert float(frame.depth.depth_m[at]) == pytest.approx(pixel["depth_m"], rel=1e-6)
        assert float(frame.depth.sigma_m[at]) == pytest.approx(pixel["sigma_m"], rel=1e-6)
        np.testing.assert_allclose(frame.bgr[at].astype(int), pixel["bgr"], atol=4)


@pytest.mark.parametrize("vector", LAYERS, ids=["coarse-1", "fine-1", "coarse-2", "fine-2"])
def test_both_decoders_agree_in_every_pixel(vector: dict[str, Any]) -> None:
    data = bytes.fromhex(vector["hex"])
    frame, layer = codec.decode([data]), read_layer(data)
    assert frame is not None
    known = {(int(u), int(v)) for v, u in np.argwhere(frame.fresh)}
    assert known == set(layer["pixels"])
    for (u, v), (depth, sigma, views, _) in layer["pixels"].items():
        assert frame.depth.depth_m[v, u] == np.float32(depth)
        assert frame.depth.sigma_m[v, u] == pytest.approx(sigma, rel=1e-6)
        assert frame.depth.views[v, u] == views


def resealed(data: bytes, at: int, value: int, crc_at: int) -> bytes:
    """The record with one byte changed and its CRC-32 made right again."""
    changed = bytearray(data)
    changed[at] = value
    rest = changed[crc_at + 4 :]
    crc = zlib.crc32(bytes(rest), zlib.crc32(bytes(changed[:crc_at])))
    changed[crc_at : crc_at + 4] = struct.pack("<I", crc)
    return bytes(changed)


def test_other_versions_are_refused_although_the_checksum_holds() -> None:
    layer = bytes.fromhex(LAYERS[1]["hex"])
    pose, repose = (bytes.fromhex(VECTORS[kind]["hex"]) for kind in ("pose", "repose"))
    assert codec.decode([resealed(layer, 4, 1, 218)]) is not None
    assert unpack_pose(resealed(pose, 2, 1, 212)) is not None
    for version in (0, 2, 255):
        assert codec.decode([resealed(layer, 4, version, 218)]) is None
        assert unpack_pose(resealed(pose, 2, version, 212)) is None
        assert unpack_repose(resealed(repose, 2, version, 156)) is None
        message = bytearray.fromhex(VECTORS["parts"]["hex"])
        message[2] = version
        assert list(parse(bytes(message))) == []
        assert (
            unpack(VECTORS["head"]["json"].replace('"v":1', f'"v":{version}').encode(), Head)
            is None
        )


def test_what_stations_say() -> None:
    text = VECTORS["held"]["json"].encode()
    said = unpack(text, Held)
    assert said is not None and pack(said) == text
    text = VECTORS["ask"]["json"].encode()
    wish = unpack(text, Ask)
    assert wish is not None and pack(wish) == text
    held = json.loads(VECTORS["held"]["json"])
    assert set(held) == {"v", "numbers", "received_bytes"}
    ask = json.loads(VECTORS["ask"]["json"])
    assert ask == {"v": 1, "peer": "base-1", "parts": [[2, 3], [7, 7]], "parts_of": 9}


@pytest.mark.parametrize("name", ["announcement", "announcement_of_a_run"])
def test_announcement(name: str) -> None:
    expected = VECTORS[name]
    data = bytes.fromhex(expected["hex"])
    tag = zlib.crc32(f"{expected['drone']}/{expected['scan']}".encode())
    fields = struct.unpack_from("<BIqddfHB", data)
    assert fields[:3] == (0x11, tag, expected["started_unix_ns"])
    assert fields[3:5] == (expected["lat_deg"], expected["lon_deg"])
    assert fields[6:] == (expected["epsg"], len(expected["drone"]))
    assert data[36:].decode() == expected["drone"] + expected["scan"]
    header = unpack_announce(data)
    assert header is not None and pack_announce(header) == data
    assert header.scan_id == expected.get("scan_id", expected["scan"])
    assert header.run_id == expected.get("run_id", "")


def test_pose_of_the_narrow_radio() -> None:
    tag = zlib.crc32(b"drone-a/scan-1")
    expected = VECTORS["radio_pose"]
    data = bytes.fromhex(expected["hex"])
    fields = struct.unpack("<BIIq3i4h2ifHBH", data)
    assert fields[:4] == (0x12, tag, expected["number"], expected["time_unix_ns"])
    assert list(fields[4:7]) == expected["position_cm"]
    assert fields[11:13] == (474_300_000, -85_500_000)
    found = unpack_radio_pose(data)
    assert found is not None and pack_radio_pose(*found) == data


@pytest.mark.parametrize("vector", VECTORS["headers"], ids=["of-old", "of-a-run"])
def test_a_header_names_its_keys(vector: dict[str, Any]) -> None:
    text = vector["json"].encode()
    plain = json.loads(text)
    header = header_from_json(text)
    assert header is not None and header.started_unix_ns == plain["started_unix_ns"]
    assert header.notes == ("windy",) and header.run_id == plain.get("run_id", "")
    assert vector["key"] == f"skyrelief/{plain['drone']}/{header.name}/head"
    assert json.loads(header.to_json())["run_id"] == header.run_id


def test_the_two_methods_carry_the_same_depth() -> None:
    one, two = (read_layer(bytes.fromhex(LAYERS[k]["hex"]))["pixels"] for k in (1, 3))
    assert {at: p[0] for at, p in one.items()} == {at: p[0] for at, p in two.items()}


def test_records() -> None:
    expected = VECTORS["pose"]
    data = bytes.fromhex(expected["hex"])
    pose = unpack_pose(data)
    assert pose is not None and len(pack_pose(pose)) == len(data) == 216
    assert (pose.time_unix_ns, pose.keyframe_seq, pose.lat_deg, pose.agl_m) == (
        expected["time_unix_ns"], expected["keyframe_seq"], expected["lat_deg"], expected["agl_m"],
    )  # fmt: skip
    assert list(pose.sources) == expected["sources"]
    np.testing.assert_allclose(pose.T_world_camera, expected["T_world_camera"], atol=1e-12)
    assert struct.unpack_from("<q", data, 4)[0] == expected["time_unix_ns"]
    assert struct.unpack_from("<d", data, 156)[0] == expected["lat_deg"]
    assert struct.unpack_from("<f", data, 196)[0] == expected["speed_m_s"]
    expected = VECTORS["repose"]
    data = bytes.fromhex(expected["hex"])
    repose = unpack_repose(data)
    assert repose is not None and len(pack_repose(repose)) == len(data) == 160
    assert (repose.seq, repose.revision, repose.scale) == (41, 7, 1.25)
    assert struct.unpack_from("<II", data, 4) == (41, 7)
    assert struct.unpack_from("<f", data, 152)[0] == 1.25


def test_parts_and_head() -> None:
    expected = VECTORS["parts"]
    message, record = bytes.fromhex(expected["hex"]), bytes.fromhex(expected["record_hex"])
    assert b"".join(p.pack() for p in split("k1", 41, record, 90)) == message
    assembler = Assembler()
    whole = [assembler.add(part, 0.0) for part in reversed(list(parse(message)))]
    assert whole[:-1] == [None, None] and whole[-1] == record
    text = VECTORS["head"]["json"].encode()
    head = unpack(text, Head)
    assert head is not None and pack(head) == text
    assert list(head.numbers["k0"]) == [0, 1, 2, 3, 4, 6]


def test_tile() -> None:
    expected = VECTORS["tile"]
    data = bytes.fromhex(expected["hex"])
    tag = zlib.crc32(f"{expected['drone']}/{expected['scan']}".encode())
    kind, got_tag, seq, _, w, h, index = struct.unpack_from("<BIHIBBB", data)
    assert (kind, got_tag, seq, [w, h], index) == (
        0x13, tag, expected["seq"], expected["grid_px"], expected["index"],
    )  # fmt: skip
    near, far = struct.unpack_from("<HH", data, 40)
    bits = "".join(f"{byte:08b}" for byte in data[47:127])
    found = unpack_tile(data)
    assert found is not None and found[0] == tag
    for cell in expected["cells"]:
        k = 10 * (8 * cell["row"] + cell["column"])
        code = int(bits[k + 4 : k + 10], 2)
        low, high = 1 / (far * 0.02), 1 / (near * 0.02)
        depth = 1 / (low + (code - 1) / 62 * (high - low))
        assert depth == pytest.approx(cell["depth_m"], rel=1e-5)
        assert float(found[1].depth_m[cell["row"], cell["column"]]) == pytest.approx(
            depth, rel=1e-5
        )
    assert len(pack_tile(tag, found[1])) == len(data)
