"""The formats of captures that are read: a new one is a file in `importers/` and a line here.

The API loads this file and all importers: standard library only.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable

from pipelines.captures.contents import Contents
from pipelines.captures.importer import Claim, Importer, Listing
from pipelines.captures.importers import (
    blender,
    colmap,
    llff,
    metashape,
    nerfstudio,
    opensfm,
    photos,
    polycam,
    realitycapture,
    record3d,
    rgbd,
    scanner_app,
    stray_scanner,
    video_file,
    video_files,
    visualsfm,
)
from pipelines.captures.unpack import CaptureArchive

IMPORTERS: tuple[Importer, ...] = (
    video_file.IMPORTER,
    nerfstudio.IMPORTER,
    blender.IMPORTER,
    record3d.IMPORTER,
    polycam.IMPORTER,
    scanner_app.IMPORTER,
    stray_scanner.IMPORTER,
    opensfm.IMPORTER,
    metashape.IMPORTER,
    realitycapture.IMPORTER,
    colmap.IMPORTER,
    visualsfm.IMPORTER,
    llff.IMPORTER,
    rgbd.IMPORTER,
    video_files.IMPORTER,
    photos.IMPORTER,
)
"""In order of precedence: the first that claims an upload reads it. `photos` takes any picture."""

KINDS: tuple[str, ...] = tuple(importer.kind for importer in IMPORTERS)


def importer_of(kind: str) -> Importer:
    """The importer of a kind. Raises KeyError for an unknown one."""
    for importer in IMPORTERS:
        if importer.kind == kind:
            return importer
    raise KeyError(kind)


def claimed(listing: Listing) -> tuple[Importer, Claim] | None:
    """The importer that an upload belongs to, and where in it; None where there is none."""
    for importer in IMPORTERS:
        claim = importer.claims(listing)
        if claim is not None:
            return importer, claim
    return None


def load_reader(importer: Importer) -> Callable[[CaptureArchive, Claim], Contents]:
    """Import a format's reader: call it only in the process that runs `ingest`."""
    module_name, _, function_name = importer.read.partition(":")
    reader: Callable[[CaptureArchive, Claim], Contents] = getattr(
        importlib.import_module(module_name), function_name
    )
    return reader
