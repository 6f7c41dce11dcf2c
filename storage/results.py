"""What a job's stages have made, and whether it goes together.

A stage keeps what its last success published until it has succeeded anew: its row goes on naming
it (`output_prefix`, `manifest`, `fingerprint`, `summary`) while the job is retried, and afterwards
where the retry was cancelled, or failed. `storage.transitions.put_back` makes it the stage's result
again. So it is kept from the sweep, too.
"""

from __future__ import annotations

from collections.abc import Iterable

from storage.models import StageRow


def is_offered(row: StageRow) -> bool:
    """Whether what the stage last published is there to be had: it is not about to be made anew."""
    return row.state in ("succeeded", "failed", "cancelled") and row.output_prefix is not None


def fitting(stages: Iterable[StageRow]) -> dict[str, StageRow]:
    """The stages, by name, whose results go together.

    stages: in order. What a stage had made before fits as long as all that it was made of is what
    the job has now: the `inputs` of its manifest name the `content` of each. One without content is
    the report of a failure, as workers of earlier versions leave it.
    """
    rows = {row.name: row for row in stages}
    fit: dict[str, StageRow] = {}
    for row in rows.values():
        if is_offered(row) and (row.state == "succeeded" or _fits(row, rows, fit)):
            fit[row.name] = row
    return fit


def _fits(row: StageRow, rows: dict[str, StageRow], fit: dict[str, StageRow]) -> bool:
    made = row.manifest or {}
    inputs = made.get("inputs", {})
    return "content" in made and all(
        name in fit and (fit[name].manifest or {}).get("content") == content
        for name, content in inputs.items()
        if name in rows  # else the upload, or of the job that this one is an export of
    )
