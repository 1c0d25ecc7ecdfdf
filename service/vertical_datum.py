"""Vertical datums: what heights are above, their EPSG codes, and conversion by geoid grids.

PROJ's grids hold the geoid's height above the ellipsoid. They are not part of this package.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from recon.types import F64
from service.errors import InputError

if TYPE_CHECKING:
    from pyproj import CRS, Transformer

NAMES = {"ellipsoid": None, "EGM96": 5773, "EGM2008": 3855}
"""Datums with a name, and the EPSG code of their heights; the ellipsoid is that of WGS 84."""

AREA_DEG = 0.05


def vertical_code(name: str) -> int | None:
    """EPSG code of the heights ``name`` (of NAMES, or ``EPSG:n``); None for the ellipsoid.

    Raises ValueError for what is not a vertical datum.
    """
    if name in NAMES:
        return NAMES[name]
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    kind, _, number = name.partition(":")
    try:
        if kind.upper() == "EPSG" and number.isdecimal() and CRS.from_epsg(int(number)).is_vertical:
            return int(number)
    except CRSError:
        pass
    known = ", ".join(NAMES)
    raise ValueError(f"{name}: give {known}, or EPSG:n of vertical coordinates")


@dataclass(frozen=True, slots=True, eq=False)
class HeightChange:
    """Conversion of heights from one vertical datum to another, near one place."""

    words: str
    transformer: Transformer

    def __call__(self, geodetic: F64, undo: bool = False) -> F64:
        """(N, 3) latitude, longitude (degrees) and the height above the other datum, metres.

        Raises InputError where the grid ends.
        """
        from pyproj.enums import TransformDirection

        way = TransformDirection.INVERSE if undo else TransformDirection.FORWARD
        lat, lon, height = geodetic.T
        # PROJ takes arrays of one element for numbers.
        *_, changed = self.transformer.transform(
            lon.tolist(), lat.tolist(), height.tolist(), direction=way
        )
        out = np.column_stack([lat, lon, np.asarray(changed, np.float64)])
        if not np.isfinite(out[np.isfinite(height), 2]).all():
            raise InputError(f"{self.words}: PROJ's grid does not cover all of the scan")
        return out


def height_change(source: str, target: str, lat_deg: float, lon_deg: float) -> HeightChange | None:
    """The conversion of heights near a place by PROJ's grids; None where both datums are one.

    Raises InputError when a grid is missing or PROJ knows no conversion; no offset is assumed.
    """
    from pyproj.datadir import get_user_data_dir  # type: ignore[attr-defined]
    from pyproj.transformer import AreaOfInterest, TransformerGroup

    if vertical_code(source) == vertical_code(target):
        return None
    south, north = max(lat_deg - AREA_DEG, -90.0), min(lat_deg + AREA_DEG, 90.0)
    area = AreaOfInterest(lon_deg - AREA_DEG, south, lon_deg + AREA_DEG, north)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of grids that are not there: said below
        group = TransformerGroup(
            _geodetic(source), _geodetic(target), always_xy=True,
            area_of_interest=area, allow_ballpark=False,
        )  # fmt: skip
    words = f"heights above {source} to heights above {target}"
    if group.transformers:
        return HeightChange(words, group.transformers[0])
    if not group.unavailable_operations:
        raise InputError(f"{words}: PROJ knows no conversion at this place")
    missing = [grid for grid in group.unavailable_operations[0].grids if not grid.available]
    names = " and ".join(grid.short_name for grid in missing)
    raise InputError(
        f"{words}: PROJ's grid {names} is missing; 'python -m pyproj sync --file NAME' fetches it, "
        f"or copy it ({' '.join(grid.url for grid in missing)}) to {get_user_data_dir()}"
    )


def _geodetic(name: str) -> CRS:
    """Longitude and latitude on WGS 84 with heights above the datum ``name``."""
    from pyproj import CRS

    code = vertical_code(name)
    return CRS("EPSG:4979" if code is None else f"EPSG:4326+{code}")
