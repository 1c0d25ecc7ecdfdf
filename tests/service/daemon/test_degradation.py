"""The ladder: down by measured lag, heat and memory, up again when it passes, never flapping."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.config import ComputeConfig
from service.daemon.load_shedding import (
    CALM_S,
    HEAT_PATIENCE_S,
    LONGEST_CALM_S,
    PATIENCE_S,
    Ladder,
    Level,
    MachineReadings,
    Move,
    lowered,
    strains,
)

CALM = MachineReadings(10, 0, 60, 0, 0.05, 55.0, False, 4000.0)
LATE = replace(CALM, late_views=4)
HOPELESS = replace(CALM, views=20, late_views=19)
HOT = replace(CALM, temperature_c=95.0)


def run(
    ladder: Ladder, readings: Callable[[float], MachineReadings], from_s: float, to_s: float
) -> list[tuple[float, Move]]:
    """Moves with their times, looked at every two seconds."""
    moves = []
    now_s = from_s
    while now_s < to_s:
        move = ladder.update(readings(now_s), now_s)
        if move is not None:
            moves.append((now_s, move))
        now_s += 2.0
    return moves


def test_nothing_happens_while_it_keeps_up() -> None:
    assert run(Ladder(ComputeConfig()), lambda _: CALM, 0.0, 1000.0) == []


def test_a_hiccup_is_borne() -> None:
    hiccup = run(Ladder(ComputeConfig()), lambda s: LATE if 10 <= s <= 13 else CALM, 0.0, 200.0)
    assert hiccup == []


def test_lag_steps_down_one_by_one_but_not_to_recording_alone() -> None:
    moves = run(Ladder(ComputeConfig()), lambda _: LATE, 0.0, 300.0)
    assert [m.level for _, m in moves] == [1, 2, 3]
    assert moves[0][1].text == "Load: lower rate (40 % of the views late)"
    gaps = [b - a for (a, _), (b, _) in pairwise(moves)]
    assert min(gaps) >= PATIENCE_S
    assert [m.level for _, m in run(Ladder(ComputeConfig()), lambda _: HOPELESS, 0.0, 300.0)] == [
        1,
        2,
        3,
        4,
    ]


def test_it_comes_back_when_the_strain_passes() -> None:
    ladder = Ladder(ComputeConfig())
    down = run(ladder, lambda _: HOT, 0.0, 100.0)
    assert [m.level for _, m in down] == [1, 2, 3, 4]
    assert down[0][0] >= HEAT_PATIENCE_S
    warm = replace(CALM, temperature_c=86.0)  # neither too hot nor cool enough
    assert run(ladder, lambda _: warm, 100.0, 400.0) == []
    up = run(ladder, lambda _: CALM, 400.0, 700.0)
    assert [m.level for _, m in up] == [3, 2, 1, 0]
    assert up[0][0] >= 400.0 + CALM_S
    assert up[-1][1].text == "Load: full quality again"
    assert ladder.reason == ""


def test_a_step_up_that_does_not_hold_is_tried_less_and_less_often() -> None:
    ladder = Ladder(ComputeConfig())

    def only_without_full_rate(_: float) -> MachineReadings:
        return LATE if ladder.level is Level.FULL else CALM

    moves = run(ladder, only_without_full_rate, 0.0, 2000.0)
    assert {m.level for _, m in moves} == {Level.FULL, Level.LOWER_RATE}
    ups = [s for s, m in moves if m.level is Level.FULL]
    gaps = [b - a for a, b in pairwise(ups)]
    assert gaps == sorted(gaps)
    assert gaps[-1] > LONGEST_CALM_S
    calm = run(ladder, lambda _: CALM, 2000.0, 3000.0)  # long calm: patience is forgotten
    assert ladder.level is Level.FULL and len(calm) <= 1
    again = run(ladder, lambda s: LATE if s < 3020.0 else CALM, 3000.0, 3150.0)
    assert again[-1][1].level is Level.FULL


def test_memory_goes_straight_to_recording_when_it_is_nearly_gone() -> None:
    short, gone = replace(CALM, memory_free_mib=250.0), replace(CALM, memory_free_mib=100.0)
    assert [m.level for _, m in run(Ladder(ComputeConfig()), lambda _: short, 0.0, 18.0)] == [1, 2]
    moves = run(Ladder(ComputeConfig()), lambda _: gone, 0.0, 20.0)
    assert [(s, m.level) for s, m in moves] == [(0.0, Level.RECORD_ONLY)]
    assert "100 MiB" in moves[0][1].text


def test_throttling_never_ends_the_reconstruction() -> None:
    moves = run(Ladder(ComputeConfig()), lambda _: replace(CALM, throttled=True), 0.0, 500.0)
    assert [m.level for _, m in moves] == [1, 2, 3]


@pytest.mark.parametrize(
    ("readings", "word"),
    [
        (replace(CALM, age_s=2.0), "2.0 s late"),
        (replace(CALM, late_frames=50), "83 % of the images"),
        (replace(CALM, temperature_c=95.0, memory_free_mib=10.0), "memory"),
        (MachineReadings(), ""),
    ],
)
def test_the_reason_is_reported(readings: MachineReadings, word: str) -> None:
    reasons = [strain.reason for strain in strains(readings, ComputeConfig()) if strain.times > 1]
    assert word in reasons[0] if word else not reasons


@given(
    st.lists(
        st.builds(
            MachineReadings,
            st.integers(0, 20),
            st.integers(0, 20),
            st.integers(0, 100),
            st.integers(0, 100),
            st.floats(0, 10),
            st.none() | st.floats(-40, 150),
            st.none() | st.booleans(),
            st.none() | st.floats(0, 8000),
        ),
        max_size=200,
    )
)
def test_any_readings_move_it_by_whole_steps_within_the_ladder(
    series: list[MachineReadings],
) -> None:
    ladder = Ladder(ComputeConfig())
    for i, readings in enumerate(series):
        before = ladder.level
        move = ladder.update(readings, 2.0 * i)
        assert Level.FULL <= ladder.level <= Level.RECORD_ONLY
        if move is None:
            assert ladder.level is before
        elif move.reason:
            assert ladder.level > before
        else:
            assert ladder.level == before - 1


def test_each_step_costs_less_than_the_one_before() -> None:
    full = ComputeConfig()
    assert lowered(full, Level.FULL) == full
    assert lowered(full, Level.LOWER_RATE) == replace(full, pairs=2)
    assert lowered(full, Level.LOWER_RESOLUTION) == replace(full, pairs=2, stereo_width=224)
    assert lowered(full, Level.NO_UPSAMPLING) == replace(
        full, pairs=2, stereo_width=224, upsample=False
    )
    small = ComputeConfig(stereo_width=64, guide_width=64, pairs=1)
    assert lowered(small, Level.LOWER_RESOLUTION) == small


def test_limit_of_the_control_group_is_read(tmp_path: Path) -> None:
    from service.daemon.machine import Machine, read_machine

    def put(name: str, text: str) -> None:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    put("proc/self/cgroup", "0::/system.slice/skyrelief.service\n")
    group = "sys/fs/cgroup/system.slice/skyrelief.service"
    put(f"{group}/memory.max", "max\n")
    put(f"{group}/memory.current", f"{700 << 20}\n")
    assert read_machine(tmp_path, tmp_path).memory_limit_free_mib is None
    put(f"{group}/memory.max", f"{1000 << 20}\n")
    put(f"{group}/memory.stat", f"anon 5\ninactive_file {50 << 20}\n")
    found = read_machine(tmp_path, tmp_path)
    assert found.memory_limit_free_mib == 350.0
    assert found.memory_left_mib == min(350.0, found.memory_free_mib or 350.0)
    assert Machine("m", memory_free_mib=100.0).memory_left_mib == 100.0
    assert Machine("m").memory_left_mib is None
