"""Pages that commands write are up to date, and documents keep to the rules of their form."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from doc_pages import FENCE, PAGES, text_of
from paths import ROOT
from trial_rig import Table

from recon.posegraph import factors, pose_graph, records, sensor_offsets
from recon.posegraph.alignment import HUBER as MIN_FIT_SIGMAS
from recon.posegraph.alignment import WILD
from recon.posegraph.pose_graph import PoseGraph
from recon.posegraph.segments import REFIT_GROWTH, SETTLED_GROWTH
from recon.posegraph.sensor_noise import ALTITUDE_S, ATTITUDE_S, FIX_S, PRECISE_TAU_S, TAUS_S
from service.config import keys

REPORTS = ROOT / "docs" / "reports"
ROOMS = ("recon", "mavlink", "service")
MAX_WORDS, MAX_CHARACTERS = 8000, 140
HASH = re.compile(r"\b(?=[0-9a-f]*[0-9])(?=[0-9a-f]*[a-f])[0-9a-f]{7,40}\b")
"""Seven to forty hexadecimal digits with a number and a letter: a commit."""


def script(name: str) -> ModuleType:
    """A command of docs as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def report() -> ModuleType:
    return script("report")


def faults(text: str) -> Iterator[str]:
    """Lines outside tables that are too long, or name a commit outside code blocks."""
    for line in text.split("\n"):
        if not line.startswith("|") and len(line) > MAX_CHARACTERS:
            yield line
    for line in FENCE.sub("", text).split("\n"):
        if not line.startswith("|") and HASH.search(re.sub(r"\]\(\S+\)", "", line)):
            yield line


def test_reports_are_what_their_data_says(report: ModuleType) -> None:
    there = {page.name: text_of(page) for page in REPORTS.glob("*.md")}
    assert there == report.pages(), "run make pages"


def test_the_configuration_reference_is_up_to_date() -> None:
    module = script("configuration")
    page = text_of(module.PAGE)
    assert page == module.page(), "run make pages"
    assert all(f"| `{field.name}` |" in page for _, field in keys())


@pytest.mark.slow
def test_the_images_of_the_concepts_are_up_to_date() -> None:
    module = script("concepts")
    assert text_of(module.IMAGES / "frame_life.svg") == module.life(), "run make pages"
    drawn, now = text_of(module.IMAGES / "reposes.svg"), module.correction(module.track())
    number = re.compile(r"-?\d+(?:\.\d+)?")
    assert number.sub("", drawn) == number.sub("", now), "run make pages"
    places = [np.array(number.findall(text), float) for text in (drawn, now)]
    np.testing.assert_allclose(places[0], places[1], atol=2.0)  # px: another machine's last digits


def test_private_concepts_are_names_of_the_code() -> None:
    text = text_of(ROOT / "docs" / "concepts.md").partition("## Private concepts")[2]
    named = re.findall(r"`([A-Z]\w+)`", text)
    code = "".join(text_of(path) for room in ROOMS for path in (ROOT / room).rglob("*.py"))
    assert len(named) > 10
    assert [name for name in named if f"class {name}" not in code] == []


def test_the_page_on_the_pose_graph_has_the_factors_and_numbers_of_the_code() -> None:
    page = " ".join(text_of(ROOT / "docs" / "pose-graph.md").split())
    rows = page.partition("| kind | error")[2].partition("Huber's loss begins")[0]
    kinds = re.findall(r'"([\w ]+)"', PoseGraph.residuals.__doc__ or "")
    assert len(kinds) == 11
    assert [kind for kind in kinds if f"`{kind}`" not in rows] == []
    for words in (
        f"grown by {(REFIT_GROWTH - 1) * 100:.0f} % ({(SETTLED_GROWTH - 1) * 100:.0f} % from",
        f"block of {factors.BLOCK} keyframes",
        f"({records.SIGMA_STEP} of its length)",
        f"{MIN_FIT_SIGMAS} sigmas. Beyond {WILD} sigmas",
        f"claimed, inflated over {ATTITUDE_S:.0f} s",
        f"claimed and inflated over {FIX_S:.0f} s",
        f"claimed, inflated over {ALTITUDE_S:.0f} s",
        f"\\sqrt{{{factors.BLOCK} \\cdot {factors.BLOCKS_PER_HEIGHT:.0f}}}",
        f"{factors.SIGMA_SCALE_WALK} for {factors.BLOCK} keyframes; the first "
        f"{factors.KNOWN_SCALE} to {factors.UNKNOWN_SCALE:.0f}",
        f"depths at a loop's ends | {factors.SIGMA_LOOP_SCALE} |",
        f"{factors.LINK_RAD} rad ({factors.LINK_WITHOUT_HEADING_RAD} without a heading); "
        f"{factors.LINK_M:.0f} m and {factors.LINK_M_S:.0f} m",
        f"Huber's loss begins at {factors.HUBER_SIGMAS} sigmas",
        f"more than {sensor_offsets.GATE_SIGMAS:.0f} sigmas from the prediction",
        f"{factors.ALTITUDE_SLACK_M:.0f} m further off",
        f"{pose_graph.SLACK_M:.0f} m and {pose_graph.DRIFT * 100:.0f} % of the path",
        f"{pose_graph.MAX_TURN_RAD} rad; and",
        f"within {records.LOOP_WINDOW} keyframes",
        f"below {records.CHI2_LIMIT}",
        f"from {TAUS_S[0]:.0f} to {TAUS_S[-1]:.0f} s",
        f"{PRECISE_TAU_S:.0f} s for RTK",
    ):
        assert words in page, words


