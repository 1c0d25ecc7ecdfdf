"""Which backend is taken, what it keeps between starts, and a learned model in its place."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from paths import ROOT

from recon.backends import Backend, load_backend
from recon.stereo.belief_propagation import BeliefPropagationConfig
from service.commands.diagnosis import examine_compute
from service.compute.backend_choice import (
    Choice,
    choose_backend,
    engine_folder,
    fastest_backend,
    open_backend,
    pointless,
)
from service.config import ComputeConfig, load_config
from service.errors import InputError, OutsideError

GOOD = 'model = "net.onnx"\nheight = 96\nwidth = 192\n'


def declared(folder: Path, text: str = GOOD) -> Path:
    """A model that answers three tenths of a unit everywhere, and its declaration."""
    from exported_network import write_network

    write_network(folder / "net.onnx", 0.3)
    declaration = folder / "net.toml"
    declaration.write_text(text)
    return declaration


@pytest.mark.slow
def test_torch_without_a_device_runs_and_says_how_slow_it_is(
    caplog: pytest.LogCaptureFixture,
) -> None:
    torch = pytest.importorskip("torch")
    if torch.cuda.is_available():
        pytest.skip("there is a CUDA device")
    backend = choose_backend("torch")
    assert (backend.name, backend.device) == ("torch", "cpu")
    assert "expect about 12 times the duration of '--backend cpu'" in caplog.text


def test_onnx_is_for_a_model() -> None:
    """Without one a line says where it comes from."""
    with pytest.raises(InputError, match=r"give it with compute\.model .*export-model"):
        open_backend(ComputeConfig(backend="onnx"))


def test_auto_says_what_it_took_and_why(caplog: pytest.LogCaptureFixture) -> None:
    """One line for each that is left out, and the times of those that were tried."""
    caplog.set_level(logging.INFO)
    without_torch = Choice(pointless=lambda name: pointless(name, lambda _: None))
    assert choose_backend("auto", without_torch).name == "cpu"
    assert "backend torch: not tried, torch is not installed" in caplog.text
    assert "backend cpu on cpu, the only one" in caplog.text

    class Gpu:
        """A backend on a device."""

        name, device = "torch", "cuda"

    def trial(backend: Backend) -> float:
        if backend.name == "torch" and is_full:
            raise RuntimeError("CUDA out of memory")
        return {"cpu": 0.02, "torch": 0.004}[backend.name]

    def load(name: str) -> Any:
        return Gpu() if name == "torch" else load_backend(name)

    by = Choice(load, lambda name: None, trial)
    is_full = True
    assert fastest_backend(by).name == "cpu"
    assert "backend torch: failed its trial, CUDA out of memory" in caplog.text
    is_full = False
    assert fastest_backend(by).name == "torch"
    assert "torch on cuda: 4.0 ms a trial, the fastest of cpu 20.0 ms, torch 4.0 ms" in caplog.text


def test_doctor_explains_a_named_backend_that_cannot_run() -> None:
    """The same reason stops the start."""

    def refuse(name: str) -> Any:
        raise RuntimeError("CUDA driver is older than this torch")

    config, by = load_config(None, ["compute.backend=torch"]), Choice(refuse)
    (said,) = examine_compute(config, by)
    assert said.what == "compute" and said.verdict == "bad"
    assert said.text == "backend torch cannot run here: CUDA driver is older than this torch"
    with pytest.raises(OutsideError, match="older than this torch"):
        open_backend(config.compute, by=by)


def test_tensorrt_keeps_its_engines_and_no_other_provider_is_reported(tmp_path: Path) -> None:
    """Each model has its own folder: TensorRT tells models apart by names, which may be shared."""
    pytest.importorskip("onnxruntime")
    from recon.backends.onnx_backend import provider_options

    both = ["TensorrtExecutionProvider", "CPUExecutionProvider"]
    (first, kept), (second, none) = provider_options(both, b"one", str(tmp_path))
    assert (first, second) == tuple(both)
    assert kept["trt_engine_cache_enable"] is True
    assert Path(kept["trt_engine_cache_path"]).parent == tmp_path
    assert none == {}
    again, other = (provider_options(both, m, str(tmp_path))[0][1] for m in (b"one", b"two"))
    assert again == kept
    assert other["trt_engine_cache_path"] != kept["trt_engine_cache_path"]
    assert provider_options(both, b"one", None)[0][1] == {}
    cpu = ["CPUExecutionProvider"]
    assert provider_options(cpu, b"one", str(tmp_path)) == [("CPUExecutionProvider", {})]


def test_no_runtime_is_loaded_without_a_driver() -> None:
    """It takes tens of MiB for as long as the process lives."""
    script = (
        "import sys, importlib.util\n"
        "from service.compute import backend_choice\n"
        "backend_choice.find_spec = lambda name: 'found'\n"
        "backend_choice.loads = lambda library: False\n"
        "assert 'no CUDA driver' in backend_choice.pointless('torch')\n"
        "assert not {'torch', 'onnx', 'onnxruntime'} & set(sys.modules)\n"
    )
    root = str(ROOT)
    subprocess.run([sys.executable, "-c", script], check=True, cwd=root)


def test_engines_are_kept_where_the_service_may_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """systemd's cache folder when it gives one, else the user's."""
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)
    monkeypatch.setenv("TRITON_CACHE_DIR", "")
    monkeypatch.delenv("TRITON_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert engine_folder() == str(tmp_path / "skyrelief" / "engines")
    assert os.environ["TRITON_CACHE_DIR"] == str(tmp_path / "skyrelief" / "engines" / "triton")
    monkeypatch.setenv("CACHE_DIRECTORY", f"{tmp_path}/cache:/elsewhere")
    assert engine_folder() == str(tmp_path / "cache" / "engines")


def test_a_learned_model_serves_the_whole_path(tmp_path: Path) -> None:
    """``compute.model`` gives a backend whose labels are the model's."""
    text = GOOD + "disparity_scale = 10.0\n"
    config = ComputeConfig(backend="onnx", model=str(declared(tmp_path, text)), stereo_width=160)
    backend = open_backend(config, (640, 360))
    assert backend.name == "learned"
    image = np.random.default_rng(0).integers(0, 256, (90, 160), np.uint8)
    found = backend.belief_propagation(image, image, 16, BeliefPropagationConfig())
    assert np.nanmedian(found.px) == pytest.approx(3.0)
    assert np.isfinite(found.px[:, 8:]).all()
    large = np.random.default_rng(0).integers(0, 256, (180, 288), np.uint8)
    found = backend.belief_propagation(large, large, 16, BeliefPropagationConfig())
    shrunk = 288 / int(288 * 96 / 180)  # averaged down to fit; disparities grow back
    assert found.px.shape == (180, 288)
    assert np.nanmedian(found.px) == pytest.approx(3.0 * shrunk)


