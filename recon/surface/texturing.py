"""A mesh textured from posed pictures: the finest view of each triangle, in one atlas.

The steps of Waechter, Moehrle and Goesele 2014, "Let There Be Color!"
(doi:10.1007/978-3-319-10602-1_54): visibility, photo-consistency, a Markov random field for
the view of each triangle, exposure levelling, seams. Levelling here is a gain and an offset
per view and channel; seams fade over a few triangles instead of a Poisson edit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from recon.surface.meshing import Mesh
from recon.surface.texture_atlas import Layout, Palette, lay_out, paint
from recon.surface.texture_colour import fading, levels
from recon.surface.texture_labels import choose, face_neighbours
from recon.surface.texture_views import TextureView, consistent, look
from recon.types import U8

I32 = npt.NDArray[np.int32]

LARGEST_ATLAS_PX = 8192


@dataclass(frozen=True, slots=True, eq=False)
class Textured:
    """A mesh with its picture, and what the picture is made of."""

    mesh: Mesh  # uv set; vertices doubled where charts meet
    picture: U8  # (h, w, 3) RGB
    seen_share: float  # of the triangles
    views_used: int
    charts: int
    scale: float  # texels per pixel of the views


def texture(
    mesh: Mesh,
    views: Sequence[TextureView],
    largest_px: int = LARGEST_ATLAS_PX,
    progress: Callable[[str], None] = lambda _: None,
) -> Textured:
    """``mesh`` textured from ``views``; where none sees it, the mesh's own vertex colours.

    The mesh needs ``rgb``. Raises ValueError without it, or without triangles.
    """
    if mesh.rgb is None or not len(mesh.faces):
        raise ValueError("a mesh to be textured needs triangles and colours at its vertices")
    told = [-1]

    def share(done: float) -> None:
        if int(10 * done) > told[0]:
            told[0] = int(10 * done)
            progress(f"visibility {10 * told[0]} %")

    found = consistent(look(mesh, views, share))
    progress("choosing a view for each triangle")
    neighbours = face_neighbours(mesh.faces)
    slot = choose(found, neighbours)
    label = np.where(slot >= 0, found.view[np.arange(len(slot)), slot], -1).astype(np.int32)
    progress("levelling exposures")
    gains = levels(found, len(views))
    fade_view, fade_share = fading(mesh.faces, label, len(mesh.vertices_m), len(views))
    progress("packing the atlas")
    layout = lay_out(mesh, views, label, neighbours, largest_px)
    progress("painting {} x {} texels".format(*layout.size_px))
    palette = Palette(views, gains, fade_view, fade_share, mesh.rgb)
    picture = paint(mesh, layout, found, label, palette)
    used = np.unique(label[label >= 0])
    charts = len(np.unique(layout.chart[label >= 0]))
    return Textured(
        _split(mesh, layout), picture, float((label >= 0).mean()), len(used), charts, layout.scale
    )


def _split(mesh: Mesh, layout: Layout) -> Mesh:
    """The mesh with one vertex for each corner of each chart, and its uv."""
    chart = np.repeat(layout.chart.astype(np.int64), 3)
    key = chart * len(mesh.vertices_m) + mesh.faces.ravel()
    _, first, number = np.unique(key, return_index=True, return_inverse=True)
    vertex = mesh.faces.ravel()[first]
    uv = layout.uv_px.reshape(-1, 2)[first] / np.array(layout.size_px, np.float64)
    assert mesh.rgb is not None
    return Mesh(
        mesh.vertices_m[vertex],
        number.reshape(-1, 3).astype(np.int32),
        uv.astype(np.float32),
        mesh.rgb[vertex],
    )
