"""The configuration: strict TOML composed of frozen dataclasses, one per section.

Every key has a working default and one line of documentation, which ``skyrelief config default``
prints. Unknown keys are errors with a suggestion.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import functools
import re
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_type_hints

import msgspec
import msgspec.toml

from service.errors import InputError
from service.small_file import read_small

LARGEST_FILE_BYTES, LONGEST_LINE_BYTES = 65_536, 4_096
"""The memory for parsing a dotted key grows with the square of its length."""
T = TypeVar("T")


def key(default: T, doc: str, live: bool = False) -> T:
    """A field with its documentation; ``live`` keys may change while the service runs."""
    field: T = dataclasses.field(default=default, metadata={"doc": doc, "live": live})
    return field


@dataclass(frozen=True, slots=True)
class CameraConfig:
    """[camera]: source of the images and mount of the camera."""

    source: str = key(
        "",
        "file:V.mp4, images:DIR, pipe:-, rtsp://…, rtmp-listen:1935/live, srt://:9000, "
        "v4l2:/dev/video0, gst:…, sim:",
    )
    model: str = key("", "camera model, ROS camera_info YAML as written by 'skyrelief calibrate'")
    mount: Literal["auto", "gimbal", "fixed"] = key(
        "auto", "auto: gimbal attitude if telemetry has it, otherwise fixed to the body"
    )
    mount_roll_deg: float = key(0.0, "fixed mount: roll of the optical axis in the body frame")
    mount_pitch_deg: float = key(-90.0, "fixed mount: -90 looks straight down, 0 looks ahead")
    mount_yaw_deg: float = key(0.0, "fixed mount: 0 points the image's top to the nose")
    image_roll_deg: float | Literal["auto"] = key(
        "auto",
        "images turned clockwise against gimbal or mount; auto: 0 unless they turn as the "
        "telemetry does by 90, 180 or 270",
    )
    lever_forward_m: float = key(0.0, "camera ahead of the autopilot's position, body frame")
    lever_right_m: float = key(0.0, "camera to the right of it, body frame")
    lever_down_m: float = key(0.0, "camera below it, body frame")
    latency_ms: float = key(0.0, "from mid-exposure to the image's time stamp", live=True)
    latency: Literal["fixed", "auto"] = key(
        "fixed", "fixed: latency_ms; auto: measured in flight, latency_ms until then", live=True
    )
    readout_ms: float | Literal["model", "auto"] = key(
        "model",
        "rolling shutter, first to last row; 0: global shutter; model: as the camera model says, "
        "else auto; auto: found in flight",
    )
    readout_direction: Literal["down", "up", "right", "left"] = key(
        "down", "readout order of the rows or columns, used if readout_ms is a number"
    )

    def __post_init__(self) -> None:
        lever_m = (-100, 100)
        _check_ranges(
            self, mount_roll_deg=(-180, 180), mount_pitch_deg=(-180, 180),
            mount_yaw_deg=(-360, 360), image_roll_deg=(-360, 360), lever_forward_m=lever_m,
            lever_right_m=lever_m, lever_down_m=lever_m, latency_ms=(-10_000, 10_000),
            readout_ms=(0, 200),
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class MavlinkConfig:
    """[mavlink]: links to the autopilot and our identity on them."""

    links: tuple[str, ...] = key(
        (),
        "in pymavlink's notation: serial:/dev/…:921600, udpin:…, tcp:…; lines:0.0.0.0:10110 for "
        "NMEA or CSV on UDP",
    )
    system_id: int = key(0, "the vehicle's system id; 0: that of the connected autopilot")
    gimbal_yaw_frame: Literal["auto", "vehicle", "earth", "body", "servo"] = key(
        "auto", "reference of the gimbal's angles; auto: by its flags unless refuted"
    )
    signing_key: str = key("", "file with the 32-byte key of signed links, mode 600")
    odometry: bool = key(False, "send our motion estimate to the autopilot (ODOMETRY)")
    memory: str = key(
        "", "folder for tuned parameters, signing time and system id; empty: scan.folder"
    )

    def __post_init__(self) -> None:
        _check_ranges(self, system_id=(0, 255))


@dataclass(frozen=True, slots=True)
class ScanConfig:
    """[scan]: recording and its density."""

    folder: str = key("/var/lib/skyrelief/scans", "parent folder of the scans")
    drone: str = key("", "name of this aircraft in scans and on the datalink; empty: host name")
    start: Literal["on-command", "on-boot", "on-arm"] = key("on-command", "what starts a scan")
    close_after_landing_s: float = key(
        60.0, "a commanded scan is closed this long after disarming; 0: never", live=True
    )
    baseline: float | str = key(
        "auto", "auto: by altitude; or metres; or 'n/m' frames as in the paper: '2/10'", live=True
    )
    base_to_height: float = key(0.1, "auto baseline: metres of baseline per metre above ground")
    assumed_agl_m: float | None = key(
        None, "height above ground if telemetry has none; determines the scan's scale"
    )
    keep_free_mib: float = key(
        2048.0,
        "disk space to keep free; the oldest finished scans are deleted for it; 0: never",
        True,
    )
    resolution_m: float = key(
        0.0, "voxel size of the map, from the next scan on; 0: by image resolution", live=True
    )
    keep_debug: bool = key(False, "keep every stage for 'skyrelief inspect'")

    def __post_init__(self) -> None:
        _check_ranges(
            self, base_to_height=(0.03, 1.0), close_after_landing_s=(0, 86_400),
            keep_free_mib=(0, 1e9), assumed_agl_m=(0.5, 10_000),
        )  # fmt: skip
        if self.resolution_m != 0.0:
            _check_ranges(self, resolution_m=(0.01, 100))
        parse_baseline(self.baseline)

    @property
    def drone_name(self) -> str:
        """``drone``, or this machine's name when that is empty."""
        return self.drone or socket.gethostname()


