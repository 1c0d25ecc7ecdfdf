"""Two tiers of tests, by folder or marker: ``make test`` runs the quick one, ``test-all`` both.

A plugin of pytest; ``tests/conftest.py`` names it.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import pytest

SLOW = {"bench", "gpu", "portal", "trials"}
"""Folders whose tests are all slow: development's benchmarks, GPU kernels, browsers, attacks."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--rest FILE``: what did not run, or was skipped, in the run of that JUnit report."""
    parser.addoption("--rest", type=Path, help="run what this JUnit report does not hold as run")


def has_run(report: Path) -> set[tuple[str, str]]:
    """(class name, name) of the report's tests that passed or failed."""
    cases = ElementTree.parse(report).iter("testcase")
    return {
        (case.get("classname", ""), case.get("name", ""))
        for case in cases
        if case.find("skipped") is None
    }


def reported(nodeid: str) -> tuple[str, str]:
    """(class name, name) of a test, as pytest's JUnit report spells it."""
    path, bracket, parameters = nodeid.partition("[")
    *scope, name = path.split("::")
    scope[0] = scope[0].removesuffix(".py").replace("/", ".")
    return ".".join(scope), name + bracket + parameters


def is_slow(path: Path, root: Path) -> bool:
    """Whether the file lies in a slow folder."""
    return not SLOW.isdisjoint(path.relative_to(root).parts)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """The quick tier imports no slow folder: torch and browsers take seconds in each worker."""
    quick = config.option.markexpr == "not slow"
    return True if quick and is_slow(collection_path, config.rootpath) else None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the slow folders, begin with the trials, which wait, and leave out what has run."""
    for item in items:
        if is_slow(item.path, config.rootpath):
            item.add_marker("slow")
    items.sort(key=lambda item: "trials" not in item.path.parts)
    report = config.getoption("rest")
    if report is not None:
        done = has_run(report)
        config.hook.pytest_deselected(items=[i for i in items if reported(i.nodeid) in done])
        items[:] = [item for item in items if reported(item.nodeid) not in done]
