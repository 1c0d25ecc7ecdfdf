"""What the tests of the portal's pages share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from service.bench.browser import Browser, chromium
from service.ground.http import PAGE

NEEDS = [
    pytest.mark.skipif(not chromium(), reason="needs Chromium"),
    pytest.mark.skipif(not (PAGE / "index.html").is_file(), reason="needs the built page"),
]
TOKEN = "a-token-of-enough-letters"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """One Chromium for all tests of a file."""
    one = Browser(tmp_path_factory.mktemp("chromium"))
    yield one
    one.close()