@dataclass(frozen=True, slots=True)
class ComputeConfig:
    """[compute]: backend and quality settings."""

    backend: str = key("auto", "auto, cpu, torch or onnx; a named one must run")
    model: str = key(
        "",
        "TOML file of a learned stereo model that replaces belief propagation; needs ONNX Runtime",
    )
    threads: int = key(0, "threads of the CPU backend; 0: one per core")
    stereo_width: int = key(
        320,
        "width of the stereo pair in pixels; the paper's is 320. If unset, an offline replay uses "
        "up to 640, at most half of the recording's width",
    )
    labels: int = key(16, "minimum number of disparity labels; the paper's is 16")
    iterations: int = key(5, "iterations of belief propagation per level; the paper's is 5")
    guide_width: int = key(
        1280,
        "images over a third wider are reduced to this width; the upsampling is guided by them",
    )
    upsample: bool = key(True, "joint bilateral upsampling; without it depth is coarser and faster")
    pairs: int = key(4, "maximum number of stereo pairs fused into a keyframe")
    relief: bool = key(
        True,
        "shed load when too slow, too hot or short of memory: lower rate, lower resolution, no "
        "upsampling, finally record only; reversed on recovery",
        live=True,
    )
    map_voxels: int = key(
        2_000_000,
        "map voxels in memory, about 40 bytes each; the oldest are paged to the scan's folder",
    )
    hottest_c: float = key(90.0, "temperature from which the load is shed, degrees C", live=True)
    least_memory_mib: float = key(300.0, "free memory below which the load is shed", live=True)

    def __post_init__(self) -> None:
        _check_ranges(
            self, threads=(0, 1024), stereo_width=(64, 4096), labels=(4, 96),
            iterations=(1, 100), pairs=(1, 64), guide_width=(64, 8192),
            map_voxels=(1000, 8_000_000), hottest_c=(30, 150), least_memory_mib=(0, 1e6),
        )  # fmt: skip
        if self.guide_width < self.stereo_width:
            raise ValueError(
                f"compute.guide_width {self.guide_width} is less than compute.stereo_width "
                f"{self.stereo_width}; the guide must not be coarser"
            )


@dataclass(frozen=True, slots=True)
class DatalinkConfig:
    """[datalink]: Zenoh endpoints and link budget."""

    connect: tuple[str, ...] = key((), "ground stations to connect to: tcp/192.168.144.11:7447")
    listen: tuple[str, ...] = key((), "endpoints to listen on")
    budget_kbit_s: float = key(1000.0, "rate of the link to the ground", live=True)
    share: float = key(0.65, "share of that rate for all our traffic", live=True)
    plain: bool = key(False, "allow remote endpoints without TLS")
    tls_ca: str = key("", "fleet's certificate authority (PEM), from 'skyrelief keys'")
    tls_certificate: str = key("", "this aircraft's certificate (PEM)")
    tls_key: str = key("", "this aircraft's private key (PEM)")
    radio: str = key(
        "", "narrow fallback: 'mavlink' for [mavlink] links, or an endpoint: udpout:127.0.0.1:14551"
    )
    radio_baud: int = key(57600, "baud rate of that telemetry radio")
    radio_share: float = key(0.3, "share of it for our traffic")
    drain_s: float = key(20.0, "at the end, maximum wait for the ground to fetch the rest")

    def __post_init__(self) -> None:
        _check_ranges(
            self, budget_kbit_s=(1, 10_000_000), drain_s=(0, 86_400), share=(0.01, 1.0),
            radio_baud=(1200, 10_000_000), radio_share=(0.01, 1.0),
        )  # fmt: skip
        for endpoint in (*self.connect, *self.listen):
            if not re.fullmatch(r"[a-z]+/.+", endpoint):
                raise ValueError(f"datalink endpoint {endpoint!r} is not like tcp/HOST:7447")


