"""No file needs, by whatever way of imports, another file that needs it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter

import pytest
from paths import ROOT


def modules() -> dict[str, ast.Module]:
    """Every module of the product, parsed, by its dotted name."""
    out = {}
    for package in ("recon", "mavlink", "service"):
        for path in sorted((ROOT / package).rglob("*.py")):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            out[name.removesuffix(".__init__")] = ast.parse(path.read_bytes())
    return out


def imported(tree: ast.Module) -> Iterator[str]:
    """Dotted names of imports: at the top, in functions and for types alone."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def circle(trees: dict[str, ast.Module]) -> list[str]:
    """Names of modules that need each other, in a round; empty without any."""
    needs: dict[str, set[str]] = {}
    for name, tree in trees.items():
        found = (one if one in trees else one.rpartition(".")[0] for one in imported(tree))
        needs[name] = {one for one in found if one in trees and one != name}
    try:
        TopologicalSorter(needs).prepare()
    except CycleError as error:
        round_trip: list[str] = error.args[1]
        return round_trip
    return []


@pytest.mark.slow
def test_files_do_not_need_each_other() -> None:
    trees = modules()
    assert len(trees) > 200 and not circle(trees), " -> ".join(circle(trees))


@pytest.mark.parametrize("way", ["from m.b import B", "if TYPE_CHECKING:\n    import m.b"])
def test_a_circle_is_found(way: str) -> None:
    trees = {"m.a": ast.parse(way), "m.b": ast.parse("def f():\n    from m import a")}
    assert set(circle(trees)) == {"m.a", "m.b"}
