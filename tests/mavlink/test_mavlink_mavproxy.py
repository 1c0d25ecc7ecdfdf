"""MAVProxy without a screen, driving both components by what is typed."""

from __future__ import annotations

import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from loopback import free_port, until
from rehearsal import RehearsalVehicle


def test_mavproxy_drives_both_components(tmp_path: Path) -> None:
    own = Path(sys.prefix) / "peers" / "bin" / "mavproxy.py"  # made by 'make test'
    program = str(own) if own.exists() else shutil.which("mavproxy.py")
    if program is None:
        pytest.skip("MAVProxy is not installed")
    port = free_port()
    with RehearsalVehicle(f"udpout:127.0.0.1:{port}") as daemon:
        proxy = subprocess.Popen(
            [program, f"--master=udpin:127.0.0.1:{port}", f"--state-basedir={tmp_path}"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            cwd=tmp_path,
        )
        assert proxy.stdin is not None
        lines: list[str] = []
        reader = threading.Thread(
            target=lambda: lines.extend(iter(proxy.stdout.readline, "")),  # type: ignore[union-attr]
            daemon=True,
        )
        reader.start()
        try:
            until(lambda: any("191" in line for line in lines), 40.0)

            def type_in(*commands: str) -> None:
                for command in commands:
                    proxy.stdin.write(command + "\n")  # type: ignore[union-attr]
                    proxy.stdin.flush()  # type: ignore[union-attr]
                    time.sleep(0.3)

            type_in("set target_system 1", "set target_component 100")
            type_in("long MAV_CMD_VIDEO_START_CAPTURE 0 0 0 0 0 0 0")
            until(lambda: daemon.control.state.is_recording)
            type_in("set target_component 191", "long MAV_CMD_USER_1 1 0 0 0 0 0 0")
            until(lambda: "pause" in daemon.control.asked)
            type_in("long MAV_CMD_COMPONENT_ARM_DISARM 1 0 0 0 0 0 0")
            until(lambda: any("UNSUPPORTED" in line for line in lines))
        finally:
            proxy.kill()
            proxy.wait()
            reader.join(timeout=5)
            assert proxy.stdout is not None
            proxy.stdin.close()
            proxy.stdout.close()
