"""Coded images of a live stream, each as soon as it is whole.

FFmpeg's demuxer of MPEG-TS passes an image on when it finds the start of the next one, an interval
later. Most senders give each image a packet (PES) of its own: such a packet need not wait.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import av

SURE = 5  # packets at the start of a stream that end with an image, before one counts as whole

LARGEST_BYTES = 1 << 23
"""Of a packet, and so of a coded image; without a limit given, FFmpeg's demuxer cuts at 200 KiB."""


LONGEST_HEAD = 4096  # bytes of parameter sets and the like in packets of their own

START = re.compile(rb"\x00\x00\x01(.)", re.DOTALL)
"""The start code of a NAL unit, and its first byte."""

IS_VCL: dict[str, Callable[[int], bool]] = {
    "h264": lambda first: 1 <= first & 0x1F <= 5,
    "hevc": lambda first: first & 0x7F < 64,
}
"""Whether a NAL unit, by its first byte, is of the video coding layer: a part of an image."""


def access_units(
    packets: Iterator[av.Packet[Any]], stream: av.VideoStream
) -> Iterator[av.Packet[Any]]:
    """The images of ``packets``, which were demuxed with FFmpeg's flag ``noparse``.

    Where packets do not hold an image each, FFmpeg's parser cuts them, as it does without the flag.
    An image has the times of the packet in which it begins. The first ones come together: the time
    of a live image follows from its arrival, which must not become earlier in a stream. After a
    packet that did not end with an image, none counts as whole. Raises OSError when no image ends.
    """
    import av

    parser = av.CodecContext.create(stream.codec_context.name, "r")
    # H.264 with lengths in place of start codes, as Matroska has it
    are_images = (stream.codec_context.extradata or b"").startswith(b"\x01")
    try:
        parser.parse(None)
    except ValueError:  # no parser: the packets of this codec are images
        are_images = True
    if are_images:
        yield from packets
        return
    begun: deque[tuple[int, av.Packet[Any]]] = deque()  # the packets that may begin an image
    held: list[av.Packet[Any]] = []  # until the first packets show what they hold
    fed = cut = given = 0  # bytes from the stream's start: parsed, in whole images, passed on
    are_whole = True
    packets = headed(packets, parser.name)
    for number, packet in enumerate(packets):  # the last one is empty, and empties the parser
        start, fed = fed, fed + packet.size
        begun.append((start, packet))
        images = parser.parse(bytes(packet))
        if number:
            are_whole = are_whole and bool(images) and cut + images[0].size == start
        for image in images:
            while len(begun) > 1 and begun[1][0] <= cut:
                begun.popleft()
            began, cut = cut, cut + image.size
            if began >= given:
                held.append(_timed(image, begun[0][1]))
        if fed - cut > 2 * LARGEST_BYTES:
            raise OSError(f"no image in {(fed - cut) >> 20} MiB")
        if are_whole and number >= SURE and len(images) == 1 and packet.size:
            given = fed
            held.append(packet)
        if number >= SURE or not packet.size:
            yield from held
            held.clear()


def headed(packets: Iterator[av.Packet[Any]], codec: str) -> Iterator[av.Packet[Any]]:
    """The packets, those that hold nothing of an image joined to the next one. Some senders give
    the parameter sets of a key frame a packet of their own."""
    import av

    is_vcl, head = IS_VCL.get(codec), b""
    for packet in packets:
        if is_vcl is not None and 0 < packet.size <= LONGEST_HEAD - len(head):
            data = bytes(packet)
            is_started = START.search(data[:5])
            if is_started and not any(is_vcl(nal[0]) for nal in START.findall(data)):
                head += data
                continue
        if head and packet.size:  # else no image follows
            packet, head = _timed(av.Packet(head + bytes(packet)), packet), b""
        yield packet


def _timed(image: av.Packet[Any], packet: av.Packet[Any]) -> av.Packet[Any]:
    image.pts, image.dts, image.time_base = packet.pts, packet.dts, packet.time_base
    image.stream = packet.stream
    return image
