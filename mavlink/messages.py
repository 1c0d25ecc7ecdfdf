"""Outgoing messages: who says what to whom, before it is packed for a link."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

ONBOARD = 191  # MAV_COMP_ID_ONBOARD_COMPUTER
CAMERA = 100  # MAV_COMP_ID_CAMERA


@dataclass(frozen=True, slots=True)
class Address:
    """A component of a system; 0 means all."""

    system: int
    component: int


@dataclass(frozen=True, slots=True)
class Outgoing:
    """A message from one of our components, for one link or (None) for all."""

    component: int
    message: Any
    link: int | None = None


class Outbox:
    """Messages waiting to be packed; the oldest give way when nobody takes them."""

    def __init__(self, limit: int = 2000) -> None:
        self._waiting: deque[Outgoing] = deque(maxlen=limit)

    def put(self, component: int, message: Any, link: int | None = None) -> None:
        """Queue a message of one of our components."""
        self._waiting.append(Outgoing(component, message, link))

    def take(self) -> list[Outgoing]:
        """Everything queued since the last call, in order."""
        taken = list(self._waiting)
        self._waiting.clear()
        return taken
