"""Write the requirements with hashes, the SBOM and ``THIRD_PARTY_NOTICES`` of a bundle.

    python3 deploy/inventory.py BUNDLE

Reads the wheels in BUNDLE/wheels and writes the three files next to them. Needs Python alone, so
that it runs wherever deploy/bundle.sh does.
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
import uuid
import zipfile
from dataclasses import dataclass
from email.message import Message
from email.parser import Parser
from pathlib import Path

GPL_LIBRARIES = ("x264", "x265")
COPYLEFT = re.compile(r"\b[AL]?GPL|GNU |Lesser|\bMPL|Mozilla", re.IGNORECASE)
DUTIES = """\
skyrelief itself is Apache-2.0. Distributing this bundle, on a medium or inside a product, also
distributes the packages below; their licences apply:

- keep this file and the licence texts inside the wheels with every copy;
- for GPL, LGPL and MPL parts, provide or offer the source code of exactly the versions listed
  (for wheels from PyPI: the source archive of the same version, and of the libraries inside);
- leave LGPL parts replaceable: they are installed as wheels of their own, unchanged, and
  'pip install' in the version's folder replaces them;
- GPL libraries inside a wheel put that wheel under the GPL, and the program that loads it when
  both are passed on together. To ship a product without that, build the wheel against an FFmpeg
  without GPL parts (pip wheel --no-binary av av, with an FFmpeg configured without --enable-gpl)
  and put it in place of the one here; only 'skyrelief simulate' encodes, nothing that flies does.
"""


@dataclass(frozen=True)
class Part:
    """One wheel of the bundle."""

    name: str
    version: str
    license: str
    digest: str  # sha256 of the wheel
    libraries: tuple[str, ...]  # shared libraries that the wheel brings
    texts: tuple[tuple[str, str], ...]  # licence files: name, text

    @property
    def purl(self) -> str:
        """Its package URL."""
        return f"pkg:pypi/{re.sub(r'[-_.]+', '-', self.name).lower()}@{self.version}"

    @property
    def gpl_inside(self) -> list[str]:
        """The libraries in it that are under the GPL."""
        return [lib for lib in self.libraries if any(name in lib for name in GPL_LIBRARIES)]


def read_wheel(path: Path) -> Part:
    """Read the metadata of a wheel."""
    with zipfile.ZipFile(path) as wheel:
        names = wheel.namelist()
        (about,) = (n for n in names if re.fullmatch(r"[^/]+\.dist-info/METADATA", n))
        message = Parser().parsestr(wheel.read(about).decode())
        info = about.rpartition("/")[0] + "/"
        texts = tuple(
            (n.rpartition("/")[2], wheel.read(n).decode("utf-8", "replace"))
            for n in sorted(names)
            if n.startswith(info) and re.search(r"(licen[cs]e|copying|notice)[^/]*$", n, re.I)
        )
    libraries = sorted(n.rpartition("/")[2] for n in names if re.search(r"\.libs/[^/]+\.so", n))
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    name, version = str(message["Name"]), str(message["Version"])
    return Part(name, version, _license(message), digest, tuple(libraries), texts)


def _license(about: Message) -> str:
    """The licence in one line: SPDX where given, else what the author wrote, else classifiers."""
    given = about["License-Expression"] or about["License"] or ""
    if given and "\n" not in given and len(given) < 100:
        return str(given)
    classified = [
        c.rpartition(" :: ")[2] for c in about.get_all("Classifier", ()) if "License ::" in c
    ]
    return ", ".join(classified) or str(given).strip().split("\n")[0][:100] or "see its texts"


def requirements(parts: list[Part]) -> str:
    """A requirements file for ``pip install --require-hashes``."""
    head = "# The wheels of this bundle; deploy/install.sh installs exactly these.\n"
    return head + "".join(f"{p.name}=={p.version} --hash=sha256:{p.digest}\n" for p in parts)


def sbom(parts: list[Part]) -> dict[str, object]:
    """A CycloneDX 1.6 document; the same wheels give the same document."""
    own = next(p for p in parts if p.name == "skyrelief")
    identity = uuid.uuid5(uuid.NAMESPACE_URL, "\n".join(p.digest for p in parts))
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "serialNumber": f"urn:uuid:{identity}",
        "version": 1,
        "metadata": {"component": _component(own) | {"type": "application"}},
        "components": [_component(p) for p in parts if p is not own],
        "dependencies": [
            {"ref": own.purl, "dependsOn": [p.purl for p in parts if p is not own]},
        ],
    }


def _component(part: Part) -> dict[str, object]:
    return {
        "type": "library",
        "bom-ref": part.purl,
        "name": part.name,
        "version": part.version,
        "purl": part.purl,
        "hashes": [{"alg": "SHA-256", "content": part.digest}],
        "licenses": [{"license": {"name": part.license}}],
        "properties": [{"name": "skyrelief:library", "value": lib} for lib in part.libraries],
    }


def notices(parts: list[Part]) -> str:
    """The licences of everything in the bundle, those that ask for more first."""
    lines = ["Third-party software in this bundle", "", DUTIES]
    asking = [p for p in parts if p.gpl_inside or COPYLEFT.search(p.license)]
    lines += ["Packages that ask for more than their notice:", ""]
    for part in asking:
        inside = f"; contains {', '.join(part.gpl_inside)} (GPL-2.0-or-later)" * bool(
            part.gpl_inside
        )
        lines.append(f"  {part.name} {part.version}: {part.license}{inside}")
    lines += ["", "All packages:", ""]
    lines += [f"  {p.name} {p.version}: {p.license}" for p in parts]
    for part in parts:
        for name, text in part.texts:
            lines += ["", "=" * 78, f"{part.name} {part.version}: {name}", "=" * 78, text.rstrip()]
    return "\n".join(lines) + "\n"


def main(bundle: Path) -> None:
    """Write the three files."""
    wheels = sorted((bundle / "wheels").glob("*.whl"), key=lambda path: path.name.lower())
    parts = [read_wheel(path) for path in wheels]
    (bundle / "requirements.txt").write_text(requirements(parts), encoding="utf-8")
    (bundle / "sbom.cdx.json").write_text(json.dumps(sbom(parts), indent=1) + "\n")
    (bundle / "THIRD_PARTY_NOTICES").write_text(notices(parts), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
