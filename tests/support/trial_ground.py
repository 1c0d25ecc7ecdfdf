"""A ground station and honest drones as processes, and what is seen of them from outside."""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

from loopback import free_port
from trial_rig import PATIENCE_S, WHOLE, crowd, stored

from service.stream.keys import make_keys, tls_files
from service.stream.records import ScanHeader
from service.stream.session import SessionConfig, open_session

DRONE = """
import json, os, sys, time
from dataclasses import replace
from pathlib import Path
import numpy as np
from service.bench.keyframes import make_keyframe, strip
from service.config import DatalinkConfig
from service.stream import codec
from service.stream.link import DatalinkSender
from service.stream.records import PoseRecord, Repose, ScanHeader
from service.stream.store import ScanStore
path, name, config = Path(sys.argv[1]), sys.argv[2], json.loads(sys.argv[3])
keyframes_hz, poses = 1.2, 7
size = (320, 180)
coded = [
    [codec.unpack(data) for data in codec.encode(make_keyframe(k, size, strip(size, k), 1 + k), 0)]
    for k in range(4)
]
run_id = config.pop("run_id")
store = ScanStore.create(path, ScanHeader("scan-1", name, time.time_ns(), run_id=run_id))
link = DatalinkSender(store, DatalinkConfig(**{k: tuple(v) if isinstance(v, list) else v
    for k, v in config.items()}))
os.set_blocking(0, False)
print("up", flush=True)
began = time.monotonic()
seq = at = 0
while not sys.stdin.buffer.read(1):
    if at % poses == 0:
        T = np.eye(4)
        T[:3, :3] = np.diag([1.0, -1.0, -1.0])
        T[:3, 3] = 10 * (seq % 40), 25 * (seq // 40 % 16), 72
        layers = [
            codec.pack(replace(head, seq=seq, time_unix_ns=time.time_ns(), T_world_camera=T), rest)
            for head, rest in coded[seq % 4]
        ]
        store.add_keyframe(seq, layers)
        if seq % 10 == 9:
            store.add_reposes([Repose(seq - 5, seq, T, 1.0, np.eye(6) * 1e-4)])
        seq += 1
    store.add_pose(PoseRecord(time.time_ns(), np.eye(4), np.eye(6) * 1e-4, keyframe_seq=seq - 1))
    at += 1
    time.sleep(max(0.0, began + at / (keyframes_hz * poses) - time.monotonic()))
store.finish({"keyframes": seq})
print(json.dumps({"drained": link.drain(120.0), "keyframes": seq}), flush=True)
link.close()
store.close()
"""
"""Stored keyframes under new numbers, through the store and the link that fly."""


class Ground:
    """``skyrelief ground`` with its portal; with ``keys`` by TLS and with the fleet's rights."""

    def __init__(self, folder: Path, keys: Path | None = None, more: tuple[str, ...] = ()) -> None:
        self.store, self.log = folder / "ground", folder / "ground.log"
        self.endpoint = f"{'tls' if keys else 'tcp'}/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        self.port = free_port(socket.SOCK_STREAM)
        command = [sys.executable, "-m", "service.cli", "ground", "--store", str(self.store)]
        command += ["--listen", self.endpoint, "--portal", f"127.0.0.1:{self.port}", *more]
        if keys is not None:
            command += ["--keys", str(keys)]
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )
        self.until(lambda: "token=" in self.said, "a portal")
        self.token = re.findall(r"token=(\S+)", self.said)[-1]

    def __enter__(self) -> Ground:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()

    @property
    def said(self) -> str:
        """All of its log."""
        return self.log.read_text(errors="replace")

    @property
    def mib(self) -> float:
        """Resident memory without pages of files."""
        text = Path(f"/proc/{self.process.pid}/status").read_text()
        return float(re.findall(r"RssAnon:\s+(\d+)", text)[0]) / 1024

    @property
    def files(self) -> int:
        """Descriptors that it holds."""
        return len(os.listdir(f"/proc/{self.process.pid}/fd"))

    def until(self, reached: Callable[[], Any], what: str) -> None:
        """Wait; fails with the log when the process ends or nothing comes."""
        start = time.monotonic()
        while not reached():
            alive = self.process.poll() is None
            late = time.monotonic() > start + PATIENCE_S * crowd()
            assert alive and not late, f"{what}:\n{self.said[-3000:]}"
            time.sleep(0.05)

    def ask(self, path: str, method: str = "GET", body: Any = None) -> tuple[int, bytes]:
        """Status and body of a request of the operator; status 0 when nothing comes."""
        request = urllib.request.Request(
            f"http://127.0.0.1:{self.port}{path}",
            None if body is None else json.dumps(body).encode(),
            {"Authorization": f"Bearer {self.token}", "Content-Type": "application/json"},
            method=method,
        )
        try:
            with urllib.request.urlopen(request, timeout=30) as page:
                return page.status, page.read()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.read()
        except OSError:
            return 0, b""

    def stop(self) -> int:
        """The exit code after Ctrl-C and after the deliverables of all scans."""
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(timeout=3600 if WHOLE else PATIENCE_S * crowd())

    def check(self) -> None:
        """It runs, and no thread or task of it has failed."""
        assert self.process.poll() is None, self.said[-3000:]
        for word in ("Traceback", "exception", "panicked", "restart"):
            assert word not in self.said, self.said[self.said.index(word) - 2000 :][:4000]


