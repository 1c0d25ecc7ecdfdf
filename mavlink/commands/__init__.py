"""The commands that our components carry out: one file each, one line in the table.

A module here has ``NUMBERS`` (MAV_CMD), ``COMPONENTS`` (which of ours take it), ``WINDOW_S``
(for how long the same call again is a retransmission; 0 for questions, which may be asked
again at will) and ``handle(call, host)``.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

COMMANDS: dict[str, str] = {
    "start_scan": "mavlink.commands.start_scan",
    "stop_scan": "mavlink.commands.stop_scan",
    "control_video": "mavlink.commands.control_video",
    "capture": "mavlink.commands.capture",
    "stop_capture": "mavlink.commands.stop_capture",
    "digicam": "mavlink.commands.digicam",
    "baseline": "mavlink.commands.baseline",
    "user": "mavlink.commands.user",
    "reboot": "mavlink.commands.reboot",
    "erase": "mavlink.commands.erase",
    "camera_settings": "mavlink.commands.camera_settings",
    "request_message": "mavlink.commands.request_message",
    "request_camera": "mavlink.commands.request_camera",
    "message_interval": "mavlink.commands.message_interval",
}
"""Name to module. The next command is one file and one line."""


def load_commands() -> dict[int, Any]:
    """MAV_CMD number to the module that carries it out."""
    table: dict[int, Any] = {}
    for target in COMMANDS.values():
        module = import_module(target)
        for number in module.NUMBERS:
            table[number] = module
    return table
