"""Hostile peers, hostile files and hostile clients against the processes that an operator runs."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import random
import shutil
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile_media import hostile_media
from hostile_records import (
    ATTACKER,
    damaged,
    endless_puts,
    hostile_puts,
    hostile_reports,
    hostile_tunnels,
)
from hostile_stores import hostile_stores, numbered
from house_flight import HouseFlight
from loopback import free_port
from paths import demo_stretch
from trial_cage import Cage
from trial_ground import Fleet, Ground, HonestDrone, Watch
from trial_rig import WHOLE, Row, Service, stored

from service.radio import DRONE, RadioLink
from service.stream.naming import ROOT
from service.stream.records import Repose
from service.stream.session import SessionConfig, open_session

zenoh = pytest.importorskip("zenoh")
for needed in ("starlette", "uvicorn", "websockets", "cryptography", "mcap", "rasterio", "laspy"):
    pytest.importorskip(needed)

SOAK_MINUTES = float(os.environ.get("SKYRELIEF_SOAK_MINUTES", "60")) if WHOLE else 0.05
pytestmark = [pytest.mark.trial, pytest.mark.timeout(SOAK_MINUTES * 60 + 7200 if WHOLE else 280)]

SEED = 18
STORES = 300 if WHOLE else 4
MEDIA = 300 if WHOLE else 40
SLOW = 1000
GROWTH_MIB = 50.0
POSE_S, TIMES, LATE_S = 2.0 if WHOLE else 20.0, 3.0, 30.0 if WHOLE else 3.0
"""The oldest honest pose at a ground that is attacked: so many seconds, or where other programs
take the cores so many times the oldest one that came meanwhile to a ground without an attack.
What was held up may come so long after the attack."""
EXPORTS = ("laz", "coverage", "dsm", "3dtiles", "kml", "mcap", "colmap", "ply", "contours")
COMMANDS = (
    *(("export", kind) for kind in (*EXPORTS, "glb", "copc")),
    *(("mesh",), ("refine",), ("inspect",), ("refly",)),
)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sound scan folder, closed."""
    house, folder = HouseFlight(), tmp_path_factory.mktemp("flown") / "sound"
    with house.flown(folder) as store:
        store.add_reposes([Repose(1, 1, house.pose(5.1), 1.0, np.eye(6) * 1e-4)])
        store.finish({"keyframes": 5, "points": 1})
    return folder


def sent(session: Any, key: str, payload: bytes) -> bool:
    """Whether the key is one that Zenoh carries."""
    try:
        session.put(f"{ROOT}/{key}", payload, congestion_control=zenoh.CongestionControl.BLOCK)
    except (zenoh.ZError, ValueError):
        return False
    return True


def asked(session: Any, key: str, payload: bytes) -> bool:
    """Whether the request is one that Zenoh carries; the answer is dropped."""
    try:
        session.get(f"{ROOT}/{key}", lambda _: None, payload=payload, timeout=1.0)
    except (zenoh.ZError, ValueError):
        return False
    return True


@pytest.fixture(scope="module")
def cage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cage]:
    """Where hostile files are opened."""
    with Cage(tmp_path_factory.mktemp("cage")) as one:
        yield one


@pytest.fixture
def calm(tmp_path: Path) -> Iterator[Watch]:
    """The poses at a ground without an attack: what other programs do to a trial."""
    folder = tmp_path / "calm"
    folder.mkdir()
    with Ground(folder) as ground, HonestDrone(folder, "calm", ground.endpoint):
        ground.until(lambda: stored(ground.store), "a calm chunk")
        with contextlib.closing(Watch(ground, "calm")) as watch:
            yield watch


# Hostile peers


