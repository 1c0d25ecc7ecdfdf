"""Annotations: bounds on what is kept, the portal's routes, the GeoPackage, and a browser."""

from __future__ import annotations

import json
import sqlite3
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from portal_client import NEEDS, ONE, TOKEN, Client, browser, client, flown_store, store

from service.errors import InputError
from service.georeference import LocalFrame
from service.ground.portal import Portal, PortalConfig
from service.offline.exports.view import ExportOptions, ScanView, export
from service.scans.annotations import (
    ANNOTATIONS,
    MAX_ANNOTATIONS,
    LineString,
    Point,
    add_annotation,
    delete_annotation,
    read_annotations,
)

if TYPE_CHECKING:
    from house_flight import HouseFlight
    from person import Browser

__all__ = ["browser", "client", "store"]  # the fixtures

SPOT = (11.5, 48.1, 410.25)
NOTES = ONE + "/annotations"


def test_annotations_are_added_listed_and_deleted(client: Client, store: Path) -> None:
    assert client.ask(NOTES, token=None)[1] == {"type": "FeatureCollection", "features": []}
    for number, text in enumerate(("crack  in the roof\n", "Grüße <b>"), 1):
        status, made, _ = client.ask(NOTES, "POST", {"coordinates": SPOT, "text": text})
        assert status == 201 and made["id"] == number
        assert made["properties"]["text"] == " ".join(text.split())
        assert made["properties"]["by"] == "operator"
    on_disk = json.loads((store / "drone-1/test-1" / ANNOTATIONS).read_text())
    assert client.ask(NOTES)[1] == on_disk
    assert [f["geometry"]["coordinates"] for f in on_disk["features"]] == [list(SPOT)] * 2
    assert client.ask(f"{ONE}/files/{ANNOTATIONS}")[0] == 200
    assert client.ask(f"{NOTES}/1", "DELETE")[0] == 200
    assert [f["id"] for f in client.ask(NOTES)[1]["features"]] == [2]
    assert client.ask(f"{NOTES}/1", "DELETE")[0] == 404


def test_a_change_needs_the_token_and_is_audited(client: Client, store: Path) -> None:
    body = {"coordinates": SPOT, "text": "a crack"}
    assert client.ask(NOTES, "POST", body, token=None)[0] == 401
    assert client.ask(NOTES, "POST", body)[0] == 201
    assert client.ask(f"{NOTES}/1", "DELETE", token=None)[0] == 401
    lines = [json.loads(line) for line in (store / "audit.jsonl").read_text().splitlines()]
    assert ("annotate", "a crack", 201) in [
        (x["action"], x.get("text"), x["status"]) for x in lines
    ]


@pytest.mark.parametrize(
    "body",
    [
        {"coordinates": SPOT, "text": " \n"},
        {"coordinates": SPOT, "text": "x" * 501},
        {"coordinates": SPOT, "text": "\ud800"},
        {"coordinates": [181.0, 0.0, 0.0], "text": "x"},
        {"coordinates": [0.0, 91.0, 0.0], "text": "x"},
        {"coordinates": [0.0, 0.0], "text": "x"},
        {"coordinates": [0.0, 0.0, 1e9], "text": "x"},
        {"coordinates": SPOT, "text": "x", "by": "another"},
        {"text": "x"},
        {"coordinates": SPOT, "line": [SPOT, SPOT], "text": "x"},
        {"line": [SPOT], "text": "x"},
        {"line": [SPOT] * 51, "text": "x"},
        {"line": [SPOT, [0.0, 0.0]], "text": "x"},
    ],
)
def test_unfit_annotations_are_refused(client: Client, store: Path, body: dict[str, Any]) -> None:
    status, answer, _ = client.ask(NOTES, "POST", body)
    assert status == 400 and "\n" not in answer["error"]
    assert not (store / "drone-1/test-1" / ANNOTATIONS).exists()


def test_their_number_is_bounded(tmp_path: Path) -> None:
    for _ in range(MAX_ANNOTATIONS):
        add_annotation(tmp_path, Point(SPOT), "x", "me", 0.0)
    with pytest.raises(InputError, match="at most 200"):
        add_annotation(tmp_path, Point(SPOT), "x", "me", 0.0)
    assert len(read_annotations(tmp_path).features) == MAX_ANNOTATIONS


def test_the_number_of_a_deleted_annotation_is_not_given_again(tmp_path: Path) -> None:
    def add() -> int:
        return add_annotation(tmp_path, Point(SPOT), "x", "me", 0.0).id

    assert [add(), add()] == [1, 2]
    delete_annotation(tmp_path, 2)
    assert add() == 3
    for number in (1, 3):
        delete_annotation(tmp_path, number)
    assert read_annotations(tmp_path).features == [] and add() == 4
    kept = json.loads((tmp_path / ANNOTATIONS).read_text())
    del kept["last_id"]  # a file of an earlier version
    (tmp_path / ANNOTATIONS).write_text(json.dumps(kept))
    delete_annotation(tmp_path, 4)
    assert add() == 5
    (tmp_path / ANNOTATIONS).write_text(json.dumps({**kept, "last_id": 2**53}))
    with pytest.raises(InputError, match="no number left"):
        add()


