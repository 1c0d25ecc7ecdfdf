"""The portal over real HTTP and WebSocket connections on this machine."""

from __future__ import annotations

import gzip
import json
import struct
import threading
import urllib.error
import urllib.request
import zlib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from loopback import until
from portal_client import ONE, TOKEN, Client, FakeOperator, client, flown_store, serving, store

from recon.types import F64
from service.errors import InputError, OutsideError
from service.ground import live
from service.ground.http import PAGE
from service.ground.library import Library
from service.ground.live import LiveFeed
from service.ground.portal import Portal, PortalConfig, config_of
from service.ground.state import KINDS
from service.ground.vehicle import Vehicle
from service.listener import parse_address
from service.stream import codec, plane_coders, planes
from service.stream.codec import encode, encode_image
from service.stream.records import Repose, ScanHeader
from service.stream.store import ScanStore

if TYPE_CHECKING:
    from house_flight import HouseFlight

__all__ = ["client", "store"]  # the fixtures


def test_the_list_shows_the_scan(client: Client, store: Path) -> None:
    status, scans, headers = client.ask("/api/scans", token=None)
    assert status == 200
    assert [(s["drone"], s["scan"], s["title"]) for s in scans] == [("drone-1", "test-1", "test-1")]
    assert scans[0]["preview"] and scans[0]["counts"]["keyframes"] == 5
    assert scans[0]["origin"]["lat_deg"] == pytest.approx(47.39)
    assert {"cloud.laz", "scan.json"} <= {f["name"] for f in scans[0]["files"]}
    assert "default-src 'self'" in headers["content-security-policy"]


def test_products_are_listed_with_file_size_and_obstacle(client: Client, store: Path) -> None:
    found = {p["kind"]: p for p in client.ask(ONE + "/exports")[1]}
    assert set(found) == set(KINDS)
    assert {p["group"] for p in found.values()} == {"Cloud", "Maps", "Models", "Flight", "Improve"}
    assert found["laz"]["bytes"] == (store / "drone-1/test-1/cloud.laz").stat().st_size
    ortho = found["ortho"]
    assert (ortho["bytes"], ortho["file"], ortho["impossible"]) == (None, "ortho.tif", None)
    assert ortho["about_bytes"] > 10_000 and ortho["about_s"] >= 1 and ortho["text"]
    document = json.loads((store / "drone-1/test-1/scan.json").read_text())
    document["origin"], document["coverage"]["corners_lat_lon"] = None, None
    (store / "drone-1/test-1/scan.json").write_text(json.dumps(document))
    found = {p["kind"]: p for p in client.ask(ONE + "/exports")[1]}
    assert found["kml"]["impossible"] == "needs a georeference"
    assert client.ask(ONE)[1]["corners_lat_lon"] is None


def test_downloads_and_their_ranges(client: Client, store: Path) -> None:
    path = "/api/scans/drone-1/test-1/files/cloud.laz"
    whole = (store / "drone-1/test-1/cloud.laz").read_bytes()
    status, content, headers = client.ask(path)
    assert status == 200 and content == whole
    assert "test-1-cloud.laz" in headers["content-disposition"]
    status, content, headers = client.ask(path, headers={"Range": "bytes=100-199"})
    assert status == 206 and content == whole[100:200]
    assert headers["content-range"] == f"bytes 100-199/{len(whole)}"


def test_pieces_of_a_scan_are_listed_given_and_imported(
    client: Client, store: Path, tmp_path: Path
) -> None:
    folder = store / "drone-1/test-1"
    for name in ("piece-1.laz", "piece-12.laz", "piece-x.laz"):
        (folder / name).write_bytes(name.encode())
    (folder / "piece-2.laz").symlink_to(folder / "scan.db")
    listed = [f["name"] for f in client.ask(ONE)[1]["files"]]
    assert [name for name in listed if "piece" in name] == ["piece-1.laz", "piece-12.laz"]
    assert client.ask(f"{ONE}/files/piece-12.laz")[1] == b"piece-12.laz"
    for name in ("piece-x.laz", "piece-2.laz", "piece-0.laz"):
        assert client.ask(f"{ONE}/files/{name}")[0] == 404
    drone, scan = Library(tmp_path / "other").take(folder)
    copied = (tmp_path / "other" / "drones" / drone / scan).glob("piece-*")
    assert sorted(path.name for path in copied) == ["piece-1.laz", "piece-12.laz"]


