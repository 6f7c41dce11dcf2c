"""Photos that were taken outdoors by day, told by their exposure."""

from __future__ import annotations

import pytest

from pipelines.captures.daylight import is_daylight
from pipelines.captures.record import CaptureRecord


def capture(*exposures: float | None) -> CaptureRecord:
    images = [
        {"file": f"images/{number}.jpg", "exif": {} if it is None else {"exposure_value": it}}
        for number, it in enumerate(exposures)
    ]
    return CaptureRecord("images", "photos.zip", "0", len(images), images=images)


@pytest.mark.parametrize(
    ("exposures", "expected"),
    [
        ((13.0, 14.5, 12.1), True),  # in the sun, and in the shade
        ((12.0, 12.2, None, None), True),
        ((5.3, 5.9, 7.0), False),  # in a room
        ((6.4, 7.7, 7.7, 11.0), False),  # in a room that the sun shines into
        ((14.0, None, None), False),  # of most photos nothing is known
        ((None, None), False),
        ((), False),
    ],
)
def test_most_photos_are_exposed_for_daylight(
    exposures: tuple[float | None, ...], expected: bool
) -> None:
    assert is_daylight(capture(*exposures)) is expected


def test_photos_without_a_record_of_their_exif_say_nothing() -> None:
    """As captures that came with poses have them."""
    listed = CaptureRecord("nerfstudio", "a.zip", "0", 1, images=[{"file": "images/1.png"}])
    assert is_daylight(listed) is False
