"""recon is a library: the example in docs/design.md runs as it stands."""

from __future__ import annotations

import re
import subprocess
import sys
from typing import Any

import pytest
from paths import DEMO, ROOT

import recon

TEXT = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")


def example() -> str:
    found = re.findall(r"```python\n(from pathlib.*?)```", TEXT, re.DOTALL)
    assert len(found) == 1
    return str(found[0])


@pytest.mark.slow
def test_the_example_makes_a_cloud(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(DEMO.parents[1])
    names: dict[str, Any] = {}
    exec(example(), names)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("keyframe ") and lines[-1].endswith(" points")
    cloud = names["cloud"]
    assert len(cloud) > 50_000
    height_m = 80.0 + cloud.xyz_m[:, 2]  # the first camera is the origin
    assert abs(float(height_m.mean())) < 25.0  # the height above ground is assumed


def test_every_name_of_the_library_is_there() -> None:
    assert all(getattr(recon, name) is not None for name in recon.__all__)
    with pytest.raises(AttributeError, match="nothing"):
        recon.nothing  # noqa: B018


def test_the_library_needs_nothing_of_the_service() -> None:
    code = "import sys; from recon import Mapper; print(*sys.modules)"
    ran = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert not [name for name in ran.stdout.split() if name.startswith(("service", "mavlink"))]
