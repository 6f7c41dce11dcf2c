"""Methods and parts that other packages bring, found through entry points.

A package offers them in its `pyproject.toml`:

    [project.entry-points."nerfworks.methods"]
    mine = "my_package:PLUGINS"

where `PLUGINS` is a `Method`, a `Component`, or a list of both. Names in options then mean these as
well as the built-in ones; a name that is taken twice is refused. No torch is imported here.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from typing import Any

from pipelines.nerf.errors import NerfError

GROUP = "nerfworks.methods"
COMPONENT_KINDS = ("contraction", "spacing", "position_encoding", "direction_encoding")


@dataclass(frozen=True)
class Method:
    """A way to learn a scene: what `train.method` chooses.

    config: a frozen dataclass derived from `options.parts.ModelConfig`, every field made by
        `options.parts.option`.
    model: "module:class" of the `models.base.Model`, built as `class(config, num_train_images)`;
        imported when first built.
    train: what the method wants other than `TrainConfig` has it, as nested plain values.
    """

    name: str
    summary: str
    config: type[Any]
    model: str
    train: Mapping[str, Any] = field(default_factory=dict)

    def build(self, config: Any, num_train_images: int) -> Any:
        """The untrained model."""
        module, _, attribute = self.model.partition(":")
        return getattr(importlib.import_module(module), attribute)(config, num_train_images)


@dataclass(frozen=True)
class Component:
    """A part that an option names.

    kind: one of `COMPONENT_KINDS`. part: what that kind wants:
        "contraction": a `contraction.Contraction`; "spacing": an `intervals.Spacing`;
        "position_encoding": called with the model's options, gives a module from unit points
        [..., 3] to features [..., num_outputs]; "direction_encoding": likewise from unit vectors.
    """

    kind: str
    name: str
    part: Any


@functools.cache
def _found() -> tuple[Method | Component, ...]:
    found: list[Method | Component] = []
    for entry in entry_points(group=GROUP):
        offered = _loaded(entry.name, entry.load)
        items: Iterable[Any] = offered if isinstance(offered, list | tuple) else [offered]
        for item in items:
            is_part = isinstance(item, Component) and item.kind in COMPONENT_KINDS
            if not (isinstance(item, Method) or is_part):
                raise _bad_plugin(entry.name, f"offers {item!r}, neither a Method nor a Component")
            found.append(item)
    return tuple(found)


def _loaded(name: str, load: Callable[[], Any]) -> Any:
    try:
        return load()
    except (ImportError, AttributeError) as error:
        raise _bad_plugin(name, f"cannot be loaded: {error}") from error


def _bad_plugin(name: str, problem: str) -> NerfError:
    return NerfError(
        "bad_plugin",
        f"The entry point {name} of the group {GROUP} {problem}.",
        "Repair or uninstall the package that declares it.",
    )


def forget_plugins() -> None:
    """Look again at the next question: after a package came or went."""
    _found.cache_clear()


def plugin_methods(taken: Iterable[str] = ()) -> dict[str, Method]:
    """Methods of other packages by name.

    taken: names that they may not have. Raises NerfError `bad_plugin`, for a name that is taken
    twice too.
    """
    offered = [(item.name, item) for item in _found() if isinstance(item, Method)]
    return _by_name("method", offered, taken)


def plugin_components(kind: str, taken: Iterable[str] = ()) -> dict[str, Any]:
    """Parts of one kind of other packages by name; as `plugin_methods`."""
    parts = (item for item in _found() if isinstance(item, Component) and item.kind == kind)
    return _by_name(kind, [(item.name, item.part) for item in parts], taken)


def _by_name(kind: str, offered: list[tuple[str, Any]], taken: Iterable[str]) -> dict[str, Any]:
    known, found = set(taken), {}
    for name, item in offered:
        if name in known:
            raise NerfError(
                "bad_plugin",
                f"Several packages offer the {kind} {name}, or it is built in.",
                f"Uninstall one of the packages with entry points in {GROUP}.",
            )
        known.add(name)
        found[name] = item
    return found
