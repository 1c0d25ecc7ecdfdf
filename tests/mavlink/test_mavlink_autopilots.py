"""Whose vehicle we are on, and which components are never its autopilot."""

from __future__ import annotations

import pytest
from vehicles_around import GENERIC, QUADROTOR, Net, Vehicle

from mavlink.wire.dialect import dialect

S = 1_000_000_000
MS = 1_000_000


# Components that are not autopilots


@pytest.mark.parametrize("kind", [5, 6, 18, 26, 27, 30, 34, 36, 39, 42])
@pytest.mark.parametrize("component", [1, 25, 154])
def test_a_companion_type_is_never_the_autopilot(kind: int, component: int) -> None:
    net = Net()
    net.beat((1, component), kind, GENERIC)
    assert net.presence.autopilot is None and not net.presence.is_disarmed(0)


@pytest.mark.parametrize("component", [100, 154, 158, 191, 195, 220, 249, 251])
def test_a_device_that_calls_itself_a_vehicle_is_not_the_autopilot(component: int) -> None:
    net = Net()
    net.beat((1, component), QUADROTOR, GENERIC)
    assert net.presence.autopilot is None
    net.beat((1, 1), armed=True)
    net.beat((1, component), QUADROTOR, GENERIC, armed=False)
    assert net.presence.autopilot == (1, 1) and net.presence.is_armed


def test_everybody_is_no_vehicle() -> None:
    net = Net()
    net.beat((0, 1), QUADROTOR, GENERIC)
    assert net.presence.autopilot is None and net.presence.system == 1


def test_a_generic_autopilot_is_one() -> None:
    net = Net()
    net.beat((4, 1), QUADROTOR, GENERIC, armed=True)
    assert net.presence.autopilot == (4, 1) and net.presence.is_armed


def test_inav_is_an_autopilot_unless_there_is_another() -> None:
    net = Net()
    net.beat((1, 250), QUADROTOR, GENERIC, armed=True)
    assert net.presence.autopilot == (1, 250) and net.presence.is_armed
    net.beat((1, 1), armed=True)
    net.beat((1, 250), QUADROTOR, GENERIC, armed=False)
    assert net.presence.autopilot == (1, 1) and net.presence.is_armed


def test_another_component_does_not_take_the_place_of_the_autopilot() -> None:
    net = Net()
    net.beat((1, 1), armed=True)
    net.beat((1, 25), QUADROTOR, GENERIC, armed=False)
    assert net.presence.autopilot == (1, 1) and net.presence.is_armed
    later = Net()
    later.beat((1, 25), QUADROTOR, GENERIC, armed=False)
    later.beat((1, 1), armed=True)  # by its number the autopilot
    assert later.presence.autopilot == (1, 1) and later.presence.is_armed


def test_a_gimbal_in_flight_does_not_let_the_companion_reboot() -> None:
    net = Net()
    net.beat((1, 1), armed=True)
    net.beat((1, 154), 26, GENERIC)
    net.beat((1, 154), 0, GENERIC)
    reboot = dialect.MAVLink_command_long_message(1, 191, 246, 0, 0, 1, 0, 0, 0, 0, 0)
    net.feed(reboot, (255, 190))
    acks = [o.message for o in net.companion.take() if o.message.get_type() == "COMMAND_ACK"]
    assert [ack.result for ack in acks] == [1]
    assert net.presence.is_armed


def test_disarmed_is_known_only_for_a_moment() -> None:
    net = Net(given=1)
    assert not net.presence.is_disarmed(0)
    net.beat((1, 1))
    assert net.presence.is_disarmed(net.now_ns - 1)
    assert not net.presence.is_disarmed(net.now_ns)


# Which vehicle is ours


def test_the_vehicle_that_answers_is_ours_though_another_was_heard_first() -> None:
    net = Net(Vehicle(2, chatter=3), Vehicle(7, 0.002))
    net.beat((2, 1))
    assert net.presence.system == 2
    net.wait(7.0)
    assert net.presence.system == 7 and net.presence.autopilot == (7, 1)
    assert net.presence.proven_system == 7
    assert any("Following system 7, not 2" in text for text in net.texts)


