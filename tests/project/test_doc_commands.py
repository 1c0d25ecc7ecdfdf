"""Commands, options, settings and make targets in the documents exist.

Complete commands in code blocks go through the parser of their command (names, options, choices,
numbers, missing arguments), and ``test_doc_commands_run.py`` runs them. Mentions in prose and
tables are checked for the command and its options. ``RUN_BY`` names, for each command, a test that
executes it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import pytest
import typer.main
from doc_pages import FENCE, PAGES, blocks, complete, text_of
from paths import ROOT

from service.cli import COMMANDS, app, load_command
from service.config import keys, load_config
from service.errors import InputError

INLINE = re.compile(r"`([^`\n]+)`")
OTHERS = ("scan.json", "scan.db", "camera.yaml", "mavlink.troubles")
"""Files and a field of /status whose names look like a key of the configuration."""

RUN_BY = {
    "demo": "test_demo.py",
    "replay": "test_replay.py",
    "run": "test_simulated.py",
    "keys": "trials/test_trial_attack.py",
    "ctl": "test_mavlink_ctl.py",
    "ground": "test_ground_service.py",
    "simulate": "test_sim_recording.py",
    "score": "test_sim_score.py",
    "export": "test_exports.py",
    "mesh": "test_meshing.py",
    "refine": "test_refine.py",
    "refly": "test_refly.py",
    "site": "test_site.py",
    "inspect": "test_inspection.py",
    "calibrate": "test_calibration.py",
    "stereo": "test_stereo_command.py",
    "export-model": "test_stereo_command.py",
    "config": "test_cli.py",
    "doctor": "test_doctor.py",
    "warm-up": "trials/test_trial_soak.py",
    "bench": "test_bench.py",
}
"""Command to a test file that executes it."""


def mentions(page: Path) -> Iterator[str]:
    """Inline code of the page, with the pipes of tables unescaped."""
    for code in INLINE.findall(FENCE.sub("", text_of(page))):
        yield code.replace("\\|", "|")


@cache
def options(command: str) -> frozenset[str]:
    """Every option of a command."""
    parameters = load_command(command).params
    found = {name for p in parameters for name in (*p.opts, *p.secondary_opts)}
    return frozenset({name for name in found if name.startswith("-")} | {"--help"})


def fault_of(words: list[str]) -> str:
    """The parser's complaint about a complete command; empty if there is none."""
    name, *arguments = [word for word in words if word not in ("-v", "--verbose")] or [""]
    if name not in COMMANDS:
        return "" if name == "--help" else f"no command {name!r}"
    parser: Any = load_command(name)
    try:
        context = parser.make_context(name, arguments)
        load_config(None, context.params.get("set_") or [])
    except InputError as error:
        return str(error)
    except Exception as error:  # UsageError of click, or of typer's own copy of it
        return getattr(error, "message", "") or repr(error)
    return ""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_complete_commands_parse(page: Path) -> None:
    faults = [(words, fault) for words in complete(page) if (fault := fault_of(words))]
    assert faults == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_mentioned_commands_and_options_exist(page: Path) -> None:
    every = {option for name in COMMANDS for option in options(name)}
    every |= {option for p in typer.main.get_command(app).params for option in p.opts}
    others = [*(ROOT / "deploy").glob("*.sh"), ROOT / "tests" / "conftest.py", ROOT / "Makefile"]
    foreign = "".join(map(text_of, others))
    wrong = []
    for code in mentions(page):
        if (found := re.match(r"(?:\S*bin/)?skyrelief ([a-z][\w-]*)", code)) is not None:
            known = options(found[1]) if found[1] in COMMANDS else frozenset()
            wrong += [code] if not known else []
            wrong += [
                f"{code}: {o}" for o in re.findall(r"(--[a-z][\w-]*)", code) if o not in known
            ]
        elif (option := re.match(r"--[a-z][\w-]*", code)) is not None:
            wrong += [code] if option[0] not in every and option[0] not in foreign else []
    assert wrong == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_settings_exist(page: Path) -> None:
    known = {f"{section}.{field.name}" for section, field in keys()}
    sections = "|".join({name.partition(".")[0] for name in known})
    named = [
        match[1]
        for code in mentions(page)
        if (match := re.match(rf"(?:--set )?((?:{sections})\.[a-z]\w*)(?: ?=|$)", code))
    ]
    assert [name for name in named if name not in known and name not in OTHERS] == []


def test_example_configurations_load(tmp_path: Path) -> None:
    loaded = 0
    for kind, body in (block for page in PAGES for block in FENCE.findall(text_of(page))):
        if kind != "toml" or not body.startswith("["):
            continue
        sections = msgspec.toml.decode(body)
        file = tmp_path / "skyrelief.toml"
        file.write_text(body, encoding="utf-8")
        config = load_config(file)
        assert {name: getattr(config, name) for name in sections}
        loaded += 1
    assert loaded >= 2


def test_make_targets_exist() -> None:
    makefile = text_of(ROOT / "Makefile")
    codes = [code for page in PAGES for code in (*mentions(page), *blocks(page))]
    named = {name for code in codes for name in re.findall(r"^make ([a-z]+)", code, re.MULTILINE)}
    assert {"demo", "test"} <= named
    assert [name for name in named if f"\n{name}:" not in makefile] == []


def test_every_command_is_executed_by_a_test() -> None:
    assert set(RUN_BY) == set(COMMANDS)
    for name, file in RUN_BY.items():
        text = text_of(next((ROOT / "tests").rglob(file)))
        assert f'"{name}"' in text, f"{file} does not run {name}"


def test_wrong_commands_are_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "```\nskyrelief replay a.mp4 --no-such \\\n  x\nskyrelief fly; skyrelief score a\n"
        "skyrelief replay a.mp4 --set scan.stat=1\nskyrelief bench --rounds many\n```\n"
    )
    faults = [fault_of(words) for words in complete(page)]
    assert len(faults) == 5 and all(faults)