class Fleet:
    """Keys of a fleet: the ground ``base``, another ground and a drone that are hostile."""

    def __init__(self, folder: Path, drones: list[str], attacker: str) -> None:
        make_keys(folder, {"drone": [*drones, attacker], "ground": ["base", "rogue"]})
        self._folder, self._attacker = folder, attacker
        self.base = folder / "ground" / "base"

    def drone(self, name: str) -> dict[str, str]:
        """The settings of a drone's datalink."""
        names = ("tls_ca", "tls_certificate", "tls_key")
        return dict(zip(names, tls_files(self._folder / "drone" / name), strict=True))

    def session(self, endpoint: str, member: str = "") -> Any:
        """A Zenoh session of the hostile drone, or of the ground ``member``."""
        role = f"ground/{member}" if member else f"drone/{self._attacker}"
        ca, certificate, key = tls_files(self._folder / role)
        return open_session(
            SessionConfig(connect=(endpoint,), tls_ca=ca, tls_certificate=certificate, tls_key=key)
        )


class HonestDrone:
    """A drone that streams from its start until :meth:`land`."""

    def __init__(self, folder: Path, name: str, endpoint: str, **settings: str) -> None:
        self.name, self.scans = name, folder / name
        run_id = secrets.token_hex(16)
        self.key = f"{name}/{ScanHeader('scan-1', name, 1, run_id=run_id).name}"
        link = {"connect": [endpoint], "budget_kbit_s": 4000.0, "run_id": run_id, **settings}
        self.process = subprocess.Popen(
            [sys.executable, "-c", DRONE, str(self.scans / "scan.db"), name, json.dumps(link)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "up\n"

    def __enter__(self) -> HonestDrone:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()

    def land(self) -> bool:
        """End the scan; whether the drone knows that all of it has arrived."""
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write("x")
        self.process.stdin.flush()
        return bool(json.loads(self.process.stdout.readline())["drained"])

    def lost(self, ground: Ground) -> tuple[int, int]:
        """(chunks that the ground's store lacks, all that the drone's has)."""
        aboard = {chunk[1:] for chunk in stored(self.scans)}
        return len(
            aboard - {chunk[1:] for chunk in stored(ground.store / "drones" / self.name)}
        ), len(aboard)


class Watch:
    """The age of an honest drone's poses when they come into the ground's store, seen from outside.

    A pose that never comes is found by :meth:`HonestDrone.lost` of its chunks.
    """

    def __init__(self, ground: Ground, name: str) -> None:
        self.oldest_s = 0.0  # the greatest age, the first poses left out
        self._place, self._last = ground.store / "drones" / name, 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        seen: set[int] = set()
        while not self._stop.wait(0.1):
            for path in self._place.rglob("scan.db"):
                with contextlib.suppress(sqlite3.Error):
                    db = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
                    query = "SELECT id, time_unix_ns FROM poses WHERE id > ?"
                    rows = db.execute(query, (self._last - 200,)).fetchall()
                    db.close()
                    fresh = {number: time_ns for number, time_ns in rows if number not in seen}
                    if seen and fresh:
                        age_s = (time.time_ns() - min(fresh.values())) * 1e-9
                        self.oldest_s = max(self.oldest_s, age_s)
                    seen |= fresh.keys()
                    self._last = max(seen, default=0)
