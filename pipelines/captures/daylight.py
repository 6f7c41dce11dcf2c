"""Whether photos were taken outdoors by day, by how they were exposed.

Daylight is so much brighter than any room that nothing else has to be known. Median exposure values
(`Exif.exposure_value`) of nine captures at hand: in rooms 3.6 to 7.0, and 7.7 where the sun shines
in; a castle in sun 12.3, a monument 14.6.
"""

from __future__ import annotations

import statistics

from pipelines.captures.record import CaptureRecord

_LEAST_EXPOSURE = 11.5
_LEAST_KNOWN = 0.5


def is_daylight(capture: CaptureRecord) -> bool:
    """Whether photos are known to be taken so: half of them must say how they were exposed.

    Of a film, and of photos without EXIF, nothing is known.
    """
    said = [image.get("exif", {}).get("exposure_value") for image in capture.images]
    known = [value for value in said if value is not None]
    if not known or len(known) < _LEAST_KNOWN * len(said):
        return False
    return bool(statistics.median(known) >= _LEAST_EXPOSURE)
