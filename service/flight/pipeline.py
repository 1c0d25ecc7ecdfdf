"""A scan's :class:`recon.pipeline.mapper.Mapper` by the configuration, on a thread of its own."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path

from recon.backends import Backend
from recon.calibration.adjusted_track import AdjustedTrack
from recon.parallel import limit_threads
from recon.pipeline.mapper import Mapper, MapperConfig, Reconstruct, Reconstructed
from recon.pipeline.views import StereoView
from recon.types import Camera
from service.background import BackgroundWorker
from service.cameras.camera_file import seeks_readout, with_shutter
from service.config import Config, ScanConfig, parse_baseline
from service.flight.paged_map import PagedMap
from service.flight.reports import GraphWatch
from service.progress import Stopwatch
from service.stream.outbox import FIRST_BYTES_S

MAX_WAITING = 3  # views that wait for reconstruction


def is_lost_if_dropped(view: StereoView) -> bool:
    """False for a first depth, as its view comes again."""
    return not view.is_first_depth


def spacing_of(scan: ScanConfig) -> tuple[float, int]:
    """Metres and frames between two views by ``scan.baseline``; 0 and 0: by base to height.

    Two of every ten frames, evenly spread, are ten frames apart: at 60 frames a second and 3 m/s
    the paper's 0.5 m.
    """
    mode, amount, every = parse_baseline(scan.baseline)
    if mode == "frames":
        return 0.0, max(1, round(every / max(int(amount) - 1, 1)))
    return amount, 0


def mapper_config(camera: Camera, config: Config, live: bool = False) -> MapperConfig:
    """The mapper's parameters by the configuration; ``live`` for a flight that can be followed."""
    compute, scan, link = config.compute, config.scan, config.datalink
    is_sent = live and bool(link.connect or link.listen)
    is_sent = is_sent and 125.0 * link.budget_kbit_s * link.share >= FIRST_BYTES_S
    return MapperConfig(
        spacing=spacing_of(scan),
        pairs=compute.pairs,
        base_to_height=scan.base_to_height,
        seeks_readout=seeks_readout(camera, config.camera),
        guide_width_px=compute.guide_width,
        stereo_width_px=compute.stereo_width,
        upsample=compute.upsample,
        labels=compute.labels,
        iterations=compute.iterations,
        loops=config.fusion.loops,
        loop_views=config.fusion.loop_views,
        graph_keyframes=config.fusion.graph_keyframes,
        resolution_m=scan.resolution_m,
        keeps_debug=scan.keep_debug,
        first_depths=is_sent and not scan.keep_debug,
    )


class Pipeline:
    """A scan's mapper, which reconstructs on the workers ``dense`` and ``placing`` and keeps old
    surface on disk."""

    def __init__(
        self,
        camera: Camera,
        config: Config,
        backend: Backend,
        pages: Path,
        live: bool = False,
        known: AdjustedTrack | None = None,
    ) -> None:
        """Raises ValueError for an unusable camera model.

        ``pages`` is a folder, made when it is needed, for the oldest parts of the map. ``live``
        drops old work when reconstruction cannot keep up. A ``known`` track takes the odometry's
        place.
        """
        limit_threads(config.compute.threads)
        self.stopwatch = Stopwatch()
        self._doubts: deque[str] = deque()  # found on the worker, taken by the operator's thread
        rows = None if config.scan.keep_debug else ("dense", "placing")
        camera = with_shutter(camera, config.camera)
        self.mapper = Mapper(
            camera,
            mapper_config(camera, config, live),
            backend,
            known,
            partial(PagedMap, folder=pages, max_voxels=config.compute.map_voxels),
            partial(self._in_background, rows, live),
            self.stopwatch,
            keeps_cloud=False,
        )
        self.watch = GraphWatch(self.mapper.keyframe_map.graph)

    def _in_background(
        self, rows: tuple[str, str] | None, live: bool, work: Reconstruct
    ) -> BackgroundWorker[StereoView, Reconstructed]:
        self.worker = BackgroundWorker(
            rows,
            lambda view: partial(self._watched, work(view)),
            MAX_WAITING,
            live,
            is_lost_if_dropped,
        )
        return self.worker

    def _watched(self, place: Callable[[], Reconstructed]) -> Reconstructed:
        """Place a view, and examine the graph now and then."""
        update = place()
        self._doubts.extend(self.watch.new_findings())
        return update

    def new_doubts(self) -> list[str]:
        """Warnings about the telemetry, each once."""
        return [self._doubts.popleft() for _ in range(len(self._doubts))]

    @property
    def held(self) -> dict[str, int]:
        """Memory that this scan takes: the map's voxels, its tiles on disk, views for loops,
        and keyframes in the pose graph."""
        known = self.mapper.surface.known
        return {
            "map_voxels": 0 if known is None else len(known),
            "map_tiles_on_disk": known.tiles_on_disk if isinstance(known, PagedMap) else 0,
        } | self.mapper.keyframe_map.held
