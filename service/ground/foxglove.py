"""Growing scans for Foxglove: a WebSocket server of ROS 2 messages, in a process of its own.

It only reads the store, so that whatever its clients do, the receiver goes on. Each client has a
queue that drops its oldest message; one that subscribes gets the growing scans from their start.
"""

from __future__ import annotations

import contextlib
import math
import resource
import select
import socket
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from service.errors import InputError, OutsideError
from service.ground.storage import is_regular
from service.listener import is_loopback, parse_address
from service.offline.exports.ros2 import Ros2Channels
from service.packages import needing
from service.stream.store import ScanStore
from service.workers import Worker, Workers, guarded, run_process

POLL_S = 0.25
GROWING_S = 60.0
"""A scan that did not change for so long is no longer followed."""
MAX_SCANS = 8
AT_ONCE = 5
"""Keyframes of one scan between two looks at the others."""
MAX_WAITING = 32
"""Messages in the queue of one client."""
DESCRIPTORS = 128
"""Open files and connections of the process."""


class FoxgloveServer:
    """Runs the process as a worker between :meth:`start` and :meth:`close`.

    Raises InputError for an address without TLS beyond this machine unless ``plain``, OutsideError
    without the packages, or when the address cannot be used.
    """

    def __init__(self, address: str, store: Path, plain: bool, workers: Workers) -> None:
        self._host, self._port = parse_address(address, "--foxglove")
        if not (plain or is_loopback(self._host)):
            raise InputError(f"--foxglove {address}: others can read all scans; allow it: --plain")
        with needing("--foxglove"):
            import foxglove  # noqa: F401
            import rosbags  # noqa: F401
        self._store, self._workers = store, workers
        self._worker: Worker | None = None

    def start(self) -> None:
        """Begin to serve."""
        try:
            _probe(self._host, self._port)
        except OSError as error:
            raise OutsideError(
                f"--foxglove: cannot listen on {self._host}:{self._port} ({error.strerror})"
            ) from error
        self._worker = self._workers.start("foxglove", self._run)

    def _run(self, worker: Worker) -> None:
        command = [sys.executable, "-m", __name__, str(self._store), self._host, str(self._port)]
        run_process(worker, "foxglove", command)

    def close(self) -> None:
        """End; clients are disconnected."""
        if self._worker is not None:
            self._worker.join(5.0)


class LiveScan:
    """Publishes what is new in the scan of a folder, which another process writes."""

    def __init__(self, context: Any, folder: Path) -> None:
        self._store = ScanStore.open(folder / "scan.db")
        self._version = (-1, -1)
        self._channels = Ros2Channels(context, self._store.header.drone)
        self._forget()

    def close(self) -> None:
        """Close the file."""
        self._store.close()

    def again(self) -> None:
        """Publish all of it once more, after what is under way: whoever asks often holds up no
        other."""
        self._is_asked = True

    def _forget(self) -> None:
        self._sent: dict[int, tuple[int, float, int]] = {}  # layer, scale, revision
        self._last_ns, self._has_more, self._is_asked = -1, True, False

    def refresh(self) -> None:
        """Publish poses that are new, and keyframes that are new, finer or moved; AT_ONCE of
        these at most."""
        if self._is_asked and not self._has_more:
            self._forget()
        before, self._version = self._version, self._store.version()
        if before == self._version and not self._has_more:
            return
        for pose in self._store.poses(self._last_ns + 1):
            self._last_ns = pose.time_unix_ns
            self._channels.log_transform(pose.T_world_camera, pose.time_unix_ns)
            self._channels.log_fix(pose)
        published = 0
        for seq, (layer, revision) in self._store.states().items():
            published += self._publish(seq, layer, revision)
            self._has_more = published == AT_ONCE
            if self._has_more:
                return

    def _publish(self, seq: int, layer: int, revision: int) -> bool:
        """Publish a keyframe if it is new or finer, its new pose if only that changed."""
        before = self._sent.get(seq)
        if before is not None and before[::2] == (layer, revision):
            return False
        repose = self._store.repose(seq)
        state = layer, 1.0 if repose is None else repose.scale, revision
        keyframe = self._store.keyframe(seq)
        self._sent[seq] = state
        if keyframe is None:
            return False
        if before is not None and before[:2] == state[:2]:
            self._channels.log_transform(keyframe.depth.T_world_camera, keyframe.time_ns)
        else:
            self._channels.log_keyframe(keyframe)
        return True


def growing(store: Path, now_unix_s: float, most: int = MAX_SCANS) -> Iterator[Path]:
    """The folder of each drone's newest scan, if it grows; ``most`` of them at most."""
    newest: dict[str, tuple[float, Path]] = {}
    for path in store.glob("*/*/scan.db*"):
        folder = path.parent
        drone = folder.parent.name
        if path.name in ("scan.db", "scan.db-wal") and drone[0] != "." and is_regular(path):
            with contextlib.suppress(OSError):
                changed = path.lstat().st_mtime, folder
                newest[drone] = max(newest.get(drone, (-math.inf, folder)), changed)
    found = sorted((entry for entry in newest.values()), reverse=True)
    return (folder for changed, folder in found[:most] if changed > now_unix_s - GROWING_S)


def _probe(host: str, port: int) -> None:
    """Raise OSError when this process cannot listen there, also because another one does."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    socket.create_server((host, port), family=family).close()


def serve(store: Path, host: str, port: int) -> None:
    """Publish the scans that grow below ``store`` until standard input ends."""
    import foxglove
    from foxglove.websocket import ServerListener

    class Listener(ServerListener):
        """Notes that a client has subscribed; called by threads of the server."""

        has_news = False

        def on_subscribe(self, client: Any, channel: Any) -> None:
            self.has_news = True

    resource.setrlimit(resource.RLIMIT_NOFILE, (DESCRIPTORS, DESCRIPTORS))
    foxglove.set_log_level("ERROR")  # strangers could fill the log with warnings
    context, listener = foxglove.Context(), Listener()

    def start() -> Any:
        return foxglove.start_server(
            name="skyrelief", host=host, port=port, context=context, capabilities=[],
            server_listener=listener, message_backlog_size=MAX_WAITING,
        )  # fmt: skip

    server = start()
    scans: dict[Path, LiveScan] = {}

    def follow(folder: Path) -> None:
        if folder not in scans:
            scans[folder] = LiveScan(context, folder)
        scans[folder].refresh()

    while not select.select([sys.stdin], [], [], POLL_S)[0]:
        again, listener.has_news = listener.has_news, False
        folders = list(growing(store, time.time()))
        for folder in scans.keys() - set(folders):
            scans.pop(folder).close()
        if again:
            for scan in scans.values():
                scan.again()
        for folder in folders:
            guarded(f"{folder} for Foxglove", partial(follow, folder))
        with contextlib.suppress(OSError):
            _probe(host, port)  # the server stops to listen when connections use up descriptors
            server.stop()
            server = start()
    server.stop()


if __name__ == "__main__":
    serve(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
