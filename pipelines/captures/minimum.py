"""How many images a capture must have, for every stage that asks. Standard library only.

`ingest` refuses what a later stage would refuse, before anybody waits for that.
"""

from __future__ import annotations

MIN_IMAGES = 8
"""Fewest photos, or frames of a video, that poses are sought for. A path through fewer views is
held together by too few of them; `poses.min_registered` starts from the same number."""

MIN_POSED_IMAGES = 4
"""Fewest images of a capture that brings its poses: what training needs to hold one of them out."""
