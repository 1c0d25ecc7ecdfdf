"""Log records in the journal's own protocol."""

from __future__ import annotations

import logging
import os
import socket
import struct
import tempfile
from contextlib import redirect_stderr
from pathlib import Path

import pytest

from service import init_system


def fields(datagram: bytes) -> dict[str, str]:
    """Read by the protocol's description: NAME=value, or NAME, length and bytes."""
    found = {}
    while datagram:
        line, _, rest = datagram.partition(b"\n")
        name, equals, value = line.partition(b"=")
        if not equals:
            (size,) = struct.unpack_from("<Q", rest)
            value, rest = rest[8 : 8 + size], rest[8 + size + 1 :]
        found[name.decode()] = value.decode()
        datagram = rest
    return found


def test_records_arrive_with_their_fields(tmp_path: Path) -> None:
    path = str(tmp_path / "socket")
    logger = logging.getLogger("service.some.part")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as journald:
        journald.bind(path)
        handler = init_system.JournalHandler(path)
        logger.addHandler(handler)
        try:
            logger.warning("camera %s: lost", "a=b")
            first = fields(journald.recv(100_000))
            try:
                raise ValueError("two\nlines")
            except ValueError:
                logger.exception("fault")
            second = fields(journald.recv(100_000))
        finally:
            logger.removeHandler(handler)
            handler.close()
    assert first["MESSAGE"] == "camera a=b: lost"
    assert (first["PRIORITY"], first["LOGGER"]) == ("4", "service.some.part")
    assert first["CODE_FUNC"] == "test_records_arrive_with_their_fields"
    assert second["PRIORITY"] == "3"
    assert second["MESSAGE"].endswith("ValueError: two\nlines")


def test_without_a_journal_it_goes_to_standard_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    handler = init_system.JournalHandler(str(tmp_path / "nobody"))
    handler.handle(logging.LogRecord("a.b", logging.ERROR, "f", 1, "it %s", ("broke",), None))
    handler.close()
    assert capsys.readouterr().err == "ERROR a.b: it broke\n"


def test_the_journal_is_used_where_it_reads_us(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("JOURNAL_STREAM", raising=False)
    assert isinstance(init_system.log_handler(), logging.StreamHandler)
    with tempfile.TemporaryFile("w") as stream, redirect_stderr(stream):
        found = os.fstat(stream.fileno())
        monkeypatch.setenv("JOURNAL_STREAM", f"{found.st_dev}:{found.st_ino}")
        assert init_system.journal_reads_us()
        monkeypatch.setenv("JOURNAL_STREAM", "1:2")
        assert not init_system.journal_reads_us()
