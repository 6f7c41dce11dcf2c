"""Where a C compiler lies: real compilers, and wrappers of one that lie elsewhere."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

import pytest

from tests.services import missing
from worker.containment import toolchain
from worker.containment.toolchain import compiler_folders


def script(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


@pytest.fixture
def compiler() -> str:
    found = shutil.which("gcc")
    if found is None:
        missing("gcc")
    return str(found)


@pytest.fixture
def away(tmp_path: Path, compiler: str) -> Path:
    """A toolchain in a folder of its own: a wrapper in bin, a program in libexec, lib/include."""
    folder = tmp_path / "toolchain"
    (folder / "lib" / "include").mkdir(parents=True)
    real = script(folder / "libexec" / "gcc-real", f'exec {compiler} "$@"')
    script(
        folder / "bin" / "gcc",
        f'exec {real} -B{folder}/lib/ -isystem {folder}/lib/include "$@"',
    )
    return folder


def environment(**more: str) -> dict[str, str]:
    return {"PATH": os.environ["PATH"], **more}


def test_a_compiler_tells_its_own_folder_its_headers_and_libraries(compiler: str) -> None:
    found = compiler_folders(environment())
    assert Path(compiler).resolve().parent in found
    assert any((folder / "stddef.h").is_file() for folder in found)
    assert any((folder / "stdio.h").is_file() for folder in found)
    assert any(
        (folder / name).exists() for folder in found for name in ("libgcc.a", "libgcc_s.so.1")
    )


def test_one_that_lies_elsewhere_is_followed(away: Path) -> None:
    named = compiler_folders(environment(CC=str(away / "bin" / "gcc")))
    assert {away / "bin", away / "lib", away / "lib" / "include"} <= set(named)
    first_of_path = f"{away / 'bin'}{os.pathsep}{os.environ['PATH']}"
    assert away / "lib" in compiler_folders(environment(PATH=first_of_path))
    assert not any(folder.is_relative_to(away) for folder in compiler_folders(environment()))


@pytest.mark.parametrize(
    "said",
    ["COLLECT_GCC={folder}/libexec/gcc-real", "InstalledDir: {folder}/libexec"],
)
def test_the_program_behind_a_wrapper_is_found(tmp_path: Path, said: str) -> None:
    (tmp_path / "libexec").mkdir()
    wrapper = script(tmp_path / "bin" / "cc", f"echo '{said.format(folder=tmp_path)}' >&2")
    assert tmp_path / "libexec" in compiler_folders({"PATH": "/nowhere", "CC": str(wrapper)})


def test_a_link_leads_to_where_the_compiler_lies(away: Path, tmp_path: Path) -> None:
    link = tmp_path / "links" / "gcc"
    link.parent.mkdir()
    link.symlink_to(away / "bin" / "gcc")
    assert away / "bin" in compiler_folders(environment(CC=str(link)))


def test_nothing_is_opened_that_holds_the_home_whatever_it_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "lib").mkdir()
    said = f"libraries: =/:{tmp_path}:{tmp_path}/lib:lib:{tmp_path}/not-there:{tmp_path}/lib/../../"
    cc = script(tmp_path / "bin" / "cc", f"echo '{said}'")
    found = compiler_folders({"PATH": "/nowhere", "CC": str(cc)})
    assert found == [tmp_path / "bin", tmp_path / "lib"]


def test_none_a_broken_one_and_one_that_hangs_are_no_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert compiler_folders({"PATH": str(tmp_path)}) == []
    assert compiler_folders({"PATH": str(tmp_path), "CC": str(tmp_path / "gone")}) == []
    broken = script(tmp_path / "broken" / "cc", "echo 'libraries: =/usr/lib'; exit 1")
    assert compiler_folders({"PATH": "/nowhere", "CC": str(broken)}) == [broken.parent]
    monkeypatch.setattr(toolchain, "_ANSWER_S", 0.2)
    hangs = script(tmp_path / "hangs" / "cc", "exec sleep 60")
    start = time.monotonic()
    assert compiler_folders({"PATH": os.environ["PATH"], "CC": str(hangs)})[0] == hangs.parent
    assert time.monotonic() - start < 30.0
