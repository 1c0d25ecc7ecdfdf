"""Control points of a scan over HTTP: their file, where images are to show them, marks by hand."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from house_flight import HouseFlight
from portal_client import ONE, Client, serving

from recon import se3
from recon.types import F64, Keyframe
from service.georeference import LocalFrame
from service.ground.control import MAX_MARKS, MAX_POINTS
from service.ground.state import Job, carry_out
from service.offline.refine.marking import GCP, Marking, survey_text
from service.offline.refine.survey_file import Sighting, SurveyPoint, read_survey
from service.stream.store import ScanStore

POINTS = f"{ONE}/control-points"
K = np.array([[280.0, 0.0, 159.5], [0.0, 280.0, 89.5], [0.0, 0.0, 1.0]])
LENS = np.array([-0.08, 0.01, 0.0, 0.0, 0.0])
SURVEY_OFF = np.array([0.3, -0.2, 0.4])
"""The map lies so far from the survey: east, north, up."""

SPOTS = {"A": (2.0, -6.0), "B": (16.0, 8.0), "C": (20.0, -9.0), "D": (0.0, 9.0)}


@pytest.fixture
def house() -> HouseFlight:
    return HouseFlight()


def flown(house: HouseFlight, root: Path, georeferenced: bool) -> Path:
    """A store of one finished scan whose camera has a lens, at twice the keyframes' size."""
    folder = root / "drone-1" / "test-1"
    with house.flown(folder, georeferenced) as scan:
        camera = {"width": 320, "height": 180, "K": K.ravel().tolist(), "distortion": LENS.tolist()}
        scan.update_header(camera=camera)
        scan.finish({})
    return root


@pytest.fixture(params=[True, False], ids=["georeferenced", "relative"])
def client(request: pytest.FixtureRequest, house: HouseFlight, tmp_path: Path) -> Iterator[Client]:
    """Of a portal with the scan, in whose place the parameter says whether it knows its place."""
    with serving(flown(house, tmp_path, request.param)) as found:
        yield found


def table(house: HouseFlight) -> str:
    """The survey: places alone, off the map by one step."""
    frame = LocalFrame(*house.origin)
    rows = ["name,lat,lon,alt_amsl_m"]
    for name, (x, y) in SPOTS.items():
        at = np.array([[x, y, house.roof_m(np.array(x), np.array(y)).item()]]) - SURVEY_OFF
        lat, lon, alt = frame.to_geodetic(at)[0]
        rows.append(f"{name},{lat:.10f},{lon:.10f},{alt:.4f}")
    return "\n".join(rows) + "\n"


def pixel(house: HouseFlight, seq: int, spot: F64) -> list[float]:
    """Where the camera's own image shows a place of the map."""
    there = se3.transform(se3.inverse(house.pose(5.0 * seq)), spot[None])
    found = cv2.projectPoints(there, np.zeros(3), np.zeros(3), K, LENS)[0]
    return [float(v) for v in found.reshape(2)]


def place_of(house: HouseFlight, name: str) -> F64:
    x, y = SPOTS[name]
    return np.array([x, y, house.roof_m(np.array(x), np.array(y)).item()])


def point(listed: Any, name: str) -> Any:
    return next(p for p in listed["points"] if p["name"] == name)


def mark(client: Client, house: HouseFlight, name: str, seqs: tuple[int, ...] = (1, 2)) -> Any:
    """Mark a point where two images show it; the points as answered."""
    for seq in seqs:
        body = {
            "name": name, "keyframe_seq": seq, "uv_px": pixel(house, seq, place_of(house, name)),
        }  # fmt: skip
        status, listed, _ = client.ask(POINTS, "POST", body)
        assert status == 200, listed
    return listed


