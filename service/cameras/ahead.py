"""Pictures of a recording decoded while the ones before are worked on."""

from __future__ import annotations

from collections.abc import Generator
from queue import Full, Queue
from threading import Event, Thread

from service.cameras.source import CameraFrame, CameraSource

_LOOK_S = 0.1
"""How often a full reader looks whether it is still wanted."""


def ahead(source: CameraSource, kept: int = 4) -> Generator[CameraFrame, None, None]:
    """Every picture of ``source`` in order, at most ``kept`` of them decoded in advance.

    Raises what the source raises. A reader whose pictures are no longer fetched ends soon;
    close the iterator before the source.
    """
    queue: Queue[CameraFrame | Exception | None] = Queue(kept)
    unwanted = Event()

    def put(item: CameraFrame | Exception | None) -> bool:
        while not unwanted.is_set():
            try:
                queue.put(item, timeout=_LOOK_S)
                return True
            except Full:
                continue
        return False

    def read() -> None:
        try:
            for frame in source:
                if not put(frame):
                    return
        except Exception as error:  # handed to the thread that iterates
            put(error)
            return
        put(None)

    reader = Thread(target=read, name="decoder", daemon=True)
    reader.start()
    try:
        while (item := queue.get()) is not None:
            if isinstance(item, Exception):
                raise item
            yield item
    finally:
        unwanted.set()
        reader.join()
