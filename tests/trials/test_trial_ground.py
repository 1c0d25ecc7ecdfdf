"""A ground station that is gone for minutes, and one of ten drones with keys."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from loopback import free_port
from trial_ground import Fleet, Ground, HonestDrone
from trial_rig import WHOLE, Row, Service, back_limit_s, stored

pytestmark = [pytest.mark.trial, pytest.mark.timeout(7200 if WHOLE else 280)]


def test_ground_gone_for_minutes(tmp_path: Path, record: Row) -> None:
    pytest.importorskip("zenoh")
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    store, gone_s = tmp_path / "ground", 180.0 if WHOLE else 5.0
    command = [sys.executable, "-m", "service.cli", "ground", "--store", str(store)]
    command += ["--listen", endpoint]

    def ground() -> subprocess.Popen[bytes]:
        with (tmp_path / "ground.log").open("ab") as log:
            return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)

    link = f'[datalink]\nconnect = ["{endpoint}"]\nbudget_kbit_s = 8000\n'
    receiver = ground()
    try:
        with Service(tmp_path, more=link) as service:
            service.until(lambda: stored(store), "a chunk at the ground")
            receiver.kill()
            receiver.wait()
            time.sleep(gone_s)
            aboard = stored(service.scans)
            receiver = ground()
            back_s = service.until(lambda: aboard <= stored(store), "what was missed")
            scanned_on = bool(stored(service.scans))
            service.stop()
    finally:
        receiver.kill()
        receiver.wait()
    lost = aboard - stored(store)
    record(
        f"ground station gone for {gone_s:g} s",
        1,
        "fetches what it missed",
        f"{len(lost)} of {len(aboard)} chunks",
        back_s,
    )
    assert scanned_on
    assert not lost
    assert back_s < 6.0 * back_limit_s()


def test_a_fleet_with_keys_arrives_whole(tmp_path: Path, record: Row) -> None:
    """All at once over TLS, each with its own rights; one is killed in flight and starts again."""
    for needed in ("zenoh", "cryptography", "starlette", "uvicorn"):
        pytest.importorskip(needed)
    names = [f"drone-{k}" for k in range(10 if WHOLE else 3)]
    fleet = Fleet(tmp_path / "keys", names, "spare")
    with contextlib.ExitStack() as stack:
        ground = stack.enter_context(Ground(tmp_path, fleet.base))

        def fly(name: str, folder: str = "") -> HonestDrone:
            return stack.enter_context(
                HonestDrone(tmp_path / folder, name, ground.endpoint, **fleet.drone(name))
            )

        drones = [fly(name) for name in names]
        ground.until(
            lambda: all(stored(ground.store / "drones" / name) for name in names), "all of them"
        )
        drones[0].process.kill()
        drones[0] = fly(names[0], "again")
        time.sleep(60.0 if WHOLE else 3.0)
        for drone in drones:
            assert drone.land(), ground.said[-3000:]
        lost = [drone.lost(ground) for drone in drones]
        ground.check()
        assert ground.stop() == 0, ground.said[-3000:]
    record(
        f"{len(names)} drones with keys at once, one killed and started again",
        1,
        "all scans arrive whole",
        f"{sum(n for n, _ in lost)} of {sum(n for _, n in lost)} chunks",
    )
    assert not any(n for n, _ in lost) and all(n for _, n in lost)
