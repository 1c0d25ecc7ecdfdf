"""The small JPEG of each whole keyframe: within its budget, over the link, in the store."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from recon.types import U8
from service.ground.intake import SMALL, ScanIntake
from service.stream.codec import (
    IMAGE_STEPS,
    MAX_IMAGE_BYTES,
    encode,
    encode_image,
    is_image,
    whole_bgr,
)
from service.stream.messages import Head, Held, parse, split
from service.stream.outbox import Outbox, Outgoing
from service.stream.ranges import RangeSet
from service.stream.records import ScanHeader
from service.stream.store import ScanStore

if TYPE_CHECKING:
    from house_flight import HouseFlight

HEADER = ScanHeader("scan", "drone", 1_700_000_000_000_000_000)


def ground(w: int = 640, h: int = 480) -> U8:
    """An image with texture of all sizes, as ground from above."""
    rng = np.random.default_rng(5)
    out = np.zeros((h, w, 3), np.float32)
    for side in (8, 32, 128):
        noise = rng.normal(0, 25, (side * 3 // 4, side, 1)).astype(np.float32)
        out += cv2.resize(noise, (w, h), interpolation=cv2.INTER_CUBIC)[..., None]
    return np.clip(out + 120, 0, 255).astype(np.uint8)


def test_the_best_image_within_the_budget() -> None:
    bgr = ground()
    best, smallest = encode_image(bgr, 1e9), encode_image(bgr, 0)
    room = (len(best) + len(smallest)) // 2
    between = encode_image(bgr, room)
    assert len(smallest) < len(between) <= room < len(best)
    shown = cv2.imdecode(np.frombuffer(best, np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None and shown.shape == (240, 320, 3)
    whole = cv2.resize(bgr, (320, 240), interpolation=cv2.INTER_AREA)
    assert cv2.PSNR(shown, whole) > 30.0


def test_no_blocks_are_seen_and_more_of_the_truth(house: HouseFlight) -> None:
    true, size = ground(640, 360), (160, 90)
    one = house.keyframe(0, 0.0)
    old = replace(one, fresh=np.zeros_like(one.fresh), bgr=np.zeros_like(one.bgr))
    for room in (0.0, 1e9):
        data = encode_image(true, room)
        plain = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert plain is not None
        plain = cv2.resize(plain, size, interpolation=cv2.INTER_CUBIC)
        small = cv2.resize(true, size, interpolation=cv2.INTER_AREA)
        assert cv2.PSNR(whole_bgr(old, data), small) > cv2.PSNR(plain, small) + 0.3


@pytest.mark.parametrize(("w", "h"), [(1, 1), (1, 2000), (40, 30), (720, 1280)])
def test_images_of_any_shape(house: HouseFlight, w: int, h: int) -> None:
    data = encode_image(np.zeros((h, w, 3), np.uint8), 1e9)
    assert is_image(data)
    shown = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None and max(shown.shape) <= IMAGE_STEPS[0][0]
    one = house.keyframe(0, 0.0)
    assert whole_bgr(one, data).shape == one.bgr.shape


def test_what_is_no_image_of_a_keyframe() -> None:
    sound = encode_image(ground(), 1e9)
    large = cv2.imencode(".jpg", np.zeros((2000, 8, 3), np.uint8))[1].tobytes()
    bombs = b"", b"\xff\xd8", sound[2:], large, sound + bytes(MAX_IMAGE_BYTES)
    assert is_image(sound) and not any(map(is_image, bombs))


def test_the_store_keeps_images_and_an_older_scan_has_none(tmp_path: Path) -> None:
    image = encode_image(ground(), 3000)
    heard: list[tuple[str, int]] = []
    with ScanStore.create(tmp_path / "a.db", HEADER) as store:
        store.listen(lambda kind, number: heard.append((kind, number)))
        store.add_keyframe(3, (), image)
        assert heard == [("image", 3)]
        assert store.seqs() == [] and store.states() == {}  # an image alone is no keyframe
        with pytest.raises(ValueError, match="image of keyframe 4"):
            store.add_keyframe(4, (), b"text")
        assert not store.put_record("image", 3, image)
        assert not store.put_record("image", 5, image[2:])
    with ScanStore.open(tmp_path / "a.db", read_only=True) as store:
        assert store.image(3) == image and store.image(4) is None
        assert store.numbers() == {"header": store.numbers()["header"], "image": RangeSet([(3, 3)])}


def test_over_the_quota_there_is_no_image(tmp_path: Path) -> None:
    with ScanStore.create(tmp_path / "a.db", HEADER, quota_bytes=100) as store:
        assert not store.put_record("image", 0, encode_image(ground(), 3000))
        assert store.refused == 1 and store.image(0) is None


def test_an_image_goes_over_the_link_before_the_detail(tmp_path: Path, house: HouseFlight) -> None:
    image = encode_image(ground(), 3000)
    with (
        ScanStore.create(tmp_path / "drone.db", HEADER) as onboard,
        ScanStore.create(tmp_path / "ground.db", HEADER) as station,
    ):
        outbox = Outbox(1e6, 0.0)
        outbox.add(onboard, 0.0)
        outbox.on_held(onboard.header.name, "base", Held({}), 0.0)
        onboard.listen(lambda kind, number: outbox.on_item("scan", kind, number, 0.0))
        one = house.keyframe(0, 0.0)
        onboard.add_keyframe(0, encode(one, one.time_ns), image)
        intake = ScanIntake(station, "base")
        intake.on_head(Head(onboard.numbers()), 0.0)
        now, kinds = 0.0, []
        while intake.missing().keys() & {"k0", "k1", "image"}:
            now += 0.05
            message = outbox.next(now)
            if isinstance(message, Outgoing) and message.topic != "head":
                kinds += [part.kind for part in parse(message.payload)]
                intake.on_items(message.payload, now)
        assert list(dict.fromkeys(kinds)) == ["k0", "image", "k1"]
        assert station.image(0) == image


def test_a_missing_image_is_asked_for_with_the_small_records(tmp_path: Path) -> None:
    image = encode_image(ground(), 3000)
    with ScanStore.create(tmp_path / "ground.db", HEADER) as station:
        intake = ScanIntake(station, "base")
        intake.on_head(Head({"image": RangeSet([(0, 1)])}), 0.0)
        wanted = intake.next_ask(SMALL, 2.0)
        assert wanted is not None and wanted[0] == "image" and list(wanted[1]) == [0, 1]
        for part in split("image", 1, image, 500):
            intake.on_items(part.pack(), 2.1)
        assert station.image(1) == image and list(intake.missing()["image"]) == [0]
