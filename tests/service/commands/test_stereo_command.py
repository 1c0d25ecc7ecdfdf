"""``skyrelief stereo`` and ``export-model``: files in and out, and what is refused."""

from __future__ import annotations

import copy
import json
import pickle
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from bench_middlebury import true_pairs
from bench_scenes import bad_share, semi_global_disparity
from command_line import skyrelief
from paths import SHARED

from recon.backends.cpu import CpuBackend
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.types import U8, DisparityMap
from service.commands.stereo import (
    FREE_SHARE,
    LABEL_BYTES,
    matched,
    matching_config,
    read_gray,
)
from service.compute.backend_choice import Choice, FallbackBackend, choose_backend
from service.errors import InputError, OutsideError

DATA = SHARED / "stereo_gt_middlebury"


def run(*words: object) -> int:
    """Exit code of the command line, whose words are printed on."""
    ended = skyrelief(*map(str, words))
    print(ended.stdout, end="")
    print(ended.stderr, end="", file=sys.stderr)
    return ended.returncode


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    """Two images of a textured wall at a disparity of 9.5 px."""
    canvas = np.random.default_rng(0).normal(128, 90, (80, 300)).astype(np.float32)
    canvas = np.asarray(cv2.GaussianBlur(canvas, (0, 0), 1.3))
    v, u = np.mgrid[0:80, 0:160].astype(np.float32)
    left = cv2.remap(canvas, u + 60 - np.float32(9.5), v, cv2.INTER_CUBIC)
    paths = tmp_path / "left.png", tmp_path / "right.png"
    for path, image in zip(paths, (left, canvas[:, 60:220]), strict=True):
        cv2.imwrite(str(path), np.clip(image, 0, 255).astype(np.uint8))
    return paths


@pytest.mark.parametrize(("first", "labels"), [(0, 16), (5, 10), (-3, 20)])
def test_writes_disparity_in_pixels(
    pair: tuple[Path, Path], tmp_path: Path,
    capsys: pytest.CaptureFixture[str], first: int, labels: int,
) -> None:  # fmt: skip
    out, image = tmp_path / "d.npy", tmp_path / "d.png"
    code = run("stereo", *pair, "--labels", labels, "--min-disparity", first,
        "--out", out, "--image", image, "--backend", "cpu", "--json",
    )  # fmt: skip
    assert code == 0
    report = json.loads(capsys.readouterr().out.splitlines()[-1])
    px = np.load(out)
    assert px.dtype == np.float32
    assert px.shape == (80, 160)
    assert report["known_share"] == pytest.approx(np.isfinite(px).mean())
    assert abs(np.nanmedian(px[:, 20:]) - 9.5) < 0.1
    assert np.isfinite(px[:, 24:]).mean() > 0.98
    drawn = cv2.imread(str(image))
    assert drawn is not None
    assert drawn.shape == (80, 160, 3)


@pytest.mark.parametrize(("first", "labels"), [(0, 64), (20, 40), (-12, 80)])
@pytest.mark.parametrize("shrink", [2, 4])
def test_a_pair_that_needs_too_much_memory_is_matched_on_smaller_images(
    pair: tuple[Path, Path], caplog: pytest.LogCaptureFixture, first: int, labels: int, shrink: int
) -> None:
    left, right = (np.asarray(cv2.resize(read_gray(path), (640, 320))) for path in pair)
    config = matching_config(labels, 5, first, checked=False)
    needed = LABEL_BYTES * left.size * labels / FREE_SHARE
    found = matched(CpuBackend(), left, right, labels, config, needed / (shrink**3 - 0.5))
    assert f"matched on {640 // shrink}x{320 // shrink} and upsampled" in caplog.text
    assert found.px.shape == left.shape and found.confidence.shape == left.shape
    assert abs(np.nanmedian(found.px[:, 80:]) + first - 38.0) < 0.4
    assert np.nanmin(found.px) >= 0.0 and np.nanmax(found.px) <= labels - 1.0
    caplog.clear()
    whole = matched(CpuBackend(), left, right, labels, config, 2.0 * needed)
    assert caplog.text == "" and abs(np.nanmedian(whole.px[:, 80:]) + first - 38.0) < 0.4


