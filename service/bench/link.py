"""``skyrelief bench link``: the datalink over emulated radios, and a fleet into one ground.

The trial: 1 Mbit/s, 100 ms each way, 3 % loss, a cut of 20 s, ten keyframes a second, which is
more than the link carries. The fleet: ten such drones with 1 Mbit/s each. Drone and ground run
in this process, over real sockets and Zenoh, with the emulator between them.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from service.bench import BenchOptions, BenchResult
from service.bench.keyframes import make_keyframe, strip
from service.bench.link_emulator import LinkEmulator, LinkModel
from service.config import DatalinkConfig
from service.ground.drone import ReceivedScan
from service.ground.receiver import Receiver, ReceiverConfig
from service.listener import free_ports
from service.stream import codec
from service.stream.link import DatalinkSender
from service.stream.records import PoseRecord, ScanHeader, pack_pose
from service.stream.session import SessionConfig, zenoh_config
from service.stream.store import ScanStore

SIZE_PX = (320, 180)
SHARE = 0.65
SETTLE_S = 3.0  # time after a cut that is reported on its own: TCP and Zenoh find each other again
PATIENCE_S = 20.0  # how long drone and ground may take to find each other before take-off


@dataclass(frozen=True, slots=True)
class Trial:
    link: LinkModel
    flight_s: float = 45.0
    keyframes_hz: float = 10.0
    drones: int = 1
    drain_s: float = 200.0


KINDS = (("pose", "poses"), ("k0", "coarse layers"), ("k1", "fine layers"))
RADIO = Trial(LinkModel(1000.0, 0.1, 0.03, ((8.0, 28.0),)), flight_s=40.0)
FLEET = Trial(LinkModel(1000.0, 0.05, 0.0), flight_s=12.0, drones=10)

Times = dict[tuple[str, str, int], float]
"""When the records of a drone, of a kind and by their number, were made, or came."""

Row = tuple[str, float, str]  # a figure, its value and unit


@dataclass(frozen=True, slots=True)
class Outcome:
    delivered: int
    made: int
    busiest_share: float  # busiest second over the budget, on the wire
    rows: list[Row]  # these and all other figures; latencies are those while the link was up


def run(options: BenchOptions) -> list[BenchResult]:
    """The trial against plain Zenoh puts over the same link, and the fleet."""
    peer = {what: value for what, value, _ in fly_plain(RADIO).rows}
    return [
        BenchResult(
            what, value, unit, name=name, peer="plain Zenoh put" if what in theirs else "",
            peer_value=theirs.get(what),
        )
        for name, trial, theirs in (("link", RADIO, peer), ("link fleet of ten", FLEET, {}))
        for what, value, unit in fly(trial).rows
    ]  # fmt: skip


def fly(trial: Trial) -> Outcome:
    """Run a trial from take-off until the ground has everything or ``drain_s`` is over."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as open_now:
        (ground_port,) = free_ports(1)
        session = SessionConfig(mode="router", listen=(f"tcp/127.0.0.1:{ground_port}",))
        ground = _WatchedReceiver(ReceiverConfig(Path(folder) / "ground", session))
        ground.start()
        open_now.callback(ground.close)
        drones = [
            _switch_on(trial, Path(folder), k, ground_port, open_now) for k in range(trial.drones)
        ]
        found_s = max(_found_s(sender) for _, sender, _ in drones)
        began, cpu = time.monotonic(), time.process_time()
        for _, _, emulator in drones:
            emulator.take_off(began)
        made = _produce(trial, [store for store, _, _ in drones], began)
        cpu_share = (time.process_time() - cpu) / (time.monotonic() - began)
        shares = [_coarse_share(made, ground.came, store.header.drone) for store, _, _ in drones]
        landed = time.monotonic()
        for store, _, _ in drones:
            store.finish({})
        for _, sender, _ in drones:
            sender.drain(max(0.0, trial.drain_s - (time.monotonic() - landed)))
        drain_s = time.monotonic() - landed
        emulators = [emulator for _, _, emulator in drones]
        wire = sum(emulator.up.total_bytes() for emulator in emulators)
        stored = sum(store.chunk_bytes for store, _, _ in drones)
        outcome = _outcome(trial, emulators, made, ground.came)
        twice = sum(entry["duplicates"] for entry in ground.progress())
        outcome.rows.extend([
            ("drone and ground find each other after", found_s, "s"),
            ("least served drone at the flight's end, coarse layers", 100 * min(shares), "%"),
            ("bytes on the wire per byte stored", wire / max(1, stored), ""),
            ("records that came twice", float(twice), ""),
            ("time to fetch the rest after the flight", drain_s, "s"),
            ("processor in flight: encoder, drone, ground and link", 100 * cpu_share,
             "% of a core"),
            *_after_cuts(trial, made, ground.came, began),
        ])  # fmt: skip
        return outcome


def _outcome(trial: Trial, emulators: Sequence[LinkEmulator], made: Times, came: Times) -> Outcome:
    """What every transport is measured by: share delivered, busiest second, latencies."""
    latency: dict[str, list[float]] = {}
    for item, at in made.items():
        if item in came and _is_up(trial.link, at - emulators[0].started):
            latency.setdefault(item[1], []).append(came[item] - at)
    budget = trial.link.rate_kbit_s * 125 * SHARE
    busiest = max(emulator.up.busiest_second_bytes() for emulator in emulators) / budget
    delivered = sum(item in came for item in made)
    return Outcome(delivered, len(made), busiest, [
        ("delivered of what was made", 100 * delivered / len(made), "%"),
        ("busiest second on the wire, of the budget", 100 * busiest, "%"),
        *(
            (f"latency of {name}, {word}", float(np.percentile(latency[kind], percent)), "s")
            for kind, name in KINDS if kind in latency
            for word, percent in (("median", 50), ("95 %", 95), ("worst", 100))
        ),
    ])  # fmt: skip


