"""Files and pages for operators agree with what the service takes."""

from __future__ import annotations

import json
import re

from paths import ROOT

from mavlink.component.commands import (
    BASELINE,
    CLEAR_MAP,
    COMMANDS,
    FINALISE,
    PAUSE,
    RESUME,
    SELF_TEST,
    START,
    STOP,
)
from mavlink.component.parameters import PARAMETERS
from mavlink.telemetry.gimbal import YAW_FRAMES


def test_every_button_of_qgroundcontrol_has_its_command() -> None:
    actions = json.loads((ROOT / "deploy" / "qgc-custom-actions.json").read_text())
    assert actions["fileType"] == "MavlinkActions" and actions["version"] == 1
    for action in actions["actions"]:
        assert action["compId"] in COMMANDS[action["mavCmd"]].components
        assert action["label"] and action["description"]
    used = {action["param1"] for action in actions["actions"]}
    assert used == {BASELINE, CLEAR_MAP, FINALISE, PAUSE, RESUME, SELF_TEST, START, STOP}


def test_the_operators_page_names_every_parameter_and_command() -> None:
    page = (ROOT / "docs" / "operators.md").read_text()
    for parameter in PARAMETERS:
        assert f"`{parameter.name}`" in page
    for number in COMMANDS:
        assert str(number) in page
    for k, frame in enumerate(YAW_FRAMES):
        assert f"{k} {frame}" in page


def test_the_operators_page_names_every_action_of_ctl() -> None:
    from service.commands.ctl import ACTIONS
    from service.ground.operator import ORDERS

    page = (ROOT / "docs" / "operators.md").read_text()
    assert all(action in page for action in ACTIONS)
    assert set(ORDERS) | {"status", "watch"} == set(ACTIONS)


def test_the_messages_of_the_operators_pages_are_those_of_the_service() -> None:
    """The longest fixed part of each listed text occurs in the code (steps as names of an enum)."""
    code = "".join(
        path.read_text(encoding="utf-8")
        for package in ("service", "mavlink")
        for path in (ROOT / package).rglob("*.py")
    )
    operators = (ROOT / "docs" / "operators.md").read_text(encoding="utf-8")
    card = (ROOT / "docs" / "card.md").read_text(encoding="utf-8")
    tables = [
        operators.partition("## Missing on the links")[2].partition("\n## ")[0],
        operators.partition("## Status texts")[2].partition("\n## ")[0],
        card.partition("| message | do |")[2].partition("\n\n")[0],
    ]
    cells = [
        line.split("|")[1] for table in tables for line in table.splitlines() if line[:3] == "| `"
    ]
    texts = [text for cell in cells for text in re.findall(r"`([^`]+)`", cell)]
    fixed = {text: max(re.split(r"\d+|…|[():,]| again", text), key=len).strip() for text in texts}
    assert len(fixed) > 20
    assert [
        text for text, part in fixed.items() if part.lower() not in code.lower().replace("_", " ")
    ] == []
