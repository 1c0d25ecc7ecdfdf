"""Write docs/reports/*.md from docs/reports/*.json and the results in docs/reports/runs.

    python docs/report.py

A report is a JSON object: ``title``, ``about`` (one sentence), ``commands``, ``conclusions`` (by
hand, at most ten lines) and ``tables``. A table has a ``title``, a ``note`` on its columns,
``date``, ``commit`` and ``machine``, and its content is one of

- ``columns`` and ``rows``,
- ``list``: lines,
- ``image``: a file of docs/images,
- ``bench``: names of benchmarks; the newest result of each that ``make bench`` kept
  on a machine with ``machine`` in its name, of the figures that the regular expression ``only``
  fits,
- ``trials``: a file of runs/ that ``make trials`` wrote.
"""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

REPORTS = Path(__file__).resolve().parent / "reports"
WIDTH, MAX_LINES = 120, 10
"""Characters of a line, and lines of conclusion."""

Json = dict[str, Any]


def pages() -> dict[str, str]:
    """Name of each page of docs/reports to its text."""
    reports = {
        path.stem: json.loads(path.read_text("utf-8")) for path in sorted(REPORTS.glob("*.json"))
    }
    texts = {f"{name}.md": page(name, report) for name, report in reports.items()}
    return {"README.md": index(reports)} | texts


def index(reports: dict[str, Json]) -> str:
    """The list of all reports."""
    rows = [
        wrapped(f"[{one['title']}]({name}.md): {one['about']}", "- ")
        for name, one in reports.items()
    ]
    text = (
        "`make pages` writes these pages from the JSON next to them and the results in `runs/`, "
        'which `make bench ARGS="NAME --keep docs/reports/runs"` and `make trials` write. A new '
        "figure replaces the old one."
    )
    return "\n".join(["# Reports", "", wrapped(text), "", *rows, ""])


def page(name: str, report: Json) -> str:
    """One report as Markdown."""
    tables = [with_origin(table) for table in report["tables"]]
    parts = [f"# {report['title']}", wrapped(report["about"])]
    parts += [commands_of(report)] if report.get("commands") else []
    parts += ["\n".join(conclusions(report))] if report.get("conclusions") else []
    parts += [part for table in tables for part in section(table)]
    machines = dict.fromkeys(table["machine"] for table in tables if "date" in table)
    parts += [wrapped(f"On {'; '.join(machines)}. [Commits]({name}.json).")] if machines else []
    return "\n\n".join(parts) + "\n"


def conclusions(report: Json) -> list[str]:
    """Lines of the conclusion, at most ``MAX_LINES``."""
    lines = [line for one in report["conclusions"] for line in wrapped(one, "- ").split("\n")]
    if len(lines) > MAX_LINES:
        raise ValueError(
            f"{report['title']}: {len(lines)} lines of conclusion, at most {MAX_LINES}"
        )
    return lines


def section(table: Json) -> Iterator[str]:
    """Heading, date with a note, commands and content of a table."""
    if table.get("title"):
        yield f"## {table['title']}"
    note = ": ".join(filter(None, (table.get("date", ""), table.get("note", ""))))
    if note:
        yield wrapped(note)
    if table.get("commands"):
        yield commands_of(table)
    if "image" in table:
        yield f"![{table['title']}](../images/{table['image']})"
    elif "list" in table:
        yield "\n".join(wrapped(line, "- ") for line in table["list"])
    else:
        yield grid(table["columns"], table["rows"])


def with_origin(table: Json, reports: Path = REPORTS) -> Json:
    """The table with the rows, date, commit and machine of the run that it names."""
    if "bench" in table:
        return bench(table)
    if "trials" in table:
        run = json.loads((reports / "runs" / table["trials"]).read_text("utf-8"))
        days = [line["when"][:10] for line in run["trials"]]
        return table | {
            "columns": ["fault", "outcome"],
            "rows": list(trials(run["trials"])),
            "machine": run["machine"],
            "date": max(days),
        }
    return table


