"""Draw docs/images/architecture.svg: rooms of the code and the data between them.

    python docs/architecture.py

The rooms are those of the table in docs/design.md; a room without a box is an error.
"""

from __future__ import annotations

import re
from pathlib import Path
from xml.sax.saxutils import escape

HERE = Path(__file__).resolve().parent
SVG = HERE / "images" / "architecture.svg"
W, H, BOX_W, BOX_H = 980, 575, 150, 46

BOXES: dict[str, tuple[int, int, str]] = {
    "service/cameras": (30, 110, "images, lens, mount"),
    "mavlink/telemetry": (195, 110, "vehicle state, clocks"),
    "mavlink/wire": (195, 30, "MAVLink packets"),
    "mavlink/component": (360, 30, "commands, parameters"),
    "service/daemon": (360, 110, "when to scan"),
    "service/flight": (195, 210, "a scan: threads, store"),
    "service/stream": (450, 210, "scan.db, datalink"),
    "service/radio.py": (450, 290, "coarse map by radio"),
    "service/ground": (760, 210, "receiver, portal"),
    "service/scans": (760, 290, "files, on both ends"),
    "service/offline": (760, 110, "refine, exports"),
    "recon/tracking": (40, 410, "Harris, EPnP, odometry"),
    "recon/stereo": (205, 410, "BP, upsampling"),
    "recon/mapping": (370, 410, "ICP, voxel map"),
    "recon/posegraph": (535, 410, "smoother, loops"),
    "recon/surface": (700, 410, "rasters, meshes"),
    "recon/calibration": (40, 485, "camera model"),
    "recon/backends": (205, 485, "CPU, torch, ONNX"),
    "recon/types.py": (370, 485, "records, frames, lens"),
    "recon/pipeline": (535, 485, "mapper.py = Figure 1"),
    "recon/survey": (700, 485, "ground control, sites"),
    "service/sim": (760, 25, "sim, bench, commands"),
}
"""Room to the corner of its box and what it holds."""

FLOWS = [
    ("service/cameras", "service/flight", ""),
    ("mavlink/wire", "mavlink/telemetry", ""),
    ("mavlink/telemetry", "service/flight", ""),
    ("mavlink/wire", "mavlink/component", ""),
    ("mavlink/component", "service/daemon", ""),
    ("service/daemon", "service/flight", ""),
    ("service/flight", "service/stream", "keyframes"),
    ("service/stream", "service/radio.py", ""),
    ("service/stream", "service/ground", "Zenoh"),
    ("service/radio.py", "service/ground", "TUNNEL"),
    ("service/ground", "service/scans", ""),
    ("service/ground", "service/offline", ""),
]
"""From, to, and what travels."""

FRAMES = [(15, 10, 605, 360, "aircraft"), (735, 90, 200, 280, "ground")]
RECON = (15, 385, 920, 180, "recon: arrays in, arrays out; used by flight and offline")
FILL = {"service": "#dbeafe", "mavlink": "#fde68a", "recon": "#d1fae5"}


def rooms() -> list[str]:
    """First name of each row of the table of rooms."""
    text = (HERE / "design.md").read_text(encoding="utf-8")
    table = text[text.index("| room |") :].split("\n\n")[0]
    return re.findall(r"^\| `([\w./]+)`", table, re.MULTILINE)


def drawing() -> str:
    """The image as SVG text."""
    if missing := set(rooms()) ^ set(BOXES):
        raise SystemExit(f"table of rooms and boxes differ: {sorted(missing)}")
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {W} {H}" '
        'font-family="sans-serif" font-size="13">',
        '<defs><marker id="a" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="8" '
        'markerHeight="8" orient="auto"><path d="M0 0L8 4L0 8z" fill="#475569"/></marker></defs>',
        f'<rect width="{W}" height="{H}" fill="white"/>',
    ]
    for x, y, w, h, label in (*FRAMES, RECON):
        parts.append(
            f'<rect x="{x}" y="{y}" width="{w}" height="{h}" rx="8" fill="#f8fafc" '
            f'stroke="#cbd5e1"/><text x="{x + 10}" y="{y + h - 8}" fill="#64748b">'
            f"{escape(label)}</text>"
        )
    parts += [_arrow(*flow) for flow in FLOWS]
    parts += [_box(name, *box) for name, box in BOXES.items()]
    return "\n".join([*parts, "</svg>", ""])


def _box(name: str, x: int, y: int, holds: str) -> str:
    middle = x + BOX_W // 2
    return (
        f'<rect x="{x}" y="{y}" width="{BOX_W}" height="{BOX_H}" rx="5" stroke="#475569" '
        f'fill="{FILL[name.partition("/")[0]]}"/><text x="{middle}" y="{y + 20}" '
        f'text-anchor="middle" font-weight="bold">{escape(name)}</text><text x="{middle}" '
        f'y="{y + 37}" text-anchor="middle" font-size="11">{escape(holds)}</text>'
    )


def _arrow(start: str, end: str, label: str) -> str:
    (ax, ay, _), (bx, by, _) = BOXES[start], BOXES[end]
    down = abs(by - ay) >= abs(bx - ax) or (by > ay and abs(bx - ax) < 200)
    if down:
        step = 1 if by > ay else -1
        x1, y1 = ax + BOX_W // 2, ay + (BOX_H if step > 0 else 0)
        x2, y2 = bx + BOX_W // 2, by + (BOX_H if step < 0 else 0)
    else:
        x1, y1, x2, y2 = ax + BOX_W, ay + BOX_H // 2, bx, by + BOX_H // 2
    text = f'<text x="{(x1 + x2) // 2 - 30}" y="{(y1 + y2) // 2 - 8}">{label}</text>'
    return (
        f'<line x1="{x1}" y1="{y1}" x2="{x2}" y2="{y2}" stroke="#475569" stroke-width="1.5" '
        f'marker-end="url(#a)"/>{text if label else ""}'
    )


if __name__ == "__main__":
    SVG.write_text(drawing(), encoding="utf-8")