def test_hostile_records_stop_nothing(tmp_path: Path, cage: Cage, record: Row) -> None:
    """Each known message, and damaged ones, while an honest drone streams; then every file."""
    radio = f"127.0.0.1:{free_port()}"
    with (
        Ground(tmp_path, more=("--mavlink", f"udpin:{radio}")) as ground,
        HonestDrone(tmp_path, "honest", ground.endpoint) as drone,
    ):
        ground.until(lambda: stored(ground.store / "drones" / "honest"), "an honest chunk")
        session = open_session(SessionConfig(connect=(ground.endpoint,)))
        known = list(hostile_puts())
        more = itertools.islice(endless_puts(SEED), 20_000 if WHOLE else 300)
        reports = list(hostile_reports("base"))
        try:
            count = sum(sent(session, put.key, put.payload) for put in (*known, *more))
            for name in ("honest", "nobody"):
                for k, (_, data) in enumerate(reports):
                    count += sent(session, f"{name}/scan-1/held/station-{k}", data)
                    for numbers in ("0-4294967295", "7-3", "x", "0", "9" * 30):
                        with contextlib.suppress(zenoh.ZError):
                            key = f"{ROOT}/{name}/scan-1/item/k0/{numbers}"
                            session.get(key, lambda _: None, payload=data, timeout=1.0)
                            count += 1
            count += tunnelled(f"udpout:{radio}", 5000 if WHOLE else 400)
            before = len(stored(drone.scans))
            ground.until(
                lambda: len(stored(ground.store / "drones" / "honest")) > before, "later chunks"
            )
            ground.check()
            assert ground.ask("/api/scans")[0] == 200
        finally:
            session.close()
        if WHOLE:  # invented drones have filled the table
            with HonestDrone(tmp_path, "newcomer", ground.endpoint) as late:
                ground.until(
                    lambda: stored(ground.store / "drones" / "newcomer"), "a drone that came later"
                )
                assert late.land() and late.lost(ground)[0] == 0
        assert drone.land(), ground.said[-3000:]
        lost, made = drone.lost(ground)
        assert ground.stop() == 0, ground.said[-3000:]
        assert "Traceback" not in ground.said, ground.said[-6000:]
    scans = sorted((ground.store / "drones" / ATTACKER).glob("*/scan.db"))
    faults = exported(cage, [path.parent for path in scans])
    record(
        "attack: hostile messages of the datalink and the radio",
        count,
        f"{len(known)} kinds, and damaged ones: dropped or kept apart; a drone that comes later is "
        "received; each scan's files are written or refused",
        f"{lost} of {made} honest chunks",
    )
    assert not lost
    assert not faults, "\n".join(faults)


def tunnelled(endpoint: str, count: int) -> int:
    """Send hostile payloads of the narrow radio; how many."""
    link = RadioLink(endpoint, DRONE)
    link.open()
    try:
        for number, payload in enumerate(hostile_tunnels(SEED, count)):
            link.send(payload)
            if number % 50 == 0:
                time.sleep(0.05)
    finally:
        link.close()
    return count


def exported(cage: Cage, scans: list[Path]) -> list[str]:
    """Faults in writing the deliverables of hostile ``scans``."""
    faults = []
    for number, scan in enumerate(scans[:40] if WHOLE else scans[:4]):
        for kind in EXPORTS if WHOLE else EXPORTS[number % len(EXPORTS) :][:1]:
            end = cage.command("export", scan, "--to", kind)
            faults += [f"{scan.name} to {kind}: {end.fault}"] if end.fault else []
    return faults


def hostile_rate(stop: threading.Event, session: Any, seed: int, tally: Counter[str]) -> None:
    """Messages of the hostile drone: a steady stream, and a burst now and then."""
    known = list(hostile_puts())
    puts = itertools.chain(known, endless_puts(seed))
    began, count = time.monotonic(), 0
    while not stop.is_set():
        for put in itertools.islice(puts, 2000 if count % 3000 == 1000 else 10):
            tally["records"] += sent(session, put.key, put.payload)
            count += 1
        stop.wait(max(0.0, began + count / 300.0 - time.monotonic()))


def rogue_station(stop: threading.Event, session: Any, keys: list[str], tally: Any) -> None:
    """A ground station of the fleet that reports and asks what nothing can mean."""
    rng = random.Random(SEED)
    reports = [data for _, data in hostile_reports("rogue")]
    while not stop.wait(0.05):
        key, kind = rng.choice(keys), rng.choice(("k0", "k1", "pose", "k9"))
        data = rng.choice((rng.choice(reports), damaged(rng.choice(reports), rng)))
        tally["reports"] += sent(session, f"{key}/held/station-{rng.randrange(1 << 40):x}", data)
        numbers = rng.choice(("0-4294967295", "0", str(rng.randrange(1 << 33))))
        tally["requests"] += asked(session, f"{key}/item/{kind}/{numbers}", data)


