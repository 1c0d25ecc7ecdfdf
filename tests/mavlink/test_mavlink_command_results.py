"""Every result of every command, as the operator's page lists them, is produced."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from dataclasses import replace

import pytest
from paths import ROOT
from rehearsal import RehearsalControl

from mavlink.component.commands import COMMANDS
from mavlink.component.companion import Companion, CompanionConfig
from mavlink.component.control import Answer, Phase, Result, Work
from mavlink.component.presence import Presence, PresenceConfig
from mavlink.telemetry.history import VehicleHistory
from mavlink.wire.dialect import COMMAND_CANCEL, dialect, x25crc
from mavlink.wire.first_beat import CAMERA, ONBOARD
from mavlink.wire.framing import Framer
from mavlink.wire.messages import Packer

S = 1_000_000_000
PAGE = ROOT / "docs" / "operators.md"
STATION = (255, 190)


class Vehicle:
    """Our companion, asked by packets and answering in packets."""

    def __init__(self) -> None:
        self.now_ns = 100 * S
        self.acknowledged: set[tuple[int, Result]] = set()  # number of a command, its result
        self.control = RehearsalControl()
        self.presence = Presence(PresenceConfig(system=1), 77, self.now_ns)
        history = VehicleHistory()
        self.companion = Companion(
            CompanionConfig(), self.control, self.presence, history, self.now_ns
        )
        self._packer, self._framer = Packer(0), Framer()
        self._ear, self._mouth = dialect.MAVLink(None), dialect.MAVLink(None, *STATION)
        self.arm(False)

    def ask(self, number: int, component: int, *params: float) -> list[Result]:
        """Send it as a COMMAND_LONG; the results of the acknowledgements that come at once."""
        values = [*params, *[0.0] * (7 - len(params))]
        message = dialect.MAVLink_command_long_message(1, component, number, 0, *values)
        return self.say(bytes(message.pack(self._mouth)))

    def say(self, data: bytes) -> list[Result]:
        for packet in self._framer.feed(data):
            self.companion.receive(0, packet, self.now_ns)
        return self.later(0.0)

    def later(self, seconds: float) -> list[Result]:
        """Results acknowledged by then."""
        self.now_ns += round(seconds * S)
        self.companion.tick(self.now_ns)
        results = []
        for outgoing in self.companion.take():
            data = self._packer.pack(1, outgoing, 0)
            assert data is not None
            for message in self._ear.parse_buffer(data) or []:
                if message.get_type() == "COMMAND_ACK":
                    assert (message.target_system, message.target_component) == STATION
                    results.append(Result(message.result))
                    self.acknowledged.add((message.command, results[-1]))
        return results

    def refuse(self, what: str, result: Result) -> None:
        self.control.answers[what] = Answer(result, "as the service says")

    def be(self, phase: Phase) -> None:
        self.control.state = replace(self.control.state, phase=phase)

    def arm(self, armed: bool = True) -> list[Result]:
        beat = dialect.MAVLink_heartbeat_message(2, 3, 128 if armed else 0, 0, 4, 3)
        return self.say(bytes(beat.pack(dialect.MAVLink(None, 1, 1))))

    def cancel(self, number: int, component: int) -> list[Result]:
        payload = struct.pack("<HBB", number, 1, component)
        head = bytes((0xFD, len(payload), 0, 0, 0, *STATION, COMMAND_CANCEL, 0, 0))
        crc = x25crc(head[1:] + payload + bytes((14,))).crc
        return self.say(head + payload + struct.pack("<H", crc))


Asked = Callable[[Vehicle], list[Result]]


def plain(number: int, component: int, *params: float) -> Asked:
    return lambda v: v.ask(number, component, *params)


def refused(what: str, result: Result, asked: Asked) -> Asked:
    def ask(v: Vehicle) -> list[Result]:
        v.refuse(what, result)
        return asked(v)

    return ask


def during(phase: Phase, asked: Asked) -> Asked:
    def ask(v: Vehicle) -> list[Result]:
        v.be(phase)
        return asked(v)

    return ask


def disarmed(asked: Asked) -> Asked:
    """Asked of a vehicle that reports afterwards that it is disarmed."""

    def ask(v: Vehicle) -> list[Result]:
        assert asked(v) == [RUNNING]
        v.later(0.5)
        return v.arm(False) + v.later(0.1)

    return ask


def armed(asked: Asked) -> Asked:
    def ask(v: Vehicle) -> list[Result]:
        v.arm()
        return asked(v)

    return ask


def unheard(asked: Asked) -> Asked:
    """Asked when the autopilot's heartbeats stop."""

    def ask(v: Vehicle) -> list[Result]:
        assert asked(v) == [RUNNING]
        return v.later(4.0)

    return ask


