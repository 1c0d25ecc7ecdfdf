"""The camera definition, the files that serve it, and its parameters."""

from __future__ import annotations

import json
import lzma
import random
import re
import struct
import xml.etree.ElementTree as ET
from dataclasses import replace
from typing import Any

import pytest
from held import held_bytes
from rehearsal import RehearsalControl

from mavlink.component.companion import Companion, CompanionConfig
from mavlink.component.ftp import (
    ACK,
    BURST,
    CRC32,
    END,
    HEAD,
    LIST,
    NAK,
    NOT_FOUND,
    OPEN,
    PROTECTED,
    READ,
    RESET,
    TERMINATE,
    FileServer,
)
from mavlink.component.metadata import (
    DEFINITION,
    DEFINITION_URI,
    GENERAL,
    ComponentMetadataMessage,
    camera_definition,
    metadata_files,
)
from mavlink.component.parameters import PARAMETERS
from mavlink.component.presence import Presence, PresenceConfig
from mavlink.telemetry.history import VehicleHistory
from mavlink.wire.dialect import dialect, x25crc
from mavlink.wire.framing import Framer
from mavlink.wire.messages import Address

STATION = Address(255, 190)
CONTENT = random.Random(1).randbytes(20_000)


class Client:
    """A reading client, written after the protocol's description."""

    def __init__(self, server: FileServer, source: Address = STATION) -> None:
        self.server, self.source, self.sequence = server, source, 0

    def ask(
        self, opcode: int, data: bytes = b"", session: int = 0, offset: int = 0, size: int = -1
    ) -> list[tuple[int, int, int, bytes, int]]:
        """(opcode, session, burst complete, data, offset) of each answer."""
        self.sequence += 1
        count = len(data) if size < 0 else size
        head = HEAD.pack(self.sequence, session, opcode, count, 0, 0, 0, offset)
        answers: list[tuple[int, int, int, bytes, int]] = []
        for raw in self.server.answer((head + data).ljust(251, b"\0"), self.source):
            assert len(raw) == 251
            sequence, number, code, length, asked, complete, _, at = HEAD.unpack_from(raw)
            assert asked == opcode
            assert sequence == self.sequence + 1 + len(answers)
            answers.append((code, number, complete, raw[HEAD.size :][:length], at))
        if opcode == BURST and answers:
            self.sequence += len(answers)
        return answers

    def open(self, name: bytes) -> tuple[int, int]:
        ((code, session, _, data, _),) = self.ask(OPEN, name)
        assert code == ACK
        return session, int.from_bytes(data, "little")


def test_a_file_is_read_piece_by_piece() -> None:
    client = Client(FileServer({"a.bin": CONTENT}))
    session, size = client.open(b"/a.bin")
    assert size == len(CONTENT)
    got = b""
    while True:
        ((code, _, _, data, _),) = client.ask(READ, session=session, offset=len(got), size=200)
        if code == NAK:
            assert data[0] == END
            break
        got += data
    assert got == CONTENT
    ((code, *_),) = client.ask(TERMINATE, session=session)
    assert code == ACK
    ((code, *_),) = client.ask(READ, session=session, size=10)
    assert code == NAK


def test_a_file_is_read_in_bursts_with_losses() -> None:
    rng = random.Random(2)
    client = Client(FileServer({"a.bin": CONTENT}))
    session, size = client.open(b"a.bin")
    got = bytearray(size)
    have = set[int]()
    at = 0
    while at < size:
        answers = client.ask(BURST, session=session, offset=at, size=239)
        assert [a[2] for a in answers] == [0] * (len(answers) - 1) + [1]
        for code, _, _, data, offset in answers:
            assert code == ACK
            if rng.random() < 0.8:
                got[offset : offset + len(data)] = data
                have.add(offset)
            at = offset + len(data)
    for offset in range(0, size, 239):  # the gaps are filled by single reads
        if offset not in have:
            ((_, _, _, data, _),) = client.ask(READ, session=session, offset=offset, size=239)
            got[offset : offset + len(data)] = data
    assert bytes(got) == CONTENT