@pytest.mark.parametrize(
    "path",
    [
        "/api/scans/drone-1/test-1/files/..%2fscan.db",
        "/api/scans/drone-1/test-1/files/library.json",
        "/api/scans/drone-1/..%2f..%2fetc/files/scan.json",
        "/api/scans/%2e%2e/test-1",
        "/api/scans/.bin/test-1",
        "/api/scans/drone-1/test-1%00",
        "/api/scans/drone-1/none",
        "/api/scans/drone-1/test-1/tiles/tileset.json",
        "/api/scans/drone-1/test-1/tiles/../scan.db",
        "/api/scans/drone-1/test-1/tiles/..%2fscan.db",
        "/api/scans/drone-1/test-1/tiles/..%2fscan.json",
        "/api/scans/drone-1/test-1/keyframes/99.jpg",
        "/api/scans/drone-1/test-1/keyframes/-1.jpg",
        "/assets/../../http.py",
        "/nothing",
    ],
)
def test_nothing_but_deliverables_is_given(client: Client, path: str) -> None:
    status, _, _ = client.ask(path)
    assert 400 <= status < 500


def test_changes_need_the_token(client: Client) -> None:
    one = "/api/scans/drone-1/test-1"
    for method, path, body in [
        ("PATCH", one, {"title": "x"}),
        ("DELETE", one, None),
        ("POST", one + "/exports", {"kind": "kml"}),
        ("POST", "/api/import", {"folder": "/"}),
        ("POST", "/api/bin/x/restore", {}),
    ]:
        for token in (None, "wrong"):
            status, answer, _ = client.ask(path, method, body, token=token)
            assert status == 401 and "token" in answer["error"]
    assert client.ask(one)[1]["title"] == "test-1"


def test_other_sites_and_other_names_are_refused(client: Client) -> None:
    assert client.ask("/api/scans", headers={"Host": "evil.example"})[0] == 421
    assert client.ask("/api/scans", headers={"Origin": "http://evil.example"})[0] == 403
    port = client.base.rsplit(":", 1)[1]
    assert client.ask("/api/scans", headers={"Host": f"localhost:{port}"})[0] == 200


def test_rename_and_tag_with_any_letters(client: Client, store: Path) -> None:
    one = "/api/scans/drone-1/test-1"
    title = "<script>alert(1)</script> Ölmühle\n Süd"
    status, labels, _ = client.ask(one, "PATCH", {"title": title, "tags": ["a", "b", "a"]})
    assert status == 200
    assert labels == {
        "title": "<script>alert(1)</script> Ölmühle Süd",
        "tags": ["a", "b"],
        "edition": 1,
    }
    assert client.ask(one)[1]["tags"] == ["a", "b"]
    hidden = {"title": "\u202eexe.\x00 \u200d", "tags": ["\x07", "c\u2066"]}
    labels = client.ask(one, "PATCH", hidden)[1]
    assert (labels["title"], labels["tags"]) == ("exe. \u200d", ["c"])  # nothing hides
    client.ask(one, "PATCH", {"tags": ["a", "b"]})
    client.ask(one, "PATCH", {"title": "only this"})
    assert client.ask(one)[1]["tags"] == ["a", "b"]
    for bad in (
        {"edition": "1"},
        {"title": 3},
        {"title": "x" * 999},
        {"tags": "a"},
        {"tags": [1]},
        {"x": 1},
        [1],
    ):
        assert client.ask(one, "PATCH", bad)[0] == 400
    assert client.ask(one, "PATCH", {"title": "x" * 70_000})[0] == 413
    (store / "drone-1/test-1/library.json").write_text("{broken")
    assert client.ask(one)[1]["title"] == "test-1"


