"""COLMAP through pycolmap: features, matches, sparse models; plain arrays come out.

A `Reconstructor` owns one database. Images enter under names that are their index ("000012.jpg"),
so that no name in a capture can upset a pair list. pycolmap blocks for minutes: each call runs in
a thread while the calling thread reports what is done through a `Watch`, and ends the call by its
cancellation token where the watch raises. Learned features are not offered: the wheel aborts the
process when asked for them. Run this in a process that may die.

While pycolmap has the database open, nothing else in the process may: Python's sqlite3 is a second
copy of SQLite, and two copies break each other's file locks (the process ends with SIGBUS; see
"Multiple copies of SQLite linked into the same application" at sqlite.org/howtocorrupt.html).
So images and pairs are given to pycolmap in portions, and done portions are counted.

Axes here are COLMAP's: cameras look along +Z, +Y down. Pixel centres lie at (0.5, 0.5), as ours.
"""

from __future__ import annotations

import copy
import os
import shutil
import tempfile
import uuid
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
from PIL import Image

from pipelines.errors import ToolError
from pipelines.tools.colmap_adjustment import Run
from pipelines.tools.colmap_lenses import LensTrials, name_unbent
from pipelines.tools.colmap_placing import num_tidying_steps, place_others
from pipelines.tools.colmap_probing import (
    MatchedPairs,
    forget_pairs,
    give_own_camera,
    set_lens,
    start_focal,
)
from pipelines.tools.colmap_results import (
    Correspondences,
    PairStatistics,
    SparseModel,
    VerifiedMatches,
    read_correspondences,
    read_features,
    read_matches,
    read_statistics,
    sparse_model,
)
from pipelines.tools.colmap_settings import (
    CameraGroup,
    FeatureSettings,
    MapperSettings,
    extraction_options,
    mapping_options,
    verification_options,
)
from pipelines.tools.colmap_tracks import StoredTracks

Watch = Callable[[int], None]
"""Called every half second with the number of items done; what it raises ends the call."""

_POLL_S = 0.5
_IMAGE_PORTION = 8
_MOST_TIMES, _FEW = 5, 40
"""How often mapping may place each image, on the average, as if there were so many more; twice as
often where models may overlap as far as they lead, as ten may hold all. Where a lens runs away,
COLMAP begins up to 200 models that all fall to pieces."""
_PAIR_TILE = 12
"""Pairs are taken in tiles of 12 x 12 images, whose features then stay in memory."""
_PAIR_PORTION = 72
"""Pairs matched in one call, which nobody hears of before it ends: 2 seconds at `preview` sizes."""
PER_IMAGE, SINGLE = pycolmap.CameraMode.PER_IMAGE, pycolmap.CameraMode.SINGLE


