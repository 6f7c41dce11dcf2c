"""The import rules of docs/architecture.md, checked on the syntax tree.

Every import counts, also one inside a function or for the type checker alone: a rule that could be
dodged by importing later would not be one. What is named in a string and loaded when it is asked
for (stages in `registry`, methods in `options.catalogue`, entry points of other packages) is no
import: there the caller knows a name only.
"""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
ROOMS = ("api", "worker", "pipelines", "storage", "deploy")
HEAVY = ("torch", "numpy", "numba", "open3d", "pycolmap", "skimage")

# llvmlite is the half of numba that kernels write vector code with; it is never there without it.
NERF_MAY_IMPORT = frozenset(
    {"torch", "numpy", "numba", "llvmlite", "triton", "PIL", "skimage", "safetensors"}
    | sys.stdlib_module_names
)
API_MAY_IMPORT = (
    "api",
    "storage",
    "pipelines.options",
    "pipelines.presets",
    "pipelines.registry",
    "pipelines.stage",
    "pipelines.manifest",
    "pipelines.errors",
    "pipelines.captures.sniff",
    "pipelines.captures.catalogue",
    "pipelines.exports.catalogue",
    "pipelines.exports.requests",
)

# What each room may take from the others, by prefix. api/client is a room of its own: the server
# takes nothing from it, and it nothing from the server.
MAY_IMPORT: dict[str, tuple[str, ...]] = {
    "api": API_MAY_IMPORT,
    "api/client": ("api.client", "pipelines.assignments"),
    "storage": ("storage",),
    "worker": ("worker", "pipelines", "storage"),
    "pipelines": ("pipelines",),
    "deploy": (
        "deploy",
        "storage",
        "api.client",
        "pipelines.options",
        "pipelines.presets",
        "pipelines.assignments",
    ),
}
# What lies in pipelines/ beside its rooms, lowest first, and what of a room it may name.
FRAME = (
    "errors",
    "assignments",
    "workspace",
    "stage",
    "option_models",
    "registry",
    "presets",
    "options",
    "manifest",
    "cli",
    "__main__",
)
FRAME_MAY_IMPORT: dict[str, tuple[str, ...]] = {
    "option_models": ("pipelines.nerf.options", "pipelines.nerf.plugins"),
    "registry": (
        "pipelines.captures.catalogue",
        "pipelines.captures.importer",
        "pipelines.exports.catalogue",
        "pipelines.exports.export",
    ),
    "presets": ("pipelines.exports.catalogue",),
    "options": (
        "pipelines.captures.minimum",
        "pipelines.exports.catalogue",
        "pipelines.exports.options",  # the draft is cut as exports are
        "pipelines.nerf.options",
        "pipelines.nerf.plugins",
        "pipelines.nerf.errors",
    ),
    "cli": ("pipelines.captures.sniff", "pipelines.stages.report"),
}
# Rooms lowest first; those of a line do not know each other. The longest name that fits counts: a
# file may stand lower than its folder.
PIPELINE_ROOMS: tuple[tuple[str, ...], ...] = (
    *((name,) for name in FRAME),
    ("nerf",),
    ("scene",),
    ("captures.magic",),  # what a file is by its first bytes: the programs in tools ask that too
    ("tools",),
    ("captures", "sfm", "judging"),
    ("exports",),
    ("filming",),
    ("stages", "sample"),
)
NERF_ROOMS: tuple[tuple[str, ...], ...] = (
    ("errors",),
    ("plugins",),
    ("devices", "ahead"),
    ("options",),
    ("space",),
    ("along_ray",),
    ("networks", "engines.cpu.parts", "engines.gpu.parts"),
    ("engines.hash_encoders",),
    ("engines.cpu.train",),
    ("models",),
    ("data",),
    ("engines.cpu.render", "engines.cpu.stereo", "engines.gpu"),
    ("stereo",),
    ("judging",),
    ("training",),
    ("renderer",),
    ("made_jobs",),
    ("compiling",),
)

CLIENT = "api/client"
NERFWORKS_MAY_IMPORT = ("api.client", "deploy.local")  # `nerfworks up` starts the launcher
CALLERS_LIBRARIES = ("httpx", "pydantic", "rich")


