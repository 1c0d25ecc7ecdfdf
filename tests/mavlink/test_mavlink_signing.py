"""Signed packets, against pymavlink's own signatures."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from autopilot import beat, packed
from file_modes import bound_by_modes
from loopback import until
from rehearsal import RehearsalControl

from mavlink.component.memory import Memory
from mavlink.component.vehicle import VehicleConfig, VehicleLink
from mavlink.wire.dialect import dialect
from mavlink.wire.framing import Framer
from mavlink.wire.messages import OutgoingMessage, Packer
from mavlink.wire.signing import UNIT_PER_S, Signing, fingerprint, read_key, timestamp_of

S = 1_000_000_000
KEY = bytes(range(32))
NOW = timestamp_of(1_760_000_000 * S)


def signed(message: Any, timestamp: int, key: bytes = KEY, link: int = 3) -> bytes:
    mouth = dialect.MAVLink(None, 255, 190)
    mouth.signing.secret_key = key
    mouth.signing.link_id = link
    mouth.signing.timestamp = timestamp
    mouth.signing.sign_outgoing = True
    return bytes(message.pack(mouth))


def accepts(signing: Signing, data: bytes) -> bool:
    (packet,) = Framer().feed(data)
    return signing.accepts(packet)


def test_signatures_of_pymavlink_are_verified_and_replays_refused() -> None:
    signing = Signing(KEY, NOW)
    first = signed(beat(), NOW + 10)
    assert accepts(signing, first)
    assert not accepts(signing, first)  # replayed
    assert not accepts(signing, signed(beat(), NOW + 5))  # older
    assert accepts(signing, signed(beat(), NOW + 11))
    assert not accepts(signing, signed(beat(), NOW + 20, bytes(32)))  # another key
    assert accepts(signing, signed(beat(), NOW + 12))  # the forgery moved nothing
    assert not accepts(signing, signed(beat(), NOW - 61 * 100_000, link=4))  # a stale stream
    assert not accepts(signing, packed(beat()))  # unsigned
    radio = dialect.MAVLink_radio_status_message(1, 1, 90, 1, 1, 0, 0)
    assert accepts(signing, packed(radio, (51, 68)))  # radios cannot sign
    assert signing.refused == 5


def test_a_flipped_bit_breaks_the_signature() -> None:
    data = signed(beat(), NOW + 10)
    for i in range(len(data) - 13, len(data)):
        signing = Signing(KEY, NOW)
        damaged = bytearray(data)
        damaged[i] ^= 1
        assert not accepts(signing, bytes(damaged))


def test_our_signatures_satisfy_pymavlink_and_times_only_grow() -> None:
    signing = Signing(KEY)
    packer = Packer(2, signing)
    ear = dialect.MAVLink(None)
    ear.signing.secret_key = KEY
    stamps = []
    for unix_ns in (1_760_000_000 * S, 1_760_000_000 * S, 1_500_000_000 * S):  # steps back
        data = packer.pack(1, OutgoingMessage(191, beat()), unix_ns)
        assert data is not None
        (message,) = ear.parse_buffer(data)
        assert message.get_signed() and message.get_srcComponent() == 191
        stamps.append(signing.timestamp)
    assert stamps == sorted(set(stamps))


def link_with(key: bytes, folder: Path) -> tuple[VehicleLink, Signing]:
    path = folder / "key"
    path.write_bytes(key)
    path.chmod(0o600)
    config = VehicleConfig(signing_key=path, state_dir=folder / "state")
    link = VehicleLink(config, RehearsalControl())
    assert link.signing is not None
    return link, link.signing


def test_a_packet_of_the_run_before_is_refused(tmp_path: Path) -> None:
    link, signing = link_with(KEY, tmp_path)
    order = signed(beat(), NOW + 10)
    assert accepts(signing, order)
    link.save()
    sent = signing.timestamp
    _, again = link_with(KEY, tmp_path)
    assert not accepts(again, order) and not accepts(again, signed(beat(), NOW + 5))
    assert accepts(again, signed(beat(), NOW + 11))
    assert accepts(again, signed(beat(), NOW + 5, link=4))  # another stream
    assert again.timestamp >= sent + UNIT_PER_S  # ours grow, whatever a crash has forgotten
    _, other = link_with(bytes(32), tmp_path)  # times of another key bind nobody
    assert accepts(other, signed(beat(), NOW + 5, bytes(32)))


@pytest.mark.parametrize("streams", ["[[1]]", "7", '[["a", 1, 1, 1]]', "[[1, 1, 1, 1e999]]"])
def test_broken_times_are_not_used(streams: str, tmp_path: Path) -> None:
    (tmp_path / "mavlink.json").write_text(
        f'{{"parameters": {{}}, "signing_timestamp": 1, "signing_key": "k", '
        f'"signing_streams": {streams}, "system": null}}'
    )
    assert Memory(tmp_path, "k").signing_streams == {}


def test_times_are_saved_within_a_second_of_a_crash(tmp_path: Path) -> None:
    link, signing = link_with(KEY, tmp_path)
    assert accepts(signing, signed(beat(), NOW + 10))
    link.start()
    kept = tmp_path / "state" / "mavlink.json"
    until(lambda: kept.is_file() and str(NOW + 10) in kept.read_text())
    assert Memory(kept.parent, fingerprint(KEY)).signing_streams == {(3, 255, 190): NOW + 10}
    link.stop()


def test_a_key_of_another_user_is_named(tmp_path: Path) -> None:
    path = tmp_path / "key"
    path.touch(0)
    with pytest.raises(ValueError, match=r"key: the signing key cannot be read.*chown"):
        bound_by_modes(lambda: read_key(path))


def test_keys_must_be_private_and_whole(tmp_path: Path) -> None:
    path = tmp_path / "key"
    with pytest.raises(ValueError, match="no such"):
        read_key(path)
    path.write_bytes(KEY)
    os.chmod(path, 0o644)
    with pytest.raises(ValueError, match="chmod 600"):
        read_key(path)
    os.chmod(path, 0o600)
    assert read_key(path) == KEY
    path.write_text(KEY.hex() + "\n")
    assert read_key(path) == KEY
    path.write_bytes(b"short")
    with pytest.raises(ValueError, match="32 bytes"):
        read_key(path)
    with pytest.raises(ValueError, match="32 bytes"):
        Signing(b"short")
