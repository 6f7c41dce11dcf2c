"""A filter over system calls: those that a stage has no use for fail, for it and all it starts.

- No internet: `socket` opens nothing but what the machine itself answers.
- Nobody leaves the process group: `setsid` and `setpgid` say that all is well and do nothing, so
  that whoever kills the group gets everything that a stage started.
- No tracing, no namespaces, no keys, no io_uring (which would open sockets past the filter).

Source: seccomp(2), Documentation/userspace-api/seccomp_filter.rst of the kernel.
"""

from __future__ import annotations

import ctypes
import errno
import platform
import struct
from dataclasses import dataclass

from worker.containment.syscalls import checked, libc

_SET_FILTER = 1
_ALL_THREADS, _KEEP_SPECULATION = 1, 4  # the latter or older kernels slow the whole process down

# Classic BPF: load a word of the call, compare, return.
_LOAD, _EQUAL, _AT_LEAST, _RETURN = 0x20, 0x15, 0x35, 0x06
_NUMBER_AT, _ARCHITECTURE_AT, _FIRST_ARGUMENT_AT = 0, 4, 16
_ALLOW, _FAIL = 0x7FFF0000, 0x00050000
_X32 = 0x40000000  # calls of x86-64's second interface

_UNIX, _NETLINK = 1, 16
_REFUSED = (
    "ptrace",
    "process_vm_readv",
    "process_vm_writev",
    "pidfd_getfd",
    "unshare",
    "setns",
    "mount",
    "keyctl",
    "add_key",
    "request_key",
    "bpf",
    "userfaultfd",
)


@dataclass(frozen=True)
class _Machine:
    """What a kernel calls itself, and its numbers of calls."""

    architecture: int
    seccomp: int
    numbers: dict[str, int]


_MACHINES = {
    "x86_64": _Machine(
        0xC000003E,
        317,
        {
            "socket": 41,
            "ptrace": 101,
            "setpgid": 109,
            "setsid": 112,
            "mount": 165,
            "add_key": 248,
            "request_key": 249,
            "keyctl": 250,
            "unshare": 272,
            "setns": 308,
            "process_vm_readv": 310,
            "process_vm_writev": 311,
            "bpf": 321,
            "userfaultfd": 323,
            "io_uring_setup": 425,
            "pidfd_getfd": 438,
        },
    ),
    "aarch64": _Machine(
        0xC00000B7,
        277,
        {
            "mount": 40,
            "unshare": 97,
            "ptrace": 117,
            "setpgid": 154,
            "setsid": 157,
            "socket": 198,
            "add_key": 217,
            "request_key": 218,
            "keyctl": 219,
            "setns": 268,
            "process_vm_readv": 270,
            "process_vm_writev": 271,
            "bpf": 280,
            "userfaultfd": 282,
            "io_uring_setup": 425,
            "pidfd_getfd": 438,
        },
    ),
}


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_ushort), ("instructions", ctypes.c_char_p))


def _instruction(code: int, value: int, if_true: int = 0, if_false: int = 0) -> bytes:
    return struct.pack("=HBBI", code, if_true, if_false, value)


def program(machine: _Machine, *, network: bool, unix: bool) -> bytes:
    """The filter as the kernel reads it. network, unix: whether such sockets may be opened."""
    fail = _FAIL | errno.EPERM
    code = [
        _instruction(_LOAD, _ARCHITECTURE_AT),
        _instruction(_EQUAL, machine.architecture, if_true=1),
        _instruction(_RETURN, _FAIL | errno.ENOSYS),  # such as 32 bits: other numbers
        _instruction(_LOAD, _NUMBER_AT),
        _instruction(_AT_LEAST, _X32, if_false=1),
        _instruction(_RETURN, _FAIL | errno.ENOSYS),
    ]
    answers = dict.fromkeys(_REFUSED, fail)
    answers |= {"setsid": _FAIL, "setpgid": _FAIL}  # an error of number 0: success
    answers["io_uring_setup"] = _FAIL | errno.ENOSYS
    for name, answer in answers.items():
        code.append(_instruction(_EQUAL, machine.numbers[name], if_false=1))
        code.append(_instruction(_RETURN, answer))
    if not network:
        families = [_NETLINK, *([_UNIX] if unix else [])]
        after = 1 + len(families) + 1
        code.append(_instruction(_EQUAL, machine.numbers["socket"], if_false=after))
        code.append(_instruction(_LOAD, _FIRST_ARGUMENT_AT))
        for index, family in enumerate(families):
            code.append(_instruction(_EQUAL, family, if_true=len(families) - index))
        code.append(_instruction(_RETURN, _FAIL | errno.EACCES))
    code.append(_instruction(_RETURN, _ALLOW))
    return b"".join(code)


def restrict(*, network: bool, unix: bool) -> None:
    """Set the filter for the whole process and all that it starts. Needs `no_new_privs`.

    Raises OSError where the kernel has none, or this kind of machine no filter.
    """
    machine = _MACHINES.get(platform.machine())
    if machine is None:
        raise OSError(errno.ENOSYS, f"no seccomp filter for {platform.machine()}")
    made = program(machine, network=network, unix=unix)
    filter_ = _Program(len(made) // 8, made)
    flags = _ALL_THREADS | _KEEP_SPECULATION
    status = libc().syscall(machine.seccomp, _SET_FILTER, flags, ctypes.byref(filter_))
    checked(status, "seccomp")
