"""A scan folder opened for its deliverables: store, place, track and fused cloud."""

from __future__ import annotations

import copy
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, wraps
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from recon.mapping.free_space import air_above
from recon.surface.change import level_filled
from recon.surface.raster import Grid, Raster, grid_over, rasterise_points, round_cell
from recon.types import F64, U8, Bool
from service.errors import InputError
from service.georeference import LocalFrame, height_change, vertical_code
from service.offline.exports import EXPORTERS, MAPPED, PACKAGES, kind_of
from service.offline.tiles import TILE_POINTS, Tile, Tiling, run_tiles, tiling
from service.packages import needing
from service.progress import Progress
from service.scans.fused_cloud import EVERYWHERE, Box, FusedCloud, fused_cloud, placed
from service.scans.main_piece import main_keyframes, main_track
from service.scans.track import flown_datum, local_frame
from service.scans.trust import SharedSigma, shared_sigma
from service.scans.writing import check_writable
from service.stream.records import PoseRecord
from service.stream.store import ScanStore

T = TypeVar("T")
Of = TypeVar("Of")

FUSING = 0.6
"""Share of an export that fusing the cloud takes."""


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """Options of an export; None takes the scan's own ground sample distance."""

    voxel_m: float | None = None
    cell_m: float | None = None
    contour_m: float = 1.0
    strict: bool = False  # cells that the surface model does not count as measured stay unknown
    video: Path | None = None  # None: the scan's recording, when it is still there
    stored: bool = False  # never look for the recording
    video_epoch_ns: int | None = None
    vertical_datum: str | None = None  # of the heights as flown, where the operator knows it
    to_datum: str | None = None  # what they are converted to
    tile_points: int = TILE_POINTS  # stored points above which products are made in tiles
    scheduler: str | None = None  # of a Dask cluster that makes them
    train_steps: int = 0  # of Gaussians, on a CUDA device

    def __post_init__(self) -> None:
        """Raise ValueError for sizes that are not positive, and for an unknown datum."""
        for option, datum in (("vertical", self.vertical_datum), ("to", self.to_datum)):
            try:
                _ = datum and vertical_code(datum)
            except ValueError as error:
                raise ValueError(f"--{option}-datum {error}") from error
        if self.to_datum is not None and self.vertical_datum is None:
            raise ValueError(
                "--to-datum needs the datum of the heights as flown; give --vertical-datum "
                "(autopilots: usually EGM96)"
            )
        for name in ("voxel_m", "cell_m", "contour_m"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} is {value}, must be positive")

    @property
    def datum(self) -> str | None:
        return self.to_datum or self.vertical_datum

    @property
    def height_key(self) -> str:
        """Name of a property that holds a height."""
        is_amsl = self.to_datum is None and self.vertical_datum != "ellipsoid"
        return "height_amsl_m" if is_amsl else "height_m"


HOLE_CELLS = 2
"""Voxels and cells of one size leave lines of cells without a point; gaps so wide between level
cells count as measured, with twice the sigma around them."""

NO_POINTS = "contains no points yet; nothing to export"


class NoPointsError(InputError):
    """A scan, or a tile of it, has not a single point."""


USUAL = ExportOptions()

Make = Callable[["ScanView", ExportOptions, Box], T | None]
"""Makes the part of a product in a box; a module's own function, so that it can travel."""


@dataclass(frozen=True, slots=True)
class ProductJob:
    """One tile of a product, in plain values."""

    tile: Tile
    make: Make[Any]
    options: ExportOptions


