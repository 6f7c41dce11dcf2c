"""Landlock: a process gives up the files, ports and processes that it has no use for, for good.

On Linux, for any user, without a helper and without root. What is not allowed by a rule is refused
from then on, to this process and to all that it starts, whoever they run as. A process that is
confined so can also no longer trace those outside: their environment and memory in /proc are closed
to it. Sources: landlock(7), Documentation/userspace-api/landlock.rst of the kernel.
"""

from __future__ import annotations

import ctypes
import errno
import os
import stat
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from worker.containment.syscalls import checked, libc

_CREATE, _ADD_RULE, _RESTRICT = 444, 445, 446  # of every architecture
_VERSION_FLAG = 1
_PATH_BENEATH = 1

EXECUTE, WRITE_FILE, READ_FILE, READ_DIR = 1 << 0, 1 << 1, 1 << 2, 1 << 3
REMOVE_DIR, REMOVE_FILE = 1 << 4, 1 << 5
MAKE_CHAR, MAKE_DIR, MAKE_REG, MAKE_SOCK = 1 << 6, 1 << 7, 1 << 8, 1 << 9
MAKE_FIFO, MAKE_BLOCK, MAKE_SYM = 1 << 10, 1 << 11, 1 << 12
REFER, TRUNCATE, IOCTL_DEV = 1 << 13, 1 << 14, 1 << 15

_FILES = {2: REFER * 2 - 1, 3: TRUNCATE * 2 - 1, 5: IOCTL_DEV * 2 - 1}
"""All rights over files that are known from a version on."""
_OF_FILES = EXECUTE | WRITE_FILE | READ_FILE | TRUNCATE | IOCTL_DEV
_TCP = 0b11  # bind, connect
_SCOPES = 0b11  # abstract UNIX sockets, signals
OLDEST = 2  # in version 1 no file can be moved from one folder to another at all

READ = EXECUTE | READ_FILE | READ_DIR
LIST = READ_DIR
WRITE = READ_FILE | READ_DIR | WRITE_FILE | TRUNCATE | REMOVE_DIR | REMOVE_FILE
WRITE |= MAKE_DIR | MAKE_REG | REFER
"""Neither links of the symbolic kind, which whoever reads the folder would follow, nor devices, nor
programs to be started."""
DEVICE = READ_FILE | READ_DIR | WRITE_FILE | IOCTL_DEV
NAME = READ_FILE | WRITE_FILE | TRUNCATE


class _Ruleset(ctypes.Structure):
    _fields_ = (
        ("files", ctypes.c_uint64),
        ("net", ctypes.c_uint64),
        ("scoped", ctypes.c_uint64),
    )


class _PathBeneath(ctypes.Structure):
    _pack_ = 1
    _fields_ = (("allowed", ctypes.c_uint64), ("parent", ctypes.c_int32))


@dataclass(frozen=True)
class Rule:
    """What a path, and all below it, may be used for. allowed: READ, LIST, WRITE, DEVICE, NAME."""

    path: Path
    allowed: int


def version() -> int:
    """The kernel's version of Landlock; 0 where there is none, or it is switched off."""
    if sys.platform != "linux":
        return 0
    return max(int(libc().syscall(_CREATE, None, 0, _VERSION_FLAG)), 0)


def restrict(rules: Iterable[Rule], *, tcp: bool) -> list[str]:
    """Confine the calling thread, and all that it starts, to the rules. Before other threads start.

    tcp: whether connections may still be made. Paths that are not there are passed over.
    Returns what is confined: "files", "tcp", "signals". Needs version() >= OLDEST and
    `no_new_privs`; raises OSError where the kernel refuses.
    """
    found = version()
    known = max(rights for since, rights in _FILES.items() if since <= found)
    attributes = _Ruleset(known, 0, 0)
    size, confined = 8, ["files"]
    if found >= 4:
        size, attributes.net = 16, 0 if tcp else _TCP
        confined += [] if tcp else ["tcp"]
    if found >= 6:
        size, attributes.scoped = 24, _SCOPES
        confined.append("signals")
    ruleset = checked(libc().syscall(_CREATE, ctypes.byref(attributes), size, 0), "landlock")
    try:
        for rule in rules:
            _add(ruleset, rule, known)
        checked(libc().syscall(_RESTRICT, ruleset, 0), "landlock")
    finally:
        os.close(ruleset)
    return confined


def _add(ruleset: int, rule: Rule, known: int) -> None:
    try:
        parent = os.open(rule.path, os.O_PATH | os.O_CLOEXEC)
    except OSError:
        return  # not there, or not for us: then it need not be allowed
    try:
        allowed = rule.allowed & known
        if not stat.S_ISDIR(os.fstat(parent).st_mode):
            allowed &= _OF_FILES
        beneath = _PathBeneath(allowed, parent)
        if allowed:
            status = libc().syscall(_ADD_RULE, ruleset, _PATH_BENEATH, ctypes.byref(beneath), 0)
            if status and ctypes.get_errno() != errno.EBADFD:  # such as a file of no file system
                checked(status, f"landlock: {rule.path}")
    finally:
        os.close(parent)
