"""The simulated place as it looks from straight above: what an orthophoto should show."""

from __future__ import annotations

import dataclasses
import typing
from pathlib import Path
from typing import Any

import numpy as np

from recon.types import U8, Camera
from service.errors import InputError
from service.sim.recording import SimulationOptions, prepare
from service.sim.render import Look, Renderer
from service.sim.surface_file import read_surface

HEIGHT_M = 200_000.0
"""Of the eye: relief of 20 m at 500 m from the middle is displaced by 5 cm."""


def view_from_above(
    truth: Path, west_m: float, north_m: float, cell_m: float, shape: tuple[int, int]
) -> U8:
    """(rows, cols, 3) BGR of the place that ``truth`` was made of, north up, in its own ENU.

    The place is laid out anew from ``params.json`` and must agree with ``surface.ply``.
    Raises InputError where it does not, or where its ground was made of photographs, which
    the truth does not hold.
    """
    import json

    try:
        options = options_of(json.loads((truth / "params.json").read_text())["options"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{truth / 'params.json'}: does not say how the place is made") from error
    if options.photos is not None:
        raise InputError(f"{truth}: the ground was made of photographs, which are not kept there")
    simulation = prepare(options)
    scene = simulation.scene
    vertices, triangles = read_surface(truth / "surface.ply")
    same = vertices.shape == scene.vertices.shape and triangles.shape == scene.triangles.shape
    if not (same and np.abs(vertices - scene.vertices).max() < 0.01):
        raise InputError(f"{truth}: made by another version of simulate; fly it again")
    rows, cols = shape
    focal = HEIGHT_M / cell_m
    K = np.array([[focal, 0.0, 0.5 * (cols - 1)], [0.0, focal, 0.5 * (rows - 1)], [0, 0, 1.0]])
    camera = Camera(K, np.zeros(5), (cols, rows))
    T = np.eye(4)
    T[:3, :3] = np.diag([1.0, -1.0, -1.0])
    T[:3, 3] = west_m + 0.5 * cols * cell_m, north_m - 0.5 * rows * cell_m, HEIGHT_M
    return Renderer(scene, simulation.renderer.picture, camera).frame(T, 0, Look(0.0, 0.0, 1.0))


def options_of(values: dict[str, Any]) -> SimulationOptions:
    """The options that ``params.json`` holds; values it does not know take their defaults.

    Raises KeyError, TypeError or ValueError for unfit values.
    """
    return typing.cast(SimulationOptions, _made(SimulationOptions, values))


def _made(kind: Any, values: dict[str, Any]) -> Any:
    """A dataclass from JSON: lists are tuples, and objects are dataclasses of their own."""
    hints = typing.get_type_hints(kind)
    known = {f.name for f in dataclasses.fields(kind)}
    return kind(**{name: _value(hints[name], v) for name, v in values.items() if name in known})


def _value(hint: Any, value: Any) -> Any:
    if dataclasses.is_dataclass(hint):
        return _made(hint, value)
    if isinstance(value, list):
        return tuple(_value(None, v) for v in value)
    return Path(value) if isinstance(value, str) and Path in typing.get_args(hint) else value
