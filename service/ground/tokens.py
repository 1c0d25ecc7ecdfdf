"""The portal's tokens: who holds them, where they are kept, and a browser's session."""

from __future__ import annotations

import hashlib
import hmac
import logging
import os
import re
import secrets
import stat
from collections.abc import Mapping
from pathlib import Path

from service.errors import InputError, OutsideError

log = logging.getLogger(__name__)

KEPT = "portal-token"
"""Name of the file in the store that holds the token that was made there."""

DEFAULT_NAME = "operator"
LARGEST_FILE_BYTES = 65_536
LINE = re.compile(r"(?:([A-Za-z0-9][A-Za-z0-9_-]{0,39})[ \t]+)?([!-~]{1,200})")


class Tokens:
    """Tokens by the name of who holds them. A browser's session is signed with its token."""

    def __init__(self, by_name: Mapping[str, str]) -> None:
        self._by_name = {name: token.encode() for name, token in by_name.items()}

    def name_of(self, token: str) -> str | None:
        """Who holds ``token``; None for a wrong one."""
        given = token.encode(errors="replace")
        found = [n for n, known in self._by_name.items() if hmac.compare_digest(given, known)]
        return found[0] if found else None

    def new_session(self, name: str) -> str:
        """A cookie's value for a new browser of ``name``; it does not hold the token."""
        session = f"{name}.{secrets.token_hex(4)}"
        return f"{session}.{self._signature(name, session)}"

    def holder_of(self, session: str) -> str | None:
        """NAME.BROWSER of a cookie's value; None when we did not make it."""
        body, _, signature = session.rpartition(".")
        name = body.partition(".")[0]
        if name not in self._by_name:
            return None
        expected = self._signature(name, body).encode()
        return body if hmac.compare_digest(signature.encode(errors="replace"), expected) else None

    def _signature(self, name: str, session: str) -> str:
        return hmac.new(self._by_name[name], session.encode(), hashlib.sha256).hexdigest()


def parse_tokens(text: str) -> dict[str, str]:
    """Name to token of a token file: one ``TOKEN`` or ``NAME TOKEN`` per line.

    Raises InputError for anything else and for a file without a token.
    """
    out: dict[str, str] = {}
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        found = LINE.fullmatch(line.strip())
        name = (found and found[1]) or DEFAULT_NAME
        if found is None or name in out:
            raise InputError(f"line {number} is not TOKEN or NAME TOKEN with a new name")
        out[name] = found[2]
    if not out:
        raise InputError("it holds no token")
    return out


def read_tokens(path: Path) -> str:
    """The text of a token file. Raises InputError, in one line, when it cannot be used."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        with open(handle, encoding="utf-8") as file:
            mode = os.fstat(handle).st_mode
            if not stat.S_ISREG(mode):
                raise InputError(f"portal token {path} is no regular file")
            text = file.read(LARGEST_FILE_BYTES)
    except (OSError, ValueError) as error:
        raise InputError(f"portal token {path} cannot be read ({error})") from error
    try:
        parse_tokens(text)
    except InputError as error:
        raise InputError(f"portal token {path}: {error}") from error
    if mode & 0o077:
        log.warning("portal token %s can be read by others; chmod 600 %s", path, path)
    return text


def kept_token(store: Path) -> str:
    """The token kept in ``store`` (mode 600), made on the first call.

    Raises OutsideError when it cannot be written there, InputError when it cannot be read.
    """
    path = store / KEPT
    if not path.exists():
        part = store / f".{KEPT}-{secrets.token_hex(4)}"
        try:
            store.mkdir(parents=True, exist_ok=True)
            handle = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
            with open(handle, "w", encoding="ascii") as file:
                file.write(secrets.token_urlsafe(24) + "\n")
                file.flush()
                os.fsync(handle)
            os.replace(part, path)
        except OSError as error:
            raise OutsideError(f"portal token {path} cannot be written ({error})") from error
    return read_tokens(path)