def test_hostile_datalink_next_to_honest_drones(tmp_path: Path, calm: Watch, record: Row) -> None:
    """A member of the fleet that turned hostile, as a drone and as a ground station."""
    names = ["honest-a", "honest-b"]
    fleet = Fleet(tmp_path / "keys", names, ATTACKER)
    tally: Counter[str] = Counter()
    stop = threading.Event()
    with contextlib.ExitStack() as stack:
        ground = stack.enter_context(Ground(tmp_path, fleet.base))
        drones = [
            stack.enter_context(HonestDrone(tmp_path, name, ground.endpoint, **fleet.drone(name)))
            for name in names
        ]
        keys = [one.key for one in drones]
        ground.until(
            lambda: all(stored(ground.store / "drones" / n) for n in names), "honest chunks"
        )
        watches = [stack.enter_context(contextlib.closing(Watch(ground, n))) for n in names]
        drone, station = fleet.session(ground.endpoint), fleet.session(ground.endpoint, "rogue")
        attackers = [
            threading.Thread(target=hostile_rate, args=(stop, drone, SEED, tally)),
            threading.Thread(target=rogue_station, args=(stop, station, keys, tally)),
        ]
        for attacker in attackers:
            attacker.start()
        try:
            mib = followed(ground, stop, tally)
        finally:
            stop.set()
            for attacker in attackers:
                attacker.join()
            time.sleep(LATE_S)
            landed = [one.land() for one in drones]
            worst_s, calm_s = max(watch.oldest_s for watch in watches), calm.oldest_s
            drone.close()
            station.close()
        lost = [one.lost(ground) for one in drones]
        code = ground.stop()
    record(
        f"attack: {SOAK_MINUTES:g} minutes of hostile datalink beside two honest drones",
        sum(tally.values()),
        f"{tally['records']} records, {tally['reports']} reports, {tally['requests']} requests; "
        f"worst age of an honest pose {worst_s:.2f} s, at a calm ground {calm_s:.2f} s; memory "
        f"{mib[0]:.0f} to {mib[-1]:.0f} MiB; nothing restarted",
        f"{sum(n for n, _ in lost)} of {sum(n for _, n in lost)} honest chunks",
    )
    assert all(landed) and not any(n for n, _ in lost), (lost, ground.said[-3000:])
    assert code == 0 and "Traceback" not in ground.said, (code, ground.said[-3000:])
    assert 0.0 < worst_s < max(POSE_S, TIMES * calm_s)
    assert max(mib) - mib[0] < GROWTH_MIB, mib


def followed(ground: Ground, stop: threading.Event, tally: Counter[str]) -> list[float]:
    """The ground's memory every ten seconds from a quarter of the time on; it is used meanwhile."""
    began, mib, length_s = time.monotonic(), [], SOAK_MINUTES * 60
    pid = ground.process.pid
    while time.monotonic() < began + length_s:
        stop.wait(min(10.0, length_s / 4))
        ground.check()
        assert ground.process.pid == pid
        assert ground.ask("/api/scans")[0] == 200
        if time.monotonic() > began + min(length_s / 4, 600.0):
            mib.append(ground.mib)
        print(
            f"{time.monotonic() - began:.0f} s: {ground.mib:.0f} MiB, {ground.files} files, "
            f"{dict(tally)}",
            flush=True,
        )
    return mib


# Hostile files


