"""Opens the GeoTIFFs in a scan's folder, which may come from anyone."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from service.errors import InputError

MAX_BLOCK_PX = 1 << 22
"""Of a block that is decoded at once; exports have 512 by 512 pixels."""

ALONE = {
    "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": ".none",
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_PAM_ENABLED": "NO",
}
"""GDAL reads no hosts, and no other file than the one that is opened."""


@contextmanager
def open_map(path: Path, bands: int = 1) -> Iterator[Any]:
    """The GeoTIFF at ``path`` with so many bands at least, open by rasterio.

    Raises InputError for any other file: other formats of GDAL name files and hosts to read.
    """
    import rasterio

    try:
        with rasterio.Env(**ALONE), rasterio.open(path, driver="GTiff") as image:
            if image.count < bands or max(h * w for h, w in image.block_shapes) > MAX_BLOCK_PX:
                raise InputError(f"{path.name} is not a map of a scan; make it again")
            yield image
    except (rasterio.errors.RasterioError, ValueError) as error:
        raise InputError(f"{path.name} cannot be read as a GeoTIFF; make it again") from error
