"""Range sets against Python's own sets."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from service.stream.ranges import (
    MAX_NUMBER,
    MAX_RANGES,
    RangeSet,
    ranges_from_pairs,
    ranges_from_text,
)

NUMBERS = st.sets(st.integers(0, 40))


@given(NUMBERS, NUMBERS)
def test_difference_is_that_of_sets(a: set[int], b: set[int]) -> None:
    difference = RangeSet.of(a) - RangeSet.of(b)
    assert set(difference) == a - b
    assert difference == RangeSet.of(a - b)


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 30)), max_size=60))
def test_adding_and_discarding_is_that_of_sets(steps: list[tuple[bool, int]]) -> None:
    ranges, plain = RangeSet(), set[int]()
    for put, number in steps:
        if put:
            ranges.add(number)
            plain.add(number)
        else:
            ranges.discard(number)
            plain.discard(number)
        assert list(ranges) == sorted(plain)
        assert ranges == RangeSet.of(plain) and len(ranges) == len(plain)
        assert (number in ranges) == (number in plain)
    assert list(ranges.newest_first()) == sorted(plain, reverse=True)


@given(NUMBERS)
def test_text_and_pairs_round_trip(numbers: set[int]) -> None:
    ranges = RangeSet.of(numbers)
    assert ranges_from_pairs([list(pair) for pair in ranges.pairs()]) == ranges
    if numbers:
        assert ranges_from_text(ranges.text()) == ranges


@given(st.text(max_size=30) | st.text("0123456789,-", max_size=30))
def test_any_text_gives_ranges_or_none(text: str) -> None:
    ranges = ranges_from_text(text)
    assert ranges is None or ranges_from_text(ranges.text()) == ranges


def test_foreign_json_gives_none() -> None:
    for raw in (
        None,
        3,
        [3],
        [[1]],
        [[2, 1]],
        [[-1, 2]],
        [["a", "b"]],
        [[0, 1 << 40]],
        [[True, 1]],
    ):
        assert ranges_from_pairs(raw) is None


def test_largest_numbers_are_held_and_larger_ones_refused() -> None:
    last = RangeSet([(MAX_NUMBER - 1, MAX_NUMBER)])
    assert ranges_from_text(last.text()) == last and last.last == MAX_NUMBER
    assert (RangeSet([(0, MAX_NUMBER)]) - last).pairs() == [(0, MAX_NUMBER - 2)]
    assert ranges_from_text(f"{MAX_NUMBER + 1}") is None


def test_a_range_without_its_end_is_none() -> None:
    assert ranges_from_text("5") == RangeSet([(5, 5)])
    for text in ("5-", "-5", "5-4", "5\n", "5,", ""):
        assert ranges_from_text(text) is None, text


def test_a_message_holds_the_newest_of_too_many_ranges() -> None:
    many = RangeSet.of(range(0, 2 * (MAX_RANGES + 10), 2))
    assert many.pairs() == [(n, n) for n in list(many)[-MAX_RANGES:]]
    assert ranges_from_text(many.text()) is None
    most = RangeSet(many.pairs())
    assert ranges_from_text(most.text()) == most