@pytest.mark.parametrize(
    "content", ["{", '{"type": "Feature"}', "[" * 100_000, '{"features": [1]}']
)
def test_a_file_of_a_stranger_is_read_or_refused(client: Client, store: Path, content: str) -> None:
    (store / "drone-1/test-1" / ANNOTATIONS).write_text(content)
    status, answer, _ = client.ask(NOTES)
    assert status == 400 and ANNOTATIONS in answer["error"]


def test_the_geopackage_holds_them_at_their_places(tmp_path: Path, house: HouseFlight) -> None:
    house.flown(tmp_path).close()
    frame = LocalFrame(*house.origin)
    enu = np.array([[3.0, -4.0, 0.0], [10.0, 2.0, 6.0]])
    for (lat, lon, alt), text in zip(frame.to_geodetic(enu), ("ground", "roof"), strict=True):
        add_annotation(tmp_path, Point((float(lon), float(lat), float(alt))), text, "me", 7.0)
    way = [(float(lon), float(lat), float(alt)) for lat, lon, alt in frame.to_geodetic(enu)]
    add_annotation(tmp_path, LineString(way), "eaves", "me", 8.0)
    with ScanView(tmp_path) as scan:
        path = export(scan, "gpkg", None, ExportOptions(contour_m=5.0))
    with sqlite3.connect(path) as file:
        kinds = file.execute(
            "SELECT table_name, geometry_type_name, srs_id FROM gpkg_geometry_columns"
        ).fetchall()
        rows = file.execute("SELECT geom, text, by, height_amsl_m FROM annotations").fetchall()
        line, name = file.execute("SELECT geom, text FROM measurements").fetchone()
    assert kinds == [
        ("contours", "LINESTRING", 32632),
        ("annotations", "POINT", 32632),
        ("measurements", "LINESTRING", 32632),
    ]
    assert name == "eaves" and line[:2] == b"GP"
    utm = np.frombuffer(line[-48:], "<f8").reshape(2, 3)
    np.testing.assert_allclose(frame.from_utm(utm), enu, atol=1e-3)
    found = []
    for data, _, by, height_m in rows:
        magic, _, _, srs, order, form, x, y = struct.unpack("<2sBBiBIdd", data)
        assert (magic, srs, order, form, by) == (b"GP", 32632, 1, 1, "me")
        found.append((x, y, height_m))
    assert [text for _, text, _, _ in rows] == ["ground", "roof"]
    np.testing.assert_allclose(frame.from_utm(np.array(found)), enu, atol=1e-3)


@pytest.mark.skipif(NEEDS[0].args[0] or NEEDS[1].args[0], reason="needs Chromium and the page")
@pytest.mark.slow
def test_a_note_is_written_where_one_clicks(
    browser: Browser, tmp_path: Path, house: HouseFlight
) -> None:
    folder = flown_store(tmp_path, house) / "drone-1" / "test-1"
    portal = Portal(PortalConfig(tmp_path, port=0, token=TOKEN))
    portal.start()
    browser.screen(1440, 900)
    browser.open("about:blank")
    browser.open(portal.url)
    browser.open(f"{portal.url.split('/?')[0]}/#/view/drone-1/test-1")
    browser.wait("document.body.dataset.points > 71000")
    browser.click("Whole site")
    browser.wait("document.body.dataset.still === 'yes'")
    browser.click("Notes")
    browser.wait("document.activeElement.matches('.notes input')")
    browser.call("Input.insertText", text="a crack <b>here</b>")
    browser.mouse(640, 520)
    browser.wait("document.querySelectorAll('.notes li').length === 1")
    first = read_annotations(folder).features[0]
    shown = browser.run("document.querySelector('.cursor').textContent").split(", ")
    assert isinstance(first.geometry, Point)
    lon, lat, _ = first.geometry.coordinates
    assert abs(float(shown[0]) - lat) < 1e-7
    assert abs(float(shown[1].split(" ")[0]) - lon) < 1e-7
    assert first.properties.text == "a crack <b>here</b>"
    drawn = browser.run(
        "(() => { const one = document.querySelector('.overlay.notes circle');"
        " const r = one.getBoundingClientRect();"
        " return [r.x + r.width / 2, r.y + r.height / 2]; })()"
    )
    assert np.abs(np.array(drawn) - (640, 520)).max() < 13  # the nearest point was picked
    browser.mouse(640, 450)
    browser.wait(
        "[...document.querySelectorAll('.note')].some(n => /write the note/.test(n.textContent))"
    )
    browser.run("document.querySelector('.notes input').focus()")
    browser.call("Input.insertText", text="by the keyboard alone")
    browser.click("Place at the middle")
    browser.wait("document.querySelectorAll('.notes li').length === 2")
    browser.image(tmp_path / "notes.png")  # to look at
    browser.screen(390, 844, mobile=True)
    browser.run("new Promise(r => setTimeout(r, 800))")
    browser.image(tmp_path / "notes-phone.png")
    browser.screen(1440, 900)
    browser.run("document.querySelector('.notes li button[aria-label]').click()")
    browser.wait("document.querySelectorAll('.notes li').length === 1")
    assert [f.id for f in read_annotations(folder).features] == [2]
    browser.key("Escape")
    browser.wait("document.querySelector('.measure.notes').hidden")
    browser.open(f"{portal.url.split('/?')[0]}/#/map/drone-1/test-1")
    words = "document.querySelector('.map .notes text')?.textContent"
    browser.wait(f"{words} === 'by the keyboard alone'")
    browser.wait("document.body.dataset.map === 'shown'")
    browser.image(tmp_path / "notes-map.png")
    portal.close()
