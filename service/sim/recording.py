"""A simulated flight on disk: video, telemetry, camera model and the exact truth."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime, timezone
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

from recon.rolling_shutter import row_times_s
from recon.se3 import inverse, quaternion_from_rotation, so3_log
from recon.types import F64, GLOBAL_SHUTTER, U8, Camera, Shutter
from service.cameras.camera_file import save_camera
from service.georeference import LocalFrame
from service.sim import flight as flights
from service.sim import ground_texture, scene
from service.sim.flight import Flight, FlightPlan, SensorNoise, Sensors, check_ranges
from service.sim.ground_texture import patchwork
from service.sim.render import Look, Renderer
from service.sim.scene import Area
from service.sim.telemetry import FlightMessages, TelemetryOptions
from service.sim.truth import write_surface

EPOCH_UNIX_S = 1_777_629_600  # 2026-05-01 10:00:00 UTC: containers keep whole seconds
FLIGHT_S, FLIGHTS = 600, 10_000
"""From the start of a flight to that of the next by its seed, and how many flights a date has."""
ORIGIN = LocalFrame(47.3977, 8.5456, 488.0)
DISTORTION = (-0.12, 0.03, 0.0, 0.0, 0.0)
TERRAIN_STEPS = 6  # steps to where a ray meets the terrain; hills are far flatter than the ray
MAX_MOMENTS = 64  # images at most that are averaged over an exposure

LARGEST_TEXELS = 120_000_000
REPEATABLE = "bframes=0:mbtree=0:scenecut=0"
"""x264's look-ahead differs from run to run; without it equal frames give equal files."""


@dataclass(frozen=True, slots=True)
class Faults:
    blank: tuple[tuple[int, int], ...] = ()  # (first frame, count) black images
    exposure: tuple[tuple[float, float], ...] = ()  # (from second, gain)


@dataclass(frozen=True, slots=True)
class SimulationOptions:
    plan: FlightPlan = field(default_factory=FlightPlan)
    noise: SensorNoise = field(default_factory=SensorNoise)
    telemetry: TelemetryOptions = field(default_factory=TelemetryOptions)
    look: Look = field(default_factory=Look)
    faults: Faults = field(default_factory=Faults)
    seed: int = 1
    size_px: tuple[int, int] = (1280, 720)
    fps: float = 30.0
    focal_share: float = 0.75  # focal length over image width
    distortion: tuple[float, float, float, float, float] = DISTORTION
    relief_m: float = 8.0
    density: float = 1.0
    photos: Path | None = None
    depth_frames: int = 12
    crf: int = 18
    with_telemetry: bool = True
    with_video: bool = True
    shutter: Shutter = GLOBAL_SHUTTER
    exposure_s: float = 0.0  # of each row, about its time
    flight_seed: int | None = None  # of the motion and the sensors; None: ``seed``
    site_m: float | None = None  # side of the place about the origin; None: what the flight sees
    changes: int = 0  # boxes that stand at one of two dates only
    date: int = 1  # of the flight: 1 or 2

    def __post_init__(self) -> None:
        W, H = self.size_px
        if not (64 <= W <= 7680 and 64 <= H <= 4320) or W % 2 or H % 2:
            raise ValueError(f"size {W}x{H} must be even and within 64x64 to 7680x4320")
        if self.date not in (1, 2):
            raise ValueError("the date must be 1 or 2")
        check_ranges(
            ("rate", self.fps, " frames per second", 0.1, 240),
            ("focal length", self.focal_share, " widths", 0.2, 10),
            ("relief", self.relief_m, " m", 0, 200),
            ("density", self.density, "", 0, 3),
            ("number of depth frames", self.depth_frames, "", 0, 10_000),
            ("crf", self.crf, "", 0, 51),
            ("number of changes", self.changes, "", 0, 1000),
            ("site", 20.0 if self.site_m is None else self.site_m, " m", 20, 5000),
        )
        for what, seconds in (("readout", self.shutter.readout_s), ("exposure", self.exposure_s)):
            if not 0 <= seconds <= 1 / self.fps:
                raise ValueError(
                    f"{what} of {1e3 * seconds:g} ms is not within 0 and the "
                    f"{1e3 / self.fps:g} ms between frames"
                )

    @property
    def camera(self) -> Camera:
        """The simulated camera; its principal point is a little off the centre."""
        W, H = self.size_px
        f = self.focal_share * W
        cx, cy = 0.5 * (W - 1) + 0.003 * W, 0.5 * (H - 1) - 0.004 * H
        K = np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])
        return Camera(K, np.array(self.distortion), (W, H), self.shutter)

    @property
    def own_seed(self) -> int:
        return self.seed if self.flight_seed is None else self.flight_seed

    @property
    def started_unix_s(self) -> int:
        """Time of the first frame; another one for each flight of a place, the second date later.
        Two scans that begin at the same time and place count as one flight."""
        flight_s = FLIGHT_S * ((self.own_seed - self.seed) % FLIGHTS)
        return EPOCH_UNIX_S + FLIGHT_S * FLIGHTS * (self.date - 1) + flight_s

    @property
    def frames(self) -> int:
        return max(1, round(self.plan.duration_s * self.fps))


