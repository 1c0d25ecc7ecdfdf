"""The configuration is strict, documented, and says in one line what is wrong."""

from __future__ import annotations

import json
from pathlib import Path
from typing import cast

import pytest

from service.cameras.source import CameraSource
from service.commands.replay import denser
from service.commands.setup import to_toml
from service.config import Config, is_given, keys, load_config, parse_baseline
from service.errors import InputError

AGREED = """
[camera]
source = "rtsp://192.168.144.25:8554/main"
model = "/etc/skyrelief/camera.yaml"
[mavlink]
links = ["serial:/dev/serial/by-id/usb-x:921600"]
[scan]
folder = "/var/lib/skyrelief/scans"
baseline = "auto"
start = "on-command"
[compute]
backend = "auto"
[datalink]
connect = ["tcp/192.168.144.11:7447"]
budget_kbit_s = 1000
[fusion]
gnss = true
[health]
http = "127.0.0.1:9560"
"""


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "skyrelief.toml"
    path.write_text(text)
    return path


def test_agreed_keys_load(tmp_path: Path) -> None:
    config = load_config(written(tmp_path, AGREED))
    assert config.camera.source == "rtsp://192.168.144.25:8554/main"
    assert config.mavlink.links == ("serial:/dev/serial/by-id/usb-x:921600",)
    assert config.datalink.connect == ("tcp/192.168.144.11:7447",)
    assert config.datalink.budget_kbit_s == 1000.0
    assert config.scan.baseline == "auto"
    assert config.compute == Config().compute


def test_no_file_is_the_defaults() -> None:
    assert load_config() == Config()
    assert Config().scan.drone_name


def test_printed_default_is_the_default(tmp_path: Path) -> None:
    text = to_toml(Config().to_dict(), documented=True)
    assert load_config(written(tmp_path, text)) == Config()
    for section, field in keys():
        assert field.metadata["doc"] in text, f"{section}.{field.name}"


def test_shown_configuration_loads_as_itself(tmp_path: Path) -> None:
    config = load_config(
        None,
        [
            'scan.drone=Kestrel "7" \\ é',
            "scan.baseline=2/10",
            'datalink.connect=["tcp/a:1", "tls/b:2"]',
            "scan.assumed_agl_m=61.5",
            "fusion.gnss=false",
        ],
    )
    assert load_config(written(tmp_path, to_toml(config.to_dict()))) == config
    json.dumps(config.to_dict())


@pytest.mark.parametrize(
    ("override", "section", "name", "value"),
    [
        ("scan.baseline=4", "scan", "baseline", 4.0),
        ("scan.baseline=2/10", "scan", "baseline", "2/10"),
        ("scan.drone=1234", "scan", "drone", "1234"),
        ("scan.drone=true", "scan", "drone", "true"),
        ("scan.drone=a=b", "scan", "drone", "a=b"),
        ("compute.backend=torch", "compute", "backend", "torch"),
        ('compute.backend="onnx"', "compute", "backend", "onnx"),
        (" scan.keep_debug = true ", "scan", "keep_debug", True),
        ("mavlink.links=udpin:0.0.0.0:14550", "mavlink", "links", ("udpin:0.0.0.0:14550",)),
        ("camera.mount_pitch_deg=-45", "camera", "mount_pitch_deg", -45.0),
    ],
)
def test_overrides(override: str, section: str, name: str, value: object) -> None:
    assert getattr(getattr(load_config(None, [override]), section), name) == value