def test_listing_checksum_and_refusals() -> None:
    client = Client(FileServer({"b.xml": b"abc", "a.bin": CONTENT}))
    ((code, _, _, data, _),) = client.ask(LIST, b"/")
    assert code == ACK and data == b"Fa.bin\t20000\0Fb.xml\t3\0"
    ((code, _, _, data, _),) = client.ask(LIST, b"/", offset=2)
    assert (code, data[0]) == (NAK, END)
    ((code, _, _, data, _),) = client.ask(LIST, b"/etc")
    assert (code, data[0]) == (NAK, NOT_FOUND)
    ((code, _, _, data, _),) = client.ask(CRC32, b"b.xml")
    # The reference: bit by bit, start 0, polynomial 0xEDB88320, no inversion.
    crc = 0
    for byte in b"abc":
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    assert int.from_bytes(data, "little") == crc
    for opcode in (6, 7, 8, 9, 13):
        ((code, _, _, data, _),) = client.ask(opcode, b"b.xml")
        assert (code, data[0]) == (NAK, PROTECTED)
    ((code, _, _, data, _),) = client.ask(OPEN, b"../../etc/passwd")
    assert (code, data[0]) == (NAK, NOT_FOUND)
    assert client.ask(200)[0][0] == NAK


def test_lost_answers_are_given_again_and_sessions_belong_to_their_owner() -> None:
    server = FileServer({"a.bin": CONTENT})
    client, other = Client(server), Client(server, Address(254, 1))
    session, _ = client.open(b"a.bin")
    client.sequence -= 1
    again, _ = client.open(b"a.bin")
    assert again == session
    ((code, *_),) = other.ask(READ, session=session, size=10)
    assert code == NAK
    assert other.ask(RESET)[0][0] == ACK
    ((code, *_),) = client.ask(READ, session=session, size=10)
    assert code == ACK


def test_a_client_that_starts_over_gets_the_answer_to_its_own_request() -> None:
    """Sequence numbers start over with a ground station: only a whole request tells a repetition.
    The answers of clients that are gone make way."""
    server = FileServer({"a.xml": b"A" * 10, "b.xml": b"B" * 20})
    held = 0
    for component in range(1, 41):
        if component == 20:
            held = held_bytes(server)
        assert Client(server, Address(255, component)).open(b"a.xml")[1] == 10
        again = Client(server, Address(255, component))  # the station has restarted
        session, size = again.open(b"b.xml")
        again.sequence -= 1
        assert size == 20 and again.open(b"b.xml") == (session, size)
    assert held_bytes(server) < held + 1000


def test_sessions_that_nobody_closes_make_way() -> None:
    server = FileServer({"a.bin": CONTENT})
    client, other = Client(server), Client(server, Address(254, 1))
    session, _ = client.open(b"a.bin")
    for _ in range(20):  # its link breaks each time
        other.open(b"a.bin")
    assert client.ask(READ, session=session, size=10)[0][0] == ACK
    for number in range(20):
        session, _ = Client(server, Address(1, number)).open(b"a.bin")
    assert client.ask(READ, session=session, size=10)[0][0] == NAK
    assert client.open(b"a.bin")[1] == len(CONTENT)


def test_any_request_is_survived() -> None:
    rng = random.Random(3)
    server = FileServer({"a.bin": CONTENT})
    for _ in range(3000):
        raw = bytearray(rng.randbytes(rng.choice([0, 5, 12, 251])))
        if len(raw) > 3:
            raw[3] = rng.randrange(20)
        answers = server.answer(bytes(raw), Address(rng.randrange(256), 1))
        assert all(len(answer) == 251 for answer in answers) and len(answers) <= 20


def test_the_definition_describes_every_parameter() -> None:
    version, xml = camera_definition("skyrelief", "3D <scan>", PARAMETERS)
    root = ET.fromstring(xml)
    assert root.tag == "mavlinkcamera"
    definition = root.find("definition")
    assert definition is not None
    assert definition.findtext("model") == "3D <scan>"
    assert int(definition.get("version", "0")) == version
    described = root.findall("parameters/parameter")
    assert [p.get("name") for p in described] == [p.name for p in PARAMETERS]
    for element, parameter in zip(described, PARAMETERS, strict=True):
        assert float(element.get("default", "nan")) == parameter.default
        options = [o.get("name") for o in element.findall("options/option")]
        assert tuple(options) == parameter.options
        if not options:
            assert float(element.get("max", "nan")) == parameter.high
    changed = (replace(PARAMETERS[0], high=99.0), *PARAMETERS[1:])
    assert camera_definition("skyrelief", "3D <scan>", changed)[0] != version