class ScanView:
    """An open scan folder; close it, or use it in a ``with``."""

    def __init__(
        self,
        folder: Path,
        voxel_m: float | None = None,
        progress: Progress | None = None,
        tile: Tile | None = None,
    ) -> None:
        """``tile`` restricts the view to its points. Raises InputError when ``folder`` is not a
        scan folder."""
        if not folder.is_dir():
            raise InputError(f"{folder} is not a folder; give a scan folder (it holds scan.db)")
        if not (folder / "scan.db").is_file():
            raise InputError(f"{folder} contains no scan.db; give a scan folder")
        self.folder = folder
        self.store = ScanStore.open(folder / "scan.db")
        self._voxel_m = voxel_m
        self.progress = progress or Progress()
        self._shared: dict[Any, Any] = {}
        self._making: dict[Any, threading.Lock] = {}
        self._lock = threading.Lock()
        self._datums: tuple[str, str] | None = None  # heights from the first to the second
        self.box = EVERYWHERE  # ENU m, of the points that are seen
        if tile is not None:
            self.box = tile.wide
            self.store.only(tile.seqs)
        self.store.hold_decoded()  # several deliverables go over all keyframes

    def __enter__(self) -> ScanView:
        return self

    def __exit__(self, *_: object) -> None:
        self.store.close()

    def with_progress(self, progress: Progress) -> ScanView:
        """The same view for another thread, which shares what deliverables are made from."""
        other = copy.copy(self)
        other.progress = progress
        return other

    def converted(self, options: ExportOptions) -> ScanView:
        """The same view with heights above the datum that ``options`` ask for.

        Raises InputError when they cannot be converted.
        """
        if options.vertical_datum is None or options.to_datum is None:
            return self
        other = copy.copy(self)
        other.__dict__.pop("frame", None)
        other._datums = options.vertical_datum, options.to_datum
        other.needs_place("a conversion of heights")
        return other

    def shared(self, key: Any, make: Callable[[], T]) -> T:
        """What several deliverables are made from: the first thread that asks makes it, the others
        wait. What ``make`` raises is raised, and the next thread makes it."""
        key = self._datums, key
        with self._lock:
            making = self._making.setdefault(key, threading.Lock())
        with making:
            if key not in self._shared:
                self._shared[key] = make()
            found: T = self._shared[key]
            return found

    @cached_property
    def frame(self) -> LocalFrame | None:
        """The scan's georeference, or None; its heights are those of the deliverables."""
        frame = self.flown_frame
        if frame is None or self._datums is None:
            return frame
        return replace(frame, heights=height_change(*self._datums, frame.lat_deg, frame.lon_deg))

    @property
    def flown_frame(self) -> LocalFrame | None:
        """The scan's georeference with heights as the autopilot reports them, or None."""
        return local_frame(self.store.header)

    def above(self, options: ExportOptions) -> str:
        """What the written heights are above, in words."""
        if self.frame is None:
            return "above the scan's origin"
        return "AMSL" if options.datum is None else f"above {options.datum}"

    @cached_property
    def poses(self) -> list[PoseRecord]:
        """The main piece's trajectory in order of time."""
        return main_track(self.store)

    @cached_property
    def shared_sigma(self) -> SharedSigma | None:
        """What all points share; None where the scan is not placed."""
        return shared_sigma(self.store)

    @cached_property
    def off_nadir_deg(self) -> F64:
        """(K,) how far each keyframe looks off straight down."""
        down = [-k.depth.T_world_camera[2, 2] for k in main_keyframes(self.store)]
        return np.asarray(np.degrees(np.arccos(np.clip(down, -1.0, 1.0))), np.float64)

    @property
    def fused(self) -> FusedCloud:
        """The fused cloud in ENU metres; InputError when there is not a single point."""
        return self.shared("fused", self._fuse)

    def _fuse(self) -> FusedCloud:
        with self.progress.part("fusing the cloud", FUSING):
            fused = fused_cloud(self.store, self._voxel_m, self.progress, self.box)
        if not len(fused.cloud):
            raise NoPointsError(f"{self.folder} {NO_POINTS}")
        return fused

    def tiling(self, options: ExportOptions, margin_m: float, on_map: bool = True) -> Tiling:
        """Tiles over the scan in its UTM zone, or in ENU metres, each with the points ``margin_m``
        around it."""
        frame, voxel_m = self.frame if on_map else None, options.voxel_m or self._voxel_m
        return self.shared(
            ("tiling", margin_m, options.tile_points, voxel_m, on_map),
            lambda: tiling(self.folder, self.store, options.tile_points, margin_m, frame, voxel_m),
        )

    def for_tiles(self, options: ExportOptions, cut: Tiling) -> ExportOptions:
        """The options with what tiles by themselves, maybe elsewhere, would choose differently."""
        voxel = options.voxel_m or self._voxel_m or cut.sample_m
        cell = options.cell_m or round_cell(voxel, up=True)
        video = None if options.video is None else options.video.resolve()
        return replace(options, voxel_m=voxel, cell_m=cell, video=video)

    @property
    def xyz_m(self) -> F64:
        """(N, 3) of the fused cloud in UTM with AMSL heights; ENU without georeference."""
        return self.shared("xyz", lambda: placed(self.fused.cloud, self.frame))

    def grid(self, cell_m: float | None) -> Grid:
        """A grid over ``xyz_m``, by default of round cells as large as the voxels at least."""
        return self.grid_of(self.xyz_m, cell_m or round_cell(self.fused.voxel_m, up=True))

    def grid_of(self, xyz_m: F64, cell_m: float) -> Grid:
        """A grid over places (N, 3) with a cell around them; InputError where it is too large."""
        try:
            return grid_over(xyz_m[:, :2], cell_m, margin_cells=1)
        except ValueError as error:
            raise InputError(f"{self.folder}: {error} with --cell-m") from error

    def raster(self, cell_m: float | None) -> Raster:
        """The upper surface on :meth:`grid`, also where it is doubtful, and in narrow gaps between
        level cells."""
        cloud = self.fused.cloud
        return self.shared(
            ("raster", cell_m),
            lambda: level_filled(
                rasterise_points(self.xyz_m, cloud.rgb, cloud.sigma_m, self.grid(cell_m)),
                HOLE_CELLS,
            ),
        )

    def air_above(self, places_m: F64, up_m: Sequence[float]) -> tuple[Bool, U8]:
        """:func:`recon.mapping.free_space.air_above` of all keyframes."""
        keyframes = self.progress.over(main_keyframes(self.store), len(self.store.seqs()))
        with self.progress.part("surface that is open to the sky", 0.3):
            return air_above(places_m, up_m, (k.depth for k in keyframes))

    def needs_place(self, what: str) -> LocalFrame:
        """The frame; InputError when the scan has no georeference."""
        if self.frame is None:
            raise InputError(f"{self.folder} has no georeference; {what} needs one (fly with GNSS)")
        return self.frame