def test_later_override_wins_over_earlier_and_file(tmp_path: Path) -> None:
    path = written(tmp_path, "[compute]\nlabels = 20\niterations = 7\n")
    config = load_config(path, ["compute.labels=30", "compute.labels=40"])
    assert (config.compute.labels, config.compute.iterations) == (40, 7)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[scan]\nbase_line = 3\n", "no key scan.base_line; did you mean 'baseline'?"),
        ("[scann]\nbaseline = 3\n", "no section [scann]; did you mean 'scan'?"),
        ("baseline = 3\n", "no section [baseline]"),
        ("scan = 3\n", "must be a section"),
        ("[scan\n", "is not TOML"),
        ("[compute]\nlabels = 'many'\n", "compute.labels: Expected `int`, got `str`"),
        ("[compute]\nlabels = 3\n", "compute.labels = 3 is outside 4 to 96"),
        ("[compute]\nlabels = 97\n", "compute.labels = 97 is outside 4 to 96"),
        ("[compute]\nstereo_width = 2000\n", "compute.guide_width 1280 is less"),
        ("[compute]\nthreads = true\n", "compute.threads: Expected `int`, got `bool`"),
        ("[scan]\nbaseline = -1\n", "scan.baseline"),
        ("[scan]\nbaseline = 'wide'\n", "scan.baseline 'wide' is not"),
        ("[scan]\nstart = 'now'\n", "there are on-command, on-boot, on-arm"),
        ("[camera]\nreadout_ms = 'autp'\n", "'autp'; there are model, auto"),
        ("[scan]\nbase_to_height = nan\n", "base_to_height"),
        ("[scan]\nbase_to_height = 0.02\n", "base_to_height = 0.02 is outside 0.03 to 1"),
        ("[datalink]\nconnect = ['192.168.1.2']\n", "not like tcp/HOST:7447"),
        ("[datalink]\nbudget_kbit_s = 0\n", "budget_kbit_s"),
        ("[health]\nhttp = 'everywhere'\n", "is not HOST:PORT"),
        ("[mavlink]\nsystem_id = 256\n", "mavlink.system_id"),
    ],
)
def test_mistakes_are_reported_in_one_line(tmp_path: Path, text: str, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        load_config(written(tmp_path, text))
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 2


@pytest.mark.parametrize("override", ["baseline=3", "scan.baseline", "scan.nope=1", "x.y=1", "=="])
def test_wrong_overrides_are_reported(override: str) -> None:
    with pytest.raises(InputError, match="--set"):
        load_config(None, [override])


def test_unreadable_files_are_reported(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        load_config(tmp_path / "none.toml")
    binary = tmp_path / "x.toml"
    binary.write_bytes(b"\xf0\x28\x8c\x28")
    with pytest.raises(InputError, match="not TOML"):
        load_config(binary)


def test_baseline_notation() -> None:
    assert parse_baseline("auto") == ("auto", 0.0, 0)
    assert parse_baseline(0.5) == ("metres", 0.5, 0)
    assert parse_baseline("0.5") == ("metres", 0.5, 0)
    assert parse_baseline("2/10") == ("frames", 2.0, 10)
    for wrong in ("0/10", "2/0", "-2", "nan", "inf", "", "2/10/3"):
        with pytest.raises(ValueError, match=r"scan\.baseline"):
            parse_baseline(wrong)


def test_what_is_given_is_known_even_where_it_is_the_default(tmp_path: Path) -> None:
    path = written(tmp_path, "[compute]\nstereo_width = 320\n")
    assert is_given("compute.stereo_width", path)
    assert not is_given("compute.guide_width", path) and not is_given("scan.folder", path)
    assert is_given("compute.guide_width", None, ["compute.guide_width=640"])
    assert not is_given("compute.guide", None, ["compute.guide_width=640"])


@pytest.mark.parametrize(("image_px", "guide_px", "width_px"), [
    (1920, 1280, 640), (960, 1280, 480), (480, 1280, 320), (1920, 500, 500),
])  # fmt: skip
def test_a_replay_is_as_dense_as_its_images(image_px: int, guide_px: int, width_px: int) -> None:
    class Images:
        size_px = (image_px, image_px // 2)

    config = load_config(None, [f"compute.guide_width={guide_px}"])
    dense = denser(config, cast(CameraSource, Images()))
    assert dense.compute.stereo_width == width_px
