"""The link emulator does what it says, and a short trial over it loses nothing."""

from __future__ import annotations

import asyncio
from itertools import pairwise
from pathlib import Path
from unittest.mock import Mock

import pytest

from service.bench.link_emulator import Direction, LinkEmulator, LinkModel

WIRE = 1400 + 52


def test_a_pipe_serialises_at_its_rate_and_delays() -> None:
    pipe = Direction(LinkModel(rate_kbit_s=1000.0, delay_s=0.05), 0.0, 1)
    out = [pipe.send(1400, 0.0) for _ in range(10)]
    for k, at in enumerate(out):
        assert at == pytest.approx((k + 1) * WIRE / 125_000 + 0.05)
    assert pipe.backlog_bytes(0.0) == pytest.approx(10 * WIRE)


def test_a_cut_holds_a_stream_until_tcp_tries_again() -> None:
    model = LinkModel(rate_kbit_s=1000.0, delay_s=0.0, cuts=((1.0, 3.0),))
    stream = Direction(model, 0.0, 1)
    # Sent at 1.5 s, again after 0.2, 0.4, 0.8 and 1.6 s.
    assert stream.resumes(1.5, 0.2) == pytest.approx(1.5 + 0.2 + 0.4 + 0.8 + 1.6)
    assert stream.resumes(0.5, 0.2) == 0.5


def test_loss_has_its_share_and_stalls_a_stream() -> None:
    model = LinkModel(rate_kbit_s=1e6, delay_s=0.1, loss=0.03)
    stream = Direction(model, 0.0, 7)
    late = [k for k in range(5000) if stream.send(100, float(k)) - k > 0.25]
    assert 100 < len(late) < 200


def test_a_stream_with_losses_keeps_its_order_and_its_last_bytes() -> None:
    years_s = 1e8  # a machine that is up for so long has a coarse clock
    at_s: list[float] = []
    plan = Mock(call_at=lambda at, *_: at_s.append(at))
    model = LinkModel(rate_kbit_s=1e6, delay_s=1.0, loss=0.5)
    emulator = LinkEmulator(model, 1, 2, loop=plan, clock=lambda: years_s)

    async def relay() -> None:
        reader = asyncio.StreamReader()
        reader.feed_data(bytes(20 * 1400))
        reader.feed_eof()
        await emulator.relay(reader, Mock(), Direction(model, years_s, model.seed))

    asyncio.run(relay())
    assert len(at_s) == 21  # the end comes after the last bytes
    assert all(before < after for before, after in pairwise(at_s))


def test_the_busiest_window_is_found() -> None:
    pipe = Direction(LinkModel(), 0.0, 1)
    pipe.traffic += [(0.0, 10), (0.9, 20), (1.5, 30), (1.8, 40), (5.0, 5)]
    assert pipe.busiest_second_bytes() == 90
    assert pipe.total_bytes() == 105


def test_a_short_trial_with_a_cut_delivers_everything() -> None:
    pytest.importorskip("zenoh")
    from service.bench.link import Trial, fly

    link = LinkModel(rate_kbit_s=3000.0, delay_s=0.02, loss=0.02, cuts=((2.0, 3.5),))
    outcome = fly(Trial(link, flight_s=5.0, keyframes_hz=3.0, drain_s=60.0))
    assert outcome.made == 45
    assert outcome.delivered == outcome.made
    assert outcome.busiest_share < 1.3


def test_keyframes_of_the_bench_are_what_they_say() -> None:
    import numpy as np

    from service.bench.keyframes import make_keyframe, strip

    frame = make_keyframe()
    assert float(frame.depth.depth_m.min()) > 40 and float(frame.depth.depth_m.max()) < 110
    assert 0.18 < float(np.mean(strip((320, 180)))) < 0.26


def test_delays_of_a_simulated_flight_are_measured_in_the_whole_system(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("zenoh")
    from bench_latency import PLACES, Trial, fly

    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    settings = (
        "compute.backend=cpu", "compute.stereo_width=160", "compute.guide_width=320",
        "fusion.loops=false",
    )  # fmt: skip
    source = "sim:?size=320x180&fps=5&duration_s=15"
    outcome = fly(Trial(source, 15.0, LinkModel(5000.0, 0.02, 0.01), settings))
    delays = outcome.delays_s
    assert all(delays[place] for place in PLACES)
    assert all(delay_s > 0 for place in PLACES for delay_s in delays[place])
    # Each passes one place after the other.
    assert sum(delays["pose at the ground"]) > sum(delays["pose stored on board"])
    stored, came = delays["depth stored on board"], delays["coarse depth at the ground"]
    assert len(came) == len(stored) - outcome.missing
    assert max(came) > min(stored)
    fine_s = delays["fine depth at the ground"]
    assert min(fine_s) > min(stored)
