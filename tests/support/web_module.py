"""A module of the portal's page, run by node without a browser."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from service.ground.http import PAGE

WEB = PAGE.parent
ROLLDOWN = WEB / "node_modules/.bin/rolldown"

NEEDS_NODE = [
    pytest.mark.skipif(not ROLLDOWN.is_file(), reason="needs npm ci in service/ground/web"),
    pytest.mark.skipif(shutil.which("node") is None, reason="needs node"),
]


def web_module(folder: Path, name: str, result: str) -> Callable[[Any], Any]:
    """A function that runs ``result``, an expression, with its argument as ``given`` and the
    exports of ``src/NAME.ts``, and those of three.js, as ``page`` and ``three``."""
    (folder / "entry.ts").write_text(
        f'export * as page from "{WEB}/src/{name}.ts";'
        f' export * as three from "{WEB}/node_modules/three";'
    )
    bundle = [str(ROLLDOWN), str(folder / "entry.ts"), "-o", str(folder / "page.mjs")]
    subprocess.run(bundle, cwd=WEB, check=True, capture_output=True)
    script = folder / "run.mjs"
    script.write_text(
        'import { readFileSync } from "fs";\n'
        'import { page, three } from "./page.mjs";\n'
        "const given = JSON.parse(readFileSync(0));\n"
        f"console.log(JSON.stringify({result}));\n"
    )

    def run(given: Any) -> Any:
        done = subprocess.run(
            ["node", str(script)],
            input=json.dumps(given), text=True, check=True, capture_output=True,
        )  # fmt: skip
        return json.loads(done.stdout)

    return run
