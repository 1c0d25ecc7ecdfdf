"""A scan's place, by its header."""

from __future__ import annotations

from dataclasses import replace

import pytest

from service.georeference import LocalFrame
from service.scans.track import heights_above, local_frame
from service.stream.records import ScanHeader

HEADER = ScanHeader("scan-1", "drone", 1, origin_lat_deg=47.0, origin_lon_deg=8.0)


@pytest.mark.parametrize("missing", ["origin_lat_deg", "origin_lon_deg"])
def test_half_an_origin_is_no_georeference(missing: str) -> None:
    assert local_frame(HEADER) == LocalFrame(47.0, 8.0, 0.0)
    assert local_frame(replace(HEADER, **{missing: None})) is None  # type: ignore[arg-type]


def test_heights_are_above_the_datum_that_is_named_or_the_sea_or_the_origin() -> None:
    frame = local_frame(HEADER)
    assert heights_above(frame, "EGM2008", False) == "metres above EGM2008"
    assert heights_above(frame, None, False) == "metres above mean sea level"
    for place, lacks in ((frame, True), (None, False)):
        assert heights_above(place, "EGM96", lacks) == "metres above the scan's origin"
