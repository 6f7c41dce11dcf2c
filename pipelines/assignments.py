"""`stage.option=value`, as people write options on a command line. Standard library only."""

from __future__ import annotations

import json
from typing import Any


class AssignmentError(ValueError):
    """A text that assigns nothing. text: what was given."""

    def __init__(self, text: str) -> None:
        super().__init__(f"{text}: expected stage.option=value")
        self.text = text


def parse_assignments(assignments: list[str]) -> dict[str, Any]:
    """`["train.max_steps=500"]` as nested options. Values are JSON where they parse as JSON.

    Raises AssignmentError for a text without "=", without a stage, or that assigns to what another
    one gave a value.
    """
    nested: dict[str, Any] = {}
    for text in assignments:
        path, equals, raw = text.partition("=")
        keys = path.strip().split(".")
        if not equals or len(keys) < 2 or not all(keys):
            raise AssignmentError(text)
        try:
            value: Any = json.loads(raw)
        except (json.JSONDecodeError, RecursionError):
            value = raw
        level = nested
        for key in keys[:-1]:
            level = level.setdefault(key, {})
            if not isinstance(level, dict):
                raise AssignmentError(text)
        level[keys[-1]] = value
    return nested