def _after_cuts(trial: Trial, made: Times, came: Times, began: float) -> list[Row]:
    """How soon new coarse layers come again after a cut."""
    settling, back = [], []
    for _, last in trial.link.cuts:
        for item, at in made.items():
            if item[1] == "k0" and item in came and last <= at - began < last + SETTLE_S:
                settling.append(came[item] - at)
                back.append(came[item] - began - last)
    if not settling:
        return []
    what = f"latency of coarse layers of the first {SETTLE_S:.0f} s after it, worst"
    return [
        ("from a cut's end to the next coarse layer", min(back), "s"),
        (what, max(settling), "s"),
    ]


def fly_plain(trial: Trial) -> Outcome:
    """The same data put on Zenoh at once: no store, no budget, default settings."""
    import zenoh

    ground_port, port = free_ports(2)
    came: Times = {}

    def on_sample(sample: zenoh.Sample) -> None:
        _, kind, number = str(sample.key_expr).split("/")
        came.setdefault(("", kind, int(number)), time.monotonic())

    listen = (f"tcp/127.0.0.1:{ground_port}",)
    ground = zenoh.open(zenoh_config(SessionConfig(mode="router", listen=listen)))
    ground.declare_subscriber("bench/*/*", on_sample)
    emulator = LinkEmulator(trial.link, port, ground_port)
    emulator.start()
    emulator.take_off(time.monotonic())
    plain = zenoh.Config()
    for key, value in (
        ("mode", "client"),
        ("connect/endpoints", [f"tcp/127.0.0.1:{port}"]),
        ("scouting/multicast/enabled", False),
        ("transport/shared_memory/enabled", False),
    ):
        plain.insert_json5(key, json.dumps(value))
    drone = zenoh.open(plain)
    made: Times = {}
    pose = pack_pose(PoseRecord(0, np.eye(4), np.eye(6)))
    for seq, layers in _keyframes(trial, time.monotonic()):
        now = time.monotonic()
        for kind, data in (("pose", pose), ("k0", layers[0]), ("k1", layers[1])):
            made["", kind, seq] = now
            drone.put(f"bench/{kind}/{seq}", data)
    landed = time.monotonic()
    while time.monotonic() - landed < 60.0 and (
        time.monotonic() - max(came.values(), default=landed) < 10.0
    ):
        time.sleep(0.2)
    drone.close()
    emulator.close()
    ground.close()
    return _outcome(trial, [emulator], made, came)


def _found_s(sender: DatalinkSender) -> float:
    """Seconds until the drone has heard its ground station."""
    began = time.monotonic()
    while not sender.progress.listened and time.monotonic() - began < PATIENCE_S:
        time.sleep(0.02)
    return time.monotonic() - began


def _switch_on(
    trial: Trial, folder: Path, number: int, ground_port: int, open_now: ExitStack
) -> tuple[ScanStore, DatalinkSender, LinkEmulator]:
    (port,) = free_ports(1)
    emulator = LinkEmulator(replace(trial.link, seed=number), port, ground_port)
    emulator.start()
    name = f"drone-{number}"
    store = ScanStore.create(folder / name / "scan.db", ScanHeader("scan", name, 1))
    sender = DatalinkSender(store, DatalinkConfig(
        connect=(f"tcp/127.0.0.1:{port}",), budget_kbit_s=trial.link.rate_kbit_s, share=SHARE
    ))  # fmt: skip
    for close in (store.close, emulator.close, sender.close):  # called from the last to the first
        open_now.callback(close)
    return store, sender, emulator


def _keyframes(trial: Trial, began: float) -> Iterator[tuple[int, Sequence[bytes]]]:
    """Number and coded layers of keyframes with 80 % overlap, at the trial's rate."""
    patterns = [make_keyframe(k, SIZE_PX, strip(SIZE_PX, 20 + k), seed=1 + k) for k in range(4)]
    for seq in range(round(trial.flight_s * trial.keyframes_hz)):
        time.sleep(max(0.0, began + seq / trial.keyframes_hz - time.monotonic()))
        yield seq, codec.encode(replace(patterns[seq % 4], seq=seq), time.time_ns())


def _produce(trial: Trial, stores: Sequence[ScanStore], began: float) -> Times:
    """Store the keyframes, and a pose each."""
    made: Times = {}
    for seq, layers in _keyframes(trial, began):
        for store in stores:
            now, name = time.monotonic(), store.header.drone
            made[name, "k0", seq] = made[name, "k1", seq] = now
            store.add_keyframe(seq, layers)
            pose = PoseRecord(time.time_ns(), np.eye(4), np.eye(6), keyframe_seq=seq)
            made[name, "pose", store.add_pose(pose)] = now
    return made


class _WatchedReceiver(Receiver):
    """A receiver that notes when each item is stored, and writes no deliverables."""

    def __init__(self, config: ReceiverConfig) -> None:
        super().__init__(config, deliver=lambda _: None, opened=self._listen)
        self.came: Times = {}

    def _listen(self, scan: ReceivedScan) -> None:
        def came(kind: str, number: int) -> None:
            self.came.setdefault((scan.drone, kind, number), time.monotonic())

        scan.intake.store.listen(came)


def _coarse_share(made: Times, came: Times, drone: str) -> float:
    coarse = [item for item in made if item[:2] == (drone, "k0")]
    return sum(item in came for item in coarse) / max(1, len(coarse))


def _is_up(link: LinkModel, at_s: float) -> bool:
    """Whether something captured then could travel: no cut just before or soon after."""
    return not any(first - 1.0 <= at_s < last + SETTLE_S for first, last in link.cuts)
