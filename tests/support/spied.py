"""A function that goes on as it is while its calls are counted."""

from __future__ import annotations

from typing import Any
from unittest.mock import Mock

import pytest


def spied(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str) -> Mock:
    """Knows each call of ``owner.name`` until the test ends; what is called does its work."""
    spy = Mock(wraps=getattr(owner, name))
    monkeypatch.setattr(owner, name, spy)
    return spy
