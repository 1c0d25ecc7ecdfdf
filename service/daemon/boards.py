"""The boards that settings are delivered for: which one this is, what it would be given."""

from __future__ import annotations

import platform
import re
import sys
from pathlib import Path

from service.config import Config, keys, load_config

BOARDS: dict[str, str] = {
    "orin-nano": r"Orin.*Nano",
    "orin-nx": r"Orin.*NX",
    "orin-agx": r"AGX.*Orin",
    "raspberry-pi-5": r"Raspberry Pi 5|Compute Module 5",
}
"""Name of the profile to what the device tree calls the board; as in deploy/install.sh."""

PLACES = (
    Path(__file__).resolve().parents[2] / "deploy" / "profiles",
    Path(sys.prefix) / "share" / "skyrelief" / "deploy" / "profiles",
)


def board_of(model: str) -> str:
    """The profile's name for a board called ``model``; empty when there is none."""
    for name, pattern in BOARDS.items():
        if re.search(pattern, model):
            return name
    return "x86-bench" if platform.machine() == "x86_64" else ""


def profile_path(name: str) -> Path | None:
    """The profile's file; None when it is not installed."""
    found = (place / f"{name}.toml" for place in PLACES)
    return next((path for path in found if path.is_file()), None)


def other_than_profile(config: Config, path: Path) -> list[str]:
    """What the profile sets and ``config`` has otherwise: ``compute.threads = 0, not 4``."""
    profile, default = load_config(path), Config()
    out = []
    for section, field in keys():
        wanted = getattr(getattr(profile, section), field.name)
        if wanted == getattr(getattr(default, section), field.name):
            continue
        value = getattr(getattr(config, section), field.name)
        if value != wanted:
            out.append(f"{section}.{field.name} = {value}, not {wanted}")
    return out
