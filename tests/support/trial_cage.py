"""Runs many cases of the command line or of a reader, each in a process of its own with bounds.

A process that has everything imported forks for each case, which takes milliseconds where a
start takes seconds. The case itself is ``service.cli.main`` as the command line calls it.
"""

from __future__ import annotations

import contextlib
import json
import os
import pkgutil
import resource
import signal
import subprocess
import sys
import time
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

ADDRESSES_BYTES = 6 << 30
"""Beyond it an allocation fails, so that a case cannot take the machine."""
PROCESSOR_S, PROCESSOR_TO_COMPILE_S = 60, 400
"""Of a core; the second for what compiles the pipeline where that has not run yet."""
LARGEST_FILE_BYTES = 1 << 30
MAX_MIB, MAX_MESH_MIB = 1536, 4096
"""Resident memory that a case may take, imports included: rasters and meshes have their own
bounds of cells and triangles, which scans of square kilometres reach."""
PRELOADED = ("offline", "scans", "stream", "cameras", "commands", "flight", "ground")
LATE = ("torch", "onnx", "mesh_cluster")
"""Packages that a case imports itself: large, or with threads that a fork does not copy."""
FOREWARNED = {0: "done", 2: "refused in a line", 3: "outside world"}


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a case ended."""

    code: int  # exit code; negative: by this signal
    mib: int  # resident memory at its most
    processor_s: float
    said: str  # the end of standard error
    max_mib: int = MAX_MIB

    @property
    def fault(self) -> str:
        """The fault, or an empty text."""
        lines = self.said.strip().splitlines()
        last = lines[-1][:200] if lines else ""
        if self.code not in FOREWARNED or "Traceback" in self.said:
            return f"exit code {self.code}: {last}"
        if self.mib > self.max_mib:
            return f"{self.mib} MiB"
        return ""


class Cage:
    """Cases one after the other; close it, or use it in a ``with``."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._process = subprocess.Popen(
            [sys.executable, __file__, str(folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
        )

    def __enter__(self) -> Cage:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()

    def command(self, *arguments: object) -> Outcome:
        """``skyrelief`` with these arguments."""
        end = self._run({"argv": list(map(str, arguments))})
        is_mesh = arguments[0] == "mesh" or "glb" in arguments
        return replace(end, max_mib=MAX_MESH_MIB) if is_mesh else end

    def reader(self, name: str, path: Path) -> Outcome:
        """One of :data:`hostile_media.READERS` on a file or folder."""
        return self._run({"reader": name, "path": str(path)})

    def _run(self, case: dict[str, Any]) -> Outcome:
        assert self._process.stdin is not None and self._process.stdout is not None
        print(json.dumps(case), file=self._process.stdin, flush=True)
        return Outcome(**json.loads(self._process.stdout.readline()))


def _serve(folder: Path) -> None:
    """In the cage's process: fork for each line of standard input."""
    sys.path.insert(0, str(Path(__file__).parent))
    import hostile_media

    import service.cli

    for package in ("recon", "mavlink.telemetry.logs", *(f"service.{name}" for name in PRELOADED)):
        for found in pkgutil.walk_packages(import_module(package).__path__, f"{package}."):
            if not any(name in found.name for name in LATE):
                with contextlib.suppress(ImportError):
                    import_module(found.name)
    for name in ("rasterio", "laspy", "lazrs", "pyproj", "imagecodecs", "scipy.spatial", "pyulog"):
        with contextlib.suppress(ImportError):
            import_module(name)
    said = folder / "said.txt"
    for line in sys.stdin:
        case = json.loads(line)
        child = os.fork()
        if child == 0:
            _bound(
                said, PROCESSOR_TO_COMPILE_S if "replay" in case.get("argv", ()) else PROCESSOR_S
            )
            if "argv" in case:
                sys.argv = ["skyrelief", *case["argv"]]
                _leave(service.cli.main)
            _leave(lambda: hostile_media.READERS[case["reader"]](Path(case["path"])))  # noqa: B023
        code, usage = _waited(child)
        text = said.read_bytes()[-4000:].decode("utf-8", "replace")
        took = usage.ru_utime + usage.ru_stime
        out = Outcome(code, usage.ru_maxrss >> 10, round(took, 2), text)
        print(json.dumps(asdict(out)), flush=True)


def _bound(said: Path, processor_s: int) -> None:
    os.setsid()
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESSES_BYTES, ADDRESSES_BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (processor_s, processor_s))
    resource.setrlimit(resource.RLIMIT_FSIZE, (LARGEST_FILE_BYTES, LARGEST_FILE_BYTES))
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    output = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    nothing = os.open(os.devnull, os.O_RDWR)
    for number, target in ((nothing, 0), (nothing, 1), (output, 2)):
        os.dup2(number, target)


def _leave(work: Any) -> None:
    """End the process as Python would after ``work``, without the cage's own clean-up."""
    code = 1
    try:
        work()
        code = 0
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else int(error.code is not None)
    except BaseException:
        sys.excepthook(*sys.exc_info())
    finally:
        sys.stderr.flush()
        os._exit(code)


def _waited(child: int) -> tuple[int, resource.struct_rusage]:
    """The child's exit code and use; whoever waits for ever is ended, as its parent would."""
    start = time.monotonic()
    while True:
        pid, status, usage = os.wait4(child, os.WNOHANG)
        if pid:
            break
        time.sleep(0.002)
        if time.monotonic() - start > 8 * PROCESSOR_S:
            os.killpg(child, signal.SIGKILL)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # what it left
    return os.waitstatus_to_exitcode(status), usage


if __name__ == "__main__":
    _serve(Path(sys.argv[1]))
