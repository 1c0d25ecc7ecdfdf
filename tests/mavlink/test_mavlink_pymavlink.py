"""pymavlink's own connections and signatures as the peer."""

from __future__ import annotations

import json
import socket
import time
from pathlib import Path
from typing import Any

import pytest
from loopback import free_port, until
from rehearsal import RehearsalVehicle

from mavlink.wire.dialect import dialect
from mavlink.wire.framing import Framer
from mavlink.wire.signing import Signing


def test_pymavlink_over_tcp_and_the_link_comes_back() -> None:
    mavutil = pytest.importorskip("pymavlink.mavutil")
    port = free_port(socket.SOCK_STREAM)
    with RehearsalVehicle(f"tcpin:127.0.0.1:{port}") as daemon:
        for _ in range(2):  # a client that leaves and another one
            client = mavutil.mavlink_connection(
                f"tcp:127.0.0.1:{port}", dialect="ardupilotmega", source_system=255
            )
            assert client.wait_heartbeat(timeout=10) is not None
            client.mav.command_long_send(1, 100, 2500, 0, 0, 0, 0, 0, 0, 0, 0)
            ack = client.recv_match(type="COMMAND_ACK", blocking=True, timeout=10)
            assert ack is not None and ack.result == 0
            client.close()
        assert daemon.control.asked == ["start_scan"]
    # And the other way round: our client finds a server that comes late and goes away.
    late = free_port(socket.SOCK_STREAM)
    with RehearsalVehicle(f"tcp:127.0.0.1:{late}") as daemon:
        time.sleep(0.3)
        for _ in range(2):
            server = socket.create_server(("127.0.0.1", late))
            server.settimeout(15.0)
            peer, _ = server.accept()
            peer.settimeout(15.0)
            framer = Framer()
            assert until(lambda: framer.feed(peer.recv(4096)))  # noqa: B023
            peer.close()
            server.close()
        until(lambda: not daemon.link.report().links[0].is_up)
        assert daemon.link.report().links[0].opened == 2


def test_signed_links_obey_only_the_key(tmp_path: Path) -> None:
    key = bytes(range(32))
    path = tmp_path / "key"
    path.write_bytes(key)
    path.chmod(0o600)
    port = free_port()
    config = {"signing_key": path, "state_dir": tmp_path}
    with (
        RehearsalVehicle(f"udpin:127.0.0.1:{port}", **config) as daemon,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer,
    ):
        peer.connect(("127.0.0.1", port))
        start = dialect.MAVLink_command_long_message(1, 100, 2500, 0, 0, 0, 0, 0, 0, 0, 0)
        mouth = dialect.MAVLink(None, 255, 190)
        peer.send(bytes(start.pack(mouth)))
        until(lambda: daemon.link.report().unverified == 1)
        assert daemon.control.asked == []
        mouth.signing.secret_key, mouth.signing.sign_outgoing = key, True
        mouth.signing.timestamp = (time.time_ns() // 1000 - 1_420_070_400_000_000) // 10
        packet = bytes(start.pack(mouth))
        peer.send(packet)
        until(lambda: daemon.control.asked)
        peer.send(packet)  # replayed
        until(lambda: daemon.link.report().unverified == 2)
        peer.settimeout(10.0)
        (answer, *_) = Framer().feed(peer.recv(4096))
        assert answer.is_signed and Signing(key).accepts(answer)
    kept = json.loads((tmp_path / "mavlink.json").read_text())
    assert kept["signing_timestamp"] >= mouth.signing.timestamp - 1


def test_tunnels_and_the_radios_state_pass_through_the_same_link() -> None:
    port = free_port()
    with (
        RehearsalVehicle(f"udpin:127.0.0.1:{port}") as daemon,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer,
    ):
        free: list[int] = []
        daemon.link.listen("RADIO_STATUS", lambda message: free.append(message.txbuf))
        peer.connect(("127.0.0.1", port))
        peer.settimeout(10.0)
        radio = dialect.MAVLink_radio_status_message(1, 1, 87, 1, 1, 0, 0)
        peer.send(bytes(radio.pack(dialect.MAVLink(None, 51, 68))))
        until(lambda: free == [87])
        daemon.link.send_tunnel(40_000, b"tile")
        ear, framer = dialect.MAVLink(None), Framer()

        def tunnel() -> Any:
            found = [p for p in framer.feed(peer.recv(4096)) if p.message_id == 385]
            return ear.decode(bytearray(found[0].data)) if found else None

        message = until(tunnel)
        assert message.payload_type == 40_000
        assert bytes(message.payload[: message.payload_length]) == b"tile"
