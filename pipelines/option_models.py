"""Options as pydantic models: what all have in common, and models of the library's dataclasses.

`pipelines.nerf` knows nothing of pydantic: its options are dataclasses whose fields carry `help`,
`unit` and bounds in their metadata. `model_of` gives the model with the same fields, defaults and
bounds. No torch is imported.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, create_model

from pipelines.nerf.options.parts import allowed_names
from pipelines.nerf.options.train import TrainConfig, default_train_config
from pipelines.nerf.plugins import Method


class ContradictionError(ValueError):
    """A request that says two things of which one can be done. name: of one of the options."""

    def __init__(self, name: str, problem: str) -> None:
        super().__init__(problem)
        self.name = name


class StageOptions(BaseModel):
    """Common ground: unknown keys are refused, values are checked, instances are frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)

    @classmethod
    def understood(
        cls, base: dict[str, Any], given: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """What lies under a request without what the request takes back of it, and the request
        with what it implies.

        base: complete options, or none. given: not checked yet. Neither is changed. Raises
        ContradictionError.
        """
        return base, given

    @classmethod
    def completed(cls, stored: Mapping[str, Any]) -> dict[str, Any]:
        """Options that a job was stored with, with what stood for those that came later where that
        is not today's default. stored: complete when they were stored; not changed."""
        return dict(stored)


def merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """`base` with the nested keys of `over` laid on top; neither is changed."""
    merged = dict(base)
    for key, value in over.items():
        if isinstance(value, dict) and isinstance(merged.get(key), dict):
            merged[key] = merge(merged[key], value)
        else:
            merged[key] = value
    return merged


def _field_of(
    annotation: Any, field: dataclasses.Field[Any], default: Any = None
) -> tuple[Any, Any]:
    """A dataclass field as pydantic wants it: (annotation, FieldInfo).

    default: plain, in place of the field's own.
    """
    meta = dict(field.metadata)
    description = meta.get("help", "")
    if "unit" in meta:
        description = f"{description} Unit: {meta['unit']}."
    bounds = {key: meta[key] for key in ("ge", "le") if key in meta}
    if "choices" in meta:
        annotation = Literal[allowed_names(meta)]
        bounds = {}
        if "former" in meta:
            annotation = Annotated[annotation, BeforeValidator(partial(_present, meta["former"]))]
    elif typing.get_origin(annotation) is tuple:
        (item, *_) = typing.get_args(annotation)
        item_model = model_of(item) if dataclasses.is_dataclass(item) else item
        inner: Any = Annotated[item_model, Field(**bounds)] if bounds else item_model
        annotation = Annotated[tuple[inner, ...], Field(min_length=1, max_length=8)]
        bounds = {}
    elif dataclasses.is_dataclass(annotation):
        annotation = model_of(annotation)
    if default is None and field.default_factory is not dataclasses.MISSING:
        default = _plain(field.default_factory())
    if default is not None:
        return annotation, Field(default_factory=lambda: default, description=description, **bounds)
    return annotation, Field(default=field.default, description=description, **bounds)


def _present(former: Mapping[str, str], name: Any) -> Any:
    """The name that a choice has now, of one that older versions knew."""
    return former.get(name, name) if isinstance(name, str) else name


def _plain(value: Any) -> Any:
    """A dataclass, or a tuple of them, as plain data."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if isinstance(value, tuple):
        return tuple(_plain(item) for item in value)
    return value


_MODELS: dict[tuple[type, str], type[StageOptions]] = {}


def model_of(cls: Any, method: Method | None = None) -> type[StageOptions]:
    """The pydantic model with the fields, defaults and bounds of a dataclass.

    method: for `TrainConfig`, whose own options its `model` holds.
    """
    key = (cls, "" if method is None else method.name)
    if key not in _MODELS:
        name = cls.__name__.replace("Config", "Options")
        hints = typing.get_type_hints(cls)
        fields: dict[str, Any] = {
            field.name: _field_of(hints[field.name], field) for field in dataclasses.fields(cls)
        }
        if method is not None:
            name += "".join(part.title() for part in method.name.split("-"))
            fields |= _fields_of_method(method)
        _MODELS[key] = create_model(name, __base__=StageOptions, __doc__=cls.__doc__, **fields)
    return _MODELS[key]


def _fields_of_method(method: Method) -> dict[str, Any]:
    """The fields of `TrainConfig` in which one method differs from another."""
    defaults = default_train_config(method.name)
    fields: dict[str, Any] = {
        "method": (Literal[method.name], Field(method.name, description=method.summary)),
        "model": (
            model_of(method.config),
            Field(
                default_factory=lambda: _plain(defaults.model), description="The model's options."
            ),
        ),
    }
    for name in method.train:
        item = next(field for field in dataclasses.fields(TrainConfig) if field.name == name)
        value = _plain(getattr(defaults, name))
        fields[name] = _field_of(typing.get_type_hints(TrainConfig)[name], item, value)
    return fields