class Reconstructor:
    """Features, matches and models of one list of images.

    database: COLMAP's database, made where it is missing. images: in the order that indices mean.
    scratch: a folder for links and models, no longer needed afterwards. masks: by the indices of
    their images, pictures of the same size: no features are found where they are black.
    """

    def __init__(
        self,
        database: Path,
        images: Sequence[Path],
        scratch: Path,
        *,
        num_threads: int = -1,
        seed: int = 0,
        masks: Mapping[int, Path] | None = None,
    ) -> None:
        pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR.value)
        self.database = database
        self.scratch = scratch
        self.num_threads = num_threads
        self.seed = seed
        self.names = [f"{i:06d}{path.suffix.lower()}" for i, path in enumerate(images)]
        self.links = scratch / "images"
        self.links.mkdir(parents=True, exist_ok=True)
        for name, path in zip(self.names, images, strict=True):
            _name_again(path.resolve(), self.links / name)
        self.masks = scratch / "masks" if masks else None
        if masks and self.masks is not None:
            self.masks.mkdir(exist_ok=True)
            for index, name in enumerate(self.names):
                link = self.masks / f"{name}.png"
                if index in masks:
                    _name_again(masks[index].resolve(), link)
                else:  # COLMAP reads no image without
                    _hide_nothing(self.links / name, link)

    def on(self, database: Path) -> Reconstructor:
        """The same images with another database."""
        other = copy.copy(self)
        other.database = database
        return other

    def without_pairs(self, pairs: Iterable[tuple[int, int]]) -> Reconstructor:
        """The same images with a copy of the database, in the scratch folder, in which these pairs
        never matched: to map by the others. Not while a call runs."""
        other = self.on(self.scratch / f"without-{uuid.uuid4().hex}.db")
        shutil.copyfile(self.database, other.database)
        forget_pairs(other.database, self.names, pairs)
        return other

    def with_cameras(self, cameras: Iterable[tuple[Sequence[int], float]]) -> Reconstructor:
        """The same images with a copy of the database, in the scratch folder, in which some have
        cameras of their own, as `give_own_camera` gives them. Not while a call runs."""
        other = self.on(self.scratch / f"cameras-{uuid.uuid4().hex}.db")
        shutil.copyfile(self.database, other.database)
        for indices, scale in cameras:
            other.give_own_camera(indices, scale)
        return other

    def count_features(self, indices: Sequence[int], settings: FeatureSettings) -> list[int]:
        """How many features a few images would get; the database is left as it is."""
        probe = self.scratch / "probe.db"
        probe.unlink(missing_ok=True)
        names = [self.names[index] for index in indices]
        reader, options = self._reader(), extraction_options(settings)
        self.on(probe)._extract_portion(names, reader, options, PER_IMAGE, lambda _done: None, 0)
        counts = read_statistics(probe, len(self.names)).num_features
        return [int(counts[index]) for index in indices]

    def extract(
        self, groups: Sequence[CameraGroup], settings: FeatureSettings, watch: Watch
    ) -> None:
        """Find SIFT features in every image; images of a group share one camera."""
        options = extraction_options(settings)
        step = max(_IMAGE_PORTION, 4 * settings.num_threads)
        done = 0
        for group in groups:
            reader = self._reader()
            reader.camera_model = group.lens
            reader.camera_params = self._prior_params(group)
            for first in range(0, len(group.indices), step):
                portion = group.indices[first : first + step]
                names = [self.names[index] for index in portion]
                self._extract_portion(names, reader, options, SINGLE, watch, done)
                done += len(portion)
                if first == 0 and done < len(self.names):
                    reader.existing_camera_id = self._camera_of(names[0])
        watch(done)

    def _reader(self) -> Any:
        """How COLMAP reads images."""
        reader = pycolmap.ImageReaderOptions()
        if self.masks is not None:
            reader.mask_path = self.masks
        return reader

    def _extract_portion(
        self, names: list[str], reader: Any, options: Any, cameras: Any, watch: Watch, done: int
    ) -> None:
        """Features of a few images. cameras: whether they share the reader's camera.

        They are put into the database first, one after another: what COLMAP's threads are done with
        first would else be numbered first, and verified as the first of a pair, so that two runs
        would not agree.
        """
        if not self.database.exists():
            pycolmap.Database.open(self.database).close()
        self._run(
            "reading images",
            lambda _token: pycolmap.import_images(
                self.database, self.links, camera_mode=cameras, image_names=names, options=reader
            ),
            lambda: watch(done),
        )
        self._run(
            "finding features",
            lambda token: pycolmap.extract_features(
                self.database,
                self.links,
                image_names=names,
                camera_mode=cameras,
                reader_options=reader,
                extraction_options=options,
                cancellation_token=token,
            ),
            lambda: watch(done),
        )

    def match(
        self, pairs: Iterable[tuple[int, int]], watch: Watch, *, thorough: bool = False
    ) -> None:
        """Match and verify pairs of indices; those already in the database are not done again.

        thorough: as many random trials as COLMAP's default, for pairs with few true matches.
        watch: receives the number of these pairs that are done.
        """
        verification = verification_options(self.seed, thorough=thorough)
        ordered = sorted(
            pairs, key=lambda pair: (pair[0] // _PAIR_TILE, pair[1] // _PAIR_TILE, pair)
        )
        for first in range(0, len(ordered), _PAIR_PORTION):
            portion = ordered[first : first + _PAIR_PORTION]
            self._match_portion(portion, verification, watch, first)
        watch(len(ordered))

    def _match_portion(
        self, pairs: list[tuple[int, int]], verification: Any, watch: Watch, done: int
    ) -> None:
        """Match and verify a few pairs."""
        listed = self.scratch / "pairs.txt"
        listed.write_text("".join(f"{self.names[i]} {self.names[j]}\n" for i, j in pairs), "utf-8")
        matching = pycolmap.FeatureMatchingOptions()
        matching.num_threads = self.num_threads
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = listed
        self._run(
            "matching images",
            lambda token: pycolmap.match_image_pairs(
                self.database,
                matching_options=matching,
                pairing_options=pairing,
                verification_options=verification,
                cancellation_token=token,
            ),
            lambda: watch(done),
        )

    def map(
        self, settings: MapperSettings, watch: Watch, only: Sequence[int] = ()
    ) -> list[SparseModel]:
        """Incremental mapping with its bundle adjustments: all models, in COLMAP's order.

        watch: receives the number of images placed so far. only: these images, all where none is
        named. Where models fall to pieces again and again, those that there are after _MOST_TIMES
        as many placings as images are all.
        """
        output = Path(tempfile.mkdtemp(prefix="models-", dir=self.scratch))
        options = mapping_options(settings, self.num_threads, self.seed)
        options.image_names = [self.names[index] for index in only]
        times = _MOST_TIMES * (2 if settings.thorough else 1)
        most = times * ((len(only) or len(self.names)) + _FEW)
        placed = 0

        def mapped(token: Any) -> Any:
            def count_one() -> None:
                nonlocal placed
                placed += 1
                if placed >= most:
                    token.cancel()

            try:
                return pycolmap.incremental_mapping(
                    self.database,
                    self.links,
                    output,
                    options=options,
                    next_image_callback=count_one,
                    cancellation_token=token,
                )
            except InterruptedError:
                if placed < most:
                    raise
                made = sorted(int(path.parent.name) for path in output.glob("*/images.bin"))
                return {number: pycolmap.Reconstruction(output / str(number)) for number in made}

        found = self._run("mapping", mapped, lambda: watch(min(placed, len(self.names))))
        if not (settings.refine_distortion or only):
            for number, model in found.items():
                name_unbent(model)
                model.write(output / str(number))
        return [
            sparse_model(model, output / str(number))
            for number, model in found.items()
            if model.num_reg_images() > 1
        ]

    def place(
        self, model: SparseModel, settings: MapperSettings, watch: Watch, tidied: Watch
    ) -> SparseModel:
        """A model that `map` found with all other images that can be placed on it, not adjusted.

        watch: receives the number of images placed so far. tidied: then the steps that are done, of
        `num_tidying_steps`.
        """
        if model.stored is None:
            raise ValueError("the model was not written by COLMAP")
        whole = Path(tempfile.mkdtemp(prefix="placed-", dir=self.scratch))
        found = place_others(
            self.database,
            model.stored,
            mapping_options(settings, self.num_threads, self.seed),
            links=self.links,
            placed=watch,
            tidied=tidied,
        )
        if not settings.refine_distortion:
            name_unbent(found)
        found.write(whole)
        steps = num_tidying_steps(len(self.names))
        tidied(steps - 1)
        read = sparse_model(found, whole)
        tidied(steps)
        return read

    def lens_trials(
        self,
        model: SparseModel,
        watch: Watch,
        *,
        refine_principal_point: bool,
        every_image: bool = False,
    ) -> LensTrials:
        """Trials of other lenses on a model that `map` found. watch: see `runner`. every_image: as
        in `LensTrials`."""
        if model.stored is None:
            raise ValueError("the model was not written by COLMAP")
        return LensTrials(
            model.stored,
            refine_principal_point=refine_principal_point,
            num_threads=self.num_threads,
            seed=self.seed,
            run=self.runner(watch),
            every_image=every_image,
        )

    def matched(self, pairs: Sequence[tuple[int, int]]) -> MatchedPairs:
        """Matches of pairs that were matched, to compare lenses by. Not while a call runs."""
        return MatchedPairs(self.database, self.names, pairs, self.seed)

    def set_lens(self, indices: Sequence[int], lens: str, focal_px: float) -> None:
        """Give images of one camera another lens, of known focal length. Not while a call runs.

        Their pairs must be matched again, which only verifies what was matched before.
        """
        set_lens(self.database, self.names, indices, lens, focal_px)

    def give_own_camera(self, indices: Sequence[int], scale: float) -> None:
        """Give images of one camera another one, see `colmap_probing`. Not while a call runs."""
        give_own_camera(self.database, self.names, indices, scale)

    def start_focal(self, indices: Sequence[int], long_sides: float) -> int:
        """Let `map` start from a focal length where none is known, see `colmap_probing`. Not while
        a call runs."""
        return start_focal(self.database, self.names, indices, long_sides)

    def stored_tracks(self, model: SparseModel, watch: Watch) -> StoredTracks:
        """The tracks of a model that `map` found. watch: see `runner`."""
        if model.stored is None:
            raise ValueError("the model was not written by COLMAP")
        return StoredTracks(model.stored, num_threads=self.num_threads, run=self.runner(watch))

    def runner(self, watch: Watch) -> Run:
        """What runs long calls of pycolmap beside `watch`, whose errors end them.

        watch: receives the number of calls that have ended, also after each: an adjustment does not
        let another thread run meanwhile.
        """
        ended = 0

        def run(what: str, call: Callable[[Any], Any]) -> Any:
            nonlocal ended
            result = self._run(what, call, lambda: watch(ended))
            ended += 1
            watch(ended)
            return result

        return run

    def correspondences(self) -> Correspondences:
        """All verified matches, by features. Not while another call runs."""
        return read_correspondences(self.database, len(self.names))

    def statistics(self) -> PairStatistics:
        """What extraction and matching put into the database. Not while another call runs."""
        return read_statistics(self.database, len(self.names))

    def verified(self, most_pairs: int | None, most_matches: int) -> VerifiedMatches:
        """Verified matches of some pairs (None: of all), see `read_matches`. Not while another call
        runs."""
        return read_matches(self.database, len(self.names), most_pairs, most_matches)

    def verified_of(self, pairs: Iterable[tuple[int, int]]) -> VerifiedMatches:
        """All verified matches of these pairs. Not while another call runs."""
        wanted = set(pairs)
        found = read_matches(self.database, len(self.names))
        return {pair: places for pair, places in found.items() if pair in wanted}

    def features(self, per_image: int) -> list[npt.NDArray[np.uint8]]:
        """Descriptors of every image, [at most per_image, 128]. Not while another call runs."""
        return read_features(self.database, len(self.names), per_image)

    def _prior_params(self, group: CameraGroup) -> str:
        """Parameters of the group's camera where its focal length is known, as COLMAP reads them.

        Their presence makes COLMAP set `has_prior_focal_length`.
        """
        if group.focal_px is None:
            return ""
        with Image.open(self.links / self.names[group.indices[0]]) as image:
            camera = pycolmap.Camera.create_from_model_name(
                0, group.lens, group.focal_px, *image.size
            )
        return ",".join(f"{value:.6f}" for value in camera.params)

    def _camera_of(self, name: str) -> int:
        """COLMAP's id of the camera of an image in the database; -1 where it was not readable."""
        with pycolmap.Database.open(self.database) as database:
            image = database.read_image_with_name(name)
            return -1 if image is None else int(image.camera_id)

    def _run(
        self,
        what: str,
        call: Callable[[Any], Any],
        poll: Callable[[], None],
    ) -> Any:
        """Run `call(token)` in a thread and `poll` here, until the call ends or `poll` raises."""
        token = pycolmap.CancellationToken()
        with ThreadPoolExecutor(max_workers=1, thread_name_prefix="colmap") as executor:
            future = executor.submit(call, token)
            try:
                while not wait([future], timeout=_POLL_S).done:
                    poll()
            finally:
                if not future.done():
                    token.cancel()
        try:
            return future.result()
        except (RuntimeError, ValueError, IndexError) as error:
            raise ToolError(
                f"COLMAP failed while {what} of {len(self.names)} images.",
                details={"log": str(error).splitlines()[-20:]},
            ) from error


def _hide_nothing(image: Path, mask: Path) -> None:
    """Write a mask of an image's size that is white all over."""
    with Image.open(image) as opened:
        Image.new("L", opened.size, 255).save(mask)


def _name_again(path: Path, link: Path) -> None:
    """A second name of a file. A contained stage makes no symbolic links, and links of the other
    kind lead to no other disk."""
    if os.path.lexists(link):
        return
    try:
        os.link(path, link)
    except OSError:
        link.symlink_to(path)