@pytest.mark.parametrize("lower_px", [0.0, 0.3, 1.5, -2.0])
def test_rows_that_lie_apart_are_brought_together(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], lower_px: float
) -> None:
    """The right image is turned by 0.1 degrees as well, about its left border's middle."""
    canvas = np.random.default_rng(0).normal(128, 90, (340, 500)).astype(np.float32)
    canvas = np.asarray(cv2.GaussianBlur(canvas, (0, 0), 1.3))
    v, u = (one.astype(np.float32) for one in np.mgrid[0:240, 0:320])
    turn = np.float32(0.0 if abs(lower_px) < 1.0 else 0.0017)
    names = tmp_path / "left.png", tmp_path / "right.png"
    there = u + 70, v + 50 - np.float32(lower_px) - turn * u
    for name, (x, y) in zip(names, ((u + 70 - np.float32(9.5), v + 50), there), strict=True):
        image = cv2.remap(canvas, x, y, cv2.INTER_CUBIC)
        cv2.imwrite(str(name), np.clip(image, 0, 255).astype(np.uint8))
    words = ("stereo", *names, "--labels", 16, "--out", tmp_path / "d.npy", "--backend", "cpu")
    assert run(*words, "--json") == 0
    report = json.loads(capsys.readouterr().out.splitlines()[-1])
    seen = lower_px + float(turn) * 160 if turn else 0.0  # less than half a pixel stays
    assert report["rows_px"] == pytest.approx(seen, abs=0.15)
    off = np.abs(np.load(tmp_path / "d.npy")[8:-8, 20:-8] - 9.5)
    assert np.nanmean(off < 0.5) > 0.98 and np.isfinite(off).mean() > 0.95


@pytest.mark.parametrize(
    ("order", "first", "words"),
    [(1, 0, ""), (-1, 0, "or give the images in the other order"), (1, 40, "--min-disparity")],
)
def test_disparities_that_are_not_looked_for_are_reported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, order: int, first: int, words: str
) -> None:
    canvas = np.random.default_rng(0).normal(128, 90, (240, 400)).astype(np.float32)
    canvas = np.asarray(cv2.GaussianBlur(canvas, (0, 0), 1.3)).clip(0, 255).astype(np.uint8)
    names = tmp_path / "a.png", tmp_path / "b.png"
    for name, first_px in zip(names[::order], (60, 69), strict=True):
        cv2.imwrite(str(name), canvas[:, first_px : first_px + 320])
    words_of = ("--labels", 16, "--min-disparity", first, "--out", tmp_path / "d.npy")
    assert run("stereo", *names, *words_of, "--backend", "cpu") == 0
    assert words in caplog.text and ("disparities of" in caplog.text) == bool(words)


def scene(size_px: tuple[int, int] = (400, 240)) -> U8:
    W, H = size_px
    canvas = np.random.default_rng(0).normal(128, 90, (H, W)).astype(np.float32)
    soft = np.asarray(cv2.GaussianBlur(canvas, (0, 0), 1.3))
    return np.asarray(soft.clip(0, 255).astype(np.uint8))


@pytest.mark.parametrize(
    ("turned", "words"),
    [
        (lambda image: image, ""),
        (lambda image: image[:, ::-1], "neither mirrored nor turned"),
        (lambda image: image[::-1], "neither mirrored nor turned"),
        (lambda image: np.roll(image, 9, axis=0), "most features 9 px lower"),
    ],
)
def test_a_pair_whose_rows_do_not_match_is_reported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, turned: Callable[[U8], U8], words: str
) -> None:
    names, canvas = (tmp_path / "a.png", tmp_path / "b.png"), scene()
    for name, image in zip(names, (canvas[:, 60:380], turned(canvas[:, 69:389])), strict=True):
        cv2.imwrite(str(name), image)
    out = tmp_path / "d.npy"
    assert run("stereo", *names, "--labels", 16, "--out", out, "--backend", "cpu") == 0
    assert words in caplog.text and ("rectif" in caplog.text) == bool(words)


