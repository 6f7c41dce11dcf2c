"""Where the C compiler lies that a stage calls: Triton builds what launches its kernels with it.

`PATH` or `CC` name the program alone. What it is made of (its assembler and linker, its headers,
libraries of its own) may lie elsewhere, and none of it need be below /usr. The compiler says where.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path

_NAMES = ("gcc", "clang", "cc")
_ANSWER_S = 20.0
_PROGRAM = re.compile(r"^(?:COLLECT_GCC=(/.+)/[^/]+|InstalledDir: (/.+))$", re.MULTILINE)
"""Of the compiler itself, which a wrapper script calls."""
_INCLUDES = re.compile(r"search starts here:\n(.*?)\nEnd of search list", re.DOTALL)


def compiler_folders(environment: Mapping[str, str]) -> list[Path]:
    """Folders that C compilers read, which `environment` names or leads to; none without any.

    Never one that holds the user's home, whatever a compiler says.
    """
    found: dict[Path, None] = {}
    for compiler in _compilers(environment):
        for folder in _told_by(compiler, environment):
            found[folder.resolve()] = None
    home = Path(os.path.expanduser("~")).resolve()
    return [path for path in found if path.is_dir() and not home.is_relative_to(path)]


def _compilers(environment: Mapping[str, str]) -> list[str]:
    """Programs. As Triton looks for them: `CC`, which has no arguments, else by name."""
    names = [name for name in (environment.get("CC"), *_NAMES) if name]
    found = [shutil.which(name, path=environment.get("PATH")) for name in names]
    return list(dict.fromkeys(program for program in found if program))


def _told_by(compiler: str, environment: Mapping[str, str]) -> Iterator[Path]:
    yield Path(compiler).resolve().parent
    for line in _ask(compiler, environment, "-print-search-dirs").splitlines():
        yield from _absolute(line.partition(": ")[2].removeprefix("="))
    yield from _absolute(_ask(compiler, environment, "-print-sysroot").strip())
    told = _ask(compiler, environment, "-E", "-v", "-x", "c", os.devnull)
    for gcc, clang in _PROGRAM.findall(told):
        yield Path(gcc or clang)
    for block in _INCLUDES.findall(told):
        for line in block.splitlines():
            if not line.startswith("#"):  # the heading of the second list
                yield from _absolute(line.strip())


def _absolute(text: str) -> list[Path]:
    return [Path(part) for part in text.split(os.pathsep) if part.startswith("/")]


def _ask(compiler: str, environment: Mapping[str, str], *arguments: str) -> str:
    """What it prints; nothing where it does not know the question or does not answer."""
    try:
        asked = subprocess.run(
            [compiler, *arguments],
            env={**environment, "LC_ALL": "C"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            timeout=_ANSWER_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return asked.stdout if asked.returncode == 0 else ""