def test_the_first_that_is_heard_is_not_certain_before_there_is_evidence() -> None:
    """Else a scan that starts with the motors would start with another vehicle's."""
    net = Net(Vehicle(7, 0.002))
    net.beat((2, 1), armed=True)
    assert net.presence.is_armed and not net.presence.is_certain
    net.beat((2, 1))
    assert not net.presence.is_disarmed(0)
    net.wait(7.0)
    assert net.presence.is_disarmed(net.now_ns - 3 * S)
    assert net.presence.system == 7 and net.presence.is_certain and not net.presence.is_armed
    for known in (Net(given=2), Net(remembered=2)):
        known.beat((2, 1), armed=True)
        assert known.presence.is_armed and known.presence.is_certain


def test_the_nearer_of_two_that_answer_is_ours() -> None:
    net = Net(Vehicle(2, 0.090), Vehicle(7, 0.002))
    net.wait(7.0)
    assert net.presence.autopilot == (7, 1)


def test_the_one_that_says_most_is_ours_where_none_answers() -> None:
    net = Net(Vehicle(2), Vehicle(7, chatter=5))
    net.wait(7.0)
    assert net.presence.autopilot == (7, 1)


def test_telemetry_of_the_wrong_vehicle_is_dropped() -> None:
    net = Net(Vehicle(2, chatter=1), Vehicle(7, 0.002))
    net.wait(2.0)
    assert net.companion.history.last_ns is not None and net.presence.system == 2
    net.wait(5.0)
    assert net.presence.system == 7
    assert net.companion.history.last_ns is None
    # Of system 7 alone: by TIMESYNC it started 7 s ago.
    assert net.companion.autopilot.boot_offset_ns == pytest.approx(7 * S, abs=2 * MS)


def test_two_that_are_alike_are_asked_about_and_none_is_followed() -> None:
    net = Net(Vehicle(5, 0.002), Vehicle(6, 0.002))
    net.wait(10.0)
    assert net.presence.autopilot is None and not net.presence.is_disarmed(0)
    assert [t for t in net.texts if "Several" in t] == [
        "Several autopilots (5, 6): set mavlink.system_id"
    ]
    net.vehicles[0].is_on = False
    net.wait(10.0)
    assert net.presence.autopilot == (6, 1)


def test_the_remembered_vehicle_decides_a_draw_and_is_waited_for() -> None:
    net = Net(Vehicle(2, 0.002), Vehicle(7, 0.002), remembered=7)
    net.beat((2, 1))
    net.wait(10.0)
    assert net.presence.autopilot == (7, 1) and net.systems == {7}
    assert [t for t in net.texts if "system" in t] == []


def test_a_companion_on_another_aircraft_leaves_the_remembered_vehicle() -> None:
    net = Net(Vehicle(3, 0.002), remembered=7)
    net.wait(10.0)
    assert net.presence.autopilot == (3, 1) and net.presence.proven_system == 3


def test_a_proven_vehicle_is_not_left_while_its_autopilot_restarts() -> None:
    net = Net(Vehicle(2, 0.090), Vehicle(7, 0.002))
    net.wait(7.0)
    net.vehicles[1].is_on = False
    net.wait(12.0)
    net.vehicles[1].is_on = True
    net.wait(12.0)
    assert net.presence.autopilot == (7, 1) and net.systems <= {2, 7}
    assert [t for t in net.texts if t == "Following system 2, not 7"] == []


def test_a_wrong_vehicle_is_left_in_the_end_even_when_it_was_proven() -> None:
    net = Net(Vehicle(2, 0.090), Vehicle(7, 0.002))
    net.vehicles[1].is_on = False
    net.wait(10.0)
    assert net.presence.proven_system == 2
    net.vehicles[1].is_on = True
    net.wait(45.0)
    assert net.presence.autopilot == (7, 1)


def test_a_system_that_is_given_is_never_left() -> None:
    net = Net(Vehicle(2, 0.002), given=12)
    net.wait(20.0)
    assert net.presence.system == 12 and net.presence.autopilot is None
    assert net.presence.others(net.now_ns) == [2]


def test_answers_of_strangers_are_ignored() -> None:
    """A system without an autopilot, or another component, may answer TIMESYNC as well."""
    net = Net(Vehicle(2, chatter=3), Vehicle(7, chatter=3))
    for _ in range(100):
        net.wait(0.1)
        for source in ((99, 1), (2, 191)):
            for ts1 in list(net.companion.autopilot.timesync._asked):
                net.feed(dialect.MAVLink_timesync_message(5 * S, ts1), source)
    assert net.presence.autopilot is None  # 2 and 7 are still alike