def bench(table: Json) -> Json:
    """Results of the newest kept run of each benchmark."""
    rows: list[list[str]] = []
    origin: dict[str, Json] = {"date": {}, "commit": {}, "machine": {}}
    for name in table["bench"]:
        run = newest(name, table.get("machine", ""))
        origin["date"][run["date"][:10]] = None
        origin["commit"][run["commit"]] = origin["machine"][run["machine"]] = None
        for result in run["results"]:
            figure = f"{result['what']} {result['peer']}"
            if result["name"] == name and re.search(table.get("only", ""), figure):
                rows += [
                    [result["what"], amount(result["value"], result["unit"]), *against(result)]
                ]
    columns = ["figure", "ours", "peer in the same run", "ratio"]
    if not any(row[2] for row in rows):
        columns, rows = columns[:2], [row[:2] for row in rows]
    made = {key: "; ".join(values) for key, values in origin.items()}
    return table | made | {"columns": columns, "rows": rows}


def newest(name: str, machine: str) -> Json:
    """The newest kept run of a benchmark on such a machine."""
    runs = [json.loads(path.read_text("utf-8")) for path in (REPORTS / "runs").glob("*.json")]
    has = [run for run in runs if any(r["name"] == name for r in run.get("results", ()))]
    return max((run for run in has if machine in run["machine"]), key=lambda run: str(run["date"]))


def against(result: Json) -> tuple[str, str]:
    """The peer's figure and the ratio of both."""
    if result["peer_value"] is None:
        return "", ""
    return (
        f"{result['peer']}: {amount(result['peer_value'], result['unit'])}",
        f"{result['ratio']:.2f}",
    )


def amount(value: float | None, unit: str) -> str:
    """A figure to three digits, with its unit."""
    if value is None:
        return "not measured"
    digits = f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
    return f"{digits} {unit}".rstrip()


def trials(lines: list[Json]) -> Iterator[list[str]]:
    """A row for each fault with the first clause of its outcome; like ones share one."""
    groups: dict[tuple[str, ...], list[Json]] = {}
    for line in lines:
        kind, _, rest = line["fault"].partition(": ")
        is_lost = not re.match("-|nothing|0 of", line["lost"])
        outcome = line["outcome"].partition(";")[0] + (f"; lost {line['lost']}" if is_lost else "")
        one = (kind if rest else line["fault"], str(line["times"]), outcome)
        groups.setdefault(one, []).append(line)
    for (kind, times, outcome), members in groups.items():
        names = factored(line["fault"].partition(": ")[2] for line in members)
        back = [line["back_s"] for line in members if line["back_s"] is not None]
        fault = f"{kind}: {names}" if names else kind
        often = f"{times} x {fault}" if times != "1" else fault
        yield [often, outcome + (f" ({max(back):.1f} s)" if back else "")]


def factored(names: Iterable[str]) -> str:
    """Names in a line, or how many; what stands in brackets after all of them once."""
    parts = [(name.partition(" (")[0], name.partition(" (")[2]) for name in sorted(names)]
    ends = {end for _, end in parts}
    if len(ends) > 1:
        parts = [(f"{name} ({end}" if end else name, "") for name, end in parts]
    shown = ", ".join(name for name, _ in parts) if len(parts) <= 3 else f"{len(parts)} decoders"
    return shown + (f" ({ends.pop()}" if len(ends) == 1 and parts[0][1] else "")


def commands_of(holder: Json) -> str:
    """Its commands as a code block; a backslash continues a long one."""
    lines = [wrapped(command, "", "    ").replace("\n", " \\\n") for command in holder["commands"]]
    return "\n".join(["```", *lines, "```"])


def wrapped(text: str, start: str = "", indent: str | None = None) -> str:
    """The text after ``start`` in lines; more than one are indented."""
    fill = textwrap.TextWrapper(
        WIDTH,
        subsequent_indent=" " * len(start) if indent is None else indent,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return fill.fill(start + text)


def grid(columns: list[str], rows: list[list[str]]) -> str:
    """A table in Markdown."""
    if not rows:
        raise ValueError(f"no rows below {columns}")
    for row in rows:
        if len(row) != len(columns):
            raise ValueError(f"{len(row)} cells for {len(columns)} columns: {row}")
    cells = [columns, ["---"] * len(columns), *rows]
    return "\n".join("| " + " | ".join(row) + " |" for row in cells)


if __name__ == "__main__":
    for name, text in pages().items():
        (REPORTS / name).write_text(text, encoding="utf-8")
    for gone in {path.name for path in REPORTS.glob("*.md")} - set(pages()):
        (REPORTS / gone).unlink()