def imports_of(path: Path) -> Iterator[tuple[int, str]]:
    """(line, dotted name) of everything a file imports."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; write it out"
            assert node.module is not None
            for alias in node.names:
                yield node.lineno, f"{node.module}.{alias.name}"


def files_of(room: str) -> list[Path]:
    return sorted((ROOT / room).rglob("*.py"))


def within(name: str, prefixes: tuple[str, ...]) -> bool:
    return any(name == prefix or name.startswith(prefix + ".") for prefix in prefixes)


def foreign_imports(paths: list[Path], allowed: tuple[str, ...]) -> list[str]:
    """What files import of ours beside what is allowed."""
    return [
        f"{path.relative_to(ROOT)}:{line} imports {name}"
        for path in paths
        for line, name in imports_of(path)
        if within(name, ROOMS) and not within(name, allowed)
    ]


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_rooms_import_only_what_the_architecture_allows(room: str) -> None:
    paths = [path for path in files_of(room) if room == CLIENT or path not in files_of(CLIENT)]
    wrong = foreign_imports(paths, MAY_IMPORT[room])
    if room == "api":
        wrong += [
            f"{path.relative_to(ROOT)}:{line} imports {name}"
            for path in paths
            for line, name in imports_of(path)
            if within(name, ("api.client",))
        ]
    assert not wrong, "docs/architecture.md allows other imports only:\n" + "\n".join(wrong)


def test_what_callers_import_leads_to_the_client_and_the_launcher_alone() -> None:
    assert not foreign_imports([ROOT / "nerfworks.py"], NERFWORKS_MAY_IMPORT)


def closure_of(distributions: tuple[str, ...]) -> set[str]:
    """The names of distributions and of all that they need on this machine, extras left out."""
    found: set[str] = set()
    left = list(distributions)
    while left:
        name = canonicalize_name(left.pop())
        if name in found:
            continue
        found.add(name)
        for text in metadata.requires(name) or []:
            need = Requirement(text)
            if need.marker is None or need.marker.evaluate({"extra": ""}):
                left.append(need.name)
    return found


def test_callers_need_only_what_their_install_brings() -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert {Requirement(text).name for text in declared["dependencies"]} == {*CALLERS_LIBRARIES}
    here = closure_of(CALLERS_LIBRARIES)
    hidden = sorted(
        name
        for name, distributions in metadata.packages_distributions().items()
        if not {canonicalize_name(found) for found in distributions} & here
        and not name.startswith("_")
        and name not in (*ROOMS, "nerfworks", "tests")
    )
    assert {"torch", "numpy", "fastapi", "sqlalchemy", "celery", "boto3"} <= {*hidden}
    program = (
        "import sys\n"
        f"sys.modules.update(dict.fromkeys({hidden!r}))\n"  # None: an import of it fails
        "from nerfworks import Client, main\n"
        "sys.argv = ['nerfworks', 'submit', 'a', '--set', 'train.max_steps=5', '--help']\n"
        "main()\n"
    )
    shown = subprocess.run(
        [sys.executable, "-c", program], check=False, capture_output=True, text=True, cwd=ROOT
    )
    assert (shown.returncode, shown.stderr) == (0, "")
    assert "--preset" in shown.stdout


def test_the_api_answers_before_it_imports_what_its_first_answers_do_not_need() -> None:
    late = ("celery", "kombu", "redis", "psycopg", "boto3", "torch", "numpy", "pycolmap", "open3d")
    program = (
        "import sys, api.app, deploy.embedded\n"
        f"print([name for name in {late!r} if name in sys.modules])\n"
    )
    shown = subprocess.run(
        [sys.executable, "-c", program], check=False, capture_output=True, text=True, cwd=ROOT
    )
    assert (shown.stdout, shown.stderr) == ("[]\n", "")


def test_nerf_imports_nothing_but_its_few_libraries() -> None:
    wrong = []
    for path in files_of("pipelines/nerf"):
        for line, name in imports_of(path):
            top = name.split(".")[0]
            if top not in NERF_MAY_IMPORT and not within(name, ("pipelines.nerf",)):
                wrong.append(f"{path.relative_to(ROOT)}:{line} imports {name}")
    assert not wrong, "pipelines/nerf must run alone on a bare GPU machine:\n" + "\n".join(wrong)


def test_stages_never_see_storage() -> None:
    wrong = [
        f"{path.relative_to(ROOT)}:{line} imports {name}"
        for path in files_of("pipelines")
        for line, name in imports_of(path)
        if within(name, ("storage", "sqlalchemy", "celery", "boto3", "redis"))
    ]
    assert not wrong, "a stage works on folders only:\n" + "\n".join(wrong)


def level_of(name: str, rooms: tuple[tuple[str, ...], ...]) -> tuple[int, str] | None:
    """(level, room) of a module, named from where the rooms are; None for one without a room."""
    fitting = [
        (level, room) for level, line in enumerate(rooms) for room in line if within(name, (room,))
    ]
    return max(fitting, key=lambda found: len(found[1]), default=None)


def out_of_order(
    package: str, rooms: tuple[tuple[str, ...], ...], allowed: dict[str, tuple[str, ...]]
) -> list[str]:
    """What files import from rooms that are not below theirs, and files that have no room."""
    wrong = []
    for path in files_of(package.replace(".", "/")):
        if path.name == "__init__.py":
            continue
        relative = path.relative_to(ROOT)
        name = ".".join(relative.with_suffix("").parts).removeprefix(package + ".")
        here = level_of(name, rooms)
        if here is None:
            wrong.append(f"{relative} stands in no room: give it a place in this test's list")
            continue
        for line, target in imports_of(path):
            if not within(target, (package,)) or within(target, allowed.get(name, ())):
                continue
            there = level_of(target.removeprefix(package + "."), rooms)
            if there is None or not (there[1] == here[1] or there[0] < here[0]):
                wrong.append(f"{relative}:{line} imports {target}")
    return wrong


def test_the_root_of_pipelines_holds_the_frame_alone() -> None:
    found = {path.stem for path in (ROOT / "pipelines").glob("*.py")} - {"__init__"}
    assert found == set(FRAME), "a file of pipelines/ belongs into one of its rooms"


def test_rooms_of_pipelines_import_only_lower_ones() -> None:
    wrong = out_of_order("pipelines", PIPELINE_ROOMS, FRAME_MAY_IMPORT)
    assert not wrong, "lowest first, as PIPELINE_ROOMS has them:\n" + "\n".join(wrong)


def test_rooms_of_nerf_import_only_lower_ones() -> None:
    wrong = out_of_order("pipelines.nerf", NERF_ROOMS, {})
    assert not wrong, "lowest first, as NERF_ROOMS has them:\n" + "\n".join(wrong)


@pytest.mark.parametrize("module", ["api.app", "api.client.cli", "nerfworks", "worker.app"])
def test_loading_a_light_process_loads_no_heavy_library(module: str) -> None:
    program = (
        f"import sys, {module}; print(*sorted(name for name in {HEAVY!r} if name in sys.modules))"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True, cwd=ROOT
    )
    assert loaded.stdout.split() == [], f"{module} loads {loaded.stdout.strip()}"


def test_no_import_cycles_between_modules() -> None:
    modules = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts): path
        for room in ROOMS
        for path in files_of(room)
        if path.name != "__init__.py"
    }
    graph: dict[str, set[str]] = {}
    for name, path in modules.items():
        imported = {target for _, target in imports_of(path)}
        # `from package import name`: the name may be a module or live in one.
        graph[name] = (imported | {target.rpartition(".")[0] for target in imported}) & {*modules}
    done: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, "import cycle: " + " -> ".join((*trail, name))
        if name not in done:
            for target in sorted(graph[name]):
                visit(target, (*trail, name))
            done.add(name)

    for name in graph:
        visit(name, ())


def test_package_init_files_stay_empty() -> None:
    full = [
        str(path.relative_to(ROOT))
        for room in ROOMS
        for path in files_of(room)
        if path.name == "__init__.py" and path.read_text("utf-8").strip()
    ]
    assert not full, f"package __init__ files stay empty: {full}"


def test_programs_are_never_started_through_a_shell() -> None:
    wrong = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for room in ROOMS
        for path in files_of(room)
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.keyword)
        and node.arg == "shell"
        and not (isinstance(node.value, ast.Constant) and node.value.value is False)
    ]
    assert not wrong, f"use an argument list: {wrong}"


def test_kernels_take_nothing_from_rooms_that_their_cache_does_not_follow() -> None:
    nerf = ROOT / "pipelines" / "nerf"
    cache = ast.parse((nerf / "engines/cpu/parts/kernel_cache.py").read_text("utf-8"))
    (rooms,) = (
        ast.literal_eval(node.value)
        for node in cache.body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "FROZEN_ROOMS"
    )
    followed = tuple(f"pipelines.nerf.{room.replace('/', '.')}" for room in rooms)
    assert all((nerf / room).is_dir() for room in rooms)
    # Errors and plugins hold no numbers.
    allowed = (*followed, "pipelines.nerf.errors", "pipelines.nerf.plugins")
    wrong = [
        f"{path.relative_to(ROOT)}:{line} imports {name}"
        for path in files_of("pipelines/nerf/engines/cpu")
        for line, name in imports_of(path)
        if within(name, ROOMS) and not within(name, allowed)
    ]
    assert not wrong, "add the room to FROZEN_ROOMS, or kernels go stale:\n" + "\n".join(wrong)
