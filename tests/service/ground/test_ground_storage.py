"""A scan that came by radio alone is completed from the aircraft's card after landing."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from spied import spied

from recon.types import DepthMap, Keyframe, Pose
from service.errors import InputError, OutsideError
from service.ground import storage
from service.ground.guard import kept_token
from service.ground.library import Library
from service.ground.storage import check_room, scan_files, scan_folder, take_in
from service.stream import codec
from service.stream import store as store_module
from service.stream.naming import NAME, station_name
from service.stream.radio_messages import pack_announce, pack_tile, tag_of, unpack_announce
from service.stream.radio_tiles import tiles_of
from service.stream.records import PoseRecord, Repose, ScanHeader
from service.stream.store import ScanStore

HEADER = ScanHeader("scan-1", "red", 1_767_268_800_000_000_000, 47.5, 8.25, 431.5)


def keyframe(seq: int) -> Keyframe:
    rng = np.random.default_rng(seq)
    depth = DepthMap(
        rng.uniform(40, 60, (90, 160)).astype(np.float32),
        np.full((90, 160), 0.1, np.float32),
        np.full((90, 160), 3, np.uint8),
        np.array([[130.0, 0, 79.5], [0, 130.0, 44.5], [0, 0, 1]]),
        np.eye(4),
    )
    bgr = rng.integers(0, 255, (90, 160, 3), np.uint8)
    return Keyframe(seq, 5, depth, bgr, Pose(np.eye(4), np.eye(6)), np.ones((90, 160), bool))


received = partial(take_in, deliver=lambda *_: None)  # the files are another module's matter


@pytest.fixture
def card(tmp_path: Path) -> Path:
    """The aircraft's storage, as a power cut left it: the write-ahead log is not folded in."""
    folder = tmp_path / "aircraft" / "scan-1"
    store = ScanStore.create(folder / "scan.db", HEADER)
    for seq in range(3):
        store.add_keyframe(seq, codec.encode(keyframe(seq), seq))
        store.add_pose(PoseRecord(seq, np.eye(4), np.eye(6)))
    store.add_reposes([Repose(1, 1, np.eye(4), 1.0, np.eye(6))])
    store.finish({"points": 1})
    (tmp_path / "card" / "scan-1").mkdir(parents=True)
    for name in ("scan.db", "scan.db-wal"):
        shutil.copyfile(folder / name, tmp_path / "card" / "scan-1" / name)
    assert (tmp_path / "card" / "scan-1" / "scan.db-wal").stat().st_size > 10_000
    store.close()
    return tmp_path / "card"


def test_the_card_completes_what_the_radio_brought(tmp_path: Path, card: Path) -> None:
    announced = unpack_announce(pack_announce(HEADER))
    assert announced is not None
    path = tmp_path / "ground" / "drones" / "red" / "scan-1" / "scan.db"
    with ScanStore.create(path, announced) as ground:
        coarse = codec.decode(codec.encode(keyframe(0), 0)[:1])
        assert coarse is not None
        for tile in tiles_of(coarse):
            ground.radio.add("tile", 0, tile.index, pack_tile(tag_of("red", "scan-1"), tile))
    before = {p.name: p.read_bytes() for p in (card / "scan-1").iterdir()}
    assert received(tmp_path / "ground", card) == [path.parent]
    assert received(tmp_path / "ground", card / "scan-1") == [path.parent]  # once more: no harm
    assert {p.name: p.read_bytes() for p in (card / "scan-1").iterdir()} == before
    assert [p.name for p in (tmp_path / "ground").iterdir()] == ["drones"]
    with ScanStore.open(path) as ground, ScanStore.open(card / "scan-1" / "scan.db") as aircraft:
        assert ground.numbers() == aircraft.numbers()
        assert ground.header == HEADER and ground.summary == {"points": 1}
        for a, b in zip(aircraft.keyframes(), ground.keyframes(), strict=True):
            np.testing.assert_array_equal(a.depth.depth_m, b.depth.depth_m)


def test_two_cards_with_runs_of_one_time_are_kept_apart(tmp_path: Path) -> None:
    for n, run_id in enumerate(("a" * 32, "b" * 32)):
        path = tmp_path / f"card-{n}" / "scan-1" / "scan.db"
        with ScanStore.create(path, replace(HEADER, run_id=run_id)) as store:
            for seq in range(n, n + 3):
                store.add_keyframe(seq, codec.encode(keyframe(seq), seq))
    taken = [received(tmp_path / "ground", tmp_path / f"card-{n}")[0] for n in (0, 1, 0)]
    assert [path.name for path in taken] == ["scan-1", "scan-1-2", "scan-1"]
    for n, path in enumerate(taken[:2]):
        with ScanStore.open(path / "scan.db") as store:
            assert store.seqs() == list(range(n, n + 3))


def test_a_folder_without_scans_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="contains no scan"):
        received(tmp_path / "ground", tmp_path)


def test_what_a_killed_process_left_is_deleted_at_the_start(tmp_path: Path, card: Path) -> None:
    """The process dies while it copies; another one, that still copies, keeps its folder."""
    ground = tmp_path / "ground"
    script = (
        "import os, sys\nfrom pathlib import Path\nfrom service.ground import storage\n"
        "storage.scan_folder = lambda *_: os.kill(os.getpid(), 9)\n"
        "storage.take_in(Path(sys.argv[1]), Path(sys.argv[2]))\n"
    )
    ended = subprocess.run([sys.executable, "-c", script, str(ground), str(card)])
    assert ended.returncode == -9
    assert [path.name[:8] for path in ground.iterdir()] == [".taking-"]
    with storage.workplace(ground) as busy:
        assert storage.clear_leftovers(ground) == 1
        assert list(ground.iterdir()) == [busy]
    assert list(ground.iterdir()) == []