@dataclass(frozen=True, slots=True, eq=False)
class Simulation:
    """A flight that is ready to be rendered, frame by frame."""

    options: SimulationOptions
    flight: Flight
    scene: scene.Scene
    renderer: Renderer
    times_s: F64  # (F,) of the frames
    poses: F64  # (F, 4, 4) T_world_camera

    def frame(self, index: int) -> U8:
        """(H, W, 3) BGR frame ``index``, with the faults asked for."""
        options = self.options
        if any(first <= index < first + count for first, count in options.faults.blank):
            return np.zeros((options.size_px[1], options.size_px[0], 3), np.uint8)
        gain = options.look.exposure
        for start, factor in options.faults.exposure:
            if self.times_s[index] >= start:
                gain = factor
        look, time_s = replace(options.look, exposure=gain), float(self.times_s[index])
        first, *others = self._poses_while_open(index)
        light = self.renderer.light(first, look, time_s)
        for pose in others:
            light += self.renderer.light(pose, look, time_s)
        return self.renderer.develop(light / np.float32(1 + len(others)), index, look)

    def _poses_while_open(self, index: int) -> list[F64]:
        """Poses of frame ``index``, evenly over its exposure and about a pixel apart. Each is (4,
        4), or has one of each row (N, 4, 4) of a rolling shutter."""
        open_s = self.options.exposure_s
        moments = int(np.clip(np.ceil(self._pixels_per_s(index) * open_s), 1, MAX_MOMENTS))
        offsets = open_s * ((np.arange(moments) + 0.5) / moments - 0.5)
        return [self._poses_of_rows(index, float(offset_s)) for offset_s in offsets]

    def _pixels_per_s(self, index: int) -> float:
        """Motion of the ground below in frame ``index``."""
        near_s = self.times_s[index] + np.array([-5e-4, 5e-4])
        before, after = self.flight.T_world_camera(near_s)
        step = inverse(before) @ after
        x, y, z = before[:3, 3]
        away_m = max(z - float(self.scene.terrain.height(np.array([x]), np.array([y]))[0]), 1.0)
        turned = float(np.linalg.norm(so3_log(step[:3, :3])))
        moved = float(np.linalg.norm(step[:3, 3])) / away_m
        return float(self.options.camera.K[0, 0] * (turned + moved) / 1e-3)

    def _poses_of_rows(self, index: int, offset_s: float) -> F64:
        """(4, 4) pose of frame ``index``, or one of each row (N, 4, 4) of a rolling shutter."""
        camera, time_s = self.options.camera, self.times_s[index] + offset_s
        if not camera.shutter.readout_s:
            return np.asarray(self.flight.T_world_camera(np.array([time_s]))[0])
        return self.flight.T_world_camera(time_s + row_times_s(camera))

    def surface_range(self, origins: F64, directions: F64) -> F64:
        """(N,) metres from (N, 3) places along (N, 3) unit directions to the first surface. Outside
        the scene it is the terrain's, for directions that lead downwards."""
        met, _ = self.scene.grid.cast(origins, directions)
        outside = np.zeros(len(origins))
        for _ in range(TERRAIN_STEPS):
            at = origins + outside[:, None] * directions
            above = at[:, 2] - self.scene.terrain.height(at[:, 0], at[:, 1])
            outside += above / np.maximum(-directions[:, 2], 0.1)
        return np.asarray(np.where(np.isfinite(met), met, outside))

    def sensors(self) -> Sensors:
        rng = np.random.default_rng(self.options.own_seed + 3)
        return Sensors(self.flight, self.options.noise, rng)