def test_colours_of_floats_are_read(pair: tuple[Path, Path], tmp_path: Path) -> None:
    names = tmp_path / "a.tiff", tmp_path / "b.tiff"
    for name, of in zip(names, pair, strict=True):
        image = cv2.imread(str(of))
        assert image is not None
        cv2.imwrite(str(name), image.astype(np.float32) / np.float32(255))
    out = tmp_path / "d.npy"
    assert run("stereo", *names, "--labels", 16, "--out", out, "--backend", "cpu") == 0
    assert right_share(np.load(out)) > 0.98


def test_a_dark_image_is_matched_with_a_bright_one(pair: tuple[Path, Path], tmp_path: Path) -> None:
    """A thirtieth of the light: eight levels are left."""
    left, right = (np.asarray(cv2.imread(str(name), 0), np.float32) for name in pair)
    dark = np.asarray((0.03 * left).astype(np.uint8))
    assert right_share(found_by(tmp_path, dark, right.astype(np.uint8))) > 0.97


def test_an_image_of_a_pixel_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = tmp_path / "a.png"
    cv2.imwrite(str(name), np.zeros((1, 1), np.uint8))
    assert run("stereo", name, name, "--labels", 2, "--out", tmp_path / "d.npy") == 2
    assert "sides are 8 px at least" in capsys.readouterr().err


def found_by(tmp_path: Path, left: Any, right: Any) -> Any:
    """Disparity by the command, of two images as they are stored in PNG."""
    names = tmp_path / "a.png", tmp_path / "b.png"
    for name, image in zip(names, (left, right), strict=True):
        cv2.imwrite(str(name), image)
    out = tmp_path / "found.npy"
    assert run("stereo", *names, "--labels", 16, "--out", out, "--backend", "cpu") == 0
    return np.load(out)


def right_share(px: Any) -> float:
    return float(np.mean(np.abs(px[8:-8, 24:-8] - 9.5) < 1.0))


