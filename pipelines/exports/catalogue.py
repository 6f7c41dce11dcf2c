"""All exports: one line for each. A file of that name in `pipelines.exports.kinds` holds the rest.

Light, as the API and the registry read it: no torch, numpy or open3d is loaded.
"""

from __future__ import annotations

import importlib

from pipelines.exports.export import Export

KINDS = (
    "mesh",
    "pointcloud",
    "video",
    "cameras",
    "dataset",
    "views",
    "meshvideo",
)
"""In the order in which they are listed and, where nothing runs side by side, made."""


def _record(kind: str) -> Export:
    export: Export = importlib.import_module(f"pipelines.exports.kinds.{kind}").EXPORT
    return export


EXPORTS: tuple[Export, ...] = tuple(_record(kind) for kind in KINDS)

_BY_KIND = {export.kind: export for export in EXPORTS}


def get_export(kind: str) -> Export:
    """The export of that kind. Raises KeyError for an unknown one."""
    return _BY_KIND[kind]