def test_reports_are_short() -> None:
    assert sum(len(text_of(page).split()) for page in REPORTS.glob("*.md")) <= MAX_WORDS


def test_readme_and_changelog_are_short() -> None:
    assert len(text_of(ROOT / "README.md").split()) < 700
    assert len(text_of(ROOT / "CHANGELOG.md").split()) <= 600


def test_a_long_conclusion_is_refused(report: ModuleType) -> None:
    assert len(report.conclusions({"title": "", "conclusions": ["a"] * 10})) == 10
    with pytest.raises(ValueError, match="11 lines of conclusion"):
        report.conclusions({"title": "", "conclusions": ["a"] * 9 + ["word " * 40]})


def test_the_newest_result_of_a_benchmark_is_shown(report: ModuleType) -> None:
    shown = report.bench({"title": "", "bench": ["stereo"], "only": "^320x180"})
    run = report.newest("stereo", "")
    assert run["date"][:10] == shown["date"] and run["commit"] == shown["commit"]
    assert [row[0] for row in shown["rows"]] == ["320x180, 16 labels, 5 iterations"]


def test_like_faults_share_a_row(report: ModuleType) -> None:
    def tried(fault: str, lost: str = "-", back_s: float | None = None) -> dict[str, object]:
        return {"fault": fault, "times": 5, "outcome": "kept; more", "lost": lost, "back_s": back_s}

    lines = [
        tried("fuzz: a (Hypothesis)"), tried("fuzz: b (Hypothesis)"),
        tried("power cut", "0 of 9 chunks", 1.25), tried("kill", "2 of 9 chunks"),
    ]  # fmt: skip
    assert list(report.trials(lines)) == [
        ["5 x fuzz: a, b (Hypothesis)", "kept"],
        ["5 x power cut", "kept (1.2 s)"],
        ["5 x kill", "kept; lost 2 of 9 chunks"],
    ]


def test_what_the_trials_write_is_a_table_of_the_report(report: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    table = Table(tmp_path / "runs" / "trials.json")
    table.add("kill", 2, "kept", "0 of 4 chunks", 1.04)
    table.add("cut", 1, "kept")
    table.add("kill", 3, "kept", "0 of 6 chunks", 2.0)  # tried again
    shown = report.with_origin({"title": "Faults", "trials": "trials.json"}, tmp_path)
    assert shown["rows"] == [["cut", "kept"], ["3 x kill", "kept (2.0 s)"]]
    assert "cores" in shown["machine"] and shown["date"][:2] == "20"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_lines_are_short_and_name_no_commit(page: Path) -> None:
    assert list(faults(text_of(page))) == []


def test_wrong_lines_are_found() -> None:
    text = (
        "| c9297af3 |\nas of c9297af3\n[a](b/c9297af3.json)\n```\nversion c9297af3\n```\n"
        + "a " * 71
    )
    assert list(faults(text)) == ["a " * 71, "as of c9297af3"]


def test_the_table_of_tests_names_their_folders() -> None:
    named = re.findall(r"^\| (tests\S*) \|", text_of(ROOT / "CONTRIBUTING.md"), re.MULTILINE)
    files = (ROOT / "tests").rglob("test_*.py")
    assert named == sorted({file.parent.relative_to(ROOT).as_posix() for file in files})


def test_the_diagram_of_growth_is_that_of_the_newest_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "docs")  # it draws with the other pages' scripts
    module = script("growth")
    assert text_of(module.IMAGES / "growth.svg") == module.diagram(module.curves()), (
        "run make pages"
    )
