"""The scan store: what goes in comes out, once, also after a crash."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from paths import ROOT

from recon import se3
from recon.types import DepthMap, Keyframe, Pose
from service.errors import InputError, OutsideError
from service.stream import codec
from service.stream.ranges import RangeSet
from service.stream.records import PoseRecord, Repose, ScanHeader
from service.stream.store import ScanStore

HEADER = ScanHeader("scan-1", "drone-a", 1_700_000_000_000_000_000, camera={"width": 320})


def keyframe(seq: int, w: int = 96, h: int = 54) -> Keyframe:
    rng = np.random.default_rng(seq)
    T = se3.exp(rng.normal(0, 0.3, 6))
    depth = DepthMap(
        rng.uniform(40, 60, (h, w)).astype(np.float32),
        rng.uniform(0.1, 0.2, (h, w)).astype(np.float32),
        np.full((h, w), 3, np.uint8),
        np.array([[80.0, 0, 47.5], [0, 80.0, 26.5], [0, 0, 1]]),
        T,
    )
    bgr = rng.integers(0, 255, (h, w, 3), np.uint8)
    fresh = rng.random((h, w)) > 0.3
    return Keyframe(seq, 5, depth, bgr, Pose(T, np.eye(6) * 1e-4, ("vision",)), fresh)


def pose(k: int) -> PoseRecord:
    return PoseRecord(1000 + k, se3.exp(np.full(6, 0.1 * k)), np.eye(6) * 0.01, lat_deg=47.0)


def test_what_goes_in_comes_out(tmp_path: Path) -> None:
    with ScanStore.create(tmp_path / "a" / "scan.db", HEADER) as store:
        layers = codec.encode(keyframe(7), 123)
        assert store.add_keyframe(7, layers) == 2
        store.add_pose(pose(2))
        store.add_pose(pose(1))
        store.update_header(origin_lat_deg=47.5, epsg=32632)
        store.finish({"points": 9})
    with ScanStore.open(tmp_path / "a" / "scan.db") as store:
        assert store.header.origin_lat_deg == 47.5 and store.header.camera == {"width": 320}
        assert store.finished and store.summary == {"points": 9}
        assert [p.time_unix_ns for p in store.poses()] == [1001, 1002]
        (back,) = store.keyframes()
        direct = codec.decode(layers)
        assert direct is not None and back.time_ns == 123
        np.testing.assert_array_equal(back.depth.depth_m, direct.depth.depth_m)
        assert store.seqs()[-1] == 7


def test_a_reader_follows_what_another_connection_writes(tmp_path: Path) -> None:
    coarse, fine = codec.encode(keyframe(7), 123)
    path = tmp_path / "scan.db"
    with ScanStore.create(path, HEADER) as writer, ScanStore.open(path) as reader:
        reported: list[str] = []
        reader.listen(lambda kind, number: reported.append(kind))
        for change in (
            lambda: writer.add_keyframe(7, [coarse]),
            lambda: writer.add_keyframe(7, [fine]),
            lambda: writer.add_reposes([Repose(7, 1, np.eye(4), 1.0, np.eye(6))]),
            lambda: writer.update_header(epsg=32632),
            lambda: writer.finish({}),
        ):
            change()
            assert reader.numbers() != writer.numbers()
            reader.follow()
            assert reader.numbers() == writer.numbers() and reader.header == writer.header
        assert not reported


def test_poses_at_once_are_those_one_by_one(tmp_path: Path) -> None:
    poses = [pose(k) for k in (3, 1, 2)]
    broken = PoseRecord(9, np.full((4, 4), np.nan), np.eye(6))
    with (
        ScanStore.create(tmp_path / "a.db", HEADER) as a,
        ScanStore.create(tmp_path / "b.db", HEADER) as b,
    ):
        reported: list[tuple[str, int]] = []
        b.listen(lambda kind, number: reported.append((kind, number)))
        for one in poses:
            a.add_pose(one)
        uses = b.database.uses[threading.get_ident()]
        assert b.add_poses([*poses[:2], broken, poses[2]]) == 1
        assert (
            b.database.uses[threading.get_ident()] == uses + 2
        )  # the next number, one transaction
        assert reported == [("pose", 1), ("pose", 2), ("pose", 3)]
        assert b.add_poses([]) == 4 == b.add_pose(broken)
        assert a.numbers() == b.numbers()
        for number in (1, 2, 3):
            assert a.record("pose", number) == b.record("pose", number)


def test_held_keyframes_are_decoded_once_and_several_at_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    both, decode, decoded = threading.Barrier(2, timeout=5.0), codec.decode, []

    def counted(layers: Sequence[bytes]) -> Keyframe | None:
        decoded.append(layers)
        both.wait()
        return decode(layers)

    with ScanStore.create(tmp_path / "scan.db", HEADER) as store:
        for k in range(2):
            store.add_keyframe(k, codec.encode(keyframe(k), 0))
        monkeypatch.setattr(codec, "decode", counted)
        store.hold_decoded()
        for _ in range(2):
            with ThreadPoolExecutor(2) as threads:
                found = list(threads.map(store.keyframe, range(2)))
            assert [one.seq for one in found if one is not None] == [0, 1]
    assert len(decoded) == 2


def test_duplicates_and_order_do_not_matter(tmp_path: Path) -> None:
    chunks = [(seq, [data]) for seq in range(4) for data in codec.encode(keyframe(seq), seq)]
    with (
        ScanStore.create(tmp_path / "a.db", HEADER) as a,
        ScanStore.create(tmp_path / "b.db", HEADER) as b,
    ):
        assert all(a.add_keyframe(*chunk) for chunk in chunks)
        for chunk in reversed(chunks):
            assert b.add_keyframe(*chunk)
            assert not b.add_keyframe(*chunk)
        assert a.numbers() == b.numbers()
        assert [a.numbers()[kind] for kind in ("k0", "k1")] == [RangeSet([(0, 3)])] * 2
        for left, right in zip(a.keyframes(), b.keyframes(), strict=True):
            np.testing.assert_array_equal(left.depth.depth_m, right.depth.depth_m)
            np.testing.assert_array_equal(left.bgr, right.bgr)


def test_the_other_end_is_rebuilt_from_records(tmp_path: Path) -> None:
    with (
        ScanStore.create(tmp_path / "a.db", HEADER) as a,
        ScanStore.create(tmp_path / "b.db", ScanHeader("scan-1", "drone-a", 0)) as b,
    ):
        reported: list[tuple[str, int]] = []
        a.listen(lambda kind, number: reported.append((kind, number)))
        a.add_keyframe(0, codec.encode(keyframe(0), 0))
        a.add_pose(pose(1))
        a.add_reposes([Repose(0, 1, np.eye(4), 1.0, np.eye(6))])
        a.add_reposes([Repose(0, 2, np.eye(4), 2.0, np.eye(6))])
        a.update_header(epsg=32632)
        a.finish({"points": 1})
        assert reported[:4] == [("k0", 0), ("k1", 0), ("pose", 1), ("repose", 1)]
        for kind, numbers in a.numbers().items():
            for number in numbers:
                record = a.record(kind, number)
                assert record is not None
                new = number not in b.numbers().get(kind, RangeSet())
                assert b.put_record(kind, number, record) == new
                assert not b.put_record(kind, number, record)
        assert a.numbers() == b.numbers()
        assert b.header == a.header and b.summary == {"points": 1}
        assert not b.put_record("summary", 5, b'{"points": 2}')
        repose = b.repose(0)
        assert repose is not None and repose.revision == 2
    with ScanStore.open(tmp_path / "a.db") as again:
        assert list(again.numbers()["repose"]) == [2]


def test_damaged_chunks_are_refused(tmp_path: Path) -> None:
    data = bytearray(codec.encode(keyframe(0), 0)[0])
    data[-1] ^= 1
    with ScanStore.create(tmp_path / "a.db", HEADER) as store:
        assert not store.put_record("k0", 0, bytes(data))
        assert not store.put_record("k0", 0, b"")
        for kind, number in (("k1", 2), ("k0", 3), ("first", 3), ("image", 2)):
            assert not store.put_record(kind, number, codec.encode(keyframe(2), 0)[0])
        assert not store.put_record("pose", 1, b"nothing")
        with pytest.raises(ValueError, match="keyframe 3"):
            store.add_keyframe(3, codec.encode(keyframe(2), 0))
        assert store.seqs() == []


def test_newest_repose_moves_and_scales(tmp_path: Path) -> None:
    with ScanStore.create(tmp_path / "a.db", HEADER) as store:
        store.add_keyframe(0, codec.encode(keyframe(0), 0))
        plain = store.keyframe(0)
        T = se3.exp(np.array([0.1, 0, 0, 5.0, 0, 0]))
        store.add_reposes([Repose(0, 2, T, 1.5, np.eye(6))])
        store.add_reposes([Repose(0, 1, np.eye(4), 9.0, np.eye(6))])
        moved = store.keyframe(0)
        assert plain is not None and moved is not None
        np.testing.assert_allclose(moved.depth.T_world_camera, T, atol=1e-12)
        np.testing.assert_allclose(moved.depth.depth_m, plain.depth.depth_m * 1.5, rtol=1e-6)
        np.testing.assert_allclose(moved.depth.sigma_m, plain.depth.sigma_m * 1.5, rtol=1e-6)
        assert list(store.numbers()["repose"]) == [1]


def test_over_the_quota_only_the_coarse_layer_is_kept(tmp_path: Path) -> None:
    layers = codec.encode(keyframe(0), 0)
    with ScanStore.create(tmp_path / "a.db", HEADER, quota_bytes=len(layers[1])) as store:
        assert store.add_keyframe(0, layers) == 1
        assert store.refused == 1 and list(store.numbers()["k0"]) == [0]
        assert "k1" not in store.numbers()


def test_wrong_files_are_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "text.db").write_text("hello " * 500)
    for name in ("absent.db", "text.db"):
        with pytest.raises(InputError) as caught:
            ScanStore.open(tmp_path / name)
        assert "\n" not in str(caught.value)
    ScanStore.create(tmp_path / "a.db", HEADER).close()
    with pytest.raises(InputError, match="exists"):
        ScanStore.create(tmp_path / "a.db", HEADER)


def test_a_store_that_is_deleted_takes_no_more(tmp_path: Path) -> None:
    with ScanStore.create(tmp_path / "a.db", HEADER) as store:
        store.add_pose(pose(0))
        for path in tmp_path.iterdir():
            path.unlink()
        with pytest.raises(OutsideError, match="gone"):
            store.add_pose(pose(1))
        assert len(list(store.poses())) == 1


def test_a_damaged_file_gives_back_what_can_be_read(tmp_path: Path) -> None:
    path = tmp_path / "scan.db"
    with ScanStore.create(path, HEADER) as store:
        for seq in range(12):
            store.add_keyframe(seq, codec.encode(keyframe(seq), seq))
            store.add_pose(pose(seq))
    whole = bytearray(path.read_bytes())
    middle = len(whole) // 2 // 4096 * 4096
    whole[middle : middle + 8192] = bytes(8192)
    path.write_bytes(whole)
    with ScanStore.open(path) as store:
        assert store.header == HEADER
        kept = store.seqs()
        assert 4 <= len(kept) <= 12
        for frame in store.keyframes():
            direct = codec.decode(codec.encode(keyframe(frame.seq), frame.seq))
            assert direct is not None
            if frame.depth.depth_m.shape == direct.depth.depth_m.shape:
                np.testing.assert_array_equal(frame.depth.depth_m, direct.depth.depth_m)
        store.add_pose(pose(99))
    assert (tmp_path / "scan.db.damaged").exists()


WRITER = """
import sys
import threading
from service.stream.store import ScanStore
from service.stream.ranges import RangeSet
from service.stream.records import ScanHeader, PoseRecord
import numpy as np
store = ScanStore.create(sys.argv[1], ScanHeader("s", "d", 1))
k = 0
while True:
    print(store.add_pose(PoseRecord(k, np.eye(4), np.eye(6))), flush=True)
    k += 1
"""


def test_a_killed_writer_loses_nothing_it_acknowledged(tmp_path: Path) -> None:
    path = tmp_path / "scan.db"
    root = str(ROOT)
    writer = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": root},
    )
    assert writer.stdout is not None
    acknowledged = [int(writer.stdout.readline()) for _ in range(20)]
    writer.send_signal(signal.SIGKILL)
    acknowledged += [int(line) for line in writer.stdout.read().split("\n")[:-1]]
    writer.wait()
    with ScanStore.open(path) as store:
        assert list(store.numbers()["pose"])[: len(acknowledged)] == acknowledged
        store.add_pose(pose(1))