def test_two_renames_at_once_leave_one_whole(store: Path) -> None:
    library = Library(store)
    titles = [f"title {n}" * 20 for n in range(8)]
    threads = [
        threading.Thread(target=library.label, args=("drone-1", "test-1", t[:200], [t[:9]], None))
        for t in titles
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    entry = library.entry("drone-1", "test-1")
    assert entry["title"] in [t[:200] for t in titles]


def test_a_change_to_labels_that_are_no_longer_so_is_refused(client: Client) -> None:
    one = "/api/scans/drone-1/test-1"
    seen = client.ask(one)[1]["edition"]
    assert client.ask(one, "PATCH", {"title": "first", "edition": seen})[0] == 200
    status, answer, _ = client.ask(one, "PATCH", {"tags": ["late"], "edition": seen})
    assert status == 409 and "first" in answer["error"]
    entry = client.ask(one)[1]
    assert (entry["title"], entry["tags"]) == ("first", [])
    assert client.ask(one, "PATCH", {"tags": ["late"], "edition": entry["edition"]})[0] == 200


def test_delete_goes_to_the_bin_and_comes_back(client: Client, store: Path) -> None:
    name = client.ask("/api/scans/drone-1/test-1", "DELETE")[1]["bin"]
    assert client.ask("/api/scans")[1] == []
    assert client.ask("/api/bin")[1] == [name]
    status, answer, _ = client.ask(f"/api/bin/{name}/restore", "POST", {})
    assert (status, answer) == (200, {"drone": "drone-1", "scan": "test-1"})
    assert len(client.ask("/api/scans")[1]) == 1
    assert client.ask("/api/bin/a~b~c/restore", "POST", {})[0] == 404


def test_a_scan_being_received_is_not_deleted(store: Path) -> None:
    entry = {"drone": "drone-1", "scan": "test-1", "held": {"k0": 5}, "received_bytes": 9}
    portal = Portal(PortalConfig(store, port=0, token=TOKEN), lambda: [entry])
    portal.start()
    try:
        client = Client(portal)
        assert client.ask("/api/scans/drone-1/test-1", "DELETE")[0] == 409
        assert client.ask("/api/status")[1]["receiving"] == [entry]
        assert (
            b'skyrelief_received_bytes{drone="drone-1",scan="test-1"} 9'
            in (client.ask("/metrics")[1])
        )
    finally:
        portal.close()


def test_import_copies_a_scan_folder(client: Client, tmp_path: Path, house: HouseFlight) -> None:
    house.flown(tmp_path / "card").close()
    client.ask("/api/scans/drone-1/test-1", "DELETE")
    status, answer, _ = client.ask("/api/import", "POST", {"folder": str(tmp_path / "card")})
    assert (status, answer) == (201, {"drone": "drone-1", "scan": "test-1"})
    assert client.ask("/api/scans")[1][0]["counts"]["keyframes"] == 5
    again = client.ask("/api/import", "POST", {"folder": str(tmp_path / "card")})
    assert again[0] == 400 and "already" in again[1]["error"]
    for bad in ({}, {"folder": 3}, {"folder": str(tmp_path)}, {"folder": "a\0b"}):
        assert client.ask("/api/import", "POST", bad)[0] == 400


def test_the_tiles_of_a_scan_are_served(client: Client, store: Path) -> None:
    assert client.ask("/api/scans/drone-1/test-1")[1]["tiles"] is False
    folder = store / "drone-1/test-1/3dtiles"
    (folder / "points").mkdir(parents=True)
    (folder / "tileset.json").write_text('{"asset": {}}')
    (folder / "points/r0.pnts").write_bytes(b"pnts")
    (folder / "secret.txt").write_text("no")
    assert client.ask("/api/scans/drone-1/test-1")[1]["tiles"] is True
    one = "/api/scans/drone-1/test-1/tiles"
    assert client.ask(f"{one}/tileset.json")[1] == {"asset": {}}
    assert client.ask(f"{one}/points/r0.pnts")[1] == b"pnts"
    for bad in ("secret.txt", "points", "points/../../scan.json", "points//r0.pnts"):
        assert client.ask(f"{one}/{bad}")[0] == 404


def test_a_keyframes_image_is_shown(client: Client, house: HouseFlight) -> None:
    status, data, headers = client.ask("/api/scans/drone-1/test-1/keyframes/2.jpg")
    assert status == 200 and headers["content-type"] == "image/jpeg"
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    error = np.abs(image.astype(float) - house.keyframe(2, 10.0).bgr)
    assert np.median(error) < 6.0


def test_a_keyframe_that_brought_little_new_is_shown_whole(
    tmp_path: Path, house: HouseFlight
) -> None:
    flown_store(tmp_path, house)
    one = house.keyframe(40, 11.0)
    fresh = np.zeros_like(one.fresh)
    fresh[:, 150:] = True  # only the border is new
    image = encode_image(one.bgr)
    with ScanStore.open(tmp_path / "drone-1/test-1/scan.db") as scan:
        scan.add_keyframe(40, encode(replace(one, fresh=fresh), one.time_ns), image)
        scan.add_keyframe(41, encode(replace(one, seq=41, fresh=fresh), one.time_ns))
    with serving(tmp_path) as client:
        whole, new = (
            np.abs(colours(client.ask(f"{ONE}/keyframes/{seq}.jpg")[1]) - one.bgr).max(axis=2)
            for seq in (40, 41)  # the second as older scans have it
        )
    small = np.abs(cv2.resize(colours(image), one.bgr.shape[1::-1]) - one.bgr).max(axis=2)
    assert np.median(whole[:, 152:]) < 0.8 * np.median(small[:, 152:])
    assert np.median(whole[:, :140]) < 1.2 * np.median(small[:, :140])
    assert np.median(new[:, 152:]) < 10.0 and new[:, :140].min() > 20.0


def colours(jpeg: bytes) -> F64:
    """(h, w, 3) BGR of an image."""
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return np.asarray(image, np.float64)


def test_an_mcap_from_the_aircraft_becomes_a_scan(
    client: Client, store: Path, tmp_path: Path
) -> None:
    pytest.importorskip("foxglove")
    pytest.importorskip("mcap")
    from service.offline.exports.recording import export_mcap

    recording = tmp_path / "flight.mcap"
    with ScanStore.open(store / "drone-1/test-1/scan.db") as scan:
        export_mcap(scan, recording)
        before = list(scan.keyframes())
        track = [pose.T_world_camera for pose in scan.poses()]
    body = {"folder": str(recording)}
    assert client.ask("/api/import", "POST", body)[0] == 400  # the library has it already
    client.ask("/api/scans/drone-1/test-1", "DELETE")
    status, answer, _ = client.ask("/api/import", "POST", body)
    assert (status, answer) == (201, {"drone": "drone-1", "scan": "test-1"})
    entry = client.ask("/api/scans/drone-1/test-1")[1]
    assert entry["finished"] and entry["preview"] and entry["trouble"] is None
    assert entry["origin"]["lat_deg"] == pytest.approx(47.39)
    with ScanStore.open(store / "drones/drone-1/test-1/scan.db") as scan:
        after = list(scan.keyframes())
        np.testing.assert_allclose([p.T_world_camera for p in scan.poses()], track, atol=1e-5)
    assert [k.seq for k in after] == [k.seq for k in before]
    for one, other in zip(before, after, strict=True):
        known = np.isfinite(one.depth.depth_m)
        assert (known == np.isfinite(other.depth.depth_m)).mean() > 0.999
        both = known & np.isfinite(other.depth.depth_m)
        assert np.abs(one.depth.depth_m - other.depth.depth_m)[both].max() < 0.02
        np.testing.assert_allclose(one.depth.T_world_camera, other.depth.T_world_camera, atol=1e-5)


def test_unfit_mcaps_are_refused_in_one_line(client: Client, tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    whole = b"\x89MCAP0\r\n" + bytes(200)
    for name, content in (("a.mcap", b""), ("b.mcap", b"not one"), ("c.mcap", whole)):
        (tmp_path / name).write_bytes(content)
        status, answer, _ = client.ask("/api/import", "POST", {"folder": str(tmp_path / name)})
        assert status == 400 and "\n" not in answer["error"] and name in answer["error"]
    assert client.ask("/api/import", "POST", {"folder": str(tmp_path / "no.mcap")})[0] == 400


def test_deliverables_are_made_on_request(client: Client) -> None:
    one = "/api/scans/drone-1/test-1"
    assert client.ask(one + "/exports", "POST", {"kind": "kml"})[0] == 202
    assert client.ask(one + "/exports", "POST", {"kind": "docx"})[0] == 400
    until(lambda: client.ask(one)[1]["jobs"][-1]["state"] not in ("waiting", "running"))
    job = client.ask(one)[1]["jobs"][-1]
    assert job["state"] == "done" and job["file"] == "flight.kml"
    assert b"<kml" in client.ask(one + "/files/flight.kml")[1]


def test_broken_folders_are_listed_with_their_trouble(store: Path, house: HouseFlight) -> None:
    for name, content in [("junk", b"not a database"), ("empty", b"")]:
        (store / "drone-1" / name).mkdir()
        (store / "drone-1" / name / "scan.db").write_bytes(content)
    house.flown(store / "drone-1" / "later").close()
    (store / "drone-1/later/scan.json").write_text('{"schema": 99}')
    house.flown(store / "drone-1" / "half").close()
    (store / "drone-1/half/scan.json").write_text('{"schema": 1, "times"')
    house.flown(store / "drone-1" / "fresh").close()
    (store / "drone-1" / "bad name").mkdir()
    troubles = {e["scan"]: e["trouble"] for e in Library(store).scans()}
    assert set(troubles) == {"test-1", "junk", "empty", "later", "half", "fresh"}
    assert troubles["test-1"] is None and troubles["fresh"] is None
    assert all(troubles[n] for n in ("junk", "empty", "half"))
    assert "another version" in str(troubles["later"])


def unpack(message: bytes) -> tuple[dict[str, Any], np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Head, world points and colours of a binary chunk, as the page reads them."""
    (size,) = struct.unpack_from("<I", message)
    head = json.loads(message[4 : 4 + size])
    ends = 4 + size + np.cumsum(head["bytes"])
    assert len(message) == ends[-1]
    mask, depth, sigma, views, colour = np.split(np.frombuffer(message, np.uint8), ends)[:5]
    mask = mask[4 + size :]
    x, y, w, h = head["box"]
    known = plane_coders.decode_mask(mask.tobytes(), w, h)
    codes = plane_coders.decode_codes(depth.tobytes(), known)
    bgr = planes.decode_colour(colour.tobytes(), w, h)
    assert codes is not None and bgr is not None
    for coded, block in ((sigma, 4), (views, 2)):
        blocks = -(-w // block) * -(-h // block)
        assert not len(coded) or len(zlib.decompress(coded.tobytes())) == blocks
    rows, cols = np.nonzero(known)
    z = head["scale"] / (head["low"] + head["step"] * codes[rows, cols])
    fx, fy, cx, cy = head["K"]
    xyz = np.column_stack([(cols + x - cx) / fx * z, (rows + y - cy) / fy * z, z])
    T = np.array(head["T"]).reshape(4, 4).T
    return head, xyz @ T[:3, :3].T + T[:3, 3], bgr[rows, cols, ::-1]


def test_the_live_view_grows_with_the_scan(client: Client, store: Path, house: HouseFlight) -> None:
    from websockets.sync.client import connect

    url = client.base.replace("http", "ws") + "/api/scans/drone-1/test-1/live"
    with ScanStore.open(store / "drone-1/test-1/scan.db") as scan, connect(url) as socket:
        chunks: dict[int, Any] = {}
        while len(chunks) < 5:
            message = socket.recv(timeout=5)
            if isinstance(message, bytes):
                head, xyz, rgb = unpack(message)
                chunks[head["seq"]] = (xyz, rgb)
        xyz, rgb = chunks[2]
        assert len(xyz) == 160 * 90
        on_roof = xyz[:, 2] > 5.5
        assert np.abs(xyz[on_roof][:, :2] - [10, 2]).max(axis=0)[0] < 6.2
        assert np.median(rgb[on_roof, 0]) > 150
        one = house.keyframe(5, 25.0)
        scan.add_keyframe(5, encode(one, one.time_ns))
        scan.add_reposes([Repose(2, 1, house.pose(60.0), 1.5, np.eye(6))])
        seen: dict[str, Any] = {}
        while not {"chunk", "repose"} <= set(seen):
            message = socket.recv(timeout=5)
            if isinstance(message, bytes):
                seen["chunk"] = unpack(message)[0]
            else:
                seen[json.loads(message)["type"]] = json.loads(message)
        assert seen["chunk"]["seq"] == 5
        assert seen["repose"]["seq"] == 2 and seen["repose"]["scale"] == pytest.approx(1.5)
        np.testing.assert_allclose(seen["repose"]["T"][12:15], [60.0, 0.0, 40.0])


def test_a_chunk_is_sent_before_the_next_one_is_made(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    from websockets.sync.client import connect

    arrived, real = threading.Event(), live.chunk_message

    def slow(scan: ScanStore, seq: int, layer: int) -> bytes | None:
        assert seq == 0 or arrived.wait(20)
        return real(scan, seq, layer)

    monkeypatch.setattr(live, "chunk_message", slow)
    url = client.base.replace("http", "ws") + "/api/scans/drone-1/test-1/live"
    with connect(url) as socket:
        while not isinstance(socket.recv(timeout=5), bytes):
            pass
        arrived.set()


def test_the_list_and_the_page_are_compressed(client: Client) -> None:
    files = sorted((PAGE / "assets").glob("index-*"))
    for path in ["/api/scans", *(f"/assets/{file.name}" for file in files)]:
        request = urllib.request.Request(client.base + path, headers={"Accept-Encoding": "gzip"})
        with urllib.request.urlopen(request, timeout=10) as answer:
            small, is_zipped = answer.read(), answer.headers["content-encoding"] == "gzip"
        with urllib.request.urlopen(client.base + path, timeout=10) as answer:
            assert is_zipped and gzip.decompress(small) == answer.read()


def test_a_live_view_of_nothing_is_closed(client: Client) -> None:
    from websockets.exceptions import ConnectionClosed, InvalidStatus
    from websockets.sync.client import connect

    url = client.base.replace("http", "ws") + "/api/scans/drone-1/none/live"
    with pytest.raises((ConnectionClosed, InvalidStatus)), connect(url) as socket:
        socket.recv(timeout=5)


def test_the_feed_sends_each_thing_once(tmp_path: Path, house: HouseFlight) -> None:
    with house.flown(tmp_path) as scan:
        feed = LiveFeed(scan)
        first = [m for m in feed.news() if isinstance(m, bytes)]
        assert len(first) == 5
        assert list(feed.news()) == []
        scan.add_reposes([Repose(1, 1, house.pose(9.0), 1.0, np.eye(6))])
        scan.add_reposes([Repose(1, 2, house.pose(8.0), 1.0, np.eye(6))])
        moved = [json.loads(m) for m in feed.news()]
        assert [(m["type"], m["seq"], m["T"][12]) for m in moved] == [("repose", 1, 8.0)]
        scan.add_pose(house.record(9, 50.0))
        track = [json.loads(m) for m in feed.news()]
        assert track[0]["type"] == "track" and len(track[0]["track"]) == 6
        scan.finish({})
        assert [json.loads(m)["finished"] for m in feed.news()] == [True]
    head, _, _ = unpack(first[0])
    sigmas = zlib.decompress(first[0][-sum(head["bytes"][2:]) : -sum(head["bytes"][3:])])
    code = np.median(np.frombuffer(sigmas, np.uint8))
    assert 0.001 * 2 ** ((code - 1) / 4) == pytest.approx(0.05, rel=0.2)


def test_depth_in_another_coding_is_coded_anew(tmp_path: Path, house: HouseFlight) -> None:
    imagecodecs = pytest.importorskip("imagecodecs")
    one = house.keyframe(0, 0.0)
    with ScanStore.create(tmp_path / "scan.db", ScanHeader("x", "d", 0)) as scan:
        for seq, layer in enumerate(codec.encode(one, one.time_ns)):
            opened = codec.unpack(layer)
            assert opened is not None
            head, sections = opened
            known = plane_coders.decode_mask(sections[0], *head.box[2:])
            codes = plane_coders.decode_codes(sections[1], known)
            assert codes is not None
            old = sections[0], bytes(imagecodecs.jpegls_encode(codes)), *sections[2:]
            method = planes.METHOD_JPEG_LS
            scan.add_keyframe(seq, [codec.pack(replace(head, seq=seq, method=method), old)])
        heads = [unpack(m) for m in LiveFeed(scan).news() if isinstance(m, bytes)]
    assert [head["seq"] for head, _, _ in heads] == [0, 1]
    np.testing.assert_allclose(heads[1][1][:, 2].min(), 0.0, atol=0.05)


def test_of_a_scan_beside_another_only_coarse_layers_are_sent(
    tmp_path: Path, house: HouseFlight
) -> None:
    with house.flown(tmp_path) as scan:
        feed = LiveFeed(scan, coarse=True)
        sent = [unpack(m)[0] for m in feed.news() if isinstance(m, bytes)]
        assert [head["layer"] for head in sent] == [0] * 5
        assert list(feed.news()) == []


def test_a_finer_layer_replaces_the_coarse_one(tmp_path: Path, house: HouseFlight) -> None:
    one = house.keyframe(0, 0.0)
    coarse, fine = encode(one, one.time_ns)
    with ScanStore.create(tmp_path / "scan.db", ScanHeader("x", "d", 0)) as scan:
        feed = LiveFeed(scan)
        scan.add_keyframe(0, [coarse])
        heads = [unpack(m)[0] for m in feed.news() if isinstance(m, bytes)]
        scan.add_keyframe(0, [fine])
        heads += [unpack(m)[0] for m in feed.news() if isinstance(m, bytes)]
    assert [(h["seq"], h["layer"]) for h in heads] == [(0, 0), (0, 1)]
    assert heads[1]["size"] > heads[0]["size"]


def test_the_page_takes_the_token_into_a_cookie(client: Client) -> None:
    class Stay(urllib.request.HTTPRedirectHandler):
        def redirect_request(self, *_: Any) -> None:
            return None

    opener = urllib.request.build_opener(Stay)
    with pytest.raises(urllib.error.HTTPError) as answer:
        opener.open(f"{client.base}/?token={TOKEN}")
    assert answer.value.code == 303
    cookie = answer.value.headers["set-cookie"]
    assert "HttpOnly" in cookie and "samesite=strict" in cookie.lower()
    value = cookie.split(";")[0]
    status, _, _ = client.ask(
        "/api/scans/drone-1/test-1", "PATCH", {"title": "by cookie"}, None, {"Cookie": value}
    )
    assert status == 200
    with pytest.raises(urllib.error.HTTPError) as answer:
        opener.open(f"{client.base}/?token=wrong")
    assert "set-cookie" not in answer.value.headers
    assert client.ask("/")[0] == 200


def test_the_interface_is_described(client: Client) -> None:
    status, document, _ = client.ask("/api/openapi.json")
    assert status == 200 and document["openapi"].startswith("3.")
    one = document["paths"]["/api/scans/{drone}/{scan}"]
    assert set(one) == {"parameters", "get", "patch", "delete"}
    assert "security" in one["patch"] and "requestBody" in one["patch"]
    assert "security" not in one["get"] and "requestBody" not in one["delete"]
    order = document["components"]["schemas"]["VehicleOrder"]["properties"]["action"]
    assert "baseline" in order["enum"]
    assert {"/api/scans", "/api/vehicle", "/api/import", "/metrics"} <= set(document["paths"])
    assert "/api/scans/{drone}/{scan}/live" in document["paths"]


def test_open_addresses_need_a_token(tmp_path: Path) -> None:
    for host in ("0.0.0.0", "192.168.1.5", "::", "ground.example"):
        with pytest.raises(InputError, match="token"):
            PortalConfig(tmp_path, host=host)
        PortalConfig(tmp_path, host=host, token=TOKEN)
    with pytest.raises(InputError, match="port"):
        PortalConfig(tmp_path, port=99999)
    assert parse_address("127.0.0.1:8080", "portal") == ("127.0.0.1", 8080)
    assert parse_address("[::1]:80", "portal") == ("::1", 80)
    for bad in ("8080", "host:", "host:x", "host:65536", ""):
        with pytest.raises(InputError, match="HOST:PORT"):
            parse_address(bad, "portal")


def test_on_open_addresses_reading_needs_the_token(store: Path) -> None:
    portal = Portal(PortalConfig(store, host="0.0.0.0", port=0, token=TOKEN))
    portal.start()
    try:
        client = Client(portal)
        client.base = client.base.replace("0.0.0.0", "127.0.0.1")
        assert client.ask("/api/scans", token=None)[0] == 401
        assert client.ask("/", token=None)[0] == 401
        assert client.ask("/api/scans")[0] == 200
    finally:
        portal.close()


def test_a_taken_port_is_said(store: Path) -> None:
    first = Portal(PortalConfig(store, port=0))
    first.start()
    try:
        port = int(first.url.split(":")[2].split("/")[0])
        with pytest.raises(OutsideError, match="cannot listen"):
            Portal(PortalConfig(store, port=port)).start()
    finally:
        first.close()


def test_a_moved_keyframe_carries_its_points(tmp_path: Path, house: HouseFlight) -> None:
    """Matrix and scale alone place the depth image, as a re-pose relies on."""
    with house.flown(tmp_path) as scan:
        scan.add_reposes([Repose(1, 1, house.pose(60.0), 1.5, np.eye(6))])
        feed = LiveFeed(scan)
        chunks = dict(enumerate(unpack(m) for m in feed.news() if isinstance(m, bytes)))
    head, xyz, _ = chunks[1]
    assert head["scale"] == 1.5
    flat = np.abs(xyz[:, 2] - 40.0 + 1.5 * 40.0) < 0.02
    assert flat.sum() > 10_000
    np.testing.assert_allclose(head["T"][12:15], [60.0, 0.0, 40.0])


@pytest.mark.slow
def test_the_ground_command_serves_the_portal(store: Path, tmp_path: Path) -> None:
    import subprocess
    import sys

    (tmp_path / "token").write_text(TOKEN + "\n")
    command = f"ground --listen tcp/127.0.0.1:0 --store {store} --portal 127.0.0.1:0"
    command += f" --portal-token {tmp_path / 'token'}"
    process = subprocess.Popen(
        [sys.executable, "-m", "service.cli", *command.split()], stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stderr is not None
        line = next(line for line in process.stderr if line.startswith("portal: "))
        base = line.split()[1].split("/?")[0]
        with urllib.request.urlopen(f"{base}/api/scans", timeout=10) as answer:
            assert [s["scan"] for s in json.load(answer)] == ["test-1"]
    finally:
        process.terminate()
        process.communicate(timeout=30)
    assert process.returncode == 0


def test_unfit_tokens_and_certificates_are_said(store: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").write_text("\n")
    for token_file, tls in (
        (tmp_path / "none", None),
        (tmp_path / "empty", None),
        (None, (tmp_path / "a.crt", tmp_path / "a.key")),
    ):
        with pytest.raises(InputError):
            config_of("127.0.0.1:0", store, token_file, tls)


def test_orders_and_figures_of_the_vehicle(store: Path) -> None:
    fake = FakeOperator()
    vehicle = Vehicle("udpin://x", lambda _: fake)  # type: ignore[arg-type, return-value]
    portal = Portal(PortalConfig(store, port=0, token=TOKEN), vehicle=vehicle)
    portal.start()
    vehicle.start()
    try:
        client = Client(portal)
        until(lambda: client.ask("/api/vehicle")[1]["connected"])
        assert client.ask("/api/vehicle", "POST", {"action": "start"}, token=None)[0] == 401
        assert fake.commands == []
        status, answer, _ = client.ask("/api/vehicle", "POST", {"action": "start"})
        assert (status, answer["result"]) == (200, "accepted")
        client.ask("/api/vehicle", "POST", {"action": "baseline", "metres": 2.5})
        assert [(c[0], c[2][:1]) for c in fake.commands] == [(2500, ()), (206, (2.5,))]
        for bad in (
            {"action": "fly"},
            {"action": "baseline"},
            {"action": "start", "metres": 1},
            {"action": "baseline", "metres": -1},
            {"action": "baseline", "metres": True},
        ):
            assert client.ask("/api/vehicle", "POST", bad)[0] == 400
        fake.result = 1
        status, answer, _ = client.ask("/api/vehicle", "POST", {"action": "stop"})
        assert status == 503 and "rejected" in answer["error"]
        fake.callbacks["SYS_STATUS"](1, {"voltage_battery": 15200, "battery_remaining": 71})
        fake.callbacks["GPS_RAW_INT"](1, {"satellites_visible": 14})
        fake.callbacks["GLOBAL_POSITION_INT"](
            1, {"lat": 470001000, "lon": 80000000, "relative_alt": 42500}
        )
        fake.callbacks["HOME_POSITION"](1, {"latitude": 470000000, "longitude": 80000000})
        figures = client.ask("/api/vehicle")[1]
        assert (figures["battery_percent"], figures["battery_volts"]) == (71.0, 15.2)
        assert (figures["satellites"], figures["height_above_home_m"]) == (14.0, 42.5)
        assert figures["home_distance_m"] == pytest.approx(11.12, abs=0.1)
        assert figures["speed_m_s"] is None
    finally:
        portal.close()
        vehicle.close()
    assert fake.closed


def test_a_stop_waits_for_no_other_order() -> None:
    """The answer to a start does not come; the stop goes out all the same."""
    answered, asked = threading.Event(), threading.Event()

    class Slow(FakeOperator):
        def command(self, number: int, component: int, params: tuple[float, ...] = ()) -> Any:
            if number == 2500:
                asked.set()
                answered.wait()
            return super().command(number, component, params)

    slow = Slow()
    vehicle = Vehicle("udpin://x", lambda _: slow)  # type: ignore[arg-type, return-value]
    vehicle.start()
    until(lambda: vehicle.figures()["connected"])
    starting = threading.Thread(target=vehicle.order, args=("start", None), daemon=True)
    stopping = threading.Thread(target=vehicle.order, args=("stop", None), daemon=True)
    try:
        starting.start()
        asked.wait()
        stopping.start()
        until(lambda: [c[0] for c in slow.commands] == [2501])
    finally:
        answered.set()
        starting.join()
        stopping.join()
        vehicle.close()


def test_without_a_vehicle_orders_are_refused(client: Client) -> None:
    assert client.ask("/api/vehicle")[1] == {"connected": None}
    status, answer, _ = client.ask("/api/vehicle", "POST", {"action": "start"})
    assert status == 404 and "--vehicle" in answer["error"]


def test_a_vehicle_that_is_not_there_says_so() -> None:
    def unreachable(_: str) -> Any:
        raise OutsideError("no companion heard")

    vehicle = Vehicle("udpin://x", unreachable)
    vehicle.start()
    until(lambda: vehicle.figures()["trouble"] == "no companion heard")
    with pytest.raises(OutsideError, match="no companion heard"):
        vehicle.order("start", None)
    vehicle.close()
