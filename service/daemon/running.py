"""What a service that runs on this machine says of itself."""

from __future__ import annotations

import http.client
import json
from contextlib import closing
from typing import Any

WAIT_S = 1.0
LARGEST_BYTES = 1 << 20


def running_service(address: str) -> dict[str, Any] | None:
    """The ``/status`` at ``address`` (HOST:PORT); None when no skyrelief answers there."""
    host, _, port = address.rpartition(":")
    try:
        with closing(http.client.HTTPConnection(host.strip("[]"), int(port), WAIT_S)) as page:
            page.request("GET", "/status")
            status = json.loads(page.getresponse().read(LARGEST_BYTES))
    except (OSError, ValueError, http.client.HTTPException):
        return None
    is_ours = isinstance(status, dict) and str(status.get("software", "")).startswith("skyrelief")
    return status if is_ours else None