class Ends:
    """A companion and pymavlink's encoder, joined in memory."""

    def __init__(self) -> None:
        self.control = RehearsalControl()
        presence = Presence(PresenceConfig(), 1, 0)
        config = CompanionConfig()
        self.companion = Companion(config, self.control, presence, VehicleHistory(), 0)

    def say(self, message: Any, component: int = 190) -> list[Any]:
        for packet in Framer().feed(bytes(message.pack(dialect.MAVLink(None, 255, component)))):
            self.companion.receive(0, packet, 10**9)
        return [o.message for o in self.companion.take()]


def test_the_camera_names_its_definition_and_serves_it() -> None:
    ends = Ends()
    info: Any = ends.companion.camera.message(259, 0)
    assert info.cam_definition_uri == DEFINITION_URI
    version, xml = camera_definition("skyrelief", "3D scan", PARAMETERS)
    assert info.cam_definition_version == version
    head = HEAD.pack(7, 0, OPEN, len(DEFINITION), 0, 0, 0, 0)
    payload = list((head + DEFINITION.encode()).ljust(251, b"\0"))
    message = dialect.MAVLink_file_transfer_protocol_message(0, 1, 100, payload)
    (reply,) = ends.say(message)
    assert (reply.target_system, reply.target_component) == (255, 190)
    size = int.from_bytes(bytes(reply.payload[HEAD.size : HEAD.size + 4]), "little")
    assert size == len(xml)
    for target in ((1, 0), (1, 1), (2, 100)):
        elsewhere = dialect.MAVLink_file_transfer_protocol_message(0, *target, payload)
        assert ends.say(elsewhere) == []


def value_of(message: Any) -> float:
    raw: bytes = message._param_value_raw  # as text the zeros would be lost
    return float(struct.unpack("<f", raw[:4])[0])


def test_settings_of_the_camera_are_the_same_parameters() -> None:
    ends = Ends()
    listed = ends.say(dialect.MAVLink_param_ext_request_list_message(1, 100))
    assert [m.param_id for m in listed] == [p.name for p in PARAMETERS]
    (read,) = ends.say(
        dialect.MAVLink_param_ext_request_read_message(1, 100, b"SR_LINK_KBIT_S", -1)
    )
    assert value_of(read) == 1000.0
    (read,) = ends.say(dialect.MAVLink_param_ext_request_read_message(1, 100, b"", 0))
    assert read.param_id == "SR_BASELINE_M"

    def put(name: bytes, value: float, kind: int = 9) -> Any:
        raw = struct.pack("<f", value).ljust(128, b"\0")
        answers = ends.say(dialect.MAVLink_param_ext_set_message(1, 100, name, raw, kind))
        return next(m for m in answers if m.get_type() == "PARAM_EXT_ACK")

    ack = put(b"SR_BASELINE_M", 2.5)
    assert (ack.param_result, value_of(ack)) == (0, 2.5)
    assert ends.companion.parameters["SR_BASELINE_M"] == 2.5
    assert ends.control.asked == ["SR_BASELINE_M=2.5"]
    ack = put(b"SR_BASELINE_M", 1e9)
    assert (ack.param_result, value_of(ack)) == (2, 2.5)
    assert put(b"NOT_THERE", 1.0).param_result == 1
    whole = dialect.MAVLink_param_ext_set_message(1, 100, b"SR_BASELINE_M", bytes(128), 6)
    (ack, text) = ends.say(whole)
    assert (ack.param_result, text.text) == (1, "SR_BASELINE_M refused: send it as REAL32")
    assert ends.say(dialect.MAVLink_param_ext_request_list_message(1, 1)) == []
    assert ends.say(dialect.MAVLink_param_ext_request_list_message(2, 100)) == []


@pytest.mark.parametrize("name", [b"", b"NOT_THERE"])
def test_questions_for_unknown_settings_stay_without_answer(name: bytes) -> None:
    message = dialect.MAVLink_param_ext_request_read_message(1, 100, name, -1)
    assert Ends().say(message) == []


# Addresses, and the metadata of the parameters