@pytest.mark.parametrize(
    ("text", "backend", "width", "image", "said"),
    [
        (GOOD, "torch", 160, None, "must be onnx or auto, not torch"),
        (GOOD, "onnx", 320, None, "takes pairs up to 192x96, but they would be 320 wide"),
        (GOOD, "auto", 160, (640, 480), "up to 192x96, but they would be 160x120"),
        (GOOD.replace("192", "200"), "onnx", 160, None, r"\[1, 3, 96, 200\] was expected"),
    ],
)
def test_a_learned_model_that_does_not_fit_is_refused(
    tmp_path: Path, text: str, backend: str, width: int,
    image: tuple[int, int] | None, said: str,
) -> None:  # fmt: skip
    """Before anything flies, with what was expected and what was found."""
    model = str(declared(tmp_path, text))
    with pytest.raises(InputError, match=said):
        open_backend(ComputeConfig(backend=backend, model=model, stereo_width=width), image)


@pytest.mark.parametrize(
    ("failure", "said"),
    [
        (RuntimeError("Failed to find C compiler"), "Failed to find C compiler"),
        (AttributeError("at 3:1:\n    area\n'int' object has no attribute 'to'"), "no attribute"),
    ],
)
@pytest.mark.slow  # the import of torch takes seconds
def test_kernels_that_do_not_compile_stop_the_start(
    failure: Exception, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No C compiler, or a kernel that this Triton refuses: before the flight, not in it."""
    pytest.importorskip("torch")
    pytest.importorskip("triton")
    from recon.backends import torch_backend

    def contrast(*given: object) -> None:
        raise failure

    monkeypatch.setattr(torch_backend, "contrast", contrast)
    with pytest.raises(RuntimeError, match=said):
        torch_backend.TorchBackend("cpu")
