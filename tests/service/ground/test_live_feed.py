"""The live feed of a growing scan reads what is new and sends what a reader of all would see."""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from spied import spied

from service.ground.live import LiveFeed
from service.stream import codec, radio_messages, store
from service.stream.codec import encode_image
from service.stream.records import PoseRecord, Repose, ScanHeader, pack_pose
from service.stream.store import ScanStore

if TYPE_CHECKING:
    from house_flight import HouseFlight


@pytest.fixture
def scan(tmp_path: Path, house: HouseFlight) -> Iterator[ScanStore]:
    with house.flown(tmp_path) as opened:
        yield opened


@pytest.fixture
def feed(scan: ScanStore) -> Iterator[LiveFeed]:
    with ScanStore.open(scan.path) as reader:
        yield LiveFeed(reader)


def texts(feed: LiveFeed) -> list[dict[str, Any]]:
    return [json.loads(m) for m in feed.news() if isinstance(m, str)]


def track(feed: LiveFeed) -> tuple[list[float], float]:
    """East of each place of the track, and of the last pose."""
    (message,) = (m for m in texts(feed) if m["type"] == "track")
    return [place[0] for place in message["track"]], message["last"]["T"][12]


def test_a_pose_and_a_repose_are_read_once(
    scan: ScanStore, feed: LiveFeed, house: HouseFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    scan.add_reposes([Repose(seq, 1, house.pose(9.0), 1.0, np.eye(6)) for seq in range(5)])
    texts(feed)
    poses = spied(monkeypatch, store, "unpack_pose")
    reposes = spied(monkeypatch, store, "unpack_repose")
    scan.add_poses([house.record(5, 25.0), house.record(6, 30.0)])
    scan.add_reposes([Repose(3, 2, house.pose(8.0), 1.0, np.eye(6))])
    poses.reset_mock()
    reposes.reset_mock()
    assert [m["type"] for m in texts(feed)] == ["repose", "track"]
    assert (poses.call_count, reposes.call_count) == (2, 1)


def test_a_scan_is_heard_when_it_grows_not_when_its_file_is_written(
    scan: ScanStore, feed: LiveFeed, house: HouseFlight
) -> None:
    texts(feed)
    at = feed.heard_unix_s
    assert at == max(pose.time_unix_ns for pose in scan.poses()) / 1e9
    scan.database.write([("CREATE TABLE IF NOT EXISTS other (x)", ())])
    assert texts(feed) == [] and feed.heard_unix_s == at
    scan.add_poses([house.record(5, 25.0)])
    assert [m["type"] for m in texts(feed)] == ["track"]
    assert time.time() - feed.heard_unix_s < 60.0


def test_poses_that_arrive_out_of_order_make_the_same_track(
    scan: ScanStore, feed: LiveFeed, house: HouseFlight
) -> None:
    texts(feed)
    for number, seq, east_m in (
        (30, 9, 9.0),
        (8, 7, 7.0),
        (20, 9, -1.0),
        (31, 3, 3.5),
        (6, 1, 1.5),
    ):
        scan.put_record("pose", number, pack_pose(house.record(seq, east_m)))
        east, last = track(feed)
        poses = scan.poses()
        assert east == [p.T_world_camera[0, 3] for p in poses]
        assert last == poses[-1].T_world_camera[0, 3] == 9.0
    assert east == [0.0, 1.5, 10.0, 3.5, 20.0, 7.0, 9.0]


def test_a_long_track_is_thinned_and_ends_at_the_last_pose(
    scan: ScanStore, feed: LiveFeed, house: HouseFlight
) -> None:
    scan.add_poses([house.record(seq, float(seq)) for seq in range(5, 4002)])
    east, last = track(feed)
    assert east[2:] == [*range(6, 4001, 3), 4001] and last == 4001.0


def test_a_first_depth_is_shown_until_it_is_replaced_or_void(
    scan: ScanStore, feed: LiveFeed, house: HouseFlight
) -> None:
    def shown() -> list[tuple[int, int, int]]:
        """Number, layer and width of the box of each chunk, in place and time."""
        found = [m for m in feed.news() if isinstance(m, bytes)]
        heads = [json.loads(m[4 : 4 + int.from_bytes(m[:4], "little")]) for m in found]
        assert all(head["time_unix_s"] and head["T"][12] == 5.0 * head["seq"] for head in heads)
        return [(head["seq"], head["layer"], head["box"][2]) for head in heads]

    shown()
    layers = {seq: codec.encode(house.keyframe(seq, 5.0 * seq), 1) for seq in (7, 8)}
    assert scan.put_record("first", 7, layers[7][0])
    assert shown() == [(7, -2, 80)] and shown() == []
    state = json.loads(list(LiveFeed(scan).news())[-1])
    assert state == {"type": "state", "finished": False, "keyframes": 5}  # 7 is none yet
    assert scan.put_record("first", 8, layers[8][0])
    assert shown() == [(7, -2, 0), (8, -2, 80)]
    scan.add_keyframe(8, layers[8])
    assert shown() == [(8, 1, 160)]


def test_a_chunk_carries_the_image_of_its_whole_keyframe(
    scan: ScanStore, feed: LiveFeed, house: HouseFlight
) -> None:
    one = house.keyframe(9, 45.0)
    image = encode_image(one.bgr)
    scan.add_keyframe(9, [*codec.encode(one, 1)], image)
    (message,) = [m for m in feed.news() if isinstance(m, bytes)][-1:]
    assert message.endswith(image)
    (size,) = struct.unpack_from("<I", message)
    sections = json.loads(message[4 : 4 + size])["bytes"]
    assert len(sections) == 6 and 4 + size + sum(sections) == len(message)


def test_text_in_place_of_numbers_is_left_out(scan: ScanStore, feed: LiveFeed) -> None:
    texts(feed)
    chunk = "INSERT INTO chunks VALUES (?, ?, 1, 0, 0, 0, x'00')"
    radio = "INSERT INTO radio VALUES ('tile', 'z', 0, x'00')"
    scan.database.write([(chunk, (1, "x")), (chunk, ("y", 0)), (radio, ())])
    assert scan.states() == dict.fromkeys(range(5), (1, -1))
    assert [m["type"] for m in texts(feed)] == []


def heard(scan: ScanStore, number: int, pose: PoseRecord) -> None:
    """Store a pose of the narrow radio."""
    scan.radio.add("pose", number, 0, radio_messages.pack_pose(7, number, pose))


def test_poses_of_the_datalink_replace_those_of_the_radio(
    tmp_path: Path, house: HouseFlight
) -> None:
    header = ScanHeader("test-1", "drone-1", house.start_ns)
    with ScanStore.create(tmp_path / "scan.db", header) as scan:
        reader = ScanStore.open(scan.path)
        feed = LiveFeed(reader)
        for seq in range(3):
            heard(scan, seq, house.record(seq, 5.0 * seq))
            assert track(feed) == ([5.0 * k for k in range(seq + 1)], 5.0 * seq)
        since_ns = house.record(1, 0.0).time_unix_ns
        later = [pose for pose in scan.poses() if pose.time_unix_ns >= since_ns]
        assert [p.T_world_camera[0, 3] for p in later] == [5.0, 10.0]
        scan.put_record("pose", 4, pack_pose(house.record(1, 5.25)))
        assert track(feed) == ([5.25], 5.25)
        reader.close()
