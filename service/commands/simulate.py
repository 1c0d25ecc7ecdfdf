"""``skyrelief simulate`` and ``score``: a synthetic flight, and a scan of it against the truth."""

from __future__ import annotations

import json
import re
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.commands import AsJson, parse_size, record_of, showing, with_options
from service.errors import InputError, refusing

if TYPE_CHECKING:
    from service.sim.recording import SimulationOptions

VIDEO_TO = "udp://127.0.0.1:5600?pkt_size=1316"
PAIR = re.compile(r"(-?(?:\d+\.?\d*|\.\d+)):(-?(?:\d+\.?\d*|\.\d+))", re.ASCII)


@dataclass(frozen=True)
class SimulateOptions:
    out: Annotated[Path, typer.Option(help="Folder for the flight and its truth.")]
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the site and of all random numbers.")
    ] = 1
    duration_s: Annotated[float, typer.Option(help="Length of the video.")] = 30.0
    height_m: Annotated[float, typer.Option(help="Height above the ground at the start.")] = 60.0
    speed_m_s: Annotated[float, typer.Option(help="Speed over ground.")] = 5.0
    pattern: Annotated[str, typer.Option(help="nadir, oblique, legs, orbit or hover.")] = "nadir"
    legs: Annotated[int, typer.Option(help="Parallel legs of the pattern 'legs'.")] = 3
    spacing_m: Annotated[float | None, typer.Option(help="Distance between legs.")] = None
    heading_deg: Annotated[float, typer.Option(help="First leg, from north over east.")] = 35.0
    camera_pitch_deg: Annotated[float | None, typer.Option(help="-90 is straight down.")] = None
    size: Annotated[str, typer.Option(help="Width x height in pixels.")] = "1280x720"
    fps: Annotated[float, typer.Option(help="Frames per second.")] = 30.0
    focal: Annotated[float, typer.Option(help="Focal length over image width.")] = 0.75
    distortion: Annotated[bool, typer.Option(help="Barrel distortion of the lens.")] = True
    wobble_deg: Annotated[float, typer.Option(help="Unsteadiness of the gimbal.")] = 1.0
    sway_m: Annotated[float, typer.Option(help="Unsteadiness of the path.")] = 0.15
    climb_m: Annotated[float, typer.Option(help="Height gained from start to end.")] = 0.0
    swing_deg: Annotated[float, typer.Option(help="Swing of the camera at about 1 Hz.")] = 0.0
    readout_ms: Annotated[
        float, typer.Option(help="Rolling shutter, first to last row; 0: global.")
    ] = 0.0
    readout_direction: Annotated[
        str, typer.Option(help="Readout direction: down, up, right, left.")
    ] = "down"
    shutter_ms: Annotated[float, typer.Option(help="Exposure, which blurs by motion.")] = 0.0
    relief_m: Annotated[float, typer.Option(help="Height of the hills; 0 is flat.")] = 8.0
    water_m: Annotated[
        float | None, typer.Option(help="Level of a sea with waves, above the origin's ground.")
    ] = None
    density: Annotated[float, typer.Option(help="Density of houses and trees; 0: none.")] = 1.0
    site_m: Annotated[
        float | None,
        typer.Option(help="Side of the site, the flight in its middle; for several flights."),
    ] = None
    flight_seed: Annotated[
        int | None, typer.Option(min=0, help="Seed of motion and sensors; default: --seed.")
    ] = None
    changes: Annotated[
        int, typer.Option(help="Boxes; half stand at --date 1, half at --date 2.")
    ] = 0
    date: Annotated[int, typer.Option(help="1 or 2: which half of the boxes stands.")] = 1
    photos: Annotated[Path | None, typer.Option(help="Aerial photos as the ground.")] = None
    gps_noise_m: Annotated[float, typer.Option(help="Wander of the GPS.")] = 1.0
    gnss_noise: Annotated[
        str, typer.Option(help="wander: slow; white: from fix to fix; exact: no sensor errors.")
    ] = "wander"
    boresight_deg: Annotated[
        str, typer.Option(help="RIGHT:UP degrees between camera and gimbal.")
    ] = "0:0"
    baro_noise_m: Annotated[float, typer.Option(help="Wander of the altitude.")] = 0.5
    attitude_noise_deg: Annotated[float, typer.Option(help="Wander of roll and pitch.")] = 0.3
    yaw_noise_deg: Annotated[float, typer.Option(help="Wander of the heading.")] = 1.0
    image_noise: Annotated[float, typer.Option(help="Sensor noise in gray levels.")] = 1.5
    telemetry: Annotated[bool, typer.Option(help="Write flight.tlog.")] = True
    video: Annotated[bool, typer.Option(help="Render flight.mp4.")] = True
    gimbal_frame: Annotated[str, typer.Option(help="Yaw of the gimbal: earth, vehicle.")] = "earth"
    rangefinder: Annotated[bool, typer.Option(help="Send DISTANCE_SENSOR.")] = True
    gnss_accuracy: Annotated[bool, typer.Option(help="GPS_RAW_INT carries h_acc.")] = True
    home_above_m: Annotated[float, typer.Option(help="Take-off point above the site.")] = 0.0
    telemetry_gap: Annotated[str, typer.Option(help="FROM:TO seconds without packets.")] = ""
    log_lead_s: Annotated[float, typer.Option(help="The log begins so much earlier.")] = 0.0
    blank: Annotated[list[str] | None, typer.Option(help="FRAME:COUNT black frames.")] = None
    exposure: Annotated[list[str] | None, typer.Option(help="SECOND:GAIN brightness step.")] = None
    depth_frames: Annotated[int, typer.Option(help="How many depth maps to keep.")] = 12
    crf: Annotated[int, typer.Option(help="H.264 quality; lower is better.")] = 18
    live: Annotated[bool, typer.Option("--live", help="Play the flight in real time.")] = False
    video_to: Annotated[str, typer.Option(help="Live: where H.264 in MPEG-TS goes.")] = VIDEO_TO
    mavlink_to: Annotated[str, typer.Option(help="Live: UDP host:port.")] = "127.0.0.1:14550"
    loop: Annotated[bool, typer.Option("--loop", help="Live: repeat the flight.")] = False
    until_stdin_ends: Annotated[bool, typer.Option("--until-stdin-ends", hidden=True)] = False
    as_json: AsJson = False

    def simulation(self) -> SimulationOptions:
        """Raises ValueError for an impossible flight, InputError for unreadable text."""
        from service.cameras.camera_file import shutter_of
        from service.sim.flight import FlightPlan, SensorNoise
        from service.sim.recording import DISTORTION, Faults, SimulationOptions
        from service.sim.render import Look
        from service.sim.telemetry import TelemetryOptions

        noise = SensorNoise(
            gps_m=self.gps_noise_m, baro_m=self.baro_noise_m,
            attitude_deg=self.attitude_noise_deg, yaw_deg=self.yaw_noise_deg,
        )  # fmt: skip
        gap_s = _pair(self.telemetry_gap, "--telemetry-gap") if self.telemetry_gap else None
        blank = [_pair(value, "--blank") for value in self.blank or []]
        exposure = [_pair(value, "--exposure") for value in self.exposure or []]
        return record_of(
            SimulationOptions,
            self,
            plan=record_of(FlightPlan, self, centred=self.site_m is not None),
            noise=SensorNoise.of(self.gnss_noise, noise),
            telemetry=record_of(
                TelemetryOptions, self, gap_s=gap_s, lead_s=self.log_lead_s,
                boresight_deg=_pair(self.boresight_deg, "--boresight-deg"),
                accuracy=self.gnss_accuracy,
            ),
            look=Look(noise=self.image_noise, water_m=self.water_m),
            faults=Faults(tuple((int(a), int(b)) for a, b in blank), tuple(sorted(exposure))),
            size_px=parse_size(self.size),
            focal_share=self.focal,
            distortion=DISTORTION if self.distortion else (0.0,) * 5,
            with_telemetry=self.telemetry,
            with_video=self.video,
            shutter=shutter_of(self.readout_ms, self.readout_direction),
            exposure_s=1e-3 * self.shutter_ms,
        )  # fmt: skip