@dataclass(frozen=True, slots=True)
class FusionConfig:
    """[fusion]: which telemetry may correct the poses."""

    gnss: bool = key(True, "use positions")
    attitude: bool = key(True, "use roll, pitch and yaw")
    altitude: bool = key(True, "use the height above ground")
    loops: bool = key(True, "detect revisited places and close the loop")
    loop_views: int = key(
        400, "keyframes kept for loop detection, 0.1 MB each; above that, old ones are thinned"
    )
    graph_keyframes: int = key(
        400, "keyframes in the pose graph, 0.04 MB each; above that, older ones are interpolated"
    )

    def __post_init__(self) -> None:
        _check_ranges(self, loop_views=(2, 100_000), graph_keyframes=(50, 100_000))


@dataclass(frozen=True, slots=True)
class HealthConfig:
    """[health]: status over HTTP."""

    http: str = key("127.0.0.1:9560", "address of /healthz, /status and /metrics; empty: off")

    def __post_init__(self) -> None:
        if self.http and not re.fullmatch(r"(\[[0-9a-fA-F:]+\]|[^:\s]+):\d{1,5}", self.http):
            raise ValueError(f"health.http {self.http!r} is not HOST:PORT")


@dataclass(frozen=True, slots=True)
class Config:
    """All sections; the defaults replay a recording without further settings."""

    camera: CameraConfig = dataclasses.field(default_factory=CameraConfig)
    mavlink: MavlinkConfig = dataclasses.field(default_factory=MavlinkConfig)
    scan: ScanConfig = dataclasses.field(default_factory=ScanConfig)
    compute: ComputeConfig = dataclasses.field(default_factory=ComputeConfig)
    datalink: DatalinkConfig = dataclasses.field(default_factory=DatalinkConfig)
    fusion: FusionConfig = dataclasses.field(default_factory=FusionConfig)
    health: HealthConfig = dataclasses.field(default_factory=HealthConfig)

    def to_dict(self) -> dict[str, dict[str, Any]]:
        plain: dict[str, dict[str, Any]] = msgspec.to_builtins(self)
        return plain


def load_config(path: Path | None = None, overrides: Sequence[str] = (), only: str = "") -> Config:
    """The configuration of ``path`` (None: defaults) with ``section.key=value`` overrides.

    ``only`` names a section: all other sections keep their defaults. Raises InputError, in one
    line, for a file that cannot be read, is not TOML, or holds an unknown key, type or value.
    """
    data = _read(path) if path is not None else {}
    where = str(path) if path is not None else "configuration"
    if only:
        data = {name: value for name, value in data.items() if name == only}
        overrides = [text for text in overrides if text.startswith(f"{only}.")]
    _check_keys(data, where)
    config = _convert(data, where)
    for override in overrides:
        config = _override(config, override)
    return config


def is_given(name: str, path: Path | None, overrides: Sequence[str] = ()) -> bool:
    """True where the file or an override sets ``section.key``, be it to its default."""
    section, _, field = name.partition(".")
    data = _read(path).get(section) if path is not None else None
    in_file = isinstance(data, dict) and field in data
    return in_file or any(text.partition("=")[0].strip() == name for text in overrides)


def reload(
    running: Config, wanted: Config, before: Config | None = None
) -> tuple[Config, list[str], list[str]]:
    """``running`` with the live keys of ``wanted``; names of the applied and the pending keys.

    Pending keys differ too, but need a restart. Keys that ``wanted`` shares with ``before``, the
    last wanted configuration, keep their running value: an operator may have tuned it.
    """
    taken, waiting = [], []
    for section, field in keys():
        old, new = getattr(running, section), getattr(wanted, section)
        value = getattr(new, field.name)
        if value == getattr(getattr(before or running, section), field.name):
            continue
        name = f"{section}.{field.name}"
        if not field.metadata.get("live"):
            waiting.append(name)
            continue
        taken.append(name)
        changed = dataclasses.replace(old, **{field.name: value})
        running = dataclasses.replace(running, **{section: changed})
    return running, taken, waiting


def change(config: Config, name: str, value: object) -> Config:
    """``config`` with ``section.key`` set to a plain value; InputError when it is not allowed."""
    return _override(config, f"{name}={value}")


MIN_BASELINE_M, MAX_BASELINE_M = 0.01, 1000.0


