"""MCAPs that claim more than they hold, or hold other things than a scan."""

from __future__ import annotations

import random
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from house_flight import HouseFlight

pytest.importorskip("foxglove")
pytest.importorskip("mcap")
zstandard = pytest.importorskip("zstandard")

from google.protobuf import descriptor_pb2  # noqa: E402
from mcap.reader import make_reader  # noqa: E402

from service.errors import InputError  # noqa: E402
from service.ground import mcap_import  # noqa: E402
from service.ground.mcap_import import header_in, store_from_mcap  # noqa: E402
from service.offline.exports.recording import export_mcap  # noqa: E402

MAGIC = b"\x89MCAP0\r\n"


@pytest.fixture(scope="module")
def recording(house: HouseFlight, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mcap")
    with house.flown(folder) as store:
        export_mcap(store, folder / "flight.mcap")
    return folder / "flight.mcap"


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def with_chunk(path: Path, compression: str, data: bytes, claims: int) -> Path:
    """An MCAP of one chunk, put together from the format's page."""
    body = struct.pack("<QQQI", 0, 0, claims, 0) + text(compression)
    body += struct.pack("<Q", len(data)) + data
    footer = record(2, struct.pack("<QQI", 0, 0, 0))
    head = record(1, text("") + text(""))
    path.write_bytes(MAGIC + head + record(6, body) + record(15, b"\0\0\0\0") + footer + MAGIC)
    return path


def test_the_numbers_of_the_fields_are_those_that_recordings_describe(recording: Path) -> None:
    with recording.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    described: dict[str, dict[str, Any]] = {}
    for schema in summary.schemas.values():
        for one in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
            for message in one.message_type:
                described[message.name] = {field.name: field for field in message.field}
    for name, fields in mcap_import.FIELDS.items():
        for field, number, kind, holds in fields:
            there = described[name][field]
            assert (there.number, there.type) == (number, kind), (name, field)
            assert (there.label == 3) == (holds == "repeated")


LIMITED = """
import resource, sys
from pathlib import Path
from service.errors import InputError
from service.ground.mcap_import import header_in
import mcap.stream_reader, google.protobuf.descriptor_pb2, zstandard, lz4.frame
used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    header_in(Path(sys.argv[1]))
except InputError as error:
    print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - used) // 1024)
"""


@pytest.mark.parametrize("how", ["honest claim", "small claim", "lz4", "plain", "long record"])
@pytest.mark.slow
def test_a_small_file_takes_no_large_memory(tmp_path: Path, how: str) -> None:
    """In a process of its own, whose peak is read at the end."""
    size = 1 << 30
    path = tmp_path / "bomb.mcap"
    if how in ("honest claim", "small claim"):
        packer = zstandard.ZstdCompressor().compressobj(size=size)
        data = b"".join(packer.compress(bytes(1 << 20)) for _ in range(1024)) + packer.flush()
        assert len(data) < 100_000
        with_chunk(path, "zstd", data, size if how == "honest claim" else 1000)
    elif how == "lz4":
        lz4 = pytest.importorskip("lz4.frame")
        with_chunk(path, "lz4", lz4.compress(bytes(64 << 20)), 1000)
    elif how == "plain":
        with_chunk(path, "", struct.pack("<BQ", 5, 1 << 60), 9)
    else:
        path.write_bytes(MAGIC + struct.pack("<BQ", 6, 1 << 33) + bytes(100))
    command = [sys.executable, "-c", LIMITED, str(path)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert ended.returncode == 0 and ended.stdout, ended.stderr
    assert int(ended.stdout) < 64  # MiB


@pytest.mark.slow
def test_flipped_recordings_never_end_in_a_traceback(tmp_path: Path, recording: Path) -> None:
    good = recording.read_bytes()
    outcomes = set()
    for seed in range(120):
        rng = random.Random(seed)
        data = bytearray(good)
        for _ in range(rng.choice([1, 8, 64])):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        path = tmp_path / f"{seed}.mcap"
        path.write_bytes(data if seed % 6 else data[: rng.randrange(len(data))])
        try:
            store_from_mcap(path, tmp_path / str(seed) / "scan.db").close()
            outcomes.add(True)
        except InputError as error:
            assert "\n" not in str(error)
            outcomes.add(False)
    assert outcomes == {True, False}


def test_a_recording_from_an_impossible_place_is_refused(
    tmp_path: Path, house: HouseFlight
) -> None:
    with house.flown(tmp_path) as store:
        store.update_header(origin_lat_deg=None)
        store.put_header(type(store.header)("s", "d", 1, origin_lat_deg=1e308, origin_lon_deg=0.0))
        export_mcap(store, tmp_path / "far.mcap")
    with pytest.raises(InputError, match="origin_lat_deg"):
        header_in(tmp_path / "far.mcap")