@with_options(SimulateOptions)
def simulate(given: SimulateOptions) -> None:
    """Render a flight: flight.mp4, flight.tlog, camera.yaml, and truth/ to score against.

    --live plays it in real time, as a camera's stream and an autopilot's MAVLink. A flight that
    exists is not rendered again.
    """
    if given.live and (given.out / "flight.mp4").exists():
        _play(given)
        return
    started = time.monotonic()
    with refusing("simulate"):
        from service.scans.writing import check_writable, filling_folder

        if any((given.out / name).exists() for name in ("flight.mp4", "truth")):
            raise InputError(f"{given.out} already holds a flight; give another folder with --out")
        check_writable(given.out, is_folder=True)
    with refusing("simulate"), showing("simulate") as progress:
        progress("laying out the site")
        from service.sim import recording

        simulation = recording.prepare(given.simulation())
    with showing("simulate") as progress, filling_folder(given.out) as part:

        def rendered(done: int, total: int) -> None:
            progress.share = done / total
            progress("rendering")

        result = recording.write(simulation, part, rendered)
    if not given.live:
        _report(given.out, result, time.monotonic() - started, given.as_json)
        return
    print(f"{given.out}: {result['frames']} frames rendered", file=sys.stderr)
    _play(given)


def _play(given: SimulateOptions) -> None:
    """Play a flight until its end or Ctrl-C."""
    from service.sim.live import play

    where = f"video to {given.video_to}, MAVLink to {given.mavlink_to}"
    print(f"playing {given.out}: {where}", file=sys.stderr)
    counts = None
    with refusing("simulate --live"), suppress(KeyboardInterrupt):
        counts = play(
            given.out, given.video_to, given.mavlink_to, given.loop, given.until_stdin_ends
        )
    if given.as_json and counts is not None:
        is_piped = given.video_to.startswith("pipe:")
        print(json.dumps(counts), file=sys.stderr if is_piped else sys.stdout)


