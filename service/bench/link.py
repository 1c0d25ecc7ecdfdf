"""``skyrelief bench link``: the datalink over emulated radios, and a fleet into one ground.

The trial: 1 Mbit/s, 100 ms each way, 3 % loss, a cut of 20 s, ten keyframes a second, which is
more than the link carries. The fleet: ten such drones with 1 Mbit/s each. Drone and ground run
in this process, over real sockets and Zenoh, with the emulator between them.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from service.bench import BenchOptions, BenchResult
from service.bench.keyframes import make_keyframe, strip
from service.bench.link_emulator import LinkEmulator, LinkModel
from service.config import DatalinkConfig
from service.ground.received import ReceivedScan
from service.ground.receiver import Receiver, ReceiverConfig
from service.listener import free_ports
from service.stream import codec
from service.stream.link import DatalinkSender
from service.stream.records import PoseRecord, ScanHeader, pack_pose
from service.stream.session import SessionConfig, zenoh_config
from service.stream.store import ScanStore

SIZE_PX = (320, 180)
SHARE = 0.65
SETTLE_S = 3.0
"""Time after a cut that is reported on its own: TCP and Zenoh find each other again."""
PATIENCE_S = 20.0
"""How long drone and ground may take to find each other before take-off."""


@dataclass(frozen=True, slots=True)
class Trial:
    """A trial: scan and link."""

    link: LinkModel
    flight_s: float = 45.0
    keyframes_hz: float = 10.0
    drones: int = 1
    drain_s: float = 200.0


KINDS = (("pose", "poses"), ("k0", "coarse layers"), ("k1", "fine layers"))
DELIVERED = "delivered of what was made"
BUSIEST = "busiest second on the wire, of the budget"

RADIO = Trial(LinkModel(1000.0, 0.1, 0.03, ((8.0, 28.0),)), flight_s=40.0)
FLEET = Trial(LinkModel(1000.0, 0.05, 0.0), flight_s=12.0, drones=10)


@dataclass(slots=True, eq=False)
class _Drone:
    store: ScanStore
    sender: DatalinkSender
    emulator: LinkEmulator
    found_s: float = 0.0  # from switching on until a ground station was heard
    made: dict[tuple[str, int], float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a trial; latencies in seconds, per kind, while the link was up."""

    delivered: int
    made: int
    min_share: float  # of the drone that got through least, when the flight ended
    latency_s: dict[str, list[float]]
    busiest_share: float  # busiest second over the budget, on the wire
    sent_over_stored: float
    duplicates: int
    drain_s: float
    cpu_share: float  # of one core in flight: encoder, drones, grounds and emulators together
    found_s: float = 0.0  # from switching on until the last drone heard its ground
    settling_s: list[float] = field(default_factory=list)
    """Latency of the coarse layers made in the first SETTLE_S after a cut."""
    back_s: float = float("nan")  # from a cut's end to the first new coarse layer at the ground


def run(options: BenchOptions) -> list[BenchResult]:
    """The trial against plain Zenoh puts over the same link, and the fleet."""
    plain = fly_plain(RADIO)
    peer = {
        DELIVERED: 100 * plain.delivered / plain.made,
        BUSIEST: 100 * plain.busiest_share,
        **{
            what: value
            for kind, name in KINDS
            for what, value in _latencies(name, plain.latency_s.get(kind, []))
        },
    }
    return [*_report("link", fly(RADIO), peer), *_report("link fleet of ten", fly(FLEET), {})]


def _latencies(what: str, latencies: list[float]) -> list[tuple[str, float]]:
    if not latencies:
        return []
    return [
        (f"latency of {what}, median", float(np.median(latencies))),
        (f"latency of {what}, 95 %", float(np.percentile(latencies, 95))),
        (f"latency of {what}, worst", max(latencies)),
    ]


def _report(name: str, outcome: Outcome, peer: dict[str, float]) -> list[BenchResult]:
    rows = [
        (DELIVERED, 100 * outcome.delivered / outcome.made, "%"),
        ("drone and ground find each other after", outcome.found_s, "s"),
        ("least served drone at the flight's end, coarse layers", 100 * outcome.min_share, "%"),
        (BUSIEST, 100 * outcome.busiest_share, "%"),
        ("bytes on the wire per byte stored", outcome.sent_over_stored, ""),
        ("records that came twice", float(outcome.duplicates), ""),
        ("time to fetch the rest after the flight", outcome.drain_s, "s"),
        (
            "processor in flight: encoder, drone, ground and link",
            100 * outcome.cpu_share,
            "% of a core",
        ),
    ]
    for kind, what in KINDS:
        rows += [(w, v, "s") for w, v in _latencies(what, outcome.latency_s.get(kind, []))]
    if outcome.settling_s:
        rows += [
            ("from a cut's end to the next coarse layer", outcome.back_s, "s"),
            (
                f"latency of coarse layers of the first {SETTLE_S:.0f} s after it, worst",
                max(outcome.settling_s),
                "s",
            ),
        ]
    return [
        BenchResult(
            what,
            value,
            unit,
            name=name,
            peer="plain Zenoh put" if what in peer else "",
            peer_value=peer.get(what),
        )
        for what, value, unit in rows
    ]


