"""Two tiers of tests, by folder or marker: ``make test`` runs the quick one, ``test-all`` both.

A plugin of pytest; ``tests/conftest.py`` names it. Called with JUnit reports it prints the table of
tests and processor seconds by folder and tier.
"""

from __future__ import annotations

import os
import sys
from collections import defaultdict
from collections.abc import Generator, Iterable
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


BEGUN_S = pytest.StashKey[float]()


def spent_s() -> float:
    """Processor time of this process and of its children that have ended."""
    return sum(os.times()[:4])


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> Generator[None, None, None]:
    """The test's processor time begins, with that of the fixtures that it is the first to need."""
    item.stash[BEGUN_S] = spent_s()
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item) -> Generator[None, None, None]:
    """For the JUnit report."""
    try:
        return (yield)
    finally:
        tier = "quick" if item.get_closest_marker("slow") is None else "slow"
        item.user_properties += [(tier, f"{spent_s() - item.stash[BEGUN_S]:.2f}")]


def run_tests(report: Path) -> Iterable[tuple[str, str, float]]:
    """(module, tier, processor seconds of all tries) of the tests that ran."""
    found: dict[tuple[str, str], tuple[str, str, float]] = {}
    for case in ElementTree.parse(report).iter("testcase"):
        tries = [(p.get("name", ""), float(p.get("value", "nan"))) for p in case.iter("property")]
        if tries and case.find("skipped") is None:
            module, name = case.get("classname", ""), case.get("name", "")
            found[module, name] = module, tries[0][0], sum(seconds for _, seconds in tries)
    return found.values()


def tier_table(tests: Iterable[tuple[str, str, float]]) -> str:
    """Markdown: tests and processor seconds by folder and tier."""
    found: defaultdict[str, dict[str, list[float]]]
    found = defaultdict(lambda: {"quick": [], "slow": []})
    for module, tier, seconds in tests:
        folders = [name for name in module.split(".") if not name.startswith(("test_", "Test"))]
        for folder in ("/".join(folders), "all"):
            found[folder][tier].append(seconds)
    head = "| folder | quick tests | s | slow tests | s |\n|---|---|---|---|---|\n"
    names = sorted(found, key=lambda name: (name == "all", name))
    cells = ([f"{len(t)} | {sum(t):.0f}" for t in found[name].values()] for name in names)
    return head + "".join(
        f"| {name} | {' | '.join(row)} |\n" for name, row in zip(names, cells, strict=True)
    )


if __name__ == "__main__":
    print(tier_table(one for path in sys.argv[1:] for one in run_tests(Path(path))))