def _pair(text: str, option: str) -> tuple[float, float]:
    found = PAIR.fullmatch(text.strip())
    if found is None:
        raise InputError(f"{option} {text!r}: expected two numbers with a colon, such as 10:2.5")
    return float(found[1]), float(found[2])


def _report(out: Path, result: dict[str, Any], seconds: float, as_json: bool) -> None:
    if as_json:
        keys = ("frames", "packets", "path_m", "median_agl_m", "triangles")
        report = {key: result[key] for key in keys} | {"folder": str(out), "seconds": seconds}
        print(json.dumps(report))
        return
    print(
        f"{out}: {result['frames']} frames, {result['packets']} MAVLink packets, "
        f"{result['path_m']:.0f} m at {result['median_agl_m']:.0f} m above ground, "
        f"in {seconds:.0f} s"
    )
    if not (out / "flight.mp4").exists():
        return
    telemetry = f"--telemetry {out / 'flight.tlog'} " if result["packets"] else ""
    print(f"next: skyrelief replay {out / 'flight.mp4'} {telemetry}"
          f"--camera-model {out / 'camera.yaml'} --out SCAN")  # fmt: skip
    print(f"then: skyrelief score SCAN {out / 'truth'}")


def score(
    scan_dir: Annotated[Path, typer.Argument(help="Scan folder of replay or run.")],
    truth_dir: Annotated[
        Path, typer.Argument(help="truth/ of simulate; with --views the video or folder of stills.")
    ],
    views: Annotated[
        bool, typer.Option("--views", help="draw frames that took no part and compare them instead")
    ] = False,
    images: Annotated[
        Path | None, typer.Option(help="with --views: folder for what was seen and drawn")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure accuracy, completeness and trajectory error of a scan of a simulated flight."""
    from service.offline.exports.view import ScanView
    from service.offline.view_scoring import frame_scores, means
    from service.sim import scoring

    with showing("score") as progress:
        if views:
            flight = truth_dir / "flight.mp4"  # of simulate
            with ScanView(scan_dir, progress=progress) as scan:
                video = flight if flight.is_file() else truth_dir
                report = means(frame_scores(scan, video, images))
        else:
            report = scoring.score(scan_dir, truth_dir, progress)
    text = _text_of_views if views else _text
    print(json.dumps(report) if as_json else text(report))


def _text_of_views(report: dict[str, Any]) -> str:
    lines = [
        f"{'drawn from':<12} {'frames':>6} {'covered':>8} {'PSNR':>9} {'SSIM':>7} {'on grids':>9} "
        f"{'exposed':>9}"
    ]
    for name, r in report.items():
        lines.append(
            f"{name:<12} {r['frames']:>6} {r['covered']:>8.2%} {r['psnr_db']:>6.2f} dB "
            f"{r['ssim']:>7.4f} {r['psnr_on_grids_db']:>6.2f} dB {r['psnr_exposed_db']:>6.2f} dB"
        )
    return "\n".join(lines)


def _text(report: dict[str, Any]) -> str:
    lines = [
        f"{report['points']} points, {report['poses_compared']} of {report['poses']} poses "
        f"compared, flown {report['altitude_m']:.1f} m above the ground"
        + ("" if report["georeferenced"] else "; the scan has no georeference"),
        "",
        "surface              median      rms      p90     bias   <0.25 m   <0.5 m"
        "   of altitude  distance",
    ]
    for name, s in report["surface"].items():
        lines.append(
            f"  {_label(name):<16} {s['median_m']:7.3f} m {s['rms_m']:6.3f} m {s['p90_m']:6.3f} m "
            f"{s['bias_m']:+6.3f} m  {s['share_25cm']:7.1%}  {s['share_50cm']:7.1%} "
            f"  {s['median_percent_of_altitude']:8.2f} %  {s['median_percent_of_distance']:8.2f} %"
        )
    for name, s in report["surface"].items():
        if s.get("honesty") and name == report["judged_after"]:
            h = s["honesty"]
            lines.append(
                f"  sigma: {h['within_1_sigma']:.0%} within 1, {h['within_2_sigma']:.0%} within 2 "
                f"(a Gaussian has 68 % and 95 %), median {h['median_sigma_m']:.3f} m"
            )
    for name, d in report["dsm"].items():
        if d["cells"]:
            lines.append(
                f"  DSM {_label(name)}, {d['cell_m']:g} m cells: rms {d['rms_m']:.3f} m, "
                f"{d['rms_away_from_steps_m']:.3f} m away from steps, median "
                f"{d['median_m']:+.3f} m, {d['within_30cm']:.1%} within 0.3 m, "
                f"{d['known_share']:.1%} of the cells seen are known"
            )
    c = report["completeness"]
    lines += [
        "",
        f"completeness: {c['share']:.1%} of {c['seen_m2']:.0f} m2 seen lies within "
        f"{c['within_m']:g} m of a point ({c['share_flat']:.1%} of ground and roofs, "
        f"{c['share_steep']:.1%} of walls, {c['share_near_track']:.1%} within "
        f"{c['near_track_m']:g} m of the track)",
        "",
        "trajectory              rms   median      max     turn    drift",
    ]
    for name, t in report["trajectory"].items():
        lines.append(
            f"  {_label(name):<16} {t['rms_m']:6.2f} m {t['median_m']:6.2f} m {t['max_m']:6.2f} m "
            f"{t['median_deg']:6.2f} deg {t['drift_percent']:5.2f} % of path"
        )
    for name, s in report["surface"].items():
        f = s["fit"]
        if name != "raw":
            lines.append(
                f"  the {_label(name)} moved the cloud by {f['shift_m']:.2f} m "
                f"({f['shift_up_m']:+.2f} m up), {f['turn_deg']:.2f} deg, scale {f['scale']:.4f}"
            )
    return "\n".join(lines)


def _label(name: str) -> str:
    return {"raw": "as delivered", "rigid": "rigid fit", "similarity": "similarity fit"}[name]