def test_links_and_devices_on_a_card_are_not_followed(tmp_path: Path, card: Path) -> None:
    odd = tmp_path / "odd"
    for name, target in (("one", "/dev/zero"), ("two", str(card / "scan-1" / "scan.db"))):
        (odd / name).mkdir(parents=True)
        (odd / name / "scan.db").symlink_to(target)
    with pytest.raises(InputError, match="contains no scan"):
        take_in(tmp_path / "ground", odd)


def test_a_damaged_scan_leaves_the_others_and_no_card_fills_the_disk(
    tmp_path: Path, card: Path
) -> None:
    (card / "scan-0").mkdir()
    (card / "scan-0" / "scan.db").write_bytes(b"no database")
    (card / "scan-2").symlink_to(tmp_path)
    (tmp_path / "link").symlink_to(card)  # the operator's own
    assert [path.name for path in received(tmp_path / "ground", tmp_path / "link")] == ["scan-1"]
    (card / "scan-3").mkdir()
    with open(card / "scan-3" / "scan.db", "wb") as sparse:
        sparse.truncate(2 * shutil.disk_usage(tmp_path).total)
    with pytest.raises(OutsideError, match="has room for"):
        received(tmp_path / "ground", card)
    with pytest.raises(OutsideError, match="has room for"):  # some of the disk stays free
        check_room(shutil.disk_usage(tmp_path).free - 1_000_000, tmp_path)


def test_a_station_whose_name_is_damaged_takes_another(tmp_path: Path) -> None:
    for torn in (b"\x83\xff\x00", b""):
        (tmp_path / "station.txt").write_bytes(torn)
        name = station_name(tmp_path)
        assert NAME.fullmatch(name) and station_name(tmp_path) == name


def test_the_list_reads_no_growing_scan_as_a_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ScanStore.create(tmp_path / "red" / "scan-1" / "scan.db", HEADER) as store:
        store.add_keyframe(3, codec.encode(keyframe(3), 3))
        read_whole = spied(monkeypatch, store_module, "is_sound")
        (entry,) = Library(tmp_path).scans()
    assert not read_whole.called
    assert entry["trouble"] is None and entry["counts"]["keyframes"] == 1


def test_the_library_imports_two_runs_of_one_time_and_no_run_twice(tmp_path: Path) -> None:
    library = Library(tmp_path / "ground")
    cards = []
    for run_id in ("a" * 32, "b" * 32):
        cards.append(tmp_path / run_id)
        ScanStore.create(cards[-1] / "scan.db", replace(HEADER, run_id=run_id)).close()
    (tmp_path / "ground").mkdir()
    assert [library.take(card) for card in cards] == [
        ("red", "scan-1"),
        ("red", "scan-1-2"),
    ]
    with pytest.raises(InputError, match="holds red/scan-1-2 already"):
        library.take(cards[1])


def test_a_drone_of_any_name_keeps_to_its_own_folder(tmp_path: Path) -> None:
    store = tmp_path / "ground"
    token, library = kept_token(store), Library(store)
    kept = {path.name: path.read_bytes() for path in store.iterdir()}
    names = ("portal-token", "audit.jsonl", "station.txt", "site", "drones")
    for name in names:
        header = ScanHeader("scan-1", name, 1)
        ScanStore.create(tmp_path / "card" / name / "scan.db", header).close()
    assert received(store, tmp_path / "card") == [
        store / "drones" / n / "scan-1" for n in sorted(names)
    ]
    assert {path.name: path.read_bytes() for path in store.iterdir() if path.is_file()} == kept
    assert kept_token(store) == token and not (store / "site").exists()
    assert {entry["drone"] for entry in library.scans()} == set(names)
    for name in names:
        bin_name = library.delete(name, "scan-1")
        assert library.restore(bin_name) == (name, "scan-1")
    assert {entry["drone"] for entry in library.scans()} == set(names)


def test_scans_that_are_deleted_meanwhile_are_left_out(tmp_path: Path) -> None:
    for drone in ("red", "blue"):
        for scan in ("scan-1", "scan-2"):
            ScanStore.create(tmp_path / "drones" / drone / scan / "scan.db", HEADER).close()
    files = scan_files(tmp_path, "scan.db")
    first = next(files)
    for drone in ("red", "blue"):
        shutil.rmtree(tmp_path / "drones" / drone)
    assert list(files) == [] and first.name == "scan.db"


def test_drones_of_an_earlier_version_stay_where_they_are(tmp_path: Path) -> None:
    store, header = tmp_path / "ground", ScanHeader("scan-1", "red", 1)
    ScanStore.create(store / "red" / "scan-1" / "scan.db", header).close()
    ScanStore.create(store / "site" / "red-scan-1" / "scan.db", header).close()
    library = Library(store)
    assert library.folder("red", "scan-1") == store / "red" / "scan-1"
    assert library.folder("site", "red-scan-1") == store / "site" / "red-scan-1"
    assert [(e["drone"], e["scan"]) for e in library.scans()] == [
        ("red", "scan-1"), ("site", "red-scan-1"),
    ]  # fmt: skip
    assert scan_folder(store, "red", "scan-1") == store / "red" / "scan-1"
    assert scan_folder(store, "red", "scan-2") == store / "red" / "scan-2"
    assert scan_folder(store, "blue", "scan-1") == store / "drones" / "blue" / "scan-1"
