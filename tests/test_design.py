"""docs/design.md says what the code says."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")


def test_every_path_in_it_exists() -> None:
    paths = re.findall(r"`((?:service|recon|mavlink|tests)/[\w./]+)`", TEXT)
    assert len(paths) > 20
    assert [path for path in paths if not (ROOT / path).exists()] == []


def test_the_image_of_the_architecture_is_up_to_date() -> None:
    spec = importlib.util.spec_from_file_location("architecture", ROOT / "docs/architecture.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.SVG.read_text(encoding="utf-8") == module.drawing(), "run docs/architecture.py"
