"""Pictures out of an archive: decoded to be sure, and written as sRGB without any metadata.

A photo's EXIF may hold where it was taken; only what `pipelines.captures.exif` keeps of it reaches
a later stage, as data. Photos without poses are turned upright by their EXIF orientation; pictures
with poses are not, since their intrinsics speak of the pixels as stored.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import PIL.Image
import PIL.ImageOps

from pipelines.captures.archive_rules import shown
from pipelines.captures.color_profiles import in_srgb
from pipelines.captures.decoders import DAMAGED, open_picture
from pipelines.captures.exif import Exif, read_exif
from pipelines.captures.panorama_files import photo_projection
from pipelines.captures.photo_masks import Meaning, cut_out, fitted
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError

JPEG_QUALITY = 95
_MASK_FOLDERS = ("masks", "cuts")
# Segments of a JPEG that hold nothing private: JFIF and Adobe's note on the colour transform.
_HARMLESS_SEGMENTS = frozenset({"APP0", "APP14"})
_HARMLESS_PNG_KEYS = frozenset({"dpi", "gamma", "srgb", "aspect", "interlace"})


@dataclass(frozen=True)
class Picture:
    """A picture as written.

    file: relative to the stage's folder. source: its name as sent. projection: as its XMP names it,
    "" for a plain view. views: files of those that were cut from it, where it is a panorama. mask:
    file of a one-channel picture of its size, black where it is to be ignored, or None. cut: the
    same, of what it was cut out by, black where nothing stands.
    """

    file: str
    source: str
    width: int
    height: int
    exif: Exif
    projection: str = ""
    views: tuple[str, ...] = ()
    mask: str | None = None
    cut: str | None = None

    def as_dict(self) -> dict[str, Any]:
        """As plain JSON, for `capture.json`."""
        return {
            "file": self.file,
            "source": self.source,
            "width": self.width,
            "height": self.height,
            "exif": self.exif.as_dict(),
            **({"views": list(self.views)} if self.views else {}),
            **({"mask": self.mask} if self.mask else {}),
            **({"cut": self.cut} if self.cut else {}),
        }


def evenly_picked(count: int, most: int) -> list[int]:
    """At most `most` indices of `count`, at even distances, first and last among them."""
    if count <= most:
        return list(range(count))
    if most == 1:
        return [0]
    return [round(step * (count - 1) / (most - 1)) for step in range(most)]


class PictureWriter:
    """Writes pictures of one archive to `out/images`, masks to `out/masks` and `out/cuts`.

    upright: whether the EXIF orientation is applied (photos) or only dropped (posed pictures).
    """

    def __init__(
        self, archive: CaptureArchive, out: Path, *, max_pixels: int, upright: bool
    ) -> None:
        self._archive = archive
        self._out = out
        self._max_pixels = max_pixels
        self._upright = upright
        self._raw = out / ".raw"
        self._without_profile: list[str] = []
        for folder in ("images", *_MASK_FOLDERS):
            (out / folder).mkdir(parents=True, exist_ok=True)

    def close(self) -> None:
        """Remove what was only needed while writing."""
        self._raw.unlink(missing_ok=True)
        for folder in _MASK_FOLDERS:
            if not any((self._out / folder).iterdir()):
                (self._out / folder).rmdir()

    def store(
        self, name: str, number: int, mask: str | None = None, meaning: Meaning = "ignore"
    ) -> Picture:
        """Decode the picture `name` and write it as `images/<number>`.

        mask: the one in the archive that lies beside it (`pipelines.captures.photo_masks`), or
        None; by its meaning the picture is cut out and the mask is written as `cuts/<number>`, or
        it is written as `masks/<number>`.
        Raises CaptureError image_undecodable.
        """
        kind = self._archive.image_format(name)
        self._archive.extract(name, self._raw)
        with self._opened(self._raw, name, kind) as image:
            if mask is None:
                return self._store(image, self._raw, kind, name, number)
            beside = self._mask_beside(mask, name, image)
            if meaning == "cut_out":
                picture = self._store(image, self._raw, kind, name, number, beside)
                return replace(picture, cut=self._write_mask(beside, number, "cuts"))
            picture = self._store(image, self._raw, kind, name, number)
            return replace(picture, mask=self._write_mask(beside, number))

    def store_frame(self, path: Path, label: str, number: int) -> Picture:
        """Write a JPEG that was decoded from a film, as `store` does. label: what it is called."""
        with self._opened(path, label, "JPEG") as image:
            return self._store(image, path, "JPEG", label, number)

    def _store(
        self,
        image: PIL.Image.Image,
        raw: Path,
        kind: str,
        name: str,
        number: int,
        cut_by: PIL.Image.Image | None = None,
    ) -> Picture:
        """Write an open picture. raw: its file. cut_by: white beyond which it is to be white."""
        exif = read_exif(image)
        projection = photo_projection(image)
        turned = self._upright and exif.orientation not in (None, 1)
        suffix = ".png" if kind == "PNG" else ".jpg"
        file = f"images/{number:05d}{suffix}"
        target = self._out / file
        if not turned and cut_by is None and _is_clean(image, raw):
            shutil.copyfile(raw, target)
            return Picture(file, name, image.width, image.height, exif, projection)
        upright = PIL.ImageOps.exif_transpose(image) if turned else image
        plain = _plain_rgb(self._in_srgb(_eight_bit(upright), name))
        if cut_by is not None:
            plain = cut_out(plain, cut_by)
        if suffix == ".png":
            plain.save(target, "PNG", compress_level=3)
        else:
            plain.save(target, "JPEG", quality=JPEG_QUALITY, subsampling=0)
        return Picture(file, name, plain.width, plain.height, exif, projection)

    def _mask_beside(self, mask: str, name: str, image: PIL.Image.Image) -> PIL.Image.Image:
        """A mask that lies beside the picture `name`, as that is written. image: as it was sent.

        Raises CaptureError image_undecodable.
        """
        path = self._out / ".mask"
        self._archive.extract(mask, path)
        try:
            with self._opened(path, mask, self._archive.image_format(mask)) as opened_mask:
                turn = read_exif(image).orientation
                found = fitted(opened_mask, image.size, turn, upright=self._upright)
        finally:
            path.unlink(missing_ok=True)
        if found is None:
            raise CaptureError(
                f'The mask "{shown(mask)}" has another shape than "{shown(name)}".',
                code="image_undecodable",
                hint="Masks must have the shape of their pictures; ingest.masks=off leaves them.",
            )
        return found

    @property
    def warnings(self) -> list[str]:
        """What is to be told about the pictures stored so far."""
        names = self._without_profile
        if not names:
            return []
        which = f'"{shown(names[0])}"' + (f" and {len(names) - 1} more" if names[1:] else "")
        return [f"The colour profile of {which} cannot be used; taken as sRGB: colours may be off."]

    def store_mask(self, name: str, number: int, size: tuple[int, int]) -> str:
        """Write the mask `name` as a one-channel PNG of `size`; returns its path below `out`.

        Raises CaptureError image_undecodable, also where the size differs.
        """
        self._archive.extract(name, self._raw)
        with self._opened(self._raw, name, self._archive.image_format(name)) as image:
            if image.size != size:
                raise CaptureError(
                    f'The mask "{shown(name)}" is {image.width}x{image.height}, its picture '
                    f"{size[0]}x{size[1]}.",
                    code="image_undecodable",
                    hint="Masks must have the size of their pictures.",
                )
            return self._write_mask(image, number)

    def _write_mask(self, mask: PIL.Image.Image, number: int, folder: str = "masks") -> str:
        """Write a mask without what its file said beside it; returns its path below `out`."""
        file = f"{folder}/{number:05d}.png"
        PIL.Image.frombytes("L", mask.size, mask.convert("L").tobytes()).save(self._out / file)
        return file

    def _in_srgb(self, image: PIL.Image.Image, name: str) -> PIL.Image.Image:
        """The picture's colours as sRGB; with an unusable profile as they are, and noted."""
        try:
            return in_srgb(image)
        except CaptureError as error:
            if error.code != "profile_unusable":
                raise
            self._without_profile.append(name)
            return image

    def _opened(self, raw: Path, name: str, kind: str) -> PIL.Image.Image:
        return opened(raw, name, kind, self._max_pixels)