def prepare(options: SimulationOptions) -> Simulation:
    """Lay out the place under the flight and colour it; ValueError for a flight too large."""
    flight = flights.fly(options.plan, options.own_seed)
    times = np.arange(options.frames) / options.fps
    poses = flight.T_world_camera(times)
    area = _area(flight, options)
    texel = 0.75 * options.plan.lowest_m / options.camera.K[0, 0]
    texel = max(texel, float(np.sqrt(area.size_m[0] * area.size_m[1] / LARGEST_TEXELS)))
    if area.size_m[0] * area.size_m[1] > 25e6:
        raise ValueError(
            f"the flight would cover {area.size_m[0]:.0f} x {area.size_m[1]:.0f} m; "
            "make it shorter, slower or lower"
        )
    place = scene.make(
        area, options.relief_m, options.density, options.seed, options.changes, options.date
    )
    mosaic = None
    if options.photos is not None:
        size = [max(4, int(np.ceil(s / texel))) for s in area.size_m]
        mosaic = patchwork(options.photos, (size[0], size[1]), options.seed)
    renderer = Renderer(place, ground_texture.make(place, texel, mosaic), options.camera)
    return Simulation(options, flight, place, renderer, times, poses)


def _area(flight: Flight, options: SimulationOptions) -> Area:
    """The ground that the camera can see, with a rim; the horizon itself stays empty."""
    plan = options.plan
    if options.site_m is not None:
        half = 0.5 * options.site_m
        return Area(-half, -half, half, half)
    t = np.linspace(0.0, plan.duration_s, 200)
    xy = flight.position(t)[:, :2]
    W, H = options.size_px
    diagonal = np.arctan(0.55 * np.hypot(W, H) / (options.focal_share * W))
    tilt = np.radians(90.0 + plan.pitch_deg)
    unsteady = np.radians(3.0 * plan.wobble_deg + plan.swing_deg)
    steepest = min(tilt + diagonal + unsteady, np.radians(74.0))
    reach = (plan.highest_m + options.relief_m) * np.tan(steepest) + 12.0
    low, high = xy.min(axis=0) - reach, xy.max(axis=0) + reach
    return Area(float(low[0]), float(low[1]), float(high[0]), float(high[1]))


def write(
    simulation: Simulation, folder: Path, progress: Callable[[int, int], None] | None = None
) -> dict[str, Any]:
    """Write the flight and its truth into ``folder`` and return the parameters written there."""
    truth, options = folder / "truth", simulation.options
    truth.mkdir(parents=True, exist_ok=True)
    save_camera(folder / "camera.yaml", options.camera, "simulated")
    packet_count = 0
    if options.with_telemetry:
        messages = FlightMessages(
            simulation.sensors(), ORIGIN, options.started_unix_s, simulation.surface_range,
            options.telemetry,
        )  # fmt: skip
        packet_count = messages.write_tlog(folder / "flight.tlog")
    _write_truth(simulation, truth)
    parameters = _parameters(simulation, packet_count)
    (truth / "params.json").write_text(json.dumps(parameters, indent=2) + "\n")
    if options.with_video:
        write_video(simulation, folder / "flight.mp4", progress)
    return parameters


