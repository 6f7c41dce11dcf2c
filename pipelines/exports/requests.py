"""Exports that are asked for on their own, months after the job: their options.

Light: the API checks requests with it. The stage that makes such an export is the job's own.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from pipelines.exports.catalogue import get_export
from pipelines.option_models import StageOptions, merge
from pipelines.options import OptionsError, laid_over
from pipelines.presets import PRESETS

_SWITCH = "enabled"
"""The option of kinds that jobs may be told to leave out."""


def resolve_export(
    kind: str, preset: str, job_options: Mapping[str, Any], given: Mapping[str, Any]
) -> dict[str, Any]:
    """Complete, checked, JSON-able options of one export.

    preset: the job's. job_options: what the job itself has for this kind, which `given` is laid
    over: an export without options is what the job makes. Of two ways to say one thing the job's
    gives way to the one that is given. Where the job's are of an older version and no longer valid,
    the preset's take their place. given: may be anything that JSON can be.
    Raises OptionsError naming each wrong option, KeyError for an unknown kind.
    """
    model = get_export(kind).options
    base = _base(kind, model, preset, job_options)
    if _SWITCH in model.model_fields:
        if given.get(_SWITCH, True) is False:
            raise OptionsError([(f"{kind}.{_SWITCH}", "an export that is asked for is made")])
        base[_SWITCH] = True
    try:
        laid = laid_over(kind, model, base, dict(given))
        return model.model_validate(laid).model_dump(mode="json")
    except ValidationError as error:
        raise OptionsError(
            [
                (".".join(str(part) for part in (kind, *item["loc"])), item["msg"])
                for item in error.errors()
            ]
        ) from error


def _base(
    kind: str, model: type[StageOptions], preset: str, job_options: Mapping[str, Any]
) -> dict[str, Any]:
    """What stands where the request says nothing."""
    defaults = model().model_dump(mode="json")
    try:
        own = merge(defaults, model.completed(job_options))
        return model.model_validate(own).model_dump(mode="json")
    except ValidationError:
        known = PRESETS[preset].overrides.get(kind, {}) if preset in PRESETS else {}
        return model.model_validate(merge(defaults, known)).model_dump(mode="json")