def parse_baseline(value: float | str) -> tuple[Literal["auto", "metres", "frames"], float, int]:
    """("auto", 0, 0), ("metres", m, 0) or ("frames", n, m) of ``scan.baseline``.

    "n/m" is the paper's notation: n of every m frames are used, evenly spread.
    Raises ValueError for anything else.
    """
    if isinstance(value, str) and value.strip() == "auto":
        return "auto", 0.0, 0
    frames = re.fullmatch(r"\s*(\d+)\s*/\s*(\d+)\s*", str(value))
    if frames and int(frames[1]) >= 1 and int(frames[2]) >= 1:
        return "frames", float(frames[1]), int(frames[2])
    try:
        metres = float(value)
    except ValueError:
        metres = -1.0
    if not MIN_BASELINE_M <= metres <= MAX_BASELINE_M:
        raise ValueError(
            f"scan.baseline {value!r} is not 'auto', {MIN_BASELINE_M:g} to {MAX_BASELINE_M:g} "
            "metres, or frames like '2/10'"
        )
    return "metres", metres, 0


@functools.cache
def keys() -> tuple[tuple[str, dataclasses.Field[Any]], ...]:
    """(section, field) of every key, in the order of the file."""
    kinds = get_type_hints(Config)
    return tuple(
        (section.name, field)
        for section in dataclasses.fields(Config)
        for field in dataclasses.fields(kinds[section.name])
    )


def _read(path: Path) -> dict[str, Any]:
    try:
        data = read_small(path, LARGEST_FILE_BYTES, "configuration file")
        if max(map(len, data.splitlines()), default=0) > LONGEST_LINE_BYTES:
            raise InputError(
                f"{path} is not a valid configuration: a line of over {LONGEST_LINE_BYTES} bytes"
            )
        return msgspec.toml.decode(data, type=dict[str, Any])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{path} is not TOML: {error}") from error


def _check_keys(data: Mapping[str, Any], where: str) -> None:
    known: dict[str, list[str]] = {f.name: [] for f in dataclasses.fields(Config)}
    for section, field in keys():
        known[section].append(field.name)
    for section, values in data.items():
        if section not in known:
            raise InputError(f"{where}: no section [{section}]{_suggest(section, known)}")
        if not isinstance(values, dict):
            raise InputError(f"{where}: [{section}] must be a section, not {values!r}")
        for name in values:
            if name not in known[section]:
                raise InputError(
                    f"{where}: no key {section}.{name}{_suggest(name, known[section])}"
                )


def _suggest(name: str, known: Mapping[str, Any] | list[str]) -> str:
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f"; did you mean {near[0]!r}?" if near else f"; there are {', '.join(known)}"


def _convert(data: Mapping[str, Any], where: str) -> Config:
    try:
        return msgspec.convert(data, Config)
    except msgspec.ValidationError as error:
        raise InputError(f"{where}: {_in_words(error)}") from error


def _in_words(error: msgspec.ValidationError) -> str:
    """The error with the key before the fault: ``scan.start: Invalid enum value 'x'``."""
    text, _, place = str(error).partition(" - at `$")
    name = place.rstrip("`").lstrip(".")
    if not name or name in text:
        return text
    if text.startswith("Invalid enum value"):
        section, _, key_name = name.partition(".")
        hints = get_type_hints(get_type_hints(Config)[section])
        text += f"; there are {', '.join(_words(hints[key_name]))}"
    return f"{name}: {text}"


def _words(hint: Any) -> list[str]:
    """The words that a key takes, also next to other types."""
    return [w for one in get_args(hint) for w in ([one] if isinstance(one, str) else _words(one))]


def _override(config: Config, override: str) -> Config:
    """``config`` with one ``section.key=value``; accepts bare words and single items."""
    name, equals, text = override.partition("=")
    section, dot, field = name.strip().partition(".")
    where = f"--set {override[:200]}"
    if not equals or not dot:
        raise InputError(f"{where}: write section.key=value")
    text = text.strip()
    data: dict[str, dict[str, Any]] = config.to_dict()
    readings: list[Any] = [text, [text]]  # a name of digits; one item of a list
    with contextlib.suppress(msgspec.DecodeError, RecursionError):
        readings.insert(0, msgspec.toml.decode(f"value = {text}", type=dict[str, Any])["value"])
    _check_keys({section: {field: readings[0]}}, where)
    faults = []
    for reading in readings:
        data[section][field] = reading
        try:
            return _convert(data, where)
        except InputError as error:
            faults.append(error)
    raise faults[0]


def _check_ranges(section: object, **ranges: tuple[float, float]) -> None:
    """ValueError for the first number of a section that is out of its range; words are not."""
    name = type(section).__name__.removesuffix("Config").lower()
    for key_name, (low, high) in ranges.items():
        value = getattr(section, key_name)
        if isinstance(value, int | float) and not low <= value <= high:
            raise ValueError(f"{name}.{key_name} = {value:g} is outside {low:g} to {high:g}")