def read_file(client: Client, name: bytes) -> bytes:
    session, size = client.open(name)
    got = b""
    while len(got) < size:
        ((code, _, _, data, _),) = client.ask(READ, session=session, offset=len(got), size=100)
        assert code == ACK
        got += data
    client.ask(TERMINATE, session=session)
    return got


def place_of(uri: str, said_by: int) -> tuple[int, str]:
    """Component and path, by the MAVLink FTP page: mftp://[;comp=ID]PATH, ID else the speaker."""
    found = re.fullmatch(r"mftp://(?:\[;comp=(\d+)\])?(.+)", uri)
    assert found is not None
    return int(found[1] or said_by), found[2]


def test_the_definition_is_found_when_the_autopilot_passes_it_on_as_its_own() -> None:
    component, path = place_of(DEFINITION_URI, said_by=1)
    assert (component, path) == (100, DEFINITION)


def test_a_client_that_sends_the_whole_address_is_served() -> None:
    client = Client(FileServer({"a.bin": CONTENT}))
    for name in (b"[;comp=100]a.bin", b"/[;comp=191]/a.bin", b"a.bin"):
        assert client.open(name)[1] == len(CONTENT)
    ((code, _, _, data, _),) = client.ask(OPEN, b"[;comp=1000]a.bin")
    assert (code, data[0]) == (NAK, NOT_FOUND)


def test_the_metadata_describes_every_parameter() -> None:
    files = metadata_files(PARAMETERS)
    client = Client(FileServer(files))
    message = ComponentMetadataMessage(1234, files[GENERAL])
    packet = bytes(message.pack(dialect.MAVLink(None, 1, 191)))
    payload = packet[10:-2].ljust(108, b"\0")
    boot_ms, crc, raw = struct.unpack("<II100s", payload)
    uri = raw.partition(b"\0")[0].decode()
    assert boot_ms == 1234 and place_of(uri, 1) == (191, "general.json.xz")
    general = read_file(client, uri.partition("]")[2].encode())
    assert crc == mavlink_crc32(general)
    described = json.loads(lzma.decompress(general))
    (entry,) = described["metadataTypes"]
    assert (described["version"], described["modelName"], entry["type"]) == (1, "3D scan", 1)
    component, path = place_of(entry["uri"], 1)
    packed = read_file(client, path.encode())
    assert component == 191 and entry["fileCrc"] == mavlink_crc32(packed)
    rows = json.loads(lzma.decompress(packed))["parameters"]
    assert [row["name"] for row in rows] == [p.name for p in PARAMETERS]
    for row, p in zip(rows, PARAMETERS, strict=True):
        assert (row["min"], row["max"], row["default"]) == (p.low, p.high, p.default)
        assert row["type"] == "Float" and row.get("units", "") == p.unit
        named = {value["value"]: value["description"] for value in row.get("values", [])}
        assert named == dict(enumerate(p.options))


def mavlink_crc32(data: bytes) -> int:
    """Bit by bit from the polynomial, as the MAVLink page on checksums has it."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    return crc


def test_the_message_has_the_checksum_of_its_definition() -> None:
    """CRC_EXTRA is made of the names and types of the fields."""
    crc = x25crc(b"COMPONENT_METADATA uint32_t time_boot_ms uint32_t file_crc char uri ")
    crc.accumulate(bytes((100,)))
    message = ComponentMetadataMessage(0, b"")
    assert (crc.crc & 0xFF) ^ (crc.crc >> 8) == message.crc_extra


@pytest.mark.parametrize("component", [0, 191])
def test_the_onboard_computer_sends_its_metadata_on_request(component: int) -> None:
    presence = Presence(PresenceConfig(), 1, 0)
    companion = Companion(CompanionConfig(), RehearsalControl(), presence, VehicleHistory(), 0)
    mouth = dialect.MAVLink(None, 255, 190)
    ask = dialect.MAVLink_command_long_message(1, component, 512, 0, 397, 0, 0, 0, 0, 0, 0)
    for packet in Framer().feed(bytes(ask.pack(mouth))):
        companion.receive(0, packet, 1)
    sent = [(o.component, o.message.get_type()) for o in companion.take()]
    assert sorted(sent) == [(191, "COMMAND_ACK"), (191, "COMPONENT_METADATA")]
