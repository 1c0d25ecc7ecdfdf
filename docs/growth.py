"""Draw docs/images/growth.svg: what a scan costs as it grows.

    python docs/growth.py

The figures are those of the newest ``make bench ARGS="growth --keep docs/reports/runs"``.
"""

from __future__ import annotations

import math
import re
from xml.sax.saxutils import escape

from concepts import BLUE, GRAY, GREEN, IMAGES, INK, RED, image_of
from report import amount, newest

WIDTH, HEIGHT, LEFT, TOP = 370, 190, 60, 44
"""Of a panel, and where its axes begin."""
COLOURS = (BLUE, GREEN, RED)
PANELS = {
    "ms a keyframe (processor time)": {
        "flight": "processor time a keyframe, tracking included",
        "files": "processor time of the files a keyframe",
    },
    "memory, MiB": {"in flight": "memory in flight", "after the files": "memory after the files"},
    "files, KiB a keyframe": {"all": "files a keyframe"},
}
Curve = list[tuple[float, float]]


def curves() -> dict[str, Curve]:
    """Each figure's name to its (keyframes, value), shortest flight first."""
    out: dict[str, Curve] = {}
    for result in newest("growth", "")["results"]:
        count = re.match(r"(\d+) keyframes", result["note"])
        if result["name"] == "growth" and count:
            name = result["what"].partition(": ")[2]
            out.setdefault(name, []).append((float(count[1]), result["value"]))
    return {name: sorted(curve) for name, curve in out.items()}


def panel(title: str, lines: dict[str, Curve], x0: float) -> list[str]:
    """One diagram: keyframes to the right by powers of ten, values upwards from zero."""
    top = 1.15 * max(value for curve in lines.values() for _, value in curve)
    first = min(curve[0][0] for curve in lines.values())
    last = max(curve[-1][0] for curve in lines.values())

    def at(keyframes: float, value: float) -> tuple[float, float]:
        right = math.log(keyframes / first) / math.log(last / first)
        return x0 + LEFT + right * (WIDTH - LEFT - 60), TOP + HEIGHT * (1.0 - value / top)

    x, bottom = at(first, 0.0)
    parts = [
        f'<text x="{x0 + 10:.0f}" y="24" font-weight="bold">{escape(title)}</text>',
        f'<path d="M{x:.0f} {TOP}V{bottom:.0f}H{at(last, 0.0)[0]:.0f}" fill="none" '
        f'stroke="{GRAY}"/>',
    ]
    for keyframes, _ in next(iter(lines.values())):
        parts.append(
            f'<text x="{at(keyframes, 0.0)[0]:.0f}" y="{bottom + 18:.0f}" text-anchor="middle" '
            f'fill="{INK}">{keyframes:,.0f}</text>'
        )
    for k, ((name, curve), colour) in enumerate(zip(lines.items(), COLOURS, strict=False)):
        places = [at(*point) for point in curve]
        way = " ".join(f"{px:.0f},{py:.0f}" for px, py in places)
        parts.append(f'<polyline points="{way}" fill="none" stroke="{colour}" stroke-width="2"/>')
        label_px = 18 if k else -8  # the second curve is the lower one
        for (px, py), (_, value) in zip(places, curve, strict=True):
            parts.append(
                f'<circle cx="{px:.0f}" cy="{py:.0f}" r="3" fill="{colour}"/><text '
                f'x="{px:.0f}" y="{py + label_px:.0f}" text-anchor="middle" font-size="11" '
                f'fill="{colour}">{amount(value, "")}</text>'
            )
        px, py = places[-1]
        parts.append(f'<text x="{px + 8:.0f}" y="{py + 4:.0f}" fill="{colour}">{name}</text>')
    return parts


def diagram(figures: dict[str, Curve]) -> str:
    """All panels side by side."""
    parts = [
        part
        for k, (title, names) in enumerate(PANELS.items())
        for part in panel(title, {name: figures[of] for name, of in names.items()}, k * WIDTH)
    ]
    words = f'<text x="10" y="{TOP + HEIGHT + 42}" fill="{GRAY}">keyframes of a flight</text>'
    return image_of(WIDTH * len(PANELS), TOP + HEIGHT + 56, [*parts, words])


if __name__ == "__main__":
    (IMAGES / "growth.svg").write_text(diagram(curves()), encoding="utf-8")
