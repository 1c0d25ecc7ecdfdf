"""A pseudo-terminal as the serial line, which is unplugged."""

from __future__ import annotations

import os
import pty
import termios
import tty
from pathlib import Path

import pytest
from loopback import until
from rehearsal import RehearsalVehicle

from mavlink.wire.dialect import dialect
from mavlink.wire.framing import Framer
from mavlink.wire.ports import SerialPort, parse_link


def plug(path: Path) -> int:
    """A pseudo-terminal whose far end is reachable at ``path``; our end comes back."""
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    path.symlink_to(os.ttyname(theirs))
    os.close(theirs)
    os.set_blocking(ours, False)
    return ours


def heard(line: int, framer: Framer) -> list[int]:
    try:
        return [packet.message_id for packet in framer.feed(os.read(line, 4096))]
    except OSError:
        return []


def test_a_serial_line_is_spoken_to_first_and_survives_the_plug(tmp_path: Path) -> None:
    path = tmp_path / "autopilot"
    line = plug(path)
    with RehearsalVehicle(f"serial:{path}:57600") as daemon:
        first = until(lambda: heard(line, Framer()))
        assert first[0] == 0  # a heartbeat before anything else
        mouth = dialect.MAVLink(None, 1, 1)
        beat = dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)
        os.write(line, bytes(beat.pack(mouth)))
        until(lambda: daemon.link.presence.autopilot == (1, 1))
        path.unlink()
        os.close(line)
        until(lambda: not daemon.link.report().links[0].is_up)
        assert daemon.link.report().links[0].last_error
        line = plug(path)
        until(lambda: daemon.link.report().links[0].opened >= 2)
        start = dialect.MAVLink_command_long_message(1, 100, 2500, 0, 0, 0, 0, 0, 0, 0, 0)
        os.write(line, b"\x00\xfd noise" + bytes(start.pack(mouth)) + bytes(300))
        until(lambda: daemon.control.asked == ["start_scan"])
        framer = Framer()
        until(lambda: 77 in heard(line, framer))
    os.close(line)


def test_a_line_that_a_stand_in_still_holds_opens_again_at_once(tmp_path: Path) -> None:
    path = tmp_path / "autopilot"
    line, spec = plug(path), parse_link(f"serial:{path}:57600")
    port = SerialPort(spec)
    ((number, _),) = port.ways
    held = os.dup(number)
    with pytest.raises(OSError, match="lock"):
        SerialPort(spec)
    port.close()
    SerialPort(spec).close()
    for descriptor in (held, line):
        os.close(descriptor)


def test_a_line_that_is_unplugged_while_it_opens_is_opened_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flush, faults = termios.tcflush, [termios.error(5, "Input/output error")]

    def flaky(descriptor: int, queue: int) -> None:
        if faults:
            raise faults.pop()
        flush(descriptor, queue)

    monkeypatch.setattr(termios, "tcflush", flaky)
    line = plug(tmp_path / "autopilot")
    with RehearsalVehicle(f"serial:{tmp_path / 'autopilot'}:57600"):
        until(lambda: heard(line, Framer()))
    os.close(line)
