"""Confines the process that calls it, for good, as far as the kernel can: see `plan`.

Called by a stage process before it loads anything of a stage, and by what compiles kernels.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from worker.containment import landlock, seccomp
from worker.containment.landlock import DEVICE, LIST, NAME, READ, WRITE, Rule
from worker.containment.limits import apply_limits
from worker.containment.plan import Plan
from worker.containment.privileges import drop_capabilities, forgo_new_privileges


@dataclass(frozen=True)
class Containment:
    """on: what holds. lacks: what this machine does not offer, and why."""

    on: tuple[str, ...]
    lacks: tuple[str, ...]

    def as_json(self) -> dict[str, list[str]]:
        """For a record."""
        return {"on": [*self.on], "lacks": [*self.lacks]}

    def as_text(self) -> str:
        """One line for a log."""
        text = "; ".join(self.on) or "nothing"
        return text + (f". Not: {'; '.join(self.lacks)}" if self.lacks else "")


class ContainmentError(RuntimeError):
    """The worker is told that stages must be contained, and this machine cannot."""


_THREADS = Path("/proc/self/task")
_held: list[int] = []
"""Descriptors that stay open, so that the inode that a rule is for stays the folder's own: /proc
makes its folders anew for whoever asks."""


def _rules(plan: Plan) -> list[Rule]:
    groups = ((plan.read, READ), (plan.list, LIST), (plan.write, WRITE), (plan.devices, DEVICE))
    rules = [Rule(Path(path), allowed) for paths, allowed in groups for path in paths]
    if plan.names_threads:
        # NVIDIA's driver names its threads by writing to a file of theirs (`comm`), and does not
        # start at all (CUDA error 304) where it must not.
        _held.append(os.open(_THREADS, os.O_PATH | os.O_CLOEXEC))
        rules.append(Rule(_THREADS, NAME))
    return rules


def _limit(plan: Plan) -> str:
    return f"limits of {', '.join(apply_limits(plan.limits))}"


def _forgo_privileges(plan: Plan) -> str:
    forgo_new_privileges()
    dropped = drop_capabilities(keep_files=landlock.version() >= landlock.OLDEST)
    return "no capabilities" if dropped else "no new privileges"


def _close_files(plan: Plan) -> str:
    if (version := landlock.version()) < landlock.OLDEST:
        raise OSError(errno.ENOSYS, "no Landlock in this kernel")
    confined = landlock.restrict(_rules(plan), tcp=plan.network)
    return f"Landlock {version} ({', '.join(confined)})"


def _filter_calls(plan: Plan) -> str:
    seccomp.restrict(network=plan.network, unix=plan.unix_sockets)
    return "seccomp"


_STEPS: tuple[tuple[str, bool, Callable[[Plan], str]], ...] = (
    ("limits", False, _limit),
    ("root's powers", True, _forgo_privileges),
    ("files and other processes' memory", True, _close_files),
    ("network and process group", True, _filter_calls),
)
"""What is confined, whether only Linux can, and how. In this order: the last close what the first
need."""


def apply_plan(plan: Plan) -> Containment:
    """Confine this process. Raises ContainmentError where the plan demands what cannot be had."""
    if plan.mode == "off":
        return Containment((), ("all of it, as NERFWORKS_WORKER_CONTAIN says",))
    on, lacks = ["environment"], []
    for what, needs_linux, confine in _STEPS:
        if needs_linux and sys.platform != "linux":
            lacks.append(f"{what} ({sys.platform})")
            continue
        try:
            on.append(confine(plan))
        except (OSError, ValueError) as error:  # a stage is better run without than not at all
            lacks.append(f"{what} ({getattr(error, 'strerror', None) or error})")
    if lacks and plan.mode == "required":
        raise ContainmentError(f"stages cannot be contained: {'; '.join(lacks)}")
    return Containment(tuple(on), tuple(lacks))
