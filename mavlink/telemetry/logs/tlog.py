"""Telemetry logs of ground stations: 8 bytes of unix microseconds before each packet."""

from __future__ import annotations

from collections import Counter, defaultdict
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


Key = tuple[int, int, int]  # system, component, boot session

Streams = dict[Key, list[tuple[int, float | None, Sample]]]
"""Stamp in ns, unwrapped boot time in ms, and sample."""


def load(path: Path, config: HistoryConfig) -> TelemetryLog:
    counts: Counter[str] = Counter()
    streams, autopilots = _collect(path, counts)
    warnings: list[str] = []
    system = _vehicle(streams, {number for number, _ in autopilots}, warnings)
    history = VehicleHistory(config)
    for key in streams:
        if key[0] == system:
            speaks = key[:2] in autopilots or not autopilots
            _place(history, key, streams, speaks, warnings)
    restarts = max((n for *sender, n in streams if tuple(sender) in autopilots), default=0)
    if restarts:
        warnings.append(f"the autopilot rebooted {restarts} time(s) in this log")
    if counts["skipped_bytes"]:
        warnings.append(f"{counts['skipped_bytes']} damaged bytes were skipped")
    return finish(path, history, counts, warnings)


def _collect(path: Path, counts: Counter[str]) -> tuple[Streams, set[tuple[int, int]]]:
    """The samples by sender and session, and the (system, component) of autopilots."""
    decoder = Decoder()
    streams: Streams = defaultdict(list)
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
            key = (*sender, counter.session)
            streams[key].append((stamp_ns, boot, sample))
    return streams, autopilots


def _vehicle(streams: Streams, autopilots: set[int], warnings: list[str]) -> int | None:
    """The system whose telemetry is used: the autopilot with the most attitude samples."""
    says: Counter[int] = Counter()
    for (system, _, _), stream in streams.items():
        if not autopilots or system in autopilots:
            says[system] += sum(isinstance(s, AttitudeSample) for *_, s in stream)
    if not says:
        return next((key[0] for key in streams), None)
    system = says.most_common(1)[0][0]
    if len(says) > 1:
        others = ", ".join(str(s) for s in sorted(says) if s != system)
        warnings.append(f"the log holds several vehicles; {system} is used, not {others}")
    return system


def _place(
    history: VehicleHistory, key: Key, streams: Streams, speaks: bool, warnings: list[str]
) -> None:
    """Add a stream's samples; those of the vehicle itself only when its autopilot sends them."""
    # A sender without a boot clock uses the autopilot's.
    others = [stream for k, stream in streams.items() if k[0] == key[0] and k != key]
    fit = next(filter(None, map(_fit, [streams[key], *others])), None)
    if fit is not None and not fit.is_real_time and speaks:
        warnings.append(
            f"the log's stamps ran at {1.0 / fit.rate:.2f} of the autopilot's clock; "
            "the autopilot's clock is used from the first stamp on"
        )
    for stamp_ns, boot_ms, sample in streams[key]:
        if speaks or not isinstance(sample, OF_AUTOPILOT):
            history.add(sample, _time(fit, stamp_ns, boot_ms))


def _fit(stream: list[tuple[int, float | None, Sample]]) -> BootFit | None:
    pairs = [(stamp_ns, boot_ms) for stamp_ns, boot_ms, _ in stream if boot_ms is not None]
    return fit_boot([s for s, _ in pairs], [b for _, b in pairs]) if pairs else None


def _time(fit: BootFit | None, stamp_ns: int, boot_ms: float | None) -> int:
    if fit is None:
        return stamp_ns
    if boot_ms is None:
        return fit.from_stamp(stamp_ns)
    return fit.from_boot(boot_ms * 1e6)