def worked(what: str, end: str, number: int, component: int, *params: float) -> Asked:
    """Work that is running, or that ended in one of the ways that work ends."""

    def ask(v: Vehicle) -> list[Result]:
        work = v.control.works[what] = Work()
        first = v.ask(number, component, *params)
        v.later(0.1)
        v.arm(False)
        if end == "runs":
            return first
        if end == "cancelled":
            v.cancel(number, component)
            assert work.cancelled
        work.finish(Answer(Result.FAILED, "no") if end == "fails" else Answer())
        return v.later(0.1)

    return ask


def stopped(number: int, component: int, *params: float) -> Asked:
    """Cancelled while it waits for the autopilot."""

    def ask(v: Vehicle) -> list[Result]:
        assert v.ask(number, component, *params) == [RUNNING]
        return v.cancel(number, component)

    return ask


def busy(what: str, number: int, component: int, first: float, second: float) -> Asked:
    """Another of the same while one runs."""

    def ask(v: Vehicle) -> list[Result]:
        v.control.works[what] = Work()
        v.ask(number, component, 1.0 if number == 526 else first, first)
        return v.ask(number, component, 1.0 if number == 526 else second, second, 1.0)

    return ask


ACCEPTED, REJECTED, DENIED = Result.ACCEPTED, Result.TEMPORARILY_REJECTED, Result.DENIED
UNSUPPORTED, FAILED = Result.UNSUPPORTED, Result.FAILED
RUNNING, CANCELLED = Result.IN_PROGRESS, Result.CANCELLED
SCANNING = Phase.SCANNING