def test_points_are_expected_marked_and_refined_with(
    client: Client, house: HouseFlight, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    georeferenced = "georeferenced" in request.node.name
    assert client.ask(POINTS)[1] == {"size_px": [320, 180], "points": []}
    status, listed, _ = client.ask(POINTS, "PUT", {"text": table(house)})
    assert status == 200, listed
    assert [p["name"] for p in listed["points"]] == list(SPOTS)
    images = point(listed, "B")["images"]
    assert len(images) > 2 and all(i["marked_px"] is None for i in images)
    if georeferenced:
        spot = place_of(house, "B") - SURVEY_OFF
        wanted = [pixel(house, i["keyframe_seq"], spot) for i in images]
        np.testing.assert_allclose([i["expected_px"] for i in images], wanted, atol=0.01)
    else:
        assert all(i["expected_px"] is None for i in images)
    for name in "ABC":
        listed = mark(client, house, name)
    off_m = point(listed, "B")["off_m"]
    np.testing.assert_allclose(off_m, SURVEY_OFF if georeferenced else np.zeros(3), atol=0.05)
    assert point(listed, "B")["why_not"] == "" and point(listed, "B")["marks"] == 2
    # The point that is not marked is expected where the map has it.
    image = point(listed, "D")["images"][0]
    found = pixel(house, image["keyframe_seq"], place_of(house, "D"))
    assert np.hypot(*np.subtract(image["expected_px"], found)) < 1.0
    folder = tmp_path / "drone-1" / "test-1"
    assert carry_out(Job(1, folder, "refine")) == "cloud.laz"
    with ScanStore.open(folder / "scan.db") as store:
        figures = store.refinement or {}
        assert figures["control"]["count"] == 3 and "D" in figures["notes"][0]
        after_m = next(p["after_m"] for p in figures["points"] if p["name"] == "B")
    off_m = point(client.ask(POINTS)[1], "B")["off_m"]
    np.testing.assert_allclose(off_m, after_m, atol=0.02)


@pytest.mark.parametrize("client", [True], indirect=True)
def test_a_mark_is_taken_away_and_bad_ones_change_nothing(
    client: Client, house: HouseFlight, tmp_path: Path
) -> None:
    client.ask(POINTS, "PUT", {"text": table(house)})
    mark(client, house, "A")
    held = (tmp_path / "drone-1" / "test-1" / GCP).read_text()
    one = {"name": "A", "keyframe_seq": 1, "uv_px": [10.0, 10.0]}
    for change, code, said in (
        ({"name": "Z"}, 404, "no control point 'Z'"),
        ({"keyframe_seq": 77}, 400, "no keyframe 77"),
        ({"uv_px": [400.0, 10.0]}, 400, "outside the camera's image"),
        ({"uv_px": "here"}, 400, "not valid"),
    ):
        status, answer, _ = client.ask(POINTS, "POST", one | change)
        assert status == code and said in answer["error"], (change, answer)
    for text in ("", "name;lat\n", "EPSG:25832\nA 1 2\n", table(house) + "A,1,2,3\n"):
        status, answer, _ = client.ask(POINTS, "PUT", {"text": text})
        assert status == 400 and answer["error"].startswith("points"), answer
    assert client.ask(POINTS, "POST", one, token=None)[0] == 401
    assert (tmp_path / "drone-1" / "test-1" / GCP).read_text() == held
    status, listed, _ = client.ask(POINTS, "POST", one | {"uv_px": None})
    assert point(listed, "A")["marks"] == 1
    assert read_survey(tmp_path / "drone-1" / "test-1" / GCP)[0].sightings[0].keyframe_seq == 2


@pytest.mark.parametrize("client", [True], indirect=True)
def test_what_is_kept_can_be_read_again(client: Client, house: HouseFlight, tmp_path: Path) -> None:
    """Names are one point whatever the spaces within; marks in stills are passed over."""
    kept = tmp_path / "drone-1" / "test-1" / GCP
    two = table(house).replace("\nA,", "\nroof  edge,").replace("\nB,", "\nroof edge,")
    status, answer, _ = client.ask(POINTS, "PUT", {"text": two})
    assert status == 400 and answer["error"].startswith("points line 3: roof edge differs"), answer
    kept.write_text(
        "name,lat,lon,alt_amsl_m,image,u_px,v_px\nA,47.39,8.54,408,still.jpg,5,5\nB,47.39,8.54,408,,,"
    )
    status, listed, _ = client.ask(POINTS)
    assert status == 200 and [p["marks"] for p in listed["points"]] == [0, 0], listed
    mark(client, house, "A", (1,))
    assert [len(p.sightings) for p in read_survey(kept)] == [1, 0]
    kept.write_text("damaged")
    status, answer, _ = client.ask(POINTS)
    assert status == 400 and answer["error"].startswith("gcp.csv line 1"), answer
    assert client.ask(POINTS, "PUT", {"text": table(house)})[0] == 200


def test_points_without_a_height_read_each_keyframe_once(
    house: HouseFlight, tmp_path: Path
) -> None:
    flown(house, tmp_path, True)
    lat, lon, _ = house.origin
    points = [
        SurveyPoint(f"P{k}", lat, lon + 1e-6 * k, None, 0.03, 0.05, False, k, ()) for k in range(9)
    ]
    read = list[int]()

    class Counted(ScanStore):
        """Notes which keyframes are read."""

        def keyframe(self, seq: int) -> Keyframe | None:
            read.append(seq)
            return super().keyframe(seq)

    with Counted.peek(tmp_path / "drone-1" / "test-1" / "scan.db") as store:
        found = Marking(store).of(points)
    assert len(found) == 9 and sorted(read) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("client", [True], indirect=True)
def test_places_alone_in_a_system_of_coordinates(client: Client, house: HouseFlight) -> None:
    frame = LocalFrame(*house.origin)
    x, y, z = frame.to_utm(np.array([[2.0, -6.0, 0.0]]))[0]
    text = f"EPSG:{frame.epsg}\nA {x:.4f} {y:.4f} {z:.4f}\n# B\n"
    listed = client.ask(POINTS, "PUT", {"text": text})[1]
    image = point(listed, "A")["images"][0]
    wanted = pixel(house, image["keyframe_seq"], place_of(house, "A"))
    np.testing.assert_allclose(image["expected_px"], wanted, atol=0.01)


@pytest.mark.parametrize("client", [True], indirect=True)
def test_an_image_is_shown_as_the_camera_has_it(client: Client, house: HouseFlight) -> None:
    """The red roof's west edge in the distorted image."""
    status, data, _ = client.ask(f"{POINTS}/images/1.jpg")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert status == 200 and image is not None
    u, v = pixel(house, 1, np.array([4.0, 2.0, 6.0]))
    scale = image.shape[1] / 320
    row = image[round(v * scale)].astype(int)
    edge = np.flatnonzero(row[:, 2] - row[:, 1] > 60)[0] / scale
    assert abs(edge - u) < 4.0
    assert client.ask(f"{POINTS}/images/99.jpg")[0] == 404


def test_a_large_file_is_taken_and_one_with_too_many_points_refused(
    client: Client, house: HouseFlight
) -> None:
    text = table(house)
    marks = "".join(f"k{n}.jpg,A,{n % 300}.5,90.25\n" for n in range(8000))
    row = text.splitlines()[1].split(",")
    places = f"EPSG:4326\nA,{row[2]},{row[1]},{row[3]}\n"
    status, listed, _ = client.ask(POINTS, "PUT", {"text": places, "marks": marks})
    assert status == 200 and [p["name"] for p in listed["points"]] == ["A"], listed
    many = text + "".join(f"p{n},{row[1]},{row[2]},{row[3]}\n" for n in range(1000))
    status, said, _ = client.ask(POINTS, "PUT", {"text": many})
    assert status == 400 and "more than 1000 points" in said["error"], said
    assert [p["name"] for p in client.ask(POINTS)[1]["points"]] == ["A"]


@pytest.mark.slow
def test_a_mark_too_many_leaves_the_points_as_they_are(house: HouseFlight, tmp_path: Path) -> None:
    """Else none could be listed, and no mark taken away."""
    lat, lon, alt = house.origin
    marks = tuple(Sighting(0, keyframe_seq=seq, uv_px=(9.0, 9.0)) for seq in range(10, 30))
    survey = [
        SurveyPoint(f"P{k}", lat, lon, alt, 0.03, 0.05, False, k, marks) for k in range(MAX_POINTS)
    ]
    assert sum(len(p.sightings) for p in survey) == MAX_MARKS
    flown(house, tmp_path, True)
    kept = tmp_path / "drone-1" / "test-1" / GCP
    kept.write_text(survey_text(survey))
    with serving(tmp_path) as client:
        one_more = {"name": "P0", "keyframe_seq": 1, "uv_px": [9.0, 9.0]}
        status, said, _ = client.ask(POINTS, "POST", one_more)
    assert status == 400 and f"{MAX_MARKS} marks" in said["error"], said
    assert kept.read_text() == survey_text(survey)