def made_once(make: Callable[[ScanView, Of], T]) -> Callable[[ScanView, Of], T]:
    """``make``, whose product for a view and one more argument is shared."""

    @wraps(make)
    def found(scan: ScanView, of: Of) -> T:
        return scan.shared((make, of), lambda: make(scan, of))

    return found


def export(view: ScanView, kind: str, out: Path | None, options: ExportOptions) -> Path:
    """Write one deliverable; the path written. Raises as :func:`check`, and what it cannot see."""
    if options.vertical_datum is None:
        options = replace(options, vertical_datum=flown_datum(view.store.header))
    write, path = check(view, kind, out, options)
    with needing(f"export to {kind}"):
        write(view.converted(options), path, options)
    return path


Write = Callable[[ScanView, Path, ExportOptions], None]


def check(
    view: ScanView, kind: str, out: Path | None, options: ExportOptions
) -> tuple[Write, Path]:
    """What writes a deliverable, and its path; everything that needs no work is checked.

    Raises InputError for an unknown kind, another format's ending, a missing georeference and
    heights that cannot be converted; OutsideError for missing packages and a folder that cannot be
    written.
    """
    kind = kind_of(kind, out)
    target, usual, _ = EXPORTERS[kind]
    path = out or view.folder / usual
    if kind in MAPPED:
        view.needs_place(f"{kind}")
    view.converted(options).frame  # noqa: B018
    check_writable(path, is_folder=not Path(usual).suffix)
    module, _, name = target.partition(":")
    with needing(f"export to {kind}"):
        for package in PACKAGES.get(kind, ()):
            import_module(package)
        write: Write = getattr(import_module(f"service.offline.exports.{module}"), name)
    return write, path


def in_parts(
    scan: ScanView,
    make: Make[T],
    options: ExportOptions,
    margin_m: float,
    on_map: bool = True,
    nothing: str = NO_POINTS,
) -> Iterator[T]:
    """A product as a whole, or tile by tile where there are more points than one may have.

    Each tile, whose box is as :meth:`ScanView.tiling` has it, is made from its points and those
    ``margin_m`` around it. Raises InputError, at the first, when no tile has anything; ``nothing``
    is the reason.
    """
    cut = scan.tiling(options, margin_m, on_map)
    parts: Iterator[T | None]
    if len(cut.tiles) == 1:
        parts = iter([make(scan, options, EVERYWHERE)])
    else:
        fixed = scan.for_tiles(options, cut)
        jobs = [ProductJob(tile, make, fixed) for tile in cut.tiles]
        parts = run_tiles(make_part, jobs, options.scheduler, scan.progress)
    count = 0
    for part in parts:
        if part is not None:
            count += 1
            yield part
    if not count:
        raise InputError(f"{scan.folder} {nothing}")


def make_part(job: ProductJob, progress: Progress | None = None) -> Any:
    """One tile of a product; None without any points."""
    with ScanView(Path(job.tile.folder), job.options.voxel_m, progress, job.tile) as scan:
        try:
            return job.make(scan.converted(job.options), job.options, job.tile.box)
        except NoPointsError:
            return None
