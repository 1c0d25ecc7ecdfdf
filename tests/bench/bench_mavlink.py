"""MAVLink: parsing, the link's cost and delay, heartbeats while the cores are busy.

Targets: parsing 43,000 messages/s on a core; the link under 5 % of a core at 300 messages/s;
receive to stamp under 1 ms (median); first heartbeat under 1 s after process start, and under
200 ms of jitter while every core is saturated.
"""

from __future__ import annotations

import contextlib
import os
import socket
import statistics
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any

from mavlink.wire.dialect import dialect
from mavlink.wire.framing import Decoder, Framer
from service.bench import BenchOptions, BenchResult

S = 1_000_000_000
MESSAGES = 20_000
RATE_HZ = 300
HEARTBEAT_S = 1.0
SO_TIMESTAMPNS = 35  # Linux
TIMESYNC = (111).to_bytes(3, "little")


def run(options: BenchOptions) -> list[BenchResult]:
    """Every figure; takes about a minute."""
    ours, theirs = parse_rate()
    cost, delay, slow = link_cost_and_delay("cost")
    peer_cost, peer_delay, _ = link_cost_and_delay("peer")
    worst, usual = heartbeat_jitter()
    peer = "pymavlink"
    return [
        BenchResult("parse", ours, "msg/s", 0.0, peer, theirs, 0.0, "aim 43000"),
        BenchResult(
            f"link at {RATE_HZ} msg/s", cost, "% of a core", 0.0, peer, peer_cost, 0.0,
            "aim 5",
        ),
        BenchResult(
            "receive to stamp", delay, "ms", slow - delay, peer, peer_delay, 0.0, "aim 1"
        ),
        BenchResult("first heartbeat", first_heartbeat(False), "s", note="aim 1"),
        BenchResult(
            "first heartbeat, all cores busy", first_heartbeat(True), "s", note="aim 1"
        ),
        BenchResult(
            "heartbeat jitter, all cores busy", worst, "ms",
            note=f"worst; median {usual:.0f}; aim 200",
        ),
    ]  # fmt: skip


def telemetry(count: int) -> list[bytes]:
    """Packets as an autopilot sends them in flight: attitude, position, gimbal, and others."""
    mouth = dialect.MAVLink(None, 1, 1)
    packets: list[bytes] = []
    for k in range(count):
        boot = 1000 + k * 1000 // RATE_HZ
        kinds = (
            dialect.MAVLink_attitude_message(boot, 0.1, 0.05, 1.0, 0.01, 0.0, 0.0),
            dialect.MAVLink_attitude_quaternion_message(boot, 0.9, 0.1, 0.1, 0.1, 0, 0, 0),
            dialect.MAVLink_global_position_int_message(
                boot, 473000000 + k, 85000000, 512000, 62000, 300, 0, 0, 9000
            ),
            dialect.MAVLink_gimbal_device_attitude_status_message(
                0, 0, boot, 44, [0.7, 0.0, -0.7, 0.0], 0, 0, 0, 0
            ),
            dialect.MAVLink_vfr_hud_message(3.0, 3.0, 90, 40, 512.0, 0.0),
        )
        packets.append(bytes(kinds[k % len(kinds)].pack(mouth)))
        mouth.seq = (mouth.seq + 1) % 256
    return packets


def parse_rate() -> tuple[float, float]:
    """Messages/s through our framer and decoder, and through pymavlink's own parser."""
    data = b"".join(telemetry(MESSAGES))
    chunks = [data[i : i + 1024] for i in range(0, len(data), 1024)]

    def ours() -> int:
        framer, decoder = Framer(), Decoder()
        return sum(
            decoder.message(packet) is not None for chunk in chunks for packet in framer.feed(chunk)
        )

    def theirs() -> int:
        parser = dialect.MAVLink(None)
        return sum(len(parser.parse_buffer(chunk) or []) for chunk in chunks)

    return _rate(ours), _rate(theirs)


def _rate(parse: Callable[[], int]) -> float:
    """The best of three, after one for warming up."""
    if parse() != MESSAGES:
        raise RuntimeError("the parser lost messages")
    rates = []
    for _ in range(3):
        start = time.perf_counter()
        parse()
        rates.append(MESSAGES / (time.perf_counter() - start))
    return max(rates)


