"""Hostile connections to the portal: nothing stops it, or the datalink next to it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import resource
import socket
import subprocess
import sys
import threading
import urllib.request
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from loopback import free_port, until
from portal_client import ONE, TOKEN, Client, client, serving, store

from service.ground.portal import Portal, PortalConfig
from service.stream.session import SessionConfig, open_session
from service.workers import Workers

if TYPE_CHECKING:
    pass

__all__ = ["client", "store"]  # the fixtures


def address_of(client: Client) -> tuple[str, int]:
    host, _, port = client.base.removeprefix("http://").rpartition(":")
    return host, int(port)


@pytest.mark.slow
def test_1100_half_open_requests_stop_neither_portal_nor_datalink(tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 3000:
        pytest.skip("this test needs 3000 descriptors")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 3000), hard))
    link, page = free_port(socket.SOCK_STREAM), free_port(socket.SOCK_STREAM)
    command = f"ground --listen tcp/127.0.0.1:{link} --store {tmp_path} --portal 127.0.0.1:{page}"
    process = subprocess.Popen(
        [sys.executable, "-m", "service.cli", *command.split()],
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (1024, 1024)),
    )
    held: list[socket.socket] = []
    try:
        assert process.stderr is not None
        next(line for line in process.stderr if line.startswith("portal: "))
        threading.Thread(target=process.stderr.read, daemon=True).start()
        for _ in range(1100):
            with contextlib.suppress(OSError):
                one = socket.create_connection(("127.0.0.1", page), timeout=5)
                held.append(one)
                one.sendall(b"GET /api/scans HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Half: ")
        assert len(held) > 1000
        with urllib.request.urlopen(f"http://127.0.0.1:{page}/api/scans", timeout=20) as answer:
            assert json.load(answer) == []
        assert len(os.listdir(f"/proc/{process.pid}/fd")) < 700
        with open_session(
            SessionConfig(mode="client", connect=(f"tcp/127.0.0.1:{link}",))
        ) as drone:
            assert until(lambda: list(drone.info.routers_zid()))
    finally:
        for one in held:
            one.close()
        process.terminate()
        process.communicate(timeout=60)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def answer_to(client: Client, head: str, body: bytes = b"") -> bytes:
    """All that the portal answers until it closes the connection."""
    with socket.create_connection(address_of(client), timeout=30) as one:
        text = f"{head}\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {TOKEN}\r\n"
        with contextlib.suppress(OSError):
            one.sendall(text.encode() + b"Transfer-Encoding: chunked\r\n\r\n" + body)
        out = b""
        with contextlib.suppress(ConnectionResetError):
            while block := one.recv(65536):
                out += block
        return out


def test_a_body_is_bounded_by_what_is_read(client: Client) -> None:
    """Chunks have no length in the header; 128 kB of them are refused, whatever comes behind."""
    chunk = b"2000\r\n" + b" " * 8192 + b"\r\n"
    answer = answer_to(client, f"PATCH {ONE} HTTP/1.1", chunk * 16)
    assert answer.startswith(b"HTTP/1.1 413 ")
    body = json.dumps({"title": "in chunks"}).encode()
    good = f"{len(body):x}\r\n".encode() + body + b"\r\n0\r\n\r\n"
    assert b"200 OK" in answer_to(client, f"PATCH {ONE} HTTP/1.1\r\nConnection: close", good)
    assert client.ask(ONE)[1]["title"] == "in chunks"


def test_a_body_that_does_not_come_is_given_up(store: Path) -> None:
    with serving(store, body_s=0.2) as client:
        answer = answer_to(client, f"PATCH {ONE} HTTP/1.1", b"2\r\n{}\r\n")
    assert answer.startswith(b"HTTP/1.1 408 ")


def test_a_reader_that_stops_reading_is_dropped(
    store: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, "service.ground.guard")
    with open(store / "drone-1/test-1/cloud.ply", "wb") as file:
        file.truncate(200_000_000)
    with serving(store, stall_s=0.2) as client:
        received = 0
        with socket.create_connection(address_of(client)) as one:
            head = f"GET {ONE}/files/cloud.ply HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
            one.sendall(head.encode())
            until(lambda: "has stopped reading" in caplog.text)
            with contextlib.suppress(ConnectionResetError):
                while block := one.recv(1 << 20):
                    received += len(block)
        assert 0 < received < 200_000_000
        assert client.ask("/api/scans")[0] == 200


def test_views_without_a_token_do_not_lock_the_operator_out(client: Client) -> None:
    from websockets.exceptions import ConnectionClosed, InvalidStatus
    from websockets.sync.client import connect as open_socket

    url = client.base.replace("http", "ws") + ONE + "/live"
    with contextlib.ExitStack() as stack:
        opened = 0
        for _ in range(16):
            with contextlib.suppress(ConnectionClosed, InvalidStatus):
                stack.enter_context(open_socket(url)).recv(timeout=20)
                opened += 1
        assert opened == 8
        bearer = {"Authorization": f"Bearer {TOKEN}"}
        one = stack.enter_context(open_socket(url, additional_headers=bearer))
        assert one.recv(timeout=20)


def test_a_portal_that_fails_starts_again_at_its_address(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import uvicorn

    serve, failed = uvicorn.Server.serve, threading.Event()

    async def decode() -> None:
        async with portal.state.decoding:
            await asyncio.sleep(0)

    async def fails_once(server: uvicorn.Server, sockets: Any = None) -> None:
        await asyncio.gather(*(decode() for _ in range(5)))  # some wait
        if failed.is_set():
            await serve(server, sockets)
        failed.set()
        sockets[0].close()
        raise ZeroDivisionError

    monkeypatch.setattr(uvicorn.Server, "serve", fails_once)
    workers = Workers(pause_s=0.0)
    portal = Portal(PortalConfig(store, port=0, token=TOKEN), workers=workers)
    portal.start()
    try:
        client = Client(portal)
        assert failed.wait(20)

        def answers() -> bool:
            with contextlib.suppress(OSError):
                return bool(client.ask("/api/scans")[0] == 200)
            return False

        until(answers)
        assert [(w["name"], w["restarts"]) for w in workers.report()] == [("portal", 1)]
    finally:
        portal.close()


def test_half_open_tls_handshakes_leave_the_portal_answering(store: Path, tmp_path: Path) -> None:
    """A handshake that never comes counts as a connection; the cookie is for TLS only."""
    import http.client
    import ssl

    certificate, key = certificate_for(tmp_path)
    config = PortalConfig(store, port=0, token=TOKEN, tls=(certificate, key))
    portal = Portal(config)
    portal.start()
    held = []
    try:
        port = int(portal.url.rsplit(":", 1)[1].split("/")[0])
        before = len(os.listdir("/proc/self/fd"))
        for _ in range(200):
            held.append(socket.create_connection(("127.0.0.1", port), timeout=5))
        context = ssl.create_default_context(cafile=str(certificate))
        connection = http.client.HTTPSConnection("localhost", port, timeout=20, context=context)
        connection.request("GET", f"/?token={TOKEN}")
        answer = connection.getresponse()
        assert answer.status == 303 and "Secure" in (answer.getheader("set-cookie") or "")
        until(lambda: len(os.listdir("/proc/self/fd")) - before - len(held) < 50)
    finally:
        for one in held:
            one.close()
        portal.close()


def certificate_for(folder: Path) -> tuple[Path, Path]:
    """A certificate and key for localhost that signed itself."""
    pytest.importorskip("cryptography")
    from datetime import datetime, timedelta, timezone

    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "localhost")])
    now = datetime.now(timezone.utc)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - timedelta(hours=1))
        .not_valid_after(now + timedelta(hours=1))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), False)
        .sign(key, hashes.SHA256())
    )
    kind = serialization.Encoding.PEM
    (folder / "portal.crt").write_bytes(made.public_bytes(kind))
    (folder / "portal.key").write_bytes(
        key.private_bytes(kind, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    return folder / "portal.crt", folder / "portal.key"