CASES: dict[int, dict[Result, list[Asked]]] = {
    2500: {
        ACCEPTED: [
            plain(2500, CAMERA),
            during(SCANNING, plain(2500, CAMERA)),
            during(Phase.FINALISING, plain(2500, CAMERA)),
        ],
        REJECTED: [refused("start_scan", REJECTED, plain(2500, CAMERA))],
    },
    2501: {
        ACCEPTED: [
            plain(2501, CAMERA),
            during(SCANNING, plain(2501, CAMERA)),
            worked("stop_scan", "ends", 2501, CAMERA),
        ],
        RUNNING: [worked("stop_scan", "runs", 2501, CAMERA)],
    },
    2000: {
        ACCEPTED: [plain(2000, CAMERA, 0, 0, 1, 7), plain(2000, CAMERA, 0, 1, 5)],
        REJECTED: [refused("capture_keyframe", REJECTED, plain(2000, CAMERA, 0, 0, 1, 7))],
        DENIED: [plain(2000, CAMERA, 0, -1, 5), plain(2000, CAMERA, 0, 0.01, 5)],
    },
    2001: {ACCEPTED: [plain(2001, CAMERA)]},
    206: {
        ACCEPTED: [plain(206, CAMERA, 2.5), plain(206, ONBOARD, 0.0, 0, 1)],
        DENIED: [plain(206, CAMERA, -1.0), refused("SR_BASELINE_M", DENIED, plain(206, 191, 3.0))],
    },
    203: {
        ACCEPTED: [plain(203, CAMERA, 0, 0, 0, 0, 1)],
        REJECTED: [refused("capture_keyframe", REJECTED, plain(203, CAMERA, 0, 0, 0, 0, 1))],
        UNSUPPORTED: [plain(203, CAMERA, 0, 1)],
    },
    200: {
        ACCEPTED: [plain(200, CAMERA, 0, 0, 0, 1), plain(200, CAMERA, 0, 0, 0, 0)],
        RUNNING: [worked("stop_scan", "runs", 200, CAMERA, 0, 0, 0, 0)],
        REJECTED: [refused("start_scan", REJECTED, plain(200, CAMERA, 0, 0, 0, 1))],
        DENIED: [plain(200, CAMERA, 0, 0, 0, 9)],
    },
    526: {
        ACCEPTED: [
            disarmed(plain(526, CAMERA, 1, 1)),
            worked("erase_scans", "ends", 526, CAMERA, 1, 1),
        ],
        RUNNING: [worked("erase_scans", "runs", 526, CAMERA, 1, 1)],
        REJECTED: [
            during(SCANNING, plain(526, CAMERA, 1, 1)),
            armed(plain(526, CAMERA, 1, 1)),
            unheard(plain(526, CAMERA, 1, 1)),
            busy("erase_scans", 526, CAMERA, 1, 1),
        ],
        DENIED: [plain(526, CAMERA, 2, 1), plain(526, CAMERA, 1, 0)],
        FAILED: [worked("erase_scans", "fails", 526, CAMERA, 1, 1)],
        CANCELLED: [worked("erase_scans", "cancelled", 526, CAMERA, 1, 1)],
    },
    529: {
        ACCEPTED: [plain(529, CAMERA, 1)],
        REJECTED: [during(SCANNING, plain(529, CAMERA, 1))],
        DENIED: [plain(529, CAMERA, 0)],
    },
    31010: {
        ACCEPTED: [during(SCANNING, plain(31010, ONBOARD, k)) for k in (1, 2, 3, 4, 5, 7, 8)]
        + [plain(31010, ONBOARD, 6), worked("finalise", "ends", 31010, ONBOARD, 5)],
        RUNNING: [
            worked("finalise", "runs", 31010, ONBOARD, 5),
            worked("self_test", "runs", 31010, ONBOARD, 6),
            worked("stop_scan", "runs", 31010, ONBOARD, 8),
        ],
        REJECTED: [
            plain(31010, ONBOARD, 1),
            plain(31010, ONBOARD, 2),
            during(SCANNING, plain(31010, ONBOARD, 6)),
            busy("finalise", 31010, ONBOARD, 5, 6),
        ],
        DENIED: [
            plain(31010, ONBOARD, 0),
            plain(31010, ONBOARD, 9),
            plain(31010, ONBOARD, 4, -5),
            refused("clear_map", DENIED, plain(31010, ONBOARD, 3)),
        ],
        FAILED: [
            worked("self_test", "fails", 31010, ONBOARD, 6),
            worked("finalise", "fails", 31010, ONBOARD, 5),
        ],
        CANCELLED: [worked("finalise", "cancelled", 31010, ONBOARD, 5)],
    },
    530: {ACCEPTED: [plain(530, CAMERA, 0, 1)], DENIED: [plain(530, CAMERA, 0, 0)]},
    246: {
        ACCEPTED: [disarmed(plain(246, ONBOARD, 0, k)) for k in (1, 2)]
        + [disarmed(plain(246, ONBOARD, 0, 0, 1, 191))],
        RUNNING: [plain(246, ONBOARD, 0, 1)],
        REJECTED: [armed(plain(246, ONBOARD, 0, k)) for k in (1, 2)]
        + [armed(plain(246, ONBOARD, 0, 0, 1, 191))]
        + [unheard(plain(246, ONBOARD, 0, k)) for k in (1, 2)],
        DENIED: [plain(246, ONBOARD, 1, 0)],
        FAILED: [refused("power: reboot", FAILED, disarmed(plain(246, ONBOARD, 0, 1)))],
        CANCELLED: [stopped(246, ONBOARD, 0, 1)],
    },
    512: {
        ACCEPTED: [plain(512, CAMERA, k) for k in (259, 260, 261, 262, 271)],
        UNSUPPORTED: [plain(512, CAMERA, 269), plain(512, ONBOARD, 259), plain(512, CAMERA, 5)],
    },
    511: {
        ACCEPTED: [plain(511, CAMERA, k, 1e6) for k in (259, 260, 261, 262, 271)]
        + [plain(511, ONBOARD, 390, -1)],
        DENIED: [plain(511, CAMERA, 262, 100), plain(511, CAMERA, 262, 1e12)],
        UNSUPPORTED: [plain(511, CAMERA, 30, 1e6)],
    },
    510: {
        ACCEPTED: [plain(510, CAMERA, k) for k in (259, 260, 261, 262, 271)],
        UNSUPPORTED: [plain(510, CAMERA, 30)],
    },
    521: {ACCEPTED: [plain(521, CAMERA, 1), plain(521, CAMERA, 0)]},
    522: {ACCEPTED: [plain(522, CAMERA, 1)]},
    525: {ACCEPTED: [plain(525, CAMERA, 0, 1), plain(525, CAMERA, 0, 0)]},
    527: {ACCEPTED: [plain(527, CAMERA, 1)]},
    2504: {ACCEPTED: [], UNSUPPORTED: [plain(2504, CAMERA, 1)]},
    2505: {ACCEPTED: [], UNSUPPORTED: [plain(2505, CAMERA, 1)]},
}


