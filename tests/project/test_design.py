"""docs/design.md says what the code says."""

from __future__ import annotations

import importlib.util
import re
from typing import get_args

from paths import ROOT

from service.daemon.scan_state import TRANSITIONS
from service.ground import drone
from service.workers import ROWS

TEXT = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")


def row(stop: str, name: str, queue: str, deadline: str, restarts: str, does: str) -> str:
    return f"{stop:<4}  {name:<17} {queue:<14} {deadline:<8}  {restarts:<8}  {does}".rstrip()


def test_the_table_of_workers_is_the_code_s() -> None:
    table = [row("stop", "worker", "queue", "deadline", "restarts", "does")]
    for worker in ROWS:
        queue = " ".join(filter(None, (str(worker.bound or ""), worker.full)))
        deadline = "" if worker.deadline_s is None else f"{worker.deadline_s:g} s"
        restarts = "yes" if worker.restarts else ""
        table.append(row(str(worker.stop), worker.name, queue, deadline, restarts, worker.does))
    assert "```text\n" + "\n".join(table) + "\n```" in TEXT


def test_the_table_of_a_scan_s_states_is_the_code_s() -> None:
    table = ["| state | operator sees | event > next state |", "| --- | --- | --- |"]
    for state, row in TRANSITIONS.items():
        events = ", ".join(f"{event.value} > {after.text}" for event, after in row.items())
        table.append(f"| {state.text} | {state.phase.value} | {events} |")
    assert "\n".join(["", *table, ""]) in TEXT


def test_the_table_of_a_received_scan_s_files_is_the_code_s() -> None:
    table = ["| files | change > next |", "| --- | --- |"]
    for state, row in drone.TRANSITIONS.items():
        changes = ", ".join(f"{change.value} > {after.value}" for change, after in row.items())
        table.append(f"| {state.value} | {changes} |")
    assert "\n".join(["", *table, ""]) in TEXT


def test_the_events_and_effects_of_a_drone_are_the_code_s() -> None:
    events, effects = (
        ", ".join(kind.__name__ for kind in get_args(kinds))
        for kinds in (drone.Event, drone.Effect)
    )
    assert f"events   {events}\neffects  {effects}\n" in TEXT


def test_every_path_in_it_exists() -> None:
    paths = re.findall(r"`((?:service|recon|mavlink|tests)/[\w./]+)`", TEXT)
    assert len(paths) > 20
    assert [path for path in paths if not (ROOT / path).exists()] == []


def test_the_image_of_the_architecture_is_up_to_date() -> None:
    spec = importlib.util.spec_from_file_location("architecture", ROOT / "docs/architecture.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.SVG.read_text(encoding="utf-8") == module.drawing(), "run docs/architecture.py"
