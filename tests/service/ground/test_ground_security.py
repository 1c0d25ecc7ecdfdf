"""Fleet keys: who may join, who may write, who may only read."""

from __future__ import annotations

import contextlib
import shutil
import socket
import stat
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from loopback import until

from service.commands.diagnosis import BAD, GOOD, NOTE, check_certificate
from service.config import DatalinkConfig, load_config
from service.errors import InputError, OutsideError
from service.ground.receiver import Receiver, ReceiverConfig
from service.stream.keys import (
    access_control,
    load_fleet,
    make_keys,
    member_name,
    revoke,
    tls_files,
)
from service.stream.link import DatalinkSender
from service.stream.records import ScanHeader
from service.stream.session import SessionConfig, open_session
from service.stream.store import ScanStore

pytest.importorskip("cryptography")
zenoh = pytest.importorskip("zenoh")


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fleet")
    make_keys(folder, {"drone": ["red", "blue"], "ground": ["base"], "viewer": ["eye"]})
    return folder


def session_config(home: Path, **more: object) -> SessionConfig:
    ca, certificate, key = tls_files(home)
    return SessionConfig(tls_ca=ca, tls_certificate=certificate, tls_key=key, **more)  # type: ignore[arg-type]


@contextlib.contextmanager
def served(fleet: Path, folder: Path) -> Iterator[tuple[Receiver, str]]:
    """A ground station of the fleet, and where it listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tls/127.0.0.1:{probe.getsockname()[1]}"
    config = session_config(
        fleet / "ground" / "base", mode="router", listen=(endpoint,), fleet_rights=True
    )
    receiver = Receiver(ReceiverConfig(folder / "ground", config), deliver=lambda _: None)
    receiver.start()
    try:
        yield receiver, endpoint
    finally:
        receiver.close()


@pytest.fixture
def ground(fleet: Path, tmp_path: Path) -> Iterator[tuple[Receiver, str]]:
    with served(fleet, tmp_path) as both:
        yield both


def sender(fleet: Path, folder: Path, member: str, claims: str, endpoint: str) -> DatalinkSender:
    ca, certificate, key = tls_files(fleet / member)
    store = ScanStore.create(folder / f"{claims}.db", ScanHeader("scan-1", claims, 1))
    store.finish({})
    config = DatalinkConfig(
        connect=(endpoint,), tls_ca=ca, tls_certificate=certificate, tls_key=key
    )
    return DatalinkSender(store, config)


def until_heads_bring(fleet: Path, endpoint: str, word: str, seen: list[str]) -> None:
    """Ask as another ground station for the heads of all drones, until ``word`` is ``seen``."""
    config = session_config(fleet / "ground" / "base", connect=(endpoint,))
    with open_session(config) as station:

        def is_seen() -> bool:
            station.get("skyrelief/*/*/head", zenoh.handlers.RingChannel(1))
            return word in seen

        until(is_seen)


def test_a_drone_writes_under_its_own_key_and_under_no_other(
    fleet: Path, tmp_path: Path, ground: tuple[Receiver, str]
) -> None:
    receiver, endpoint = ground
    own = sender(fleet, tmp_path, "drone/red", "red", endpoint)
    foreign = sender(fleet, tmp_path, "drone/red", "blue", endpoint)
    try:
        assert own.drain(15.0)
        assert not foreign.drain(2.0)
        assert foreign.progress.connected
        assert [entry["drone"] for entry in receiver.progress()] == ["red"]
    finally:
        own.close()
        foreign.close()


def test_a_viewer_reads_and_cannot_write(
    fleet: Path, tmp_path: Path, ground: tuple[Receiver, str]
) -> None:
    receiver, endpoint = ground
    seen: list[str] = []
    viewer = open_session(session_config(fleet / "viewer" / "eye", connect=(endpoint,)))
    viewer.declare_subscriber("skyrelief/**", lambda s: seen.append(str(s.key_expr)))
    link = sender(fleet, tmp_path, "drone/red", "red", endpoint)
    try:
        assert link.drain(15.0)
        until_heads_bring(fleet, endpoint, "skyrelief/red/scan-1/head", seen)
        viewer.put("skyrelief/red/scan-9/head", b'{"v":1,"numbers":{},"live":{},"finished":false}')
        time.sleep(0.5)
        assert [entry["scan"] for entry in receiver.progress()] == ["scan-1"]
    finally:
        link.close()
        viewer.close()


def test_a_station_reports_under_its_own_name_only(tmp_path: Path) -> None:
    fleet = tmp_path / "fleet"
    make_keys(fleet, {"drone": ["red"], "ground": ["base", "mobile"]})
    assert member_name(fleet / "ground" / "mobile" / "certificate.pem") == "mobile"
    heard: list[str] = []
    with served(fleet, tmp_path) as (_, endpoint):
        drone = open_session(session_config(fleet / "drone" / "red", connect=(endpoint,)))
        drone.declare_subscriber("skyrelief/red/*/held/*", lambda s: heard.append(str(s.key_expr)))
        mobile = open_session(session_config(fleet / "ground" / "mobile", connect=(endpoint,)))

        def comes() -> bool:
            for name in ("base", "invented", "mobile"):
                mobile.put(f"skyrelief/red/scan-1/held/{name}", b"")
            return len(heard) >= 3

        try:
            until(comes)
        finally:
            mobile.close()
            drone.close()
    assert set(heard) == {"skyrelief/red/scan-1/held/mobile"}


@pytest.mark.parametrize("fault", ["another fleet", "expired", "not a certificate", "drone serves"])
def test_who_is_not_of_the_fleet_does_not_get_in(
    fault: str, fleet: Path, tmp_path: Path, ground: tuple[Receiver, str]
) -> None:
    _, endpoint = ground
    if fault == "another fleet":
        make_keys(tmp_path / "other", {"drone": ["red"]})
        home = tmp_path / "other" / "drone" / "red"
        (home / "ca.pem").write_bytes((fleet / "drone" / "red" / "ca.pem").read_bytes())
    elif fault == "expired":
        make_keys(fleet, {"drone": ["old"]}, days=1, now=time.time() - 90 * 86400)
        home = fleet / "drone" / "old"
    else:
        home = fleet / "drone" / "red"
    config = session_config(home, connect=(endpoint,))
    if fault == "not a certificate":
        client = zenoh.Config()
        client.insert_json5("mode", '"client"')
        client.insert_json5("connect/endpoints", f'["{endpoint}"]')
        client.insert_json5("connect/timeout_ms", "0")
        client.insert_json5("scouting/multicast/enabled", "false")
        client.insert_json5("transport/link/tls/root_ca_certificate", f'"{home / "ca.pem"}"')
        with pytest.raises(zenoh.ZError):
            zenoh.open(client)
        return
    if fault == "drone serves":
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            false_endpoint = f"tls/127.0.0.1:{probe.getsockname()[1]}"
        impostor = open_session(session_config(home, mode="router", listen=(false_endpoint,)))
        try:
            config = session_config(fleet / "drone" / "blue", connect=(false_endpoint,))
            with pytest.raises(OutsideError):
                open_session(config)
        finally:
            impostor.close()
        return
    with pytest.raises(OutsideError):
        open_session(config)


def test_a_clock_that_is_behind_does_not_keep_a_drone_out(tmp_path: Path) -> None:
    """Keys made a month from now stand for a computer here whose clock is a month behind."""
    fleet, members = tmp_path / "fleet", {"drone": ["red"], "ground": ["base"]}
    make_keys(fleet, members, now=time.time() + 30 * 86400)
    with served(fleet, tmp_path) as (_, endpoint):
        link = sender(fleet, tmp_path, "drone/red", "red", endpoint)
        try:
            assert link.drain(15.0)
        finally:
            link.close()


def test_doctor_tells_how_long_a_certificate_holds(tmp_path: Path) -> None:
    def found(days: float, path: str = "certificate.pem", drone: str = "red") -> tuple[str, str]:
        shutil.rmtree(tmp_path / "fleet", ignore_errors=True)
        now = time.time() + (days - 10.0) * 86400
        make_keys(tmp_path / "fleet", {"drone": ["red"]}, days=10, now=now)
        chosen = tmp_path / "fleet" / "drone" / "red" / path
        config = load_config(None, [f"datalink.tls_certificate={chosen}", f"scan.drone={drone}"])
        findings = list(check_certificate(config))
        assert {finding.verdict for finding in findings} == {findings[0].verdict}
        return findings[0].verdict, "; ".join(finding.text for finding in findings)

    assert found(90.5)[0] == GOOD and "is valid for 90 more days" in found(90.5)[1]
    assert found(5.5)[0] == NOTE
    assert found(-5.5)[0] == BAD and "expired" in found(-5.5)[1]
    assert found(90.0, "key.pem")[0] == BAD
    assert found(90.0, drone="blue")[0] == BAD and "of 'red'" in found(90.0, drone="blue")[1]
    assert all(fault in found(-5.5, drone="blue")[1] for fault in ("of 'red'", "expired"))
    assert not list(check_certificate(load_config(None, [])))


def test_keys_are_private_and_stay(fleet: Path) -> None:
    key = fleet / "drone" / "red" / "key.pem"
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    before = key.read_bytes()
    assert make_keys(fleet, {"drone": ["red"], "ground": ["base"]}) == []
    assert key.read_bytes() == before
    assert set(load_fleet(fleet / "ground" / "base" / "fleet.json").members) == {
        "drone", "ground", "viewer",
    }  # fmt: skip


def test_rights_name_every_member_and_deny_the_rest(fleet: Path) -> None:
    rights = access_control(load_fleet(fleet / "fleet.json"))
    assert rights["default_permission"] == "deny"
    names = {name for subject in rights["subjects"] for name in subject["cert_common_names"]}
    assert {"drone.red", "drone.blue", "ground.base", "viewer.eye"} <= names


@pytest.mark.slow
def test_a_revoked_drone_has_no_rights_and_its_successor_has(tmp_path: Path) -> None:
    fleet, stolen = tmp_path / "fleet", tmp_path / "stolen"
    make_keys(fleet, {"drone": ["red", "blue"], "ground": ["base"]})
    shutil.copytree(fleet / "drone" / "red", stolen / "drone" / "red")
    assert revoke(fleet, "red") == [fleet / "ground" / "base" / "fleet.json"]
    assert not (fleet / "drone" / "red").exists()
    assert make_keys(fleet, {"drone": ["red"]}) == [fleet / "drone" / "red"]
    (tmp_path / "old").mkdir()
    with served(fleet, tmp_path) as (receiver, endpoint), contextlib.ExitStack() as up:
        old = sender(stolen, tmp_path / "old", "drone/red", "red", endpoint)
        up.callback(old.close)
        assert not old.drain(3.0) and receiver.progress() == []
        for name in ("red", "blue"):
            link = sender(fleet, tmp_path, f"drone/{name}", name, endpoint)
            up.callback(link.close)
            assert link.drain(15.0)
        assert sorted(e["drone"] for e in receiver.progress()) == ["blue", "red"]


def test_a_revoked_viewer_sees_nothing_and_its_successor_does(tmp_path: Path) -> None:
    fleet, stolen = tmp_path / "fleet", tmp_path / "stolen"
    make_keys(fleet, {"drone": ["red"], "ground": ["base"], "viewer": ["eye"]})
    shutil.copytree(fleet / "viewer" / "eye", stolen)
    revoke(fleet, "eye")
    make_keys(fleet, {"viewer": ["eye"]})
    seen: list[str] = []
    with served(fleet, tmp_path) as (_, endpoint), contextlib.ExitStack() as up:
        for who, home in (("old", stolen), ("new", fleet / "viewer" / "eye")):
            session = up.enter_context(open_session(session_config(home, connect=(endpoint,))))
            session.declare_subscriber("skyrelief/**", lambda _, who=who: seen.append(who))
        link = sender(fleet, tmp_path, "drone/red", "red", endpoint)
        up.callback(link.close)
        assert link.drain(15.0)
        until_heads_bring(fleet, endpoint, "new", seen)
        assert "old" not in seen


def test_a_revoked_ground_station_cannot_serve_and_the_others_have_new_keys(tmp_path: Path) -> None:
    fleet, stolen = tmp_path / "fleet", tmp_path / "stolen"
    make_keys(fleet, {"drone": ["red"], "ground": ["base", "van"]})
    shutil.copytree(fleet / "ground" / "van", stolen)
    again = revoke(fleet, "ground.van")
    assert set(again) == {fleet / "drone" / "red", fleet / "ground" / "base"}
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        false_endpoint = f"tls/127.0.0.1:{probe.getsockname()[1]}"
    home = fleet / "drone" / "red"
    impostor = open_session(session_config(stolen, mode="router", listen=(false_endpoint,)))
    with impostor, pytest.raises(OutsideError):
        open_session(session_config(home, connect=(false_endpoint,)))
    with served(fleet, tmp_path) as (_, endpoint), contextlib.ExitStack() as up:
        link = sender(fleet, tmp_path, "drone/red", "red", endpoint)
        up.callback(link.close)
        assert link.drain(15.0)


def test_revoking_an_unknown_or_shared_name_is_said_in_one_line(tmp_path: Path) -> None:
    make_keys(tmp_path, {"drone": ["red"], "ground": ["base"], "viewer": ["red"]})
    with pytest.raises(InputError, match="this fleet has no member 'green'"):
        revoke(tmp_path, "green")
    with pytest.raises(InputError, match=r"give drone.red or viewer.red"):
        revoke(tmp_path, "red")
    revoke(tmp_path, "viewer.red")
    assert load_fleet(tmp_path / "fleet.json").members["drone"] == ("red",)


def test_bad_names_and_missing_files_are_said_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot travel"):
        make_keys(tmp_path, {"drone": ["../x"]})
    with pytest.raises(InputError, match="skyrelief keys"):
        tls_files(tmp_path)
    with pytest.raises(InputError, match="skyrelief keys"):
        load_fleet(tmp_path / "fleet.json")
