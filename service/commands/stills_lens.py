"""The lens of a folder of stills from the stills themselves, before they are replayed.

EXIF gives a focal length, rounded, and no distortion. A lens that bends straight lines by a few
percent turns every view of level ground a little and makes it a sixth too near: the images can
be explained that way too, until the distortion is free.
"""

from __future__ import annotations

import logging
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event
from typing import TYPE_CHECKING

from service.errors import InputError

if TYPE_CHECKING:
    from recon.types import Camera
    from service.cameras.images import ImagesSource
    from service.config import Config

log = logging.getLogger(__name__)

STILLS = 25
"""Number of stills around the middle of a flight from which the lens is estimated."""

MIN_STILLS = 6
"""Fewer stills do not determine a lens."""

COARSE = {"compute.stereo_width": 320, "compute.upsample": False, "fusion.loops": False}
"""Poses are all that is needed."""


def lens_by_stills(source: ImagesSource, camera: Camera, config: Config) -> Camera | None:
    """The camera by a reconstruction of some stills; None where they do not determine it.

    ``camera`` is the pinhole by their tags.
    """
    from service.compute.backend_choice import open_backend
    from service.config import change
    from service.flight.scan import Scan, ScanInputs, create_store
    from service.offline.refine.refinement import lens

    some = source.middle(STILLS)
    if some.images < MIN_STILLS or source.lens is None:
        return None
    for key, value in COARSE.items():
        config = change(config, key, str(value).lower())
    with TemporaryDirectory(prefix="skyrelief-lens-") as temporary:
        folder, backend = Path(temporary) / "scan", open_backend(config.compute, source.size_px)
        inputs = ScanInputs(some, camera, config, backend, folder, "lens", 0)
        store = create_store(inputs)
        try:
            scan = Scan(inputs, store)
            scan.run(Event())
            scan.close()
        finally:
            store.close()
        try:
            return lens(folder, Path(source.description), source.lens.sigma_focal)
        except InputError as error:
            log.info("the stills do not determine their lens: %s", error)
            return None
