"""The documents' pages and the commands in their code blocks."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

from paths import ROOT

PAGES = sorted(
    page
    for page in (
        *ROOT.glob("*.md"),
        *(ROOT / "docs").rglob("*.md"),
        *(ROOT / "demo").rglob("*.md"),
    )
)
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"(?:^ {4,}\S.*\n)+", re.MULTILINE)


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def blocks(page: Path) -> Iterator[str]:
    """Shell code blocks: continuation lines joined, brackets around options removed."""
    text = text_of(page)
    found = [body for kind, body in FENCE.findall(text) if kind in ("", "sh", "bash", "console")]
    found += INDENTED.findall(FENCE.sub("", text))
    for body in found:
        optional = re.sub(r"\[(--[^\]]*)\]", r"\1", body)
        yield re.sub(r"\\\n\s*", " ", optional)


def complete(page: Path) -> Iterator[list[str]]:
    """Words after ``skyrelief`` of each command in the page's code blocks."""
    for line in lines(page):
        if "skyrelief " in line:
            yield from _skyrelief(words_of(line))


def lines(page: Path) -> Iterator[str]:
    """Lines of the page's shell blocks that are not empty."""
    for block in blocks(page):
        yield from (line.strip() for line in block.splitlines() if line.strip())


def words_of(line: str) -> list[str]:
    """The line split as a shell does, without its comment."""
    lexer = shlex.shlex(line, posix=True, punctuation_chars=";|&")
    lexer.whitespace_split = True
    return list(lexer)


def _skyrelief(words: list[str]) -> Iterator[list[str]]:
    while words:
        end = next((k for k, word in enumerate(words) if set(word) <= set(";|&")), len(words))
        command, words = words[:end], words[end + 1 :]
        if command[:1] == ["sudo"]:
            command = command[3:] if command[1:2] == ["-u"] else command[1:]
        if command and Path(command[0]).name == "skyrelief":
            yield command[1:]
