"""The methods: a new one is a file in `options/methods`, its model, and a line here."""

from __future__ import annotations

from pipelines.nerf.options.methods.instant_ngp import INSTANT_NGP
from pipelines.nerf.options.methods.nerf import NERF
from pipelines.nerf.options.methods.nerfacto import NERFACTO
from pipelines.nerf.options.parts import bad_option
from pipelines.nerf.plugins import Method, plugin_methods

BUILT_IN_METHODS = (
    NERFACTO,
    INSTANT_NGP,
    NERF,
)


def methods() -> dict[str, Method]:
    """Every method by name, the built-in ones first. Raises NerfError `bad_plugin`."""
    built_in = {method.name: method for method in BUILT_IN_METHODS}
    return built_in | plugin_methods(built_in)


def find_method(name: str) -> Method:
    """The method of a name. Raises NerfError `bad_config` with the names there are."""
    known = methods()
    if name not in known:
        raise bad_option("train.method", name, ", ".join(known))
    return known[name]
