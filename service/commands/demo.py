"""``skyrelief demo``: a real flight through both ends, onboard and ground, on this machine."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer

from service.commands import AsJson, speaking
from service.errors import InputError, OutsideError
from service.scans.report_parts import height_sigma_m, within
from service.scans.writing import check_writable
from service.workers import end_process, python_command

FLIGHT = Path("demo") / "caliterra"
MARKER = ".skyrelief-demo"
READY_S = 60.0
END_S = 120.0


def demo(
    out: Annotated[Path, typer.Option(help="folder for the output")] = Path("demo-output"),
    flight: Annotated[
        Path | None,
        typer.Option(help="folder with frames/ and camera.yaml; default: the included one"),
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="section.key=value for the replay")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Replay a small real flight while a ground station receives it over the datalink."""
    from service.listener import free_ports

    source = demo_flight(flight)
    _prepare(out)
    began = time.monotonic()
    at_ground, at_portal = free_ports(2)
    endpoint = f"tcp/127.0.0.1:{at_ground}"
    has_portal = all(find_spec(package) for package in ("starlette", "uvicorn", "websockets"))
    portal = f"127.0.0.1:{at_portal}" if has_portal else ""
    compilers = compile_meanwhile()
    if compilers:
        _say(1, "compiling kernels in the background: once, a minute or two")
    ground = _start_ground(out, endpoint, portal)
    try:
        with _meanwhile(1, "starting the ground station"):
            _said(ground, out, "ground station at ")
            page = _said(ground, out, "portal: ") if portal else ""
        if page:
            _say(1, f"open this page to watch the map grow: {page}")
        images = sum(1 for _ in (source / "frames").iterdir())
        _say(2, f"flight: tracking and reconstructing {images} images")
        _replay(source, out, endpoint, set_ or [])
        with _meanwhile(3, "ground station: writing its files"):
            received = _wait_for_ground(ground, out)
    finally:
        for process in (ground, *compilers):
            end_process(process, 20.0)
    report = _figures(out, received, time.monotonic() - began)
    if report["ground_points"] != report["points"]:
        raise OutsideError(
            f"the ground holds {report['ground_points']} of {report['points']} points; "
            f"see {out / 'ground.log'}",
            report,
        )
    print(json.dumps(report) if as_json else _in_words(report))


def _say(step: int, what: str) -> None:
    """One line of progress, where it does not disturb the report."""
    print(f"[{step}/3] {what}", file=sys.stderr, flush=True)


@contextmanager
def _meanwhile(step: int, what: str) -> Iterator[None]:
    """The same, and again while the work inside lasts."""
    with speaking() as say:
        say(f"[{step}/3] {what}")
        yield


def compile_kernels() -> None:
    """Compile the kernels of stereo, ICP and the codec, or load them from numba's cache."""
    from recon.backends.cpu import warm_up
    from service.bench.keyframes import make_keyframe, strip
    from service.stream.codec import decode, encode

    warm_up()
    size_px = 160, 90
    decode(encode(make_keyframe(size_px=size_px, fresh=strip(size_px)), 0))


def compile_meanwhile() -> list[subprocess.Popen[bytes]]:
    """A process that compiles what the replay needs later; none when numba has its kernels."""
    from service.daemon.warm_up import has_kernels

    if has_kernels():
        return []
    return [subprocess.Popen(python_command(__name__), stdin=subprocess.DEVNULL)]


HOMES = (Path(__file__).resolve().parents[2], Path(sys.prefix) / "share" / "skyrelief")
"""Where the included flight lies: in a clone, or as the wheel brings it."""


def demo_flight(flight: Path | None, homes: Sequence[Path] = HOMES) -> Path:
    """The folder with the images and the camera model: ``flight``, or the first one at home."""
    folders = [flight] if flight else [home / FLIGHT for home in homes]
    for folder in folders:
        if (folder / "frames").is_dir() and (folder / "camera.yaml").is_file():
            return folder
    raise InputError(
        f"{folders[0]} contains no frames/ and camera.yaml; name a flight with --flight"
    )


def _prepare(out: Path) -> None:
    """Make ``out`` empty but for the marker; only what an earlier demo made is removed."""
    check_writable(out, is_folder=True)
    if out.exists() and any(out.iterdir()) and not (out / MARKER).exists():
        raise InputError(f"{out} is not empty and not of an earlier demo; give another --out")
    if out.exists():
        shutil.rmtree(out)
    out.mkdir(parents=True)
    (out / MARKER).touch()