def test_the_sharper_of_two_images_is_blurred_like_the_other(
    pair: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    left, right = (cv2.imread(str(name), 0) for name in pair)
    assert left is not None and right is not None
    noise = np.random.default_rng(1).normal(0, 2, (2, *left.shape))
    left, right = (np.clip(i + n, 0, 255) for i, n in zip((left, right), noise, strict=True))
    soft = cv2.GaussianBlur(right, (0, 0), 2.5).astype(np.uint8)
    sharp = left.astype(np.uint8), right.astype(np.uint8)
    assert right_share(found_by(tmp_path, *sharp)) > 0.98
    assert "blurred" not in capsys.readouterr().out
    assert right_share(found_by(tmp_path, sharp[0], soft)) > 0.95
    assert "left image sharper: blurred like the other" in capsys.readouterr().out


def test_noise_is_suppressed_where_it_hides_the_scene(
    pair: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As in a dark pair: of twelve levels, with noise of two."""
    dim = [0.05 * np.asarray(cv2.imread(str(name), 0), np.float32) for name in pair]
    noise = np.random.default_rng(1).normal(0, 2, (2, *dim[0].shape))
    dark = [np.clip(i + n, 0, 255).astype(np.uint8) for i, n in zip(dim, noise, strict=True)]
    assert right_share(found_by(tmp_path, *dark)) > 0.6
    assert "both images noisy: blurred" in capsys.readouterr().out


def test_images_of_ten_bits_are_matched_like_those_of_eight(
    pair: tuple[Path, Path], tmp_path: Path
) -> None:
    """Stored in 16 bits, as many cameras do."""
    deep = []
    for name in pair:
        image = cv2.imread(str(name), 0)
        assert image is not None
        deep.append(image.astype(np.uint16) + 400)  # of 1023 levels
    assert right_share(found_by(tmp_path, *deep)) > 0.98


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"--labels": "1"}, "2 to 1024"), ({"--iterations": "0"}, "iterations"),
        ({"--backend": "abacus"}, "available: auto, cpu"), ({"--out": "d.txt"}, ".npy"),
        ({"--out": "nowhere/d.npy"}, "no folder"), ({"--model": "none.toml"}, "none.toml"),
    ],
)  # fmt: skip
def test_bad_usage_is_one_line(
    pair: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str], change: dict[str, str], words: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    options = {"--labels": "16", "--out": "d.npy"} | change
    assert run("stereo", *pair, *(w for item in options.items() for w in item)) == 2
    error = capsys.readouterr().err.strip()
    assert words in error
    assert len([line for line in error.splitlines() if line.startswith("skyrelief")]) == 1


def test_bad_images_are_named(
    pair: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text, empty, small = tmp_path / "notes.png", tmp_path / "empty.png", tmp_path / "small.png"
    text.write_text("not an image")
    empty.touch()
    cv2.imwrite(str(small), np.zeros((40, 60), np.uint8))
    for bad, words in (
        (text, "not an image"), (empty, "not an image"), (small, "one size"),
        (tmp_path / "gone.png", "no such file"), (tmp_path, "no such file"),
    ):  # fmt: skip
        out = tmp_path / "d.npy"
        assert run("stereo", pair[0], bad, "--labels", 16, "--out", out) == 2
        assert words in capsys.readouterr().err
        assert not out.exists()


def test_blank_pair_gives_an_unknown_map(tmp_path: Path) -> None:
    path = tmp_path / "blank.png"
    cv2.imwrite(str(path), np.full((60, 80, 3), 200, np.uint8))
    out = tmp_path / "d.npy"
    assert run("stereo", path, path, "--labels", 16, "--out", out) == 0
    assert np.isnan(np.load(out)).all()


class Broken(CpuBackend):
    """A backend whose device is lost."""

    name, device = "torch", "cuda"

    def belief_propagation(
        self, left: U8, right: U8, labels: int, config: BeliefPropagationConfig
    ) -> DisparityMap:
        """Fails as torch does."""
        raise RuntimeError("CUDA out of memory\nmore lines")

    def upsample(self, *given: object) -> DisparityMap:
        """Fails too."""
        raise RuntimeError("CUDA out of memory")


def test_a_lost_device_falls_back_to_the_cpu(caplog: pytest.LogCaptureFixture) -> None:
    image = np.random.default_rng(0).integers(0, 256, (40, 60), np.uint8)
    backend = FallbackBackend(Broken())
    found = backend.belief_propagation(image, image, 4, BeliefPropagationConfig())
    assert np.nanmedian(found.px) == pytest.approx(0, abs=0.1)
    assert backend.name == backend.device == "cpu"
    assert backend.failure == "CUDA out of memory"
    assert "the CPU takes over" in caplog.text


@pytest.mark.parametrize(
    "copied", [copy.copy, copy.deepcopy, lambda b: pickle.loads(pickle.dumps(b))]
)
def test_a_backend_with_the_cpu_in_reserve_can_be_copied(copied: Callable[[Any], Any]) -> None:
    backend = copied(FallbackBackend(CpuBackend()))
    assert backend.name == "cpu" and backend.failure is None
    with pytest.raises(AttributeError, match="nothing"):
        _ = backend.nothing


def test_auto_takes_the_fastest_that_works() -> None:
    assert choose_backend("auto").name == "cpu"  # no GPU is tried where there is no driver
    slow = {"cpu": 0.5, "torch": 0.1}

    class Named(Broken):
        """A backend of any name."""

        def __init__(self, name: str) -> None:
            self.name = name

    by = Choice(Named, lambda name: None, lambda backend: slow[backend.name])
    assert choose_backend("auto", by).name == "torch"
    slow["torch"] = 0.9
    assert choose_backend("auto", by).name == "cpu"


def test_named_backend_that_cannot_run_stops() -> None:
    def refuse(name: str) -> Any:
        raise ImportError("No module named 'torch'")

    with pytest.raises(OutsideError, match="torch cannot run here: No module named"):
        choose_backend("torch", Choice(refuse))
    with pytest.raises(InputError, match="available: auto"):
        choose_backend("vulkan")


@pytest.mark.slow
def test_exported_model_gives_the_same_labels(
    tmp_path: Path, pair: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    """``export-model`` writes a model and the declaration that runs it."""
    pytest.importorskip("onnxruntime")
    pytest.importorskip("torch")
    out = tmp_path / "stereo.onnx"
    size = ("--size", "160x80", "--iterations", "1")
    assert run("export-model", *size, "--out", out) == 0
    model, found = tmp_path / "stereo.toml", tmp_path / "d.npy"
    words = ("stereo", *pair, "--labels", 16, "--out", found, "--backend", "onnx")
    assert run(*words, "--model", model) == 0
    px = np.load(found)
    assert np.isfinite(px)[:, 24:].mean() > 0.95
    assert abs(np.nanmedian(px) - 9.5) < 0.1
    assert run(*words) == 2
    assert "give it with compute.model" in capsys.readouterr().err
    assert run("export-model", "--size", "160", "--out", out) == 2
    assert run("export-model", "--out", tmp_path / "stereo.bin") == 2


@pytest.mark.slow
def test_learned_model_is_checked_and_used(
    tmp_path: Path, pair: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    """A model that says 9.5 px everywhere, declared rightly or not."""
    from exported_network import write_network

    write_network(tmp_path / "net.onnx", 0.95, ("image_l", "image_r", "disp"))
    declaration = tmp_path / "net.toml"
    good = 'model = "net.onnx"\nheight = 96\nwidth = 192\nleft = "image_l"\nright = "image_r"\n'
    good += 'disparity = "disp"\ndisparity_scale = 10.0\n'
    declaration.write_text(good)
    out = tmp_path / "d.npy"
    words = ("stereo", *pair, "--labels", 16, "--out", out, "--model", declaration)
    assert run(*words) == 0
    px = np.load(out)
    assert np.nanmedian(px) == pytest.approx(9.5)
    assert np.isnan(px[:, :8]).all()  # their partners lie outside the right image
    for wrong, said in (
        (good.replace("192", "200"), "[1, 3, 96, 200] was expected"),
        (good.replace("image_r", "image_x"), "'image_x' was expected"),
        (good.replace('"disp"', '"depth"'), "'depth' was expected"),
        (good + 'layout = "nhwc"\n', "was expected, found"),
        (good + "colour = 3\n", "unknown colour"),
        (good.replace("net.onnx", "other.onnx"), "not a file"),
        (good.replace("height = 96\n", ""), "height must be given"),
    ):
        declaration.write_text(wrong)
        assert run(*words) == 2
        assert said in capsys.readouterr().err


@pytest.mark.skipif(not DATA.is_dir(), reason="the Middlebury pairs are not here")
def test_better_than_semi_global_matching_on_truth() -> None:
    """Cones within 3.3 % bad pixels, and every pair better than OpenCV's matcher at its best."""
    from recon.stereo.belief_propagation import belief_propagation

    for pair in true_pairs(DATA):
        config = matching_config(pair.labels, 5, 0, checked=False)
        px = belief_propagation(pair.left, pair.right, pair.labels, config).px
        theirs = min(bad_share(semi_global_disparity(pair, mode), pair, 1.0) for mode in (0, 2))
        ours = bad_share(px, pair, 1.0)
        assert ours < 0.8 * theirs, pair.name
        assert pair.name != "cones" or ours <= 0.033
