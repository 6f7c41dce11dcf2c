"""Files of network weights that somebody else published: fetched, checked, read.

A file is named by its path or http(s) URL and by its sha256, which is compared before anything of
it is read as more than bytes. Reading runs nothing: safetensors, or PyTorch files of plain tensors.
"""

from __future__ import annotations

import hashlib
import http.client
import os
import pickle
import tempfile
import time
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path
from typing import IO, cast

import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor

from pipelines.nerf.errors import NerfError

MAX_FILE_BYTES = 1 << 30
"""Published files are at most 553 MB (VGG16 with its classifier, which is not used)."""
DOWNLOAD_TIMEOUT_S = 30.0
"""Longest silence of a server."""
DOWNLOAD_LIMIT_S = 1800.0
_CHUNK_BYTES = 1 << 20
# What safetensors and the restricted unpickler raise on files that are something else.
_BAD_CONTENT = (
    SafetensorError,
    pickle.UnpicklingError,
    RuntimeError,
    ValueError,
    EOFError,
    LookupError,
    TypeError,
    AttributeError,
)


def read_weights(source: str, sha256: str, cache_dir: Path) -> dict[str, Tensor]:
    """The named tensors of one file.

    source: a path, or an http(s) URL. sha256: hexadecimal, of the whole file. cache_dir: where
    downloads are kept, under their sha256. Raises NerfError `lpips_weights`.
    """
    wanted = sha256.strip().lower()
    if len(wanted) != 64 or set(wanted) - set("0123456789abcdef"):
        raise NerfError(
            "lpips_weights",
            f"The sha256 of {_shown(source)} is not 64 hexadecimal digits.",
            "Write down what `sha256sum` prints for the file.",
        )
    remote = urllib.parse.urlsplit(source).scheme in ("http", "https")
    path = _downloaded(source, wanted, cache_dir) if remote else Path(source)
    return _read_checked(path, wanted, _shown(source))


def file_digest(path: Path) -> str:
    """sha256 of a file. Raises NerfError `lpips_weights` where it cannot be read."""
    return _digest_of(path, path.name)


def _read_checked(path: Path, sha256: str, shown: str) -> dict[str, Tensor]:
    """The tensors of a file that has this sha256. Nothing in it is run."""
    try:
        with path.open("rb") as file:
            found = _digest(file, shown)
            if found != sha256:
                raise NerfError(
                    "lpips_weights",
                    f"{shown} is not the file that was configured: its sha256 is {found}, not "
                    f"{sha256}.",
                    "Get the file again, or correct the sha256 if you trust this one.",
                )
            # The same open file is read on, so that nobody can change it in between.
            file.seek(0)
            head = file.read(9)
            file.seek(0)
            if head[8:9] == b"{":
                content = safetensors.torch.load(file.read())
            else:
                content = torch.load(file, map_location="cpu", weights_only=True)
    except OSError as error:
        raise NerfError(
            "lpips_weights",
            f"{shown} cannot be read: {error.strerror or type(error).__name__}.",
            "Check the path of the LPIPS weights.",
        ) from error
    except _BAD_CONTENT as error:
        raise NerfError(
            "lpips_weights",
            f"{shown} is neither a safetensors file nor a PyTorch file of plain tensors.",
            "Configure a file of weights, not of a whole model.",
        ) from error
    if not isinstance(content, dict) or not all(isinstance(v, Tensor) for v in content.values()):
        raise NerfError(
            "lpips_weights",
            f"{shown} holds something else than named tensors.",
            "Configure a file of weights, not of a training run.",
        )
    return cast(dict[str, Tensor], dict(content))


def _downloaded(url: str, sha256: str, cache_dir: Path) -> Path:
    """The file of a URL in the cache, downloaded unless it is there already."""
    cached = cache_dir / f"{sha256}.weights"
    if cached.is_file() and _digest_of(cached, _shown(url)) == sha256:
        return cached
    # Of what urllib can open only these; a redirect to a local file would be an unknown scheme.
    opener = urllib.request.OpenerDirector()
    for handler in (
        urllib.request.ProxyHandler,
        urllib.request.HTTPHandler,
        urllib.request.HTTPSHandler,
        urllib.request.HTTPRedirectHandler,
        urllib.request.HTTPDefaultErrorHandler,
        urllib.request.HTTPErrorProcessor,
        urllib.request.UnknownHandler,
    ):
        opener.add_handler(handler())
    opener.addheaders = [("User-Agent", "nerfworks")]
    temporary: Path | None = None
    try:
        cache_dir.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=cache_dir, prefix=".download-")
        temporary = Path(name)
        with (
            os.fdopen(handle, "wb") as out,
            opener.open(url, timeout=DOWNLOAD_TIMEOUT_S) as response,
        ):
            found = _copy(response, out, _shown(url))
        if found != sha256:
            raise NerfError(
                "lpips_weights",
                f"{_shown(url)} is not the file that was configured: its sha256 is {found}, not "
                f"{sha256}.",
                "Correct the URL, or the sha256 if you trust this file.",
            )
        temporary.replace(cached)
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise NerfError(
            "lpips_weights",
            f"{_shown(url)} cannot be downloaded: {_reason(error)}.",
            "Check the URL and the network, or download the file yourself and configure its path.",
        ) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
    return cached


def _reason(error: Exception) -> str:
    """Why a download failed, without paths of this machine."""
    if isinstance(error, urllib.error.HTTPError):
        return f"the server answers {error.code}"
    if isinstance(error, urllib.error.URLError) and not isinstance(error.reason, OSError):
        return str(error.reason)
    cause = error.reason if isinstance(error, urllib.error.URLError) else error
    return getattr(cause, "strerror", None) or type(cause).__name__


def _copy(source: IO[bytes], out: IO[bytes], shown: str) -> str:
    """Copy within the bounds of size and time; the sha256 of what was copied."""
    digest, size, started = hashlib.sha256(), 0, time.monotonic()
    while chunk := source.read(_CHUNK_BYTES):
        size += len(chunk)
        if size > MAX_FILE_BYTES or time.monotonic() - started > DOWNLOAD_LIMIT_S:
            raise NerfError(
                "lpips_weights",
                f"{shown} is larger than {MAX_FILE_BYTES >> 20} MiB or took longer than "
                f"{DOWNLOAD_LIMIT_S:.0f} s.",
                "Configure a file of the needed weights alone, or one on a faster disk or server.",
            )
        out.write(chunk)
        digest.update(chunk)
    return digest.hexdigest()


def _digest_of(path: Path, shown: str) -> str:
    try:
        with path.open("rb") as file:
            return _digest(file, shown)
    except OSError as error:
        raise NerfError(
            "lpips_weights",
            f"{shown} cannot be read: {error.strerror or type(error).__name__}.",
            "Check the path of the LPIPS weights.",
        ) from error


def _digest(file: IO[bytes], shown: str) -> str:
    with Path(os.devnull).open("wb") as nowhere:
        return _copy(file, nowhere, shown)


def _shown(source: str) -> str:
    """A source as errors name it: no credentials of a URL, no folders of this machine."""
    parts = urllib.parse.urlsplit(source)
    if parts.scheme in ("http", "https"):
        return f"{parts.scheme}://{parts.hostname or ''}{parts.path}"
    return Path(source).name