def fly(trial: Trial) -> Outcome:
    """Run a trial from take-off until the ground has everything or ``drain_s`` is over."""
    with tempfile.TemporaryDirectory() as folder:
        return _fly(trial, Path(folder))


def _fly(trial: Trial, folder: Path) -> Outcome:
    (ground_port,) = free_ports(1)
    session = SessionConfig(mode="router", listen=(f"tcp/127.0.0.1:{ground_port}",))
    ground = _WatchedReceiver(ReceiverConfig(folder / "ground", session))
    ground.start()
    drones = [_switch_on(trial, folder, k, ground_port) for k in range(trial.drones)]
    for drone in drones:
        _find(drone)
    began, cpu = time.monotonic(), time.process_time()
    for drone in drones:
        drone.emulator.take_off(began)
    _produce(trial, drones, began)
    cpu_share = (time.process_time() - cpu) / (time.monotonic() - began)
    least = min(_coarse_share(drone, ground) for drone in drones)
    landed = time.monotonic()
    for drone in drones:
        drone.store.finish({})
    for drone in drones:
        drone.sender.drain(max(0.0, trial.drain_s - (time.monotonic() - landed)))
    ended = time.monotonic()
    outcome = _outcome(trial, drones, ground, least, ended - landed, cpu_share)
    for drone in drones:
        drone.sender.close()
        drone.emulator.close()
        drone.store.close()
    ground.close()
    return outcome


def fly_plain(trial: Trial) -> Outcome:
    """The same data put on Zenoh at once: no store, no budget, default settings."""
    import zenoh

    ground_port, port = free_ports(2)
    came: dict[tuple[str, int], float] = {}

    def on_sample(sample: zenoh.Sample) -> None:
        _, kind, number = str(sample.key_expr).split("/")
        came.setdefault((kind, int(number)), time.monotonic())

    endpoints = f"tcp/127.0.0.1:{ground_port}", f"tcp/127.0.0.1:{port}"
    ground = zenoh.open(zenoh_config(SessionConfig(mode="router", listen=endpoints[:1])))
    ground.declare_subscriber("bench/*/*", on_sample)
    emulator = LinkEmulator(trial.link, port, ground_port)
    emulator.start()
    emulator.take_off(time.monotonic())
    plain = zenoh.Config()
    plain.insert_json5("mode", '"client"')
    plain.insert_json5("connect/endpoints", f'["{endpoints[1]}"]')
    plain.insert_json5("scouting/multicast/enabled", "false")
    plain.insert_json5("transport/shared_memory/enabled", "false")
    drone = zenoh.open(plain)
    made: dict[tuple[str, int], float] = {}
    pose = pack_pose(PoseRecord(0, np.eye(4), np.eye(6)))
    began, cpu = time.monotonic(), time.process_time()
    for seq, layers in _keyframes(trial, began):
        now = time.monotonic()
        for kind, data in (("pose", pose), ("k0", layers[0]), ("k1", layers[1])):
            made[kind, seq] = now
            drone.put(f"bench/{kind}/{seq}", data)
    landed = time.monotonic()
    while time.monotonic() - landed < 60.0 and (
        time.monotonic() - max(came.values(), default=landed) < 10.0
    ):
        time.sleep(0.2)
    ended = time.monotonic()
    drone.close()
    emulator.close()
    ground.close()
    latency: dict[str, list[float]] = {}
    for item, at in came.items():
        if _is_up(trial.link, made[item] - emulator.started):
            latency.setdefault(item[0], []).append(at - made[item])
    return Outcome(
        delivered=len(came),
        made=len(made),
        min_share=sum(kind == "k0" for kind, _ in came) / (len(made) / 3),
        latency_s=latency,
        busiest_share=emulator.up.busiest_window_bytes() / (trial.link.rate_kbit_s * 125 * SHARE),
        sent_over_stored=0.0,
        duplicates=0,
        drain_s=ended - landed,
        cpu_share=(time.process_time() - cpu) / (ended - began),
    )