def _start_ground(out: Path, endpoint: str, portal: str) -> subprocess.Popen[bytes]:
    """A receiver that ends on SIGINT, with its report as JSON."""
    command = python_command(
        "service.cli", "ground", "--store", str(out / "ground"), "--listen", endpoint, "--json",
        *(("--portal", portal) if portal else ()),
    )  # fmt: skip
    with (out / "ground.log").open("wb") as log:
        return subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=log
        )


def _said(ground: subprocess.Popen[bytes], out: Path, start: str) -> str:
    """The rest of the line of the receiver's log that begins with ``start``, once it is there."""
    deadline = time.monotonic() + READY_S
    while time.monotonic() < deadline and ground.poll() is None:
        for line in (out / "ground.log").read_text(encoding="utf-8").splitlines():
            if line.startswith(start):
                return line.removeprefix(start)
        time.sleep(0.1)
    raise OutsideError(f"the ground receiver did not start; see {out / 'ground.log'}")


def _replay(flight: Path, out: Path, endpoint: str, overrides: list[str]) -> None:
    settings = [f'datalink.connect=["{endpoint}"]', "datalink.budget_kbit_s=20000", *overrides]
    command = python_command(
        "service.cli", "replay", str(flight / "frames"), "--out", str(out / "onboard"),
        "--camera-model", str(flight / "camera.yaml"),
        *(part for setting in settings for part in ("--set", setting)),
    )  # fmt: skip
    code = subprocess.run(command, stdin=subprocess.DEVNULL, stdout=sys.stderr).returncode
    if code != 0:
        raise OutsideError(f"the replay ended with exit code {code}; see its message above")


def _wait_for_ground(ground: subprocess.Popen[bytes], out: Path) -> Path:
    """The scan folder at the ground. The replay has ended, and so delivered what it could."""
    ground.send_signal(signal.SIGINT)
    try:
        report, _ = ground.communicate(timeout=END_S)
        (scan,) = json.loads(report.splitlines()[-1])["scans"]
    except subprocess.TimeoutExpired as error:
        raise OutsideError(
            f"the ground station did not end {END_S:.0f} s after the replay; see {out}/ground.log"
        ) from error
    except (ValueError, IndexError, KeyError) as error:
        raise OutsideError(f"the ground receiver failed; see {out}/ground.log") from error
    return Path(scan["folder"])


def _figures(out: Path, received: Path, seconds: float) -> dict[str, Any]:
    onboard, ground = (
        json.loads((folder / "scan.json").read_bytes()) for folder in (out / "onboard", received)
    )
    quality = onboard["quality"]
    return {
        "scan_folder": str(out / "onboard"),
        "ground_folder": str(received),
        "ground_store": str(out / "ground"),
        "keyframes": onboard["counts"]["keyframes"],
        "points": onboard["counts"]["points"],
        "ground_points": ground["counts"]["points"],
        "area_m2": quality["area_m2"],
        "sigma_median_m": quality["sigma_median_m"],
        "quality": quality,
        "distance_m": quality["distance_m"],
        "epsg": onboard["epsg"],
        "seconds": round(seconds, 1),
    }


def _in_words(report: dict[str, Any]) -> str:
    onboard, ground = report["scan_folder"], report["ground_folder"]
    program = os.path.relpath(Path(sys.executable).with_name("skyrelief"))
    return f"""
Scan onboard:         {onboard}
Received at ground:   {ground}
  {report["points"]:,} points from {report["keyframes"]} keyframes over {report["area_m2"]:,.0f} m2,
  {report["distance_m"]:.0f} m flown, {report["seconds"]:.0f} s in all
  {verdict(report["quality"])}
Look at:
  {onboard}/preview.jpg   image: colour and relief from above
  {onboard}/report.html   map, accuracy and faults, in a browser
  {onboard}/cloud.laz     coloured points for CloudCompare or QGIS (EPSG:{report["epsg"]})
  {program} ground --store {report["ground_store"]} --portal 127.0.0.1:8080
                          the map in 3D, in a browser"""


def verdict(quality: dict[str, Any]) -> str:
    """What may be measured, and one sigma of each, named as in the portal: what holds within the
    map first."""
    relative, scale = quality["sigma_median_m"], quality["scale_sigma"]
    across, up = quality["position_sigma_h_median_m"], height_sigma_m(quality)
    parts = [] if relative is None else [f"relative {within(relative)}"]
    if scale is not None:
        parts.append(f"lengths ± {100.0 * scale:.1f} %")
    if across is not None and up is not None:
        parts.append(f"absolute {within(across)} across, {within(up)} up")
    level: str = quality["trust"]["level"]
    return f"{level}: {', '.join(parts)}" if parts else level


if __name__ == "__main__":
    compile_kernels()