def opened(path: Path, name: str, kind: str, max_pixels: int) -> PIL.Image.Image:
    """An extracted picture, fully decoded. name: in the archive. kind: `magic.image_format`'s.

    Raises CaptureError image_undecodable, also for more than `max_pixels`.
    """
    try:
        image = open_picture(path, kind)
        if image.width * image.height > max_pixels:
            raise _undecodable(
                name, f"has {image.width}x{image.height} pixels; {max_pixels} are allowed"
            )
        image.load()
    except DAMAGED as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise  # the disk's fault, not the picture's
        raise _undecodable(name, "does not decode") from error
    return image


def _undecodable(name: str, why: str) -> CaptureError:
    return CaptureError(
        f'The picture "{shown(name)}" {why}.',
        code="image_undecodable",
        hint="Replace the picture, or leave it out.",
    )


def _is_clean(image: PIL.Image.Image, raw: Path) -> bool:
    """Whether the bytes can be kept as they came: plain RGB, and nothing but the picture."""
    if image.mode != "RGB" or image.info.get("icc_profile"):
        return False
    if image.format == "JPEG":
        segments = {name for name, _ in getattr(image, "applist", [])}
        return (
            segments <= _HARMLESS_SEGMENTS and "comment" not in image.info and _ends_at_its_end(raw)
        )
    if image.format == "PNG":
        return set(image.info) <= _HARMLESS_PNG_KEYS and not getattr(image, "text", {})
    return False


def _ends_at_its_end(raw: Path) -> bool:
    """Whether a JPEG has nothing behind its end marker (phones append further pictures there)."""
    data = raw.read_bytes()
    return data.rstrip(b"\0").endswith(b"\xff\xd9") and data.count(b"\xff\xd8\xff") == 1


def _eight_bit(image: PIL.Image.Image) -> PIL.Image.Image:
    """A grey picture of 16 bits with 8; others as they are."""
    if not (image.mode.startswith("I;16") or image.mode == "I"):
        return image
    reduced = image.convert("I").point(lambda value: value / 257).convert("L")
    reduced.info = dict(image.info)
    return reduced


def _plain_rgb(image: PIL.Image.Image) -> PIL.Image.Image:
    """The pixels as 8-bit RGB over white, in a new image that carries no metadata."""
    if image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info:
        layer = image.convert("RGBA")
        image = PIL.Image.new("RGB", layer.size, (255, 255, 255))
        image.paste(layer, mask=layer.getchannel("A"))
    rgb = image.convert("RGB")
    clean = PIL.Image.new("RGB", rgb.size)
    clean.paste(rgb)
    return clean
