"""Plays a simulated flight in real time: H.264 in MPEG-TS for the camera, MAVLink over UDP.

The flight's own packets are sent when they are due. SYSTEM_TIME is renewed, so that it gives
the present, and TIMESYNC requests are answered with the boot time, as an autopilot does.
"""

from __future__ import annotations

import heapq
import logging
import select
import socket
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av

from mavlink.wire.dialect import dialect
from mavlink.wire.messages import OutgoingMessage, Packer
from mavlink.wire.tlog import packets
from service.cameras.video import creation_unix_ns
from service.errors import InputError, OutsideError
from service.sim.telemetry import BOOT_BEFORE_VIDEO_S

log = logging.getLogger(__name__)

CAMERA, TELEMETRY = 0, 1
START_DELAY_S = 0.5
EACH_LENGTH = {"omit_video_pes_length": "0"}
"""MPEG-TS that states the length of each image: a receiver need not wait for the next one."""


class MavlinkPlayer:
    """Sends the flight's messages from their components, and answers TIMESYNC."""

    def __init__(self, address: str, until_stdin_ends: bool) -> None:
        """Open the socket; ValueError for what is no address, OutsideError for one that cannot be
        used."""
        host, _, port = address.rpartition(":")
        if not host or not port.isdigit() or not 0 < int(port) < 65536:
            raise ValueError(f"MAVLink address {address!r} is not host:port")
        self.sent = self.answered = 0
        self._packer = Packer(0)
        self._reader = dialect.MAVLink(None)
        self._requests = dialect.MAVLink(None)
        self._requests.robust_parsing = True
        self.has_ended = False
        try:
            self._to = socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)[0][4]
            self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self.socket.setblocking(False)
            self._stdin = [sys.stdin] if until_stdin_ends else []
        except OSError as error:
            raise OutsideError(f"MAVLink to {address}: {error}") from error

    def listen(self, seconds: float) -> None:
        """Wait for a request for so long; note when standard input has ended."""
        ready, _, _ = select.select([self.socket, *self._stdin], [], [], seconds)
        self.has_ended = self.has_ended or any(stream in ready for stream in self._stdin)

    def play(self, packet: bytes, boot_s: float) -> None:
        """Send one packet of the log as if it happened ``boot_s`` after the boot."""
        message = self._reader.decode(bytearray(packet))
        component = message.get_srcComponent()
        if message.get_type() == "SYSTEM_TIME":
            now_us = time.time_ns() // 1000
            message = dialect.MAVLink_system_time_message(now_us, round(boot_s * 1e3))
        self._send(message, component)
        self.sent += 1

    def answer(self, boot_s: float) -> None:
        """Answer what has come in: TIMESYNC requests get the time since the boot."""
        while True:
            try:
                data, _ = self.socket.recvfrom(2048)
            except OSError:  # nothing there, or nothing listens yet
                return
            for message in self._requests.parse_buffer(data) or []:
                if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                    reply = dialect.MAVLink_timesync_message(round(boot_s * 1e9), message.ts1)
                    self._send(reply, 1)
                    self.answered += 1

    def _send(self, message: Any, component: int) -> None:
        data = self._packer.pack(1, OutgoingMessage(component, message), 0)
        if data is None:
            return
        try:
            self.socket.sendto(data, self._to)
        except OSError as error:  # a full buffer or a refused datagram loses one packet
            log.debug("MAVLink packet not sent: %s", error)


def play(
    folder: Path, video_to: str, mavlink_to: str, loop: bool = False, until_stdin_ends: bool = False
) -> dict[str, int]:
    """Play the flight in ``folder`` to its end, or in a loop for ever; counts of what was sent.

    ``video_to`` is any URL of FFmpeg (pipe:1 is stdout), ``mavlink_to`` host:port of UDP. With
    ``until_stdin_ends`` it also ends when standard input does: with who started it. InputError
    when the folder contains no flight; OutsideError when the outputs cannot be opened.
    """
    video, tlog = folder / "flight.mp4", folder / "flight.tlog"
    if not video.exists():
        raise InputError(f"{folder} contains no flight.mp4 to play")
    player = MavlinkPlayer(mavlink_to, until_stdin_ends)
    frames = 0
    try:
        while True:
            frames += _play_once(video, tlog, video_to, loop, player)
            if not loop or player.has_ended:
                break
    finally:
        player.socket.close()
    return {"frames": frames, "packets": player.sent, "timesync_answers": player.answered}


def _play_once(video: Path, tlog: Path, url: str, loop: bool, player: MavlinkPlayer) -> int:
    """Play once from the start; returns the number of frames. In a loop without the telemetry
    before and after the video: a camera that is silent for seconds counts as lost."""
    frames = 0
    try:
        with (
            av.open(str(video)) as source,
            av.open(url, "w", format="mpegts", options=EACH_LENGTH) as sink,
        ):
            stream = sink.add_stream_from_template(source.streams.video[0])
            end_s = (source.duration or 0) / av.time_base
            start_ns = creation_unix_ns(source, source.streams.video[0])
            if start_ns is None:
                raise InputError(f"{video} has no creation time; simulate the flight again")
            said = _telemetry(tlog, start_ns)
            telemetry = (e for e in said if not loop or 0 <= e[0] <= end_s)
            events = heapq.merge(_packets(source), telemetry, key=lambda e: e[:2])
            start = None
            for due_s, kind, payload in events:
                if start is None:
                    start = time.monotonic() + START_DELAY_S - due_s
                _wait(start, due_s, player)
                if player.has_ended:
                    break
                if kind == TELEMETRY:
                    player.play(payload, due_s + BOOT_BEFORE_VIDEO_S)
                else:
                    payload.stream = stream
                    sink.mux(payload)
                    frames += 1
    except (av.error.FFmpegError, OSError) as error:
        raise OutsideError(f"video to {url}: {error}") from error
    return frames


def _wait(start: float, due_s: float, player: MavlinkPlayer) -> None:
    """Wait until ``due_s`` of the flight, answering requests meanwhile."""
    while True:
        left = start + due_s - time.monotonic()
        player.listen(max(left, 0.0))
        player.answer(time.monotonic() - start + BOOT_BEFORE_VIDEO_S)
        if player.has_ended or start + due_s - time.monotonic() <= 0:
            return


def _packets(source: Any) -> Iterator[tuple[float, int, Any]]:
    """(seconds, CAMERA, coded frame) of the video."""
    for packet in source.demux(video=0):
        if packet.dts is not None:
            yield float(packet.dts * packet.time_base), CAMERA, packet


def _telemetry(tlog: Path, start_unix_ns: int) -> Iterator[tuple[float, int, bytes]]:
    """(seconds, TELEMETRY, packet) of the log; nothing when there is none."""
    if tlog.exists():
        with tlog.open("rb") as file:
            for unix_ns, packet in packets(file, Counter()):
                yield (unix_ns - start_unix_ns) * 1e-9, TELEMETRY, packet.data
