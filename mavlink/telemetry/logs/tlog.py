"""Telemetry logs of ground stations: 8 bytes of unix microseconds before each packet."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from mavlink.telemetry.clock import BootCounter, BootFit, fit_boot
from mavlink.telemetry.decode import READERS, decode
from mavlink.telemetry.history import HistoryConfig, VehicleHistory
from mavlink.telemetry.logs import TelemetryLog, finish
from mavlink.telemetry.samples import OF_AUTOPILOT, AttitudeSample, Sample
from mavlink.wire.dialect import numbers_of
from mavlink.wire.first_beat import is_autopilot
from mavlink.wire.framing import Decoder
from mavlink.wire.tlog import packets

HEARTBEAT = 0

WANTED = numbers_of(READERS)


@dataclass(slots=True)
class _Session:
    """Samples of one sender (system, component) in one boot session."""

    stamps: list[int] = field(default_factory=list)
    samples: list[Sample] = field(default_factory=list)
    boots: list[float | None] = field(default_factory=list)


def load(path: Path, config: HistoryConfig) -> TelemetryLog:
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
        warnings.append(f"the autopilot rebooted {restarts} time(s) in this log")
    if counts["skipped_bytes"]:
        warnings.append(f"{counts['skipped_bytes']} damaged bytes were skipped")
    return finish(path, history, counts, warnings)


Key = tuple[int, int, int]
"""System, component, boot session."""


def _collect(path: Path, counts: Counter[str]) -> tuple[dict[Key, _Session], set[tuple[int, int]]]:
    """The samples by sender and session, and the (system, component) of autopilots."""
    decoder = Decoder()
    streams: dict[Key, _Session] = {}
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
            stream = streams.setdefault((*sender, counter.session), _Session())
            stream.stamps.append(stamp_ns)
            stream.samples.append(sample)
            stream.boots.append(boot)
    return streams, autopilots


def _vehicle(streams: dict[Key, _Session], autopilots: set[int], warnings: list[str]) -> int | None:
    """The system whose telemetry is used: the autopilot with the most attitude samples."""
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
    stream: _Session,
    streams: dict[Key, _Session],
    speaks: bool,
    warnings: list[str],
) -> None:
    """Add a stream's samples; those of the vehicle itself only when its autopilot sends them."""
    fit = _fit(stream)
    if fit is None:  # a sender without a boot clock uses the autopilot's
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


def _fit(stream: _Session) -> BootFit | None:
    pairs = [(s, b) for s, b in zip(stream.stamps, stream.boots, strict=True) if b is not None]
    return fit_boot([s for s, _ in pairs], [b for _, b in pairs]) if pairs else None


def _time(fit: BootFit | None, stamp_ns: int, boot_ms: float | None) -> int:
    if fit is None:
        return stamp_ns
    if boot_ms is None:
        return fit.from_stamp(stamp_ns)
    return fit.from_boot(boot_ms * 1e6)