def test_hostile_stores_are_refused_or_read(
    tmp_path: Path, flown: Path, cage: Cage, record: Row
) -> None:
    """A stranger's card: taken in, each command on it, and shown by the portal."""
    faults: list[str] = []
    copies, made, codes = tmp_path / "copies", [], Counter[int]()
    copies.mkdir()
    for number, (what, copy) in enumerate(hostile_stores(flown, copies, STORES, SEED)):
        kept = tmp_path / "ground" / "drones" / "card" / f"scan-{number}"
        shutil.copytree(copy, kept, symlinks=True, ignore=no_pipes)
        if number % 2:
            numbered(kept, number)
        made.append(what)
        name, *kind = COMMANDS[number % len(COMMANDS)]
        into = ("--store", tmp_path / "taken", "--listen", "tcp/127.0.0.1:0")
        for arguments in (
            ("ground", *into, "--idle-exit-s", "0", "--take", copy),
            (name, copy, *(("--to", kind[0]) if kind else ())),
        ):
            end = cage.command(*arguments)
            codes[end.code] += 1
            where = f"{what}: {arguments[0]} {' '.join(kind)}"
            faults += [f"{where}: {end.fault}"] if end.fault else []
        shutil.rmtree(copy, ignore_errors=True)
    with Ground(tmp_path) as ground:
        faults += shown(ground, made)
        peak = ground.mib
        ground.check()
        assert ground.stop() == 0
    record(
        "attack: mutated scan folders, taken in, exported and shown",
        STORES,
        f"exit codes 0: {codes[0]}, 2: {codes[2]}, 3: {codes[3]}; no other; each within 1.5 GiB "
        f"(meshes 4) and 60 s of a core; the portal answers for each of them, at {peak:.0f} MiB",
        "-",
    )
    assert not faults, "\n".join(faults)


def no_pipes(folder: str, names: list[str]) -> list[str]:
    """Files that ``copytree`` cannot copy."""
    return [name for name in names if (Path(folder) / name).is_fifo()]


def shown(ground: Ground, made: list[str]) -> list[str]:
    """Faults of the portal with hostile scans."""
    from websockets.exceptions import WebSocketException
    from websockets.sync.client import connect

    faults = []
    status, body = ground.ask("/api/scans")
    if status != 200:
        return [f"the list of scans: {status} {body[:200]!r}"]
    json.loads(body)
    for number, what in enumerate(made):
        scan = f"/api/scans/card/scan-{number}"
        rest = ("/coverage.json", "/coverage.png", "/keyframes/0.jpg", "/files/preview.jpg")
        for path in ("", *(rest if WHOLE or number % 3 == 0 else ())):
            status, body = ground.ask(scan + path)
            if status in (0, 500):
                faults.append(f"{what}: portal {path}: {status} {body[:200]!r}")
        with contextlib.suppress(OSError, WebSocketException, TimeoutError):
            url = f"ws://127.0.0.1:{ground.port}{scan}/live?points=500"
            with connect(url, open_timeout=30, max_size=1 << 26) as live:
                live.recv(timeout=0.5 if WHOLE else 0.05)
    if ground.ask("/api/scans")[0] != 200:
        faults.append("the list of scans at the end")
    return faults


def test_hostile_media_is_refused_or_read(
    tmp_path: Path, flown: Path, cage: Cage, record: Row
) -> None:
    """Videos, images, logs, settings, camera models, surveys, recordings."""
    faults: list[str] = []
    kinds, codes = Counter[str](), Counter[int]()
    media = tmp_path / "media"
    media.mkdir()
    copy = tmp_path / "sound"
    shutil.copytree(flown, copy)
    assert cage.command("export", copy, "--to", "mcap").code == 0
    mcap = (copy / "flight.mcap").read_bytes()
    for reader, what, path in itertools.islice(hostile_media(media, mcap, SEED), MEDIA):
        kinds[reader] += 1
        end = cage.reader(reader, path)
        faults += [f"{reader}: {what}: {end.fault}"] if end.fault else []
        if WHOLE and kinds[reader] % 10 == 1 and reader in REPLAYED:
            end = cage.command("replay", *REPLAYED[reader](path), "--out", media / "scan")
            codes[end.code] += 1
            faults += [f"replay, {reader}: {what}: {end.fault}"] if end.fault else []
            shutil.rmtree(media / "scan", ignore_errors=True)
    record(
        "attack: mutated media and settings",
        sum(kinds.values()),
        f"read or refused in a line, within 1.5 GiB and 60 s of a core; {len(kinds)} kinds; "
        f"of these {sum(codes.values())} by replay",
        "-",
    )
    assert not faults, "\n".join(faults)


FRAMES = demo_stretch()
REPLAYED: dict[str, Any] = {
    "video .mp4": lambda path: (path,),
    "images .jpg": lambda path: (path,),
    "log .tlog": lambda path: (FRAMES, "--telemetry", path),
    "configuration": lambda path: (FRAMES, "--config", path),
    "camera model": lambda path: (FRAMES, "--camera-model", path),
}


