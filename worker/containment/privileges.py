"""What a process may do beyond its own files: new privileges, and root's capabilities.

Source: prctl(2), capabilities(7).
"""

from __future__ import annotations

import ctypes
import errno
from pathlib import Path

from worker.containment.syscalls import checked, libc, prctl

_NO_NEW_PRIVS = 38
_DROP_BOUND, _AMBIENT, _AMBIENT_CLEAR = 24, 47, 4
_VERSION_3 = 0x20080522
_KEPT = (1, 3)
"""CAP_DAC_OVERRIDE and CAP_FOWNER: root may work on files that another user owns, such as a
checkout that is mounted into a container. Which files those are is Landlock's business."""


class _Header(ctypes.Structure):
    _fields_ = (("version", ctypes.c_uint32), ("pid", ctypes.c_int))


class _Sets(ctypes.Structure):
    _fields_ = (
        ("effective", ctypes.c_uint32),
        ("permitted", ctypes.c_uint32),
        ("inheritable", ctypes.c_uint32),
    )


def forgo_new_privileges() -> None:
    """No program that this process starts gains anything by a set-user-ID bit. For good."""
    prctl(_NO_NEW_PRIVS, 1)


def permitted_capabilities() -> int:
    """This process's capabilities, a bit each."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("CapPrm:"):
            return int(line.split()[1], 16)
    return 0


def drop_capabilities(*, keep_files: bool) -> bool:
    """Give up root's powers, also for programs that are started; whether there were any.

    keep_files: keep those over other users' files, where something else confines files.
    """
    held = permitted_capabilities()
    if not held:
        return False
    kept = sum(1 << number for number in _KEPT) & held if keep_files else 0
    for number in range(64):
        if kept >> number & 1:
            continue
        try:
            prctl(_DROP_BOUND, number)
        except OSError as error:
            if error.errno == errno.EINVAL:
                break  # the kernel knows no more
            if error.errno != errno.EPERM:
                raise
    prctl(_AMBIENT, _AMBIENT_CLEAR)
    header = _Header(_VERSION_3, 0)
    sets = (_Sets * 2)(_Sets(kept, kept, 0), _Sets(0, 0, 0))
    checked(libc().capset(ctypes.byref(header), ctypes.byref(sets)), "capset")
    return True
