"""Every relative link in the documents leads to a file and, where it names one, to a heading."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
from paths import ROOT

LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
HEADING = re.compile(r"^#+ +(.+?) *$", re.MULTILINE)


def documents() -> list[Path]:
    """All Markdown files of the repository, without those that git ignores."""
    try:
        listed = subprocess.run(
            ["git", "ls-files", "-co", "--exclude-standard", "*.md"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        ).stdout.split("\n")
    except (OSError, subprocess.CalledProcessError):  # unpacked without git
        return sorted({*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")})
    return [ROOT / name for name in listed if name and (ROOT / name).is_file()]


def anchors(text: str) -> set[str]:
    """The anchors that GitHub gives the headings of a page."""
    found = set()
    for heading in HEADING.findall(FENCE.sub("", text)):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower()
        found.add(re.sub(r"[^\w\- ]", "", plain).replace(" ", "-"))
    return found


def broken_links(page: Path) -> list[str]:
    """Relative links of ``page`` without a file or heading."""
    text = page.read_text(encoding="utf-8")
    broken = []
    for link in LINK.findall(FENCE.sub("", text)):
        if re.match(r"[a-z]+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name) if name else page
        known = target.exists() and (
            not anchor
            or target.suffix != ".md"
            or anchor in anchors(target.read_text(encoding="utf-8"))
        )
        if not known:
            broken.append(link)
    return broken


@pytest.mark.parametrize("page", documents(), ids=lambda page: str(page.relative_to(ROOT)))
def test_relative_links_lead_somewhere(page: Path) -> None:
    assert broken_links(page) == []


def test_every_image_is_shown() -> None:
    shown = "".join(page.read_text(encoding="utf-8") for page in documents())
    images = [path.name for path in (ROOT / "docs" / "images").iterdir()]
    assert len(images) > 10
    assert [name for name in images if name not in shown] == []


def test_a_broken_link_is_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# Here I am\n[a](#here-i-am) [b](other.md) [c](#gone) [d](https://x.org)\n")
    assert broken_links(page) == ["other.md", "#gone"]
