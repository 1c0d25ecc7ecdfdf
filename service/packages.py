"""Optional packages, their system libraries, and error texts for missing ones."""

from __future__ import annotations

import contextlib
import ctypes
import re
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

from service.errors import OutsideError

EXTRAS = {
    "distributed": "cluster",
    "gsplat": "splat",
    "onnx": "onnx",
    "onnxruntime": "onnx",
    "pyulog": "logs",
    "rosbags": "ros2",
    "starlette": "portal",
    "torch": "gpu",
    "uvicorn": "portal",
    "websockets": "portal",
}
"""Import name to the smallest extra of skyrelief that installs it, but for those of ``ground``."""

NAMES = {"foxglove": "foxglove-sdk", "google": "protobuf", "skimage": "scikit-image"}
"""Import name to the package's name, where they differ."""

LIBRARIES = {
    "open3d": {
        "libEGL.so.1": "libegl1",
        "libGL.so.1": "libgl1",
        "libX11.so.6": "libx11-6",
        "libidn2.so.0": "libidn2-0",
        "libudev.so.1": "libudev1",
        "libusb-1.0.so.0": "libusb-1.0-0",
    },
    "rasterio": {"libexpat.so.1": "libexpat1"},
}
"""Import name to the system libraries that its wheel needs, each with its Debian package."""

OURS = ("service", "recon", "mavlink")
NOT_LOADED = re.compile(
    r"(?:\S*/)?([^\s/]+\.so[.\d]*): (?:cannot open shared|file too short|invalid ELF header)"
)
"""The dynamic loader's message about a missing or broken library."""


def missing_libraries(package: str) -> list[str]:
    """The Debian packages that ``package`` needs and this system lacks, without importing it."""
    return [deb for name, deb in LIBRARIES.get(package, {}).items() if not loads(name)]


def unusable_packages() -> dict[str, list[str]]:
    """Installed packages that lack system libraries: import name to Debian packages."""
    installed = [name for name in LIBRARIES if find_spec(name) is not None]
    return {name: lacks for name in installed if (lacks := missing_libraries(name))}


def loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def remedy(error: ImportError) -> str | None:
    """The missing import and the package to install; None when the fault is in our own code."""
    package = _package(error)
    found = NOT_LOADED.match(str(error))
    if found is not None:
        debian = " ".join(missing_libraries(package))
        if debian:
            return f"{debian} of the system, for {package}; apt install {debian}"
        return f"{found[1]} of the system, for {package}; 'apt-file search {found[1]}' names it"
    if not package or package in OURS:
        return None
    if isinstance(error, ModuleNotFoundError):
        return f"the package {error.name}; pip install {installs(package)}"
    return f"a {package} that fits ({error}); install skyrelief again in a fresh environment"


def installs(package: str) -> str:
    """What to give to pip for an import: the extra, or of the large ``ground`` one package."""
    extra = EXTRAS.get(package, "ground")
    return NAMES.get(package, package) if extra == "ground" else f"'skyrelief[{extra}]'"


def _package(error: ImportError) -> str:
    """The import name of the failed package; extension modules name only themselves."""
    inside = Path(error.path or "").parts
    return next((name for name in LIBRARIES if name in inside), (error.name or "").split(".")[0])


@contextlib.contextmanager
def needing(what: str) -> Iterator[None]:
    """Raise OutsideError, one line with the remedy, when an import in the block fails."""
    try:
        yield
    except ImportError as error:
        line = remedy(error)
        if line is None:
            raise
        raise OutsideError(f"{what} needs {line}") from error


if __name__ == "__main__":  # for scripts that install missing packages
    for _debian in sorted({name for names in unusable_packages().values() for name in names}):
        print(_debian)
