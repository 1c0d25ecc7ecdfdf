"""Where ``skyrelief demo`` finds its flight, and when it compiles."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from loopback import until
from spied import spied

import service
from service.commands import demo
from service.errors import InputError
from service.stream import plane_coders


def make_flight(home: Path) -> Path:
    folder = home / demo.FLIGHT
    (folder / "frames").mkdir(parents=True)
    (folder / "camera.yaml").touch()
    return folder


def test_an_installed_wheel_brings_the_flight(tmp_path: Path) -> None:
    clone, brought = demo.HOMES
    assert clone == Path(service.__file__).resolve().parents[1] and brought.name == "skyrelief"
    homes = (tmp_path / "site", tmp_path / "venv" / "share" / "skyrelief")
    with pytest.raises(InputError, match="--flight"):
        demo.demo_flight(None, homes)
    brought = make_flight(homes[1])
    assert demo.demo_flight(None, homes) == brought
    clone = make_flight(homes[0])
    assert demo.demo_flight(None, homes) == clone


def test_kernels_of_partly_new_keyframes_are_compiled_too(monkeypatch: pytest.MonkeyPatch) -> None:
    kernels = [
        spied(monkeypatch, module, name)
        for module, name in (
            (plane_coders, "_encode_bits"), (plane_coders, "_decode_bits"), (plane_coders, "calm"),
        )
    ]  # fmt: skip
    demo.compile_kernels()
    assert all(kernel.called for kernel in kernels)


def test_a_named_flight_alone_counts(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing-here contains no frames"):
        demo.demo_flight(tmp_path / "nothing-here")


def test_the_verdict_begins_with_what_holds_within_the_map() -> None:
    quality: dict[str, Any] = {
        "sigma_median_m": 0.054, "scale_sigma": 0.0464, "position_sigma_h_median_m": 6.57,
        "position_sigma_v_median_m": 23.4, "sigma_absolute_median_m": 23.7,
        "trust": {"level": "georeferenced", "reasons": ["no"]},
    }  # fmt: skip
    assert demo.verdict(quality) == (
        "georeferenced: relative ± 5.4 cm, lengths ± 4.6 %, absolute ± 6.57 m across, ± 24 m up"
    )
    quality |= {"scale_sigma": None, "position_sigma_h_median_m": None}
    assert demo.verdict(quality) == "georeferenced: relative ± 5.4 cm"
    assert demo.verdict(quality | {"sigma_median_m": None}) == "georeferenced"


@pytest.mark.slow
def test_kernels_are_compiled_meanwhile_the_first_time_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    (compiler,) = demo.compile_meanwhile()
    try:
        until(lambda: any(tmp_path.rglob("*.nbi")), 120.0)
        assert demo.compile_meanwhile() == []
    finally:
        compiler.kill()
        compiler.wait()