def _find(drone: _Drone) -> None:
    """Wait until the drone has heard its ground station."""
    began = time.monotonic()
    while not drone.sender.progress.listened and time.monotonic() - began < PATIENCE_S:
        time.sleep(0.02)
    drone.found_s = time.monotonic() - began


def _switch_on(trial: Trial, folder: Path, number: int, ground_port: int) -> _Drone:
    (port,) = free_ports(1)
    emulator = LinkEmulator(replace(trial.link, seed=number), port, ground_port)
    emulator.start()
    name = f"drone-{number}"
    store = ScanStore.create(folder / name / "scan.db", ScanHeader("scan", name, 1))
    config = DatalinkConfig(
        connect=(f"tcp/127.0.0.1:{port}",), budget_kbit_s=trial.link.rate_kbit_s, share=SHARE
    )
    return _Drone(store, DatalinkSender(store, config), emulator)


def _keyframes(trial: Trial, began: float) -> Iterator[tuple[int, Sequence[bytes]]]:
    """Number and coded layers of keyframes with 80 % overlap, at the trial's rate."""
    patterns = [make_keyframe(k, SIZE_PX, strip(SIZE_PX, 20 + k), seed=1 + k) for k in range(4)]
    for seq in range(round(trial.flight_s * trial.keyframes_hz)):
        time.sleep(max(0.0, began + seq / trial.keyframes_hz - time.monotonic()))
        yield seq, codec.encode(replace(patterns[seq % 4], seq=seq), time.time_ns())


def _produce(trial: Trial, drones: Sequence[_Drone], began: float) -> None:
    """Store the keyframes, and a pose each."""
    for seq, layers in _keyframes(trial, began):
        for drone in drones:
            now = time.monotonic()
            drone.made["k0", seq] = drone.made["k1", seq] = now
            drone.store.add_keyframe(seq, layers)
            pose = PoseRecord(time.time_ns(), np.eye(4), np.eye(6), keyframe_seq=seq)
            drone.made["pose", drone.store.add_pose(pose)] = now


class _WatchedReceiver(Receiver):
    """A receiver that notes when each item is stored, and writes no deliverables."""

    def __init__(self, config: ReceiverConfig) -> None:
        super().__init__(config, deliver=lambda _: None, opened=self._listen)
        self.came: dict[tuple[str, str, int], float] = {}

    def _listen(self, scan: ReceivedScan) -> None:
        def came(kind: str, number: int) -> None:
            self.came.setdefault((scan.drone, kind, number), time.monotonic())

        scan.intake.store.listen(came)


def _coarse_share(drone: _Drone, ground: _WatchedReceiver) -> float:
    name = drone.store.header.drone
    coarse = [number for kind, number in drone.made if kind == "k0"]
    return sum((name, "k0", number) in ground.came for number in coarse) / max(1, len(coarse))


def _outcome(
    trial: Trial,
    drones: Sequence[_Drone],
    ground: _WatchedReceiver,
    least: float,
    drain_s: float,
    cpu_share: float,
) -> Outcome:
    latency: dict[str, list[float]] = {}
    settling: list[float] = []
    back = [float("nan")]
    delivered = 0
    for drone in drones:
        name = drone.store.header.drone
        for (kind, number), at in drone.made.items():
            came = ground.came.get((name, kind, number))
            if came is None:
                continue
            delivered += 1
            made_s = at - drone.emulator.started
            if _is_up(trial.link, made_s):
                latency.setdefault(kind, []).append(came - at)
            cuts = (last for _, last in trial.link.cuts if last <= made_s < last + SETTLE_S)
            ended = next(cuts, None)  # when the cut ended that it came soon after
            if kind == "k0" and ended is not None:
                settling.append(came - at)
                back.append(came - drone.emulator.started - ended)
    budget = trial.link.rate_kbit_s * 125 * SHARE
    wire = sum(drone.emulator.up.total_bytes() for drone in drones)
    stored = sum(drone.store.chunk_bytes for drone in drones)
    return Outcome(
        delivered=delivered,
        made=sum(len(drone.made) for drone in drones),
        min_share=least,
        latency_s=latency,
        busiest_share=max(d.emulator.up.busiest_window_bytes() for d in drones) / budget,
        sent_over_stored=wire / max(1, stored),
        duplicates=sum(entry["duplicates"] for entry in ground.progress()),
        drain_s=drain_s,
        cpu_share=cpu_share,
        found_s=max(drone.found_s for drone in drones),
        settling_s=settling,
        back_s=float(np.nanmin(back)) if settling else float("nan"),
    )


def _is_up(link: LinkModel, at_s: float) -> bool:
    """Whether something captured then could travel: no cut just before or soon after."""
    return not any(first - 1.0 <= at_s < last + SETTLE_S for first, last in link.cuts)
