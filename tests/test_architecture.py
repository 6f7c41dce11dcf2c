"""The import rules of docs/architecture.md, checked on the syntax tree.

Only imports that run when a module is loaded or a function called count alike: a rule that could be
dodged by importing inside a function would not be one.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

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
    "pipelines.registry",
    "pipelines.stage",
    "pipelines.errors",
    "pipelines.captures.sniff",
)

# What each room may take from the others, by prefix.
MAY_IMPORT: dict[str, tuple[str, ...]] = {
    "api": API_MAY_IMPORT,
    "storage": ("storage",),
    "worker": ("worker", "pipelines", "storage"),
    "pipelines": ("pipelines",),
    "deploy": ("deploy", "storage", "api.cli_display", "api.client", "pipelines.options"),
}
# `nerfworks up` starts the launcher: the one way from the command into deploy.
EXCEPTIONS = {("api/cli.py", "deploy.local")}


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


@pytest.mark.parametrize("room", ROOMS)
def test_rooms_import_only_what_the_architecture_allows(room: str) -> None:
    wrong = []
    for path in files_of(room):
        relative = path.relative_to(ROOT).as_posix()
        for line, name in imports_of(path):
            if not within(name, ROOMS) or within(name, MAY_IMPORT[room]):
                continue
            if not any(relative == file and within(name, (to,)) for file, to in EXCEPTIONS):
                wrong.append(f"{relative}:{line} imports {name}")
    assert not wrong, "docs/architecture.md allows other imports only:\n" + "\n".join(wrong)


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


@pytest.mark.parametrize("module", ["api.app", "api.client", "nerfworks", "worker.app"])
def test_loading_a_light_process_loads_no_heavy_library(module: str) -> None:
    program = (
        f"import sys, {module}; print(*sorted(name for name in {HEAVY!r} if name in sys.modules))"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True, cwd=ROOT
    )
    assert loaded.stdout.split() == [], f"{module} loads {loaded.stdout.strip()}"


def test_no_import_cycles_between_modules() -> None:
    graph: dict[str, set[str]] = {}
    modules = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts): path
        for room in ROOMS
        for path in files_of(room)
        if path.name != "__init__.py"
    }
    for name, path in modules.items():
        tree = ast.parse(path.read_text("utf-8"))
        top_level = ast.Module(
            [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)], []
        )
        targets = set()
        for node in top_level.body:
            if isinstance(node, ast.Import):
                targets |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                targets |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        graph[name] = targets & modules.keys()
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
