"""A machine without a library or a package: one line that says what to install."""

from __future__ import annotations

import ctypes.util
import json
import os
import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from house_flight import HouseFlight
from paths import ROOT

from service.errors import OutsideError
from service.packages import EXTRAS, LIBRARIES, needing, remedy

HIDE = 'mount --bind "$1" "$2" && shift 2 && exec "$@"'
CLI = [sys.executable, "-m", "service.cli"]


def without_libusb(folder: Path, *command: str) -> subprocess.CompletedProcess[str]:
    """Run a command on this machine as if libusb were not installed; skips without means."""
    if find_spec("open3d") is None:
        pytest.skip("open3d is not installed (extra 'ground')")
    soname = ctypes.util.find_library("usb-1.0")
    if soname is not None:
        paths = [p for d in ("/lib", "/usr/lib") for p in Path(d).glob(f"*/{soname}")]
        empty = folder / "empty"
        empty.touch()
        hide = ["unshare", "-rm", "sh", "-c", HIDE, "sh", str(empty), str(paths[0].resolve())]
        if (
            shutil.which("unshare") is None
            or subprocess.run([*hide, "true"], check=False).returncode
        ):
            pytest.skip("cannot hide libusb: no user namespaces here")
        command = (*hide, *command)
    return subprocess.run(
        command, cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True,
        text=True, timeout=500, check=False,
    )  # fmt: skip


@pytest.mark.slow
def test_doctor_names_the_debian_package(tmp_path: Path) -> None:
    given = ("--set", f"scan.folder={tmp_path}", "--set", "compute.backend=cpu")
    done = without_libusb(tmp_path, *CLI, "doctor", "--json", *given)
    found = [
        f for f in json.loads(done.stdout.splitlines()[-1])["findings"] if "open3d" in f["text"]
    ]
    assert [f["verdict"] for f in found] == ["note"]
    assert "apt install" in found[0]["text"] and "libusb-1.0-0" in found[0]["text"]


@pytest.mark.slow
def test_a_command_without_its_library_ends_with_one_line(
    tmp_path: Path, house: HouseFlight
) -> None:
    house.flown(tmp_path / "scan").close()
    done = without_libusb(tmp_path, *CLI, "mesh", str(tmp_path / "scan"))
    assert done.returncode == 3, done.stderr
    line = done.stderr.splitlines()[-1]
    assert line.startswith("skyrelief: a mesh file needs ") and "apt install" in line
    assert "libusb-1.0-0" in line and "Traceback" not in done.stderr


def test_a_library_that_is_missing_is_named() -> None:
    with pytest.raises(OSError) as loader:
        ctypes.CDLL("libnone-of-that-name.so.7")
    error = ImportError(str(loader.value), name="_x", path="/venv/site-packages/thing/_x.so")
    assert "apt-file search libnone-of-that-name.so.7" in str(remedy(error))


def test_a_package_that_is_missing_is_named_with_its_extra() -> None:
    with (
        pytest.raises(OutsideError, match=r"^tides needs the package no_such_package; pip install"),
        needing("tides"),
    ):
        import no_such_package  # type: ignore[import-not-found]  # noqa: F401
    missing = ModuleNotFoundError("No module named 'rasterio.io'", name="rasterio.io")
    assert str(remedy(missing)).endswith("pip install rasterio")


def test_our_own_fault_stays_a_traceback() -> None:
    with pytest.raises(ImportError, match="cannot import name"), needing("this"):
        from service.packages import nothing_of_that_name  # type: ignore[attr-defined]  # noqa: F401


def test_what_loads_libraries_is_an_extra_of_ours() -> None:
    import msgspec.toml

    extras = msgspec.toml.decode((ROOT / "pyproject.toml").read_bytes())["project"]
    assert set(EXTRAS.values()) <= set(extras["optional-dependencies"])
    of_ground = {re.split("[<>=]", one)[0] for one in extras["optional-dependencies"]["ground"]}
    assert set(LIBRARIES) <= of_ground - set(EXTRAS)
