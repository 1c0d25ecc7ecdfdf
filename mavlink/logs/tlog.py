"""Telemetry logs of ground stations: 8 bytes of unix microseconds before each packet."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mavlink.autopilots import is_autopilot
from mavlink.clock import BootCounter, BootFit, fit_boot
from mavlink.decode import READERS, decode
from mavlink.framing import Decoder, Packet, check_packet, packet_length
from mavlink.history import HistoryConfig, VehicleHistory
from mavlink.logs import TelemetryLog, finish
from mavlink.samples import OF_AUTOPILOT, AttitudeSample, Sample
from mavlink.wire import numbers_of

STAMP = 8
BLOCK = 1 << 16
LATEST_USEC = 4_102_444_800 * 10**6  # the year 2100
STEP_USEC = 3_600 * 10**6  # a longer way between two packets wants confirmation
HEARTBEAT = 0

WANTED = numbers_of(READERS)


@dataclass(slots=True)
class _Stream:
    """Samples of one sender (system, component) in one boot session."""

    stamps: list[int] = field(default_factory=list)
    samples: list[Sample] = field(default_factory=list)
    boots: list[float | None] = field(default_factory=list)


def packets(file: BinaryIO, counts: Counter[str]) -> Iterator[tuple[int, Packet]]:
    """(unix ns, packet) for each packet of a log; damage is skipped and counted in bytes."""
    buffer, at, last_usec, ended = bytearray(), 0, None, False
    while True:
        length = packet_length(buffer, at + STAMP) if len(buffer) > at + STAMP else None
        if length is None or at + STAMP + length > len(buffer):
            if not ended:
                del buffer[:at]
                at = 0
                block = file.read(BLOCK)
                buffer += block
                ended = not block
                continue
            if at >= len(buffer):
                return
            length = 0  # a torn end
        usec = int.from_bytes(buffer[at : at + STAMP], "big")
        if length and usec < LATEST_USEC:
            end = at + STAMP + length
            packet = check_packet(bytes(buffer[at + STAMP : end]))
            if packet is not None and _stamp_stands(packet, usec, last_usec, buffer, end):
                last_usec, at = usec, end
                yield usec * 1000, packet
                continue
            counts["bad_checksums"] += 1
        counts["skipped_bytes"] += 1
        at += 1


def _stamp_stands(
    packet: Packet, usec: int, last_usec: int | None, buffer: bytearray, end: int
) -> bool:
    """True when the stamp goes on from the last one, or the next stamp goes on from it.

    So a clock that was set in mid-log is followed and a damaged stamp is not. A packet of a
    kind without a checksum known here must be followed by another one as well.
    """
    steady = last_usec is not None and abs(usec - last_usec) < STEP_USEC
    if steady and packet.known:
        return True
    if end + STAMP >= len(buffer):
        return steady or last_usec is None
    following = int.from_bytes(buffer[end : end + STAMP], "big")
    return packet_length(buffer, end + STAMP) != 0 and abs(following - usec) < STEP_USEC


def load(path: Path, config: HistoryConfig) -> TelemetryLog:
    """The history of the one autopilot in a telemetry log."""
    counts: Counter[str] = Counter()
    streams, autopilots = _collect(path, counts)
    warnings: list[str] = []
    system = _vehicle(streams, {number for number, _ in autopilots}, warnings)
    history = VehicleHistory(config)
    for key, stream in streams.items():
        if key[0] == system:
            speaks = key[:2] in autopilots or not autopilots
            _place(history, key, stream, streams, speaks, warnings)
    restarts = max((n for *sender, n in streams if tuple(sender) in autopilots), default=0)
    if restarts:
        warnings.append(f"the autopilot started again {restarts} time(s) in this log")
    if counts["skipped_bytes"]:
        warnings.append(f"{counts['skipped_bytes']} damaged bytes were skipped")
    return finish(path, history, counts, warnings)


Key = tuple[int, int, int]
"""System, component, boot session."""


def _collect(path: Path, counts: Counter[str]) -> tuple[dict[Key, _Stream], set[tuple[int, int]]]:
    """The samples by sender and session, and the (system, component) of autopilots."""
    decoder = Decoder()
    streams: dict[Key, _Stream] = {}
    counters: dict[tuple[int, int], BootCounter] = {}
    autopilots: set[tuple[int, int]] = set()
    with path.open("rb") as file:
        for stamp_ns, packet in packets(file, counts):
            counts["packets"] += 1
            if packet.message_id not in WANTED and packet.message_id != HEARTBEAT:
                continue
            message = decoder.message(packet)
            if message is None:
                continue
            sender = (packet.system, packet.component)
            if packet.message_id == HEARTBEAT:
                if is_autopilot(packet.component, message):
                    autopilots.add(sender)
                continue
            sample = decode(message)
            if sample is None:
                continue
            counts[message.get_type()] += 1
            counter = counters.setdefault(sender, BootCounter())
            boot = None if sample.boot_ms is None else counter.unwrap(sample.boot_ms)
            stream = streams.setdefault((*sender, counter.session), _Stream())
            stream.stamps.append(stamp_ns)
            stream.samples.append(sample)
            stream.boots.append(boot)
    return streams, autopilots


def _vehicle(streams: dict[Key, _Stream], autopilots: set[int], warnings: list[str]) -> int | None:
    """The system whose telemetry is used: the autopilot that says most of its attitude."""
    says: Counter[int] = Counter()
    for (system, _, _), stream in streams.items():
        if not autopilots or system in autopilots:
            says[system] += sum(isinstance(s, AttitudeSample) for s in stream.samples)
    if not says:
        return next((key[0] for key in streams), None)
    system = says.most_common(1)[0][0]
    if len(says) > 1:
        others = ", ".join(str(s) for s in sorted(says) if s != system)
        warnings.append(f"the log holds several vehicles; {system} is used, not {others}")
    return system


def _place(
    history: VehicleHistory,
    key: Key,
    stream: _Stream,
    streams: dict[Key, _Stream],
    speaks: bool,
    warnings: list[str],
) -> None:
    """Put a stream's samples in; those of the vehicle itself only when its autopilot speaks."""
    fit = _fit(stream)
    if fit is None:  # a sender without a clock of its own goes by the autopilot's
        others = (_fit(s) for k, s in streams.items() if k[0] == key[0] and k != key)
        fit = next((f for f in others if f is not None), None)
    if fit is not None and not fit.is_real_time and speaks:
        warnings.append(
            f"the log's stamps ran at {1.0 / fit.rate:.2f} of the autopilot's clock; "
            "the autopilot's clock is used from the first stamp on"
        )
    for stamp, boot, sample in zip(stream.stamps, stream.boots, stream.samples, strict=True):
        if speaks or not isinstance(sample, OF_AUTOPILOT):
            history.add(sample, _time(fit, stamp, boot))


def _fit(stream: _Stream) -> BootFit | None:
    pairs = [(s, b) for s, b in zip(stream.stamps, stream.boots, strict=True) if b is not None]
    return fit_boot([s for s, _ in pairs], [b for _, b in pairs]) if pairs else None


def _time(fit: BootFit | None, stamp_ns: int, boot_ms: float | None) -> int:
    if fit is None:
        return stamp_ns
    if boot_ms is None:
        return fit.from_stamp(stamp_ns)
    return fit.from_boot(boot_ms * 1e6)
