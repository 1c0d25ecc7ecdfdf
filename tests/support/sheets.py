"""A raster as one sheet of triangles, as input for textures, files and cuts."""

from __future__ import annotations

import numpy as np

from recon.surface.meshing import Mesh
from recon.surface.raster import Raster


def height_mesh(raster: Raster) -> Mesh:
    """A vertex per cell and two triangles per four cells; all cells are known."""
    rows, cols = raster.grid.shape
    at = np.arange(rows * cols).reshape(rows, cols)
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]
    halves = [np.stack([a, c, d], -1), np.stack([a, d, b], -1)]
    faces = np.concatenate([half.reshape(-1, 3) for half in halves]).astype(np.int32)
    places = raster.grid.centres(*np.divmod(at.ravel(), cols))
    return Mesh(np.column_stack([places, raster.height_m.ravel().astype(np.float64)]), faces)
