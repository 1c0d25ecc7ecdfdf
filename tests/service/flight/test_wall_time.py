"""Whose clock names a scan and gives its times."""

from __future__ import annotations

import socket
import time
from pathlib import Path

import pytest
from loopback import free_port, until
from rehearsal import RehearsalVehicle

from mavlink.telemetry.clock import DIFFER_NS, WallTime, computer_offset_ns
from mavlink.wire.dialect import dialect
from service.daemon.scanning import disagreement, new_folder, set_since

S = 1_000_000_000
MONTH_NS = 30 * 86_400 * S
NOW_UNIX_NS = 1_795_000_000 * S


def test_the_autopilots_time_is_taken_where_the_clocks_differ() -> None:
    wall, true_ns = WallTime(), NOW_UNIX_NS - 7 * S
    for never_set in (0, 1_000_000, 2**63):
        wall.hear(never_set, 7 * S)
    assert wall.correct(true_ns - MONTH_NS) == true_ns - MONTH_NS  # nothing knows better
    wall.hear(NOW_UNIX_NS // 1000, 7 * S)
    assert wall.correct(true_ns - MONTH_NS) == true_ns
    assert wall.correct(true_ns + MONTH_NS) == true_ns
    assert wall.correct(true_ns + DIFFER_NS // 2) == true_ns + DIFFER_NS // 2  # it agrees
    wall.hear(0, 8 * S)  # restarted, no fix yet
    assert wall.correct(true_ns - MONTH_NS) == true_ns


@pytest.mark.parametrize(("ahead_ns", "word"), [(MONTH_NS, "ahead"), (-MONTH_NS, "behind")])
def test_what_is_said_of_clocks_that_differ(ahead_ns: int, word: str) -> None:
    own_ns = computer_offset_ns()
    assert disagreement(own_ns) == set_since(own_ns, own_ns + S) == []
    (text,) = disagreement(own_ns - ahead_ns)
    assert f"30 days {word}" in text
    (text,) = set_since(own_ns + ahead_ns, own_ns)
    assert text.endswith(f"30 days {word}")
    (text,) = set_since(own_ns + 90 * S, own_ns)
    assert text.endswith("90 s ahead")


def test_a_clock_that_stands_still_stops_no_scan(tmp_path: Path) -> None:
    names = []
    for _ in range(3):
        folder = new_folder(tmp_path, 1_795_737_599.5)
        folder.mkdir()
        names.append(folder.name)
    assert names == ["20261126T235959Z", "20261127T000000Z", "20261127T000001Z"]


def test_only_our_own_autopilot_sets_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: now_ns() - MONTH_NS)
    port = free_port()
    with (
        RehearsalVehicle(f"udpin:127.0.0.1:{port}") as daemon,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer,
    ):
        peer.connect(("127.0.0.1", port))

        def report(system: int, late_ns: int) -> None:
            mouth = dialect.MAVLink(None, system, 1)
            peer.send(bytes(dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(mouth)))
            unix_us = (now_ns() - late_ns) // 1000
            peer.send(bytes(dialect.MAVLink_system_time_message(unix_us, 5_000).pack(mouth)))

        def behind_s() -> float:
            return 1e-9 * (now_ns() - time.monotonic_ns() - daemon.link.unix_offset_ns())

        assert behind_s() == pytest.approx(1e-9 * MONTH_NS, abs=5.0)
        report(1, 0)
        until(lambda: abs(behind_s()) < 5.0)
        report(2, MONTH_NS // 2)
        report(1, 100 * S)  # it was set
        until(lambda: abs(behind_s() - 100.0) < 5.0)