# The parts below run our side in a process of its own, as on the aircraft.


@contextlib.contextmanager
def vehicle_process(mode: str, seconds: float, port: int) -> Iterator[subprocess.Popen[str]]:
    """Our daemon's MAVLink side in a fresh process that talks to us on a UDP port."""
    command = [sys.executable, __file__, mode, str(port), str(seconds)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        yield process
        process.wait(timeout=seconds + 30.0)
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()


def _socket() -> tuple[socket.socket, int]:
    ear = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    ear.bind(("127.0.0.1", 0))
    ear.settimeout(20.0)
    return ear, int(ear.getsockname()[1])


def link_cost_and_delay(mode: str, seconds: float = 8.0) -> tuple[float, float, float]:
    """(percent of a core, median ms, 95th percentile ms) at 300 messages/s.

    Mode ``cost`` is our vehicle link, ``peer`` pymavlink's own connection, read in a loop.
    """
    ear, port = _socket()
    packets = telemetry(round(RATE_HZ * seconds))
    beat = dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)
    mouth = dialect.MAVLink(None, 1, 1)
    with contextlib.closing(ear), vehicle_process(mode, seconds, port) as process:
        _, peer = ear.recvfrom(65536)
        threading.Thread(target=_drain, args=(ear,), daemon=True).start()
        start = time.monotonic()
        for k, packet in enumerate(packets):
            time.sleep(max(0.0, start + k / RATE_HZ - time.monotonic()))
            if k % RATE_HZ == 0:
                ear.sendto(bytes(beat.pack(mouth)), peer)
            if k % 10 == 0:  # one in ten carries the time at which it was sent
                sent = dialect.MAVLink_timesync_message(1, time.monotonic_ns())
                packet = bytes(sent.pack(mouth))
            ear.sendto(packet, peer)
        output, _ = process.communicate(timeout=seconds + 30.0)
    percent, median, high = (float(word) for word in output.split())
    return percent, median, high


