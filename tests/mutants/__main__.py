"""Plants faults in chosen files, one at a time, and counts those that their tests notice.

    make mutants [MINUTES=5]
    python -m tests.mutants [--minutes 5] [GROUP ...]

mutmut makes the faults (a sign turned, a bound moved, an argument left out, a call lost) and runs
the tests that reach them, each time in a fork of one process that has loaded everything. It works
in a copy of the project under build/mutants, a folder a group: the kernels' cache follows the
sources that kernels are made of, and so is filled once a group and not once a fault. A group stops
after so many minutes; the next call goes on with the faults that are left.

Not every survivor is a missing test: `dim=+1` for `dim=-1` is the same fault-free program where
tensors have two axes. `python -m mutmut show NAME` in a group's folder prints a survivor's change.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
WORK = ROOT / "build" / "mutants"
COPIED = ("pipelines", "storage", "api", "worker", "deploy", "tests", "pyproject.toml")
SURVIVED = {0: "", 5: " (no test reaches it)", 33: " (no test reaches it)"}
"""Of the exit codes that mutmut keeps, those of faults that no test minds; others are failed tests,
crashes, and loops that never end."""


@dataclass(frozen=True)
class Group:
    """Files that are changed together, and the tests that are to notice; paths in the project."""

    sources: tuple[str, ...]
    tests: tuple[str, ...]


NERF, UNIT = "pipelines/nerf", "tests/unit/pipelines"
GROUPS: dict[str, Group] = {
    "losses": Group(
        (f"{NERF}/along_ray/losses.py",),
        (f"{UNIT}/nerf/along_ray/test_losses.py",),
    ),
    "samplers": Group(
        (f"{NERF}/along_ray/samplers.py", f"{NERF}/along_ray/intervals.py"),
        (f"{UNIT}/nerf/along_ray/test_samplers.py", f"{UNIT}/nerf/along_ray/test_intervals.py"),
    ),
    "training": Group(
        (f"{NERF}/training/state.py", f"{NERF}/training/checkpoint.py"),
        (
            f"{UNIT}/nerf/training/test_state.py",
            f"{UNIT}/nerf/training/test_checkpoint.py",
        ),
    ),
    "transforms": Group(
        (f"{NERF}/space/contraction.py", f"{NERF}/space/camera_optimizer.py"),
        (
            f"{UNIT}/nerf/space/test_contraction.py",
            f"{UNIT}/nerf/space/test_camera_optimizer.py",
        ),
    ),
    "scene": Group(
        ("pipelines/scene/orientation.py", "pipelines/scene/cameras_file.py"),
        (f"{UNIT}/scene", f"{UNIT}/stages/test_poses.py"),
    ),
    "captures": Group(
        (
            "pipelines/captures/sniff.py",
            "pipelines/captures/posed.py",
            "pipelines/captures/importers/nerfstudio.py",
            "pipelines/captures/importers/polycam.py",
            "pipelines/captures/importers/record3d.py",
        ),
        (f"{UNIT}/captures", f"{UNIT}/stages/test_ingest.py"),
    ),
    "leases": Group(
        ("storage/leases.py",),
        (
            "tests/unit/storage/test_jobs.py",
            "tests/unit/storage/test_retries.py",
            "tests/unit/storage/test_states.py",
        ),
    ),
}


def prepare(name: str, group: Group) -> Path:
    """A copy of the project with mutmut's settings; what it found out before stays."""
    folder = WORK / name
    folder.mkdir(parents=True, exist_ok=True)
    for item in COPIED:
        if (ROOT / item).is_dir():
            ignored = shutil.ignore_patterns("__pycache__")
            shutil.copytree(ROOT / item, folder / item, dirs_exist_ok=True, ignore=ignored)
        else:
            shutil.copy2(ROOT / item, folder / item)
    settings = {
        "source_paths": sorted(item for item in COPIED if (ROOT / item).is_dir()),
        "only_mutate": list(group.sources),
        "pytest_add_cli_args_test_selection": list(group.tests),
        # A fork has none of the threads of its parent and would wait for them: what is forked is a
        # process that has only imported.
        "process_isolation": "forkserver",
    }
    lines = [f"{key} = {json.dumps(value)}" for key, value in settings.items()]
    with (folder / "pyproject.toml").open("a", encoding="utf-8") as file:
        file.write("\n[tool.mutmut]\n" + "\n".join(lines) + "\n")
    return folder


def plant(folder: Path, minutes: float) -> None:
    """Run mutmut for at most so long. Raises SystemExit with its last words where it gave up."""
    log = folder / "mutmut.log"
    with log.open("w", encoding="utf-8") as file:
        running = subprocess.Popen(
            [sys.executable, "-m", "mutmut", "run", "--max-children", "1"],
            cwd=folder,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            running.wait(60.0 * minutes)
        except subprocess.TimeoutExpired:
            stop(running)
            return
    if running.returncode != 0:
        said = log.read_text("utf-8", "replace").replace("\r", "\n").splitlines()
        raise SystemExit(f"mutmut ended with {running.returncode}:\n" + "\n".join(said[-20:]))


def stop(running: subprocess.Popen[bytes]) -> None:
    """End mutmut, which has written down all it found, and what it started."""
    running.send_signal(signal.SIGINT)
    try:
        running.wait(30.0)
    except subprocess.TimeoutExpired:  # as where a shell in the background ignores SIGINT
        os.killpg(running.pid, signal.SIGKILL)
        running.wait()


def report(folder: Path, source: str) -> tuple[int, int, list[str]]:
    """(faults planted, faults there are, survivors with a word on each) of one file."""
    path = folder / "mutants" / f"{source}.meta"
    codes: dict[str, int | None] = json.loads(path.read_text("utf-8"))["exit_code_by_key"]
    tried = {name: code for name, code in codes.items() if code is not None}
    survivors = [name + SURVIVED[code] for name, code in tried.items() if code in SURVIVED]
    return len(tried), len(codes), survivors


def main() -> None:
    """Plant, and print a line a file."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("groups", nargs="*", metavar="GROUP", help=f"of {', '.join(GROUPS)}")
    parser.add_argument("--minutes", type=float, default=5.0, help="for each group")
    asked = parser.parse_args()
    if unknown := set(asked.groups) - GROUPS.keys():
        parser.error(f"no group {', '.join(sorted(unknown))}; there are {', '.join(GROUPS)}")
    for name in asked.groups or GROUPS:
        group = GROUPS[name]
        folder = prepare(name, group)
        plant(folder, asked.minutes)
        for source in group.sources:
            tried, there_are, survivors = report(folder, source)
            noticed = tried - len(survivors)
            share = f"{100.0 * noticed / max(tried, 1):.0f} %"
            print(f"{source}: {share}, {noticed} of {tried} planted, of {there_are}", flush=True)
            for survivor in survivors:
                print(f"    survived: {survivor}", flush=True)


if __name__ == "__main__":
    main()
