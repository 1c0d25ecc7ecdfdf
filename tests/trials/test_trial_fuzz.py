"""Hostile bytes: every decoder by Hypothesis, and by atheris where it is installed; and HTTP."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from paths import ROOT
from trial_decoders import DECODERS, seeds
from trial_rig import WHOLE, Row

from service.config import load_config
from service.daemon.health import HealthServer
from service.daemon.runtime import Daemon

pytestmark = [pytest.mark.trial, pytest.mark.timeout(3600 if WHOLE else 280)]

EXAMPLES = int(os.environ.get("SKYRELIEF_FUZZ_EXAMPLES", "20000" if WHOLE else "60"))
ATHERIS_S = int(os.environ.get("SKYRELIEF_FUZZ_S", "60" if WHOLE else "0"))


def mutated(seed: bytes) -> st.SearchStrategy[bytes]:
    """``seed`` with some bytes changed, cut or grown: what noise makes of a real message."""

    def change(edits: list[tuple[int, int]], keep: int, tail: bytes) -> bytes:
        data = bytearray(seed)
        for place, value in edits:
            if data:
                data[place % len(data)] = value
        return bytes(data[: keep % (len(data) + 1)] if keep else data) + tail

    edit = st.tuples(st.integers(0, 1 << 20), st.integers(0, 255))
    return st.builds(
        change, st.lists(edit, max_size=8), st.integers(0, 1 << 20), st.binary(max_size=16)
    )


@pytest.mark.parametrize("name", sorted(DECODERS))
def test_any_bytes_are_borne(name: str, record: Row, tmp_path: Path) -> None:
    decode: Callable[[bytes], object] = DECODERS[name](tmp_path)

    @settings(
        max_examples=EXAMPLES,
        database=None,
        derandomize=not WHOLE,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.one_of(st.binary(max_size=300), *[mutated(s) for s in seeds(name)]))
    def borne(data: bytes) -> None:
        decode(data)

    borne()
    record(f"fuzz: {name} (Hypothesis)", EXAMPLES, "no exception that is not foreseen", "-")


ATHERIS = """
import atheris, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
compiled = ["plane_coders"]  # numba reads their bytecode
kernels = [f"service.stream.{name}" for name in compiled]
with atheris.instrument_imports(include=["service", "mavlink"], exclude=kernels):
    from trial_decoders import DECODERS
decode = DECODERS[sys.argv[1]](Path(sys.argv[3]))
corpus, seconds = sys.argv[4], sys.argv[5]
options = [sys.argv[0], corpus, f"-max_total_time={seconds}", "-max_len=2000", "-verbosity=0"]
atheris.Setup(options, lambda data: decode(data) and None)
atheris.Fuzz()
"""


@pytest.mark.skipif(not ATHERIS_S, reason="only in the whole trials")
@pytest.mark.parametrize("name", sorted(DECODERS))
def test_atheris_finds_nothing(name: str, record: Row, tmp_path: Path) -> None:
    if importlib.util.find_spec("atheris") is None:
        pytest.skip("atheris is not installed (extra 'trials')")
    corpus = tmp_path / "corpus"
    corpus.mkdir()
    for i, seed in enumerate(seeds(name)):
        (corpus / str(i)).write_bytes(seed)
    here = str(ROOT / "tests" / "support")
    done = subprocess.run(
        [sys.executable, "-c", ATHERIS, name, here, str(tmp_path), str(corpus), str(ATHERIS_S)],
        capture_output=True,
        text=True,
        errors="replace",
        timeout=10 * ATHERIS_S + 120,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    record(f"fuzz: {name} (atheris)", ATHERIS_S, "nothing found in so many seconds", "-")


PATHS = st.text(st.characters(min_codepoint=33, max_codepoint=126), max_size=60)


def test_health_page_answers_any_request(record: Row) -> None:
    snapshot: dict[str, Any] = {"ok": True, "state": "idle", "fault": ""}
    server = HealthServer("127.0.0.1:0", lambda: snapshot)
    examples = 2000 if WHOLE else 50

    @settings(max_examples=examples, database=None, derandomize=not WHOLE)
    @given(PATHS, st.sampled_from(["GET", "POST", "PUT", "DELETE", "HEAD", "OPTIONS"]))
    def answered(path: str, method: str) -> None:
        request = urllib.request.Request(
            f"http://127.0.0.1:{server.port}/{path.lstrip('/')}", method=method
        )
        try:
            with urllib.request.urlopen(request, timeout=10) as answer:
                assert answer.status == 200
        except urllib.error.HTTPError as error:
            with error:
                assert error.code in (400, 404, 405, 414)
        except ValueError:
            pass  # no URL

    try:
        answered()
    finally:
        server.close()
    record("fuzz: health page over HTTP", examples, "answered each time", "-")


QUERIES = st.dictionaries(st.text(max_size=20), st.text(max_size=200), max_size=5)


@pytest.mark.skipif(not WHOLE, reason="only in the whole trials")
def test_health_page_answers_as_described(tmp_path: Path, record: Row) -> None:
    """Answers of a real daemon hold what its served description says: codes, types, fields."""
    schemathesis = pytest.importorskip("schemathesis")
    daemon, tried = Daemon(load_config(None, [f"scan.folder={tmp_path}", "health.http="])), 0
    server = HealthServer("127.0.0.1:0", daemon.snapshot)
    schema = schemathesis.openapi.from_url(f"http://127.0.0.1:{server.port}/openapi.json")
    try:
        for operation in schema.get_all_operations():

            @settings(
                max_examples=100,
                database=None,
                suppress_health_check=list(HealthCheck),
            )
            @given(operation.ok().as_strategy(), QUERIES, QUERIES)
            def answered(case: Any, query: dict[str, str], headers: dict[str, str]) -> None:
                nonlocal tried
                tried += 1
                named = {f"X-{k.encode().hex()}": v.encode().hex() for k, v in headers.items()}
                case.call_and_validate(params=query, headers=named)

            answered()
    finally:
        server.close()
    assert tried >= 300
    record("fuzz: health page over HTTP (schemathesis)", tried, "as its description says", "-")


@pytest.mark.skipif(not WHOLE, reason="only in the whole trials")
def test_portal_answers_as_described(tmp_path: Path, record: Row) -> None:
    """Requests made from the served description, right and wrong: never a fault of ours."""
    schemathesis = pytest.importorskip("schemathesis")
    from service.ground.portal import Portal, PortalConfig

    token, tried = "a-token-of-the-trials", 0
    headers = {"Authorization": f"Bearer {token}", "Host": "127.0.0.1"}
    app = Portal(PortalConfig(tmp_path, port=0, token=f"trial {token}")).app
    schema = schemathesis.openapi.from_asgi("/api/openapi.json", app, headers=headers)
    for operation in schema.get_all_operations():

        @settings(
            max_examples=100,
            database=None,
            suppress_health_check=list(HealthCheck),
        )
        @given(operation.ok().as_strategy())
        def answered(case: Any) -> None:
            nonlocal tried
            tried += 1
            answer = case.call(headers=headers)
            assert answer.status_code < 500 or answer.status_code == 503, answer.text

        answered()
    assert tried > 100
    record("fuzz: portal over HTTP (schemathesis)", tried, "never a fault of ours", "-")