def _drain(ear: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while True:
            ear.recv(65536)


def first_heartbeat(busy: bool) -> float:
    """Seconds from the start of ``skyrelief run`` to its first heartbeat; median of five.

    ``busy`` keeps every core occupied by other processes meanwhile.
    """
    others = [
        subprocess.Popen([sys.executable, "-c", "while True: pass"])
        for _ in range((os.cpu_count() or 1) if busy else 0)
    ]
    try:
        return statistics.median(_first_heartbeat() for _ in range(5))
    finally:
        for other in others:
            other.kill()
            other.wait()


def _first_heartbeat() -> float:
    ear, port = _socket()
    link = f"mavlink.links=udpout:127.0.0.1:{port}"
    command = [sys.executable, "-m", "service.cli", "run", "--set", link, "--set", "health.http="]
    with contextlib.closing(ear):
        start = time.monotonic()
        # Without a camera's name the service says so and ends, long after its first heartbeat.
        with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
            while not any(p.message_id == 0 for p in Framer().feed(ear.recv(65536))):
                pass
            seconds = time.monotonic() - start
            process.wait(timeout=60.0)
    return seconds


def heartbeat_jitter(seconds: float = 15.0) -> tuple[float, float]:
    """(worst, median) deviation in ms of heartbeats from one second while all is busy.

    The vehicle's own process computes as the pipeline does: pure Python, which holds the
    interpreter's lock, and on every core NumPy, which does not.
    """
    ear, port = _socket()
    arrivals: list[float] = []
    with contextlib.closing(ear), vehicle_process("busy", seconds, port) as process:
        ear.settimeout(5.0)
        ear.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        framer = Framer()
        while process.poll() is None:
            with contextlib.suppress(TimeoutError):
                data, arrival = _receive(ear)
                found = framer.feed(data)
                arrivals += [arrival for p in found if (p.message_id, p.component) == (0, 191)]
    gaps = [b - a for a, b in pairwise(arrivals)]
    if len(gaps) < seconds / 2:
        raise RuntimeError(f"only {len(gaps)} heartbeats came in {seconds} s")
    off = [1e3 * abs(gap - HEARTBEAT_S) for gap in gaps]
    return max(off), statistics.median(off)


def _receive(ear: socket.socket) -> tuple[bytes, float]:
    """A datagram and the kernel's own time of its arrival in s: we are kept waiting as well."""
    data, extra, _, _ = ear.recvmsg(65536, 64)
    for level, kind, content in extra:
        if (level, kind) == (socket.SOL_SOCKET, SO_TIMESTAMPNS) and len(content) >= 16:
            seconds, nanoseconds = struct.unpack("@qq", content[:16])
            return data, seconds + nanoseconds * 1e-9
    return data, time.time()


def _burn(done: Any) -> None:
    x = 1.0
    while not done.is_set():
        for _ in range(100_000):
            x = x * 1.0000001 + 1e-9


# The vehicle's process.


def _vehicle(mode: str, port: int, seconds: float) -> None:
    from mavlink.component.control import NoScans
    from mavlink.component.presence import Health
    from mavlink.component.vehicle import VehicleConfig, VehicleLink

    vehicle = VehicleLink(VehicleConfig(links=(f"udpout:127.0.0.1:{port}",)), NoScans())
    vehicle.start()
    vehicle.set_health(Health.STANDBY)
    if mode == "cost":
        _measure_cost(vehicle, seconds)
    else:
        stop = threading.Event()
        busy = [threading.Thread(target=work, args=(stop,), daemon=True) for work in _work(mode)]
        for thread in busy:
            thread.start()
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            vehicle.set_health(Health.ACTIVE)
            time.sleep(0.1)
        stop.set()
        for thread in busy:
            thread.join()
    vehicle.stop()


def _work(mode: str) -> list[Callable[[Any], None]]:
    return [_burn, *[_multiply] * (os.cpu_count() or 1)] if mode == "busy" else []


def _multiply(stop: threading.Event) -> None:
    import numpy as np

    a = np.random.default_rng(0).random((800, 800))
    while not stop.is_set():
        a = a @ a
        a /= a.max()


def _measure_cost(vehicle: Any, seconds: float) -> None:
    """Print the share of a core that the links cost, and the delay from sending to the stamp."""
    from mavlink.component.presence import Health

    delays: list[float] = []
    link = vehicle._links._links[0]
    inner = link.on_data

    def timed(data: bytes, now_ns: int) -> None:
        if data[7:10] == TIMESYNC:
            payload = data[10 : 10 + data[1]].ljust(16, b"\0")
            delays.append((now_ns - int.from_bytes(payload[8:], "little")) * 1e-6)
        inner(data, now_ns)

    link.on_data = timed
    _report(delays, seconds, lambda: vehicle.set_health(Health.ACTIVE))


def _peer(port: int, seconds: float) -> None:
    """pymavlink's connection in a loop, as its users write it."""
    from pymavlink import mavutil  # type: ignore[import-untyped]

    link = mavutil.mavlink_connection(f"udpout:127.0.0.1:{port}", dialect="ardupilotmega")
    link.mav.heartbeat_send(18, 8, 0, 0, 4)
    delays: list[float] = []

    def read() -> None:
        while True:
            message = link.recv_match(blocking=True)
            now_ns = time.monotonic_ns()
            if message is not None and message.get_type() == "TIMESYNC":
                delays.append((now_ns - message.ts1) * 1e-6)

    threading.Thread(target=read, daemon=True).start()
    _report(delays, seconds, lambda: None)


def _report(delays: list[float], seconds: float, confirm: Callable[[], None]) -> None:
    until = time.monotonic() + 5.0
    while not delays and time.monotonic() < until:
        time.sleep(0.01)
    wall, cpu = time.monotonic(), time.process_time()
    while time.monotonic() - wall < seconds - 1.0:
        confirm()
        time.sleep(0.5)
    share = 100.0 * (time.process_time() - cpu) / (time.monotonic() - wall)
    taken = sorted(delays)
    print(share, statistics.median(taken), taken[round(0.95 * (len(taken) - 1))])


if __name__ == "__main__":
    if sys.argv[1] == "peer":
        _peer(int(sys.argv[2]), float(sys.argv[3]))
    else:
        _vehicle(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))
