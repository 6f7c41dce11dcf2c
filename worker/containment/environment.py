"""The environment variables of a stage: a list of those that it needs, and no others.

What a stage and the programs it starts are told is where things lie, in which language, and how the
numeric libraries shall behave: never an address or a key of the service.
"""

from __future__ import annotations

import os
import re
import site
from collections.abc import Iterable, Mapping
from pathlib import Path

CODE_ROOT = Path(__file__).resolve().parents[2]

TEMPORARY = "tmp"
_ALLOWED = re.compile(
    r"PATH|LANG|LANGUAGE|LC_[A-Z]+|TZ|TZDIR|USER|LOGNAME|TERM|VIRTUAL_ENV|CONDA_PREFIX"
    r"|LD_LIBRARY_PATH|LD_PRELOAD|DYLD_[A-Z_]+|CC|CXX|CPATH|LIBRARY_PATH|SSL_CERT_(FILE|DIR)"
    r"|PYTHON(PATH|HOME|HASHSEED|USERBASE|NOUSERSITE|WARNINGS|DEVMODE|FAULTHANDLER|UTF8)"
    r"|(OMP|KMP|GOMP|MKL|OPENBLAS|BLIS|VECLIB|NUMEXPR|NUMBA|MALLOC)_[A-Z0-9_]+|GLIBC_TUNABLES"
    r"|(CUDA|NVIDIA|CUBLAS|CUDNN|HIP|ROCM|ROCR|HSA|TORCH|PYTORCH|TRITON|TORCHINDUCTOR)_[A-Z0-9_]+"
    r"|(FONTCONFIG|OPEN3D|IMAGEIO|COVERAGE|COV_CORE)_[A-Z0-9_]+|XDG_CACHE_HOME"
    r"|NERFWORKS_(HOME|FFMPEG|LPIPS_WEIGHTS|LPIPS_SHA256)"
)


def stage_environment(
    environment: Mapping[str, str], *, home: Path, more: Iterable[str] = ()
) -> dict[str, str]:
    """The environment of a stage process, from the worker's.

    home: a folder of its own, where libraries keep their caches. more: further names to pass on.
    """
    names = {*more}
    kept = {
        name: value
        for name, value in environment.items()
        if name in names or _ALLOWED.fullmatch(name)
    }
    paths = [str(CODE_ROOT), *filter(None, kept.get("PYTHONPATH", "").split(os.pathsep))]
    kept["PYTHONPATH"] = os.pathsep.join(dict.fromkeys(paths))
    kept["PYTHONUNBUFFERED"] = "1"
    kept["NUMBA_CACHE_DIR"] = str(kernel_folder(environment))
    if site.ENABLE_USER_SITE:  # it is found by way of the home folder, which is another one now
        kept.setdefault("PYTHONUSERBASE", site.getuserbase())
    kept["HOME"] = str(home)
    kept["TMPDIR"] = str(home / TEMPORARY)  # while no stage runs, which has one of its own
    # OpenMP's waiting threads must not spin: see pipelines/__main__.py for what that costs.
    kept.setdefault("OMP_WAIT_POLICY", "passive")
    return kept


def kernel_folder(environment: Mapping[str, str]) -> Path:
    """Where compiled kernels are kept, as pipelines/nerf/engines/cpu/parts/kernel_cache.py says."""
    if chosen := environment.get("NUMBA_CACHE_DIR"):
        return Path(chosen).absolute()
    if home := environment.get("NERFWORKS_HOME"):
        return Path(home).absolute() / "numba"
    return Path("~/.cache/nerfworks/numba").expanduser()