def documented() -> dict[int, set[Result]]:
    """Command to its results, as the page has them."""
    found: dict[int, set[Result]] = {}
    for line in PAGE.read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        numbers = re.findall(r"`[A-Z0-9_]+` (\d+)", cells[0]) if len(cells) == 4 else []
        for number in numbers:
            results = {ACCEPTED}
            for part in cells[3].replace(" (5, 6, 8)", "").split(";"):
                name = part.partition(":")[0].strip().upper().replace(" ", "_")
                results |= {Result[name]} if name else set()
            found[int(number)] = results
    return found


def test_the_page_lists_every_command_and_every_result() -> None:
    page = documented()
    assert set(page) == set(COMMANDS) == set(CASES)
    for number, results in page.items():
        assert results == set(CASES[number]), number


@pytest.mark.parametrize("number", sorted(CASES))
def test_each_result_is_produced(number: int) -> None:
    for result, cases in CASES[number].items():
        for k, ask in enumerate(cases):
            assert ask(Vehicle())[-1:] == [result], (number, result, k)


def test_all_else_is_unsupported_at_once() -> None:
    vehicle = Vehicle()
    for number in (16, 22, 400, 531, 532, 2502, 31011, 65535):
        assert number not in COMMANDS
        for component in (CAMERA, ONBOARD):
            assert vehicle.ask(number, component) == [UNSUPPORTED]
        assert vehicle.ask(number, 0) == []  # somebody else's
    for number, command in COMMANDS.items():
        for component in {CAMERA, ONBOARD} - command.components:
            assert vehicle.ask(number, component) == [UNSUPPORTED]


def test_commands_of_the_table_give_only_results_of_the_page() -> None:
    """Whatever any case makes a command say on the way is on the page as well."""
    page = documented()
    said: set[tuple[int, Result]] = set()
    for results in CASES.values():
        for cases in results.values():
            for ask in cases:
                vehicle = Vehicle()
                ask(vehicle)
                vehicle.later(0.0)
                said |= vehicle.acknowledged
    assert {(n, r) for n, r in said if r not in page[n]} == set()