def _write_truth(simulation: Simulation, truth: Path) -> None:
    origin = {"lat_deg": ORIGIN.lat_deg, "lon_deg": ORIGIN.lon_deg, "alt_amsl_m": ORIGIN.alt_amsl_m}
    (truth / "origin.json").write_text(json.dumps(origin) + "\n")
    vertices, triangles = simulation.scene.vertices, simulation.scene.triangles
    level = simulation.options.look.water_m
    if level is not None:
        triangles = triangles[vertices[triangles, 2].max(axis=1) > level]
    write_surface(truth / "surface.ply", vertices, triangles)
    if simulation.scene.changes:
        boxes = [asdict(change) for change in simulation.scene.changes]
        (truth / "changes.json").write_text(json.dumps(boxes, indent=1) + "\n")
    start_s = simulation.options.started_unix_s
    with (truth / "trajectory.tum").open("w") as out:
        for t, T in zip(simulation.times_s, simulation.poses, strict=True):
            q = quaternion_from_rotation(T[:3, :3])
            row = [*T[:3, 3], q[1], q[2], q[3], q[0]]
            out.write(f"{start_s + t:.6f} " + " ".join(f"{v:.9f}" for v in row) + "\n")
    count = min(simulation.options.depth_frames, len(simulation.times_s))
    for k in np.unique(np.linspace(0, len(simulation.times_s) - 1, count).astype(int)):
        np.savez_compressed(
            truth / f"depth_{k:06d}.npz",
            depth_m=simulation.renderer.depth(simulation.poses[k], level),
            K=simulation.options.camera.K,
            T_world_camera=simulation.poses[k],
            time_unix_ns=np.int64(round((start_s + simulation.times_s[k]) * 1e9)),
        )


def _parameters(simulation: Simulation, packet_count: int) -> dict[str, Any]:
    """The flight's parameters, for people and for ``score``."""
    options = simulation.options
    t = simulation.times_s
    at = simulation.poses[:, :3, 3]
    agl = at[:, 2] - simulation.scene.terrain.height(at[:, 0], at[:, 1])
    values = asdict(options)
    values["photos"] = options.photos.name if options.photos else None
    return {
        "options": values,
        "video_epoch_unix_s": options.started_unix_s,
        "frames": len(t),
        "packets": packet_count,
        "K": options.camera.K.tolist(),
        "distortion": list(options.distortion),
        "size_px": list(options.size_px),
        "median_agl_m": float(np.median(agl)),
        "path_m": float(np.linalg.norm(np.diff(at, axis=0), axis=1).sum()),
        "triangles": len(simulation.scene.triangles),
    }


def write_video(
    simulation: Simulation, path: Path, progress: Callable[[int, int], None] | None
) -> None:
    """H.264 in MP4 with a constant frame rate and the time of the first frame."""
    options = simulation.options
    created = datetime.fromtimestamp(options.started_unix_s, timezone.utc)
    rate = Fraction(options.fps).limit_denominator(1001)
    with av.open(str(path), "w") as container:
        container.metadata["creation_time"] = created.strftime("%Y-%m-%dT%H:%M:%S.000000Z")
        stream = container.add_stream("libx264", rate=rate)
        stream.width, stream.height = options.size_px
        stream.pix_fmt = "yuv420p"
        stream.codec_context.gop_size = max(1, round(2 * options.fps))
        stream.options = {"crf": str(options.crf), "preset": "veryfast", "x264-params": REPEATABLE}
        for index in range(len(simulation.times_s)):
            shot = av.VideoFrame.from_ndarray(simulation.frame(index), format="bgr24")
            shot.pts, shot.time_base = index, 1 / rate
            container.mux(stream.encode(shot))
            if progress is not None:
                progress(index + 1, len(simulation.times_s))
        container.mux(stream.encode())