@pytest.mark.skipif(not WHOLE, reason="only in the whole trials")
def test_daemon_starts_among_hostile_scans(tmp_path: Path, flown: Path, record: Row) -> None:
    """The daemon looks at what its scan folder holds when it starts."""
    scans = tmp_path / "scans"
    scans.mkdir()
    count = sum(1 for _ in hostile_stores(flown, scans, 120, SEED + 1))
    with Service(tmp_path, scans=scans) as service:
        service.until(lambda: service.frames > 2, "a scan")
        assert "Traceback" not in service.log.read_text(), service.log.read_text()[-4000:]
        assert service.stop() == 0
    record("attack: daemon among mutated scans", count, "starts, scans and ends", "-")


# Hostile clients


def slow_requests() -> Iterator[tuple[bytes, bytes]]:
    """(first bytes, what follows now and then) of requests that never end."""
    host = b"Host: 127.0.0.1\r\n"
    upgrade = b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    order = b"POST /api/import HTTP/1.1\r\n" + host + b"Content-Type: application/json\r\n"
    yield b"", b""
    yield b"GET /api/scans HT", b"T"
    yield b"GET /api/scans HTTP/1.1\r\n" + host + b"X: ", b"x"
    yield b"GET / HTTP/1.1\r\n" + upgrade, b"x: y\r\n"
    yield order + b"Content-Length: 60000\r\n\r\n{", b" "
    yield order + b"Transfer-Encoding: chunked\r\n\r\n", b"1\r\n \r\n"
    yield b"\x16\x03\x01\x02\x00\x01\x00", b"\0"
    yield b"GET /api/scans HTTP/1.1\r\n" + host + b"\r\n", b""


def test_slow_connections_stop_nothing(tmp_path: Path, calm: Watch, record: Row) -> None:
    """Half of them from one address, half from addresses of their own."""
    requests = list(slow_requests())
    opened, refused, held = [], 0, 0
    answers = list[float]()
    with (
        Ground(tmp_path) as ground,
        HonestDrone(tmp_path, "honest", ground.endpoint) as drone,
        contextlib.closing(Watch(ground, "honest")) as watch,
    ):
        ground.until(lambda: stored(ground.store / "drones" / "honest"), "an honest chunk")
        try:
            for k in range(SLOW):
                address = "127.0.1.1" if k % 2 else f"127.0.{2 + k // 250}.{1 + k % 250}"
                one = socket.socket()
                one.setblocking(False)
                one.bind((address, 0))
                one.connect_ex(("127.0.0.1", ground.port))
                opened.append((one, *requests[k // 2 % len(requests)]))
                if k % 200 == 199:
                    honest(ground, answers)
            for one, first, _ in opened:
                with contextlib.suppress(OSError):
                    one.send(first)
            for _ in range(60 if WHOLE else 4):
                honest(ground, answers)
                for one, _, rest in opened:
                    with contextlib.suppress(OSError):
                        one.send(rest)
                time.sleep(1.0 if WHOLE else 0.1)
            before = len(stored(drone.scans))
            ground.until(
                lambda: len(stored(ground.store / "drones" / "honest")) > before, "later chunks"
            )
            for one, _, _ in opened:
                with contextlib.suppress(BlockingIOError):
                    try:
                        refused += one.recv(1) == b""
                    except ConnectionError:
                        refused += 1
            held = ground.files
            ground.check()
        finally:
            for one, _, _ in opened:
                one.close()
        time.sleep(LATE_S)
        assert drone.land()
        lost, made = drone.lost(ground)
        assert ground.stop() == 0
    record(
        "attack: slow or half-open connections to the portal",
        SLOW,
        f"{refused} closed meanwhile, {held} descriptors held; {len(answers)} honest requests "
        f"answered, the slowest in {max(answers):.1f} s; "
        f"worst age of a pose {watch.oldest_s:.2f} s, at a calm ground {calm.oldest_s:.2f} s",
        f"{lost} of {made} honest chunks",
    )
    assert not lost
    assert 0.0 < watch.oldest_s < max(POSE_S, TIMES * calm.oldest_s)


def honest(ground: Ground, answers: list[float]) -> None:
    """The operator looks at the list meanwhile."""
    began = time.monotonic()
    status, _ = ground.ask("/api/scans")
    answers.append(time.monotonic() - began)
    assert status == 200, (status, ground.said[-2000:])
