"""Text that callers send and the database is asked with: ids, labels, stored text.

Whatever has not the form of an id names nothing: it is a 404 before any database sees it.
"""

from __future__ import annotations

import re
from typing import Annotated, Any

from pydantic import AfterValidator, Field, StringConstraints

from storage.errors import NotFoundError
from storage.models import ID_LENGTH, is_id

_LABEL_KEY = re.compile(r"[A-Za-z0-9][A-Za-z0-9._/-]{0,62}")
_SHAPE = Field(json_schema_extra={"pattern": f"^[0-9a-f]{{{ID_LENGTH}}}$"})
MAX_LABELS = 50


def _job_id(text: str) -> str:
    if not is_id(text):
        raise NotFoundError("job", text)
    return text


def _capture_id(text: str) -> str:
    if not is_id(text):
        raise NotFoundError("capture", text)
    return text


def _storable(text: str) -> str:
    if "\0" in text or (not text.isascii() and any("\ud800" <= sign <= "\udfff" for sign in text)):
        raise ValueError("text holds no NUL and no half of a surrogate pair")
    return text


def _label_key(key: str) -> str:
    if not _LABEL_KEY.fullmatch(key):
        raise ValueError(
            "a label's key has 1 to 63 letters, digits, dots, dashes, underscores or slashes"
        )
    return key


def _label_filter(text: str) -> str:
    _label_key(text.partition("=")[0])
    return _storable(text)


def _storable_json(value: Any) -> Any:
    left = [value]
    while left:
        one = left.pop()
        if isinstance(one, str):
            _storable(one)
        elif isinstance(one, dict):
            left += [*one, *one.values()]
        elif isinstance(one, list):
            left += one
    return value


JobId = Annotated[str, _SHAPE, AfterValidator(_job_id)]
CaptureId = Annotated[str, _SHAPE, AfterValidator(_capture_id)]
LabelFilter = Annotated[str, StringConstraints(max_length=400), AfterValidator(_label_filter)]
"""KEY, or KEY=VALUE."""
LabelKey = Annotated[str, AfterValidator(_label_key)]
LabelValue = Annotated[str, StringConstraints(max_length=255), AfterValidator(_storable)]
JsonObject = Annotated[dict[str, Any], AfterValidator(_storable_json)]
Labels = Annotated[dict[LabelKey, LabelValue], Field(max_length=MAX_LABELS)]
