"""Sandbox of a worker: the files that it can read and the system calls that it can make.

Code that takes over a decoder has all rights of the worker process. On Linux the process drops most rights before it
loads a model or sees an image, and cannot regain them. Landlock limits it to reading certain files. A seccomp filter
refuses sockets, program execution, new processes, memory and signals of other processes, changes of file owners and
modes, and rarely used kernel interfaces. Refused calls fail with an error, like missing permissions, so that a
library that merely tries them continues.

``ctypes`` makes the system calls. Among the libraries for Landlock, ``landlock`` and ``py-landlock`` are alphas and
``landlockpy`` is a beta of a few weeks. ``pyseccomp`` needs the system's libseccomp, which slim images lack and which
is under the LGPL. Three system calls, and a filter with two instructions per rule, need none of them.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import struct
import sys
import sysconfig
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import vehanchor
import vehanchor_server

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence


@dataclass(frozen=True)
class Confinement:
    """Confinement of a process.

    Attributes:
        landlock: version of Landlock; 0 without Landlock.
        seccomp: whether system calls are filtered.
        lacks: reason for missing confinement; empty if complete.
    """

    landlock: int = 0
    seccomp: bool = False
    lacks: str = ""


def confine(readable: Iterable[Path]) -> Confinement:
    """Drop, permanently, all rights of this process that decoding and models do not need.

    Call it while the process has one thread: Landlock applies to the calling thread and those that it starts.

    Args:
        readable: files and folders to allow besides those of the system, Python and its packages.
    """
    if sys.platform != "linux":
        return Confinement(lacks=f"{sys.platform} has neither Landlock nor seccomp")
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0):
        return Confinement(lacks=f"no_new_privs: {_last_error()}")
    landlock, seccomp, lacks = 0, False, []
    try:
        landlock = _restrict_files(libc, [*_needed_files(), *readable])
    except OSError as error:
        lacks.append(f"Landlock: {error.strerror}")
    try:
        _filter_calls(libc)
        seccomp = True
    except OSError as error:
        lacks.append(f"seccomp: {error.strerror}")
    return Confinement(landlock, seccomp, "; ".join(lacks))


_PR_SET_NO_NEW_PRIVS = 38
_SYSTEM_FILES = (
    *("/usr", "/lib", "/lib64", "/nix/store", "/gnu/store", "/etc/ld.so.cache", "/etc/localtime"),
    *("/proc/self", "/proc/cpuinfo", "/proc/meminfo", "/proc/stat", "/proc/sys/vm"),
    *("/sys/devices/system", "/sys/fs/cgroup", "/dev/null", "/dev/zero", "/dev/random", "/dev/urandom"),
)
"""Shared libraries, and the files that C libraries read for processors, memory and random numbers."""


def _needed_files() -> Iterator[Path]:
    """List files of the system, Python and packages, because modules and libraries load on first use."""
    yield from map(Path, _SYSTEM_FILES)
    yield from map(Path, os.environ.get("LD_LIBRARY_PATH", "").split(":"))
    yield from map(Path, {sys.prefix, sys.base_prefix, sys.exec_prefix, *sysconfig.get_paths().values()})
    yield from (Path(folder) for package in (vehanchor, vehanchor_server) for folder in package.__path__)
    working, home = Path.cwd(), Path.home()
    for entry in map(Path, filter(None, sys.path)):
        if not (working.is_relative_to(entry) or home.is_relative_to(entry)):  # Python may have added them itself
            yield entry


# Landlock: linux/landlock.h. The numbers of its system calls are the same on every machine.
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_VERSION_FLAG, _PATH_BENEATH = 1, 1
_READ_FILE, _READ_DIR, _WRITE_FILE = 1 << 2, 1 << 3, 1 << 1
_FILE_RIGHTS = {1: 13, 2: 14, 3: 15, 5: 16}  # number of rights since a version
_BIND_AND_CONNECT = 0b11  # TCP, since version 4
_SCOPES = 0b11  # abstract sockets and signals, since version 6


def _restrict_files(libc: ctypes.CDLL, readable: Sequence[Path]) -> int:
    """Limit this thread, and those that it starts, to reading these files; return Landlock's version.

    Raises:
        OSError: Landlock is missing, disabled or forbidden.
    """
    version = _checked(libc.syscall(_CREATE_RULESET, None, ctypes.c_size_t(0), _VERSION_FLAG))
    n_rights = max(n for since, n in _FILE_RIGHTS.items() if since <= version)
    handled = [(1 << n_rights) - 1]
    if version >= 4:
        handled.append(_BIND_AND_CONNECT)
    if version >= 6:
        handled.append(_SCOPES)
    attributes = struct.pack(f"={len(handled)}Q", *handled)
    ruleset = _checked(libc.syscall(_CREATE_RULESET, attributes, ctypes.c_size_t(len(attributes)), 0))
    try:
        for path in readable:
            _allow(libc, ruleset, path)
        _checked(libc.syscall(_RESTRICT_SELF, ruleset, 0))
    finally:
        os.close(ruleset)
    return version


def _allow(libc: ctypes.CDLL, ruleset: int, path: Path) -> None:
    """Allow reading a file or a folder; ignore missing paths and the file system's root."""
    if path.resolve() == Path(path.anchor):
        return
    with suppress(OSError):
        descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
        rights = _READ_FILE | (_READ_DIR if path.is_dir() else 0) | (_WRITE_FILE if path == Path(os.devnull) else 0)
        rule = struct.pack("=Qi", rights, descriptor)
        _checked(libc.syscall(_ADD_RULE, ruleset, _PATH_BENEATH, rule, 0))
        if path != Path("/proc/self"):  # without an open descriptor, the kernel drops an entry of /proc with its rule
            os.close(descriptor)


# seccomp: linux/seccomp.h, linux/filter.h, asm/unistd.h.
_SET_MODE_FILTER, _TO_ALL_THREADS = 1, 1
_ALLOW, _KILL_PROCESS, _REFUSE = 0x7FFF0000, 0x80000000, 0x00050000  # and the error's number
_LOAD, _EQUAL, _AT_LEAST, _ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
_NUMBER_AT, _MACHINE_AT, _ARGUMENT_AT = 0, 4, 16  # in struct seccomp_data; of the first argument the lower half
_OTHER_NUMBERS = 0x40000000  # of x32, a second set on x86_64
_CLONE_THREAD = 0x10000


class _Machine(NamedTuple):
    """Numbers of system calls on a processor architecture.

    Attributes:
        name: architecture in the audit interface.
        seccomp: the call ``seccomp``.
        refused: calls that image processing does not need.
        clone: starts threads and processes.
        clone3: takes a structure that filters cannot read; the C library falls back to ``clone``.
        to_itself: allowed with this process as the first argument.
        to_none: allowed with 0 as the first argument, which means this process.
    """

    name: int
    seccomp: int
    refused: tuple[int, ...]
    clone: int
    clone3: int
    to_itself: tuple[int, ...]
    to_none: tuple[int, ...]


_NEW_CALLS = (  # the same numbers on all architectures
    *(424, 434, 438, 440),  # pidfd_send_signal pidfd_open pidfd_getfd process_madvise
    *(425, 426, 427),  # io_uring_setup io_uring_enter io_uring_register
    *(428, 429, 430, 431, 432, 433, 442),  # open_tree move_mount fsopen fsconfig fsmount fspick mount_setattr
    *(452, 463, 466),  # fchmodat2 setxattrat removexattrat
)
_MACHINES = {
    "x86_64": _Machine(
        name=0xC000003E,
        seccomp=317,
        refused=(
            *_NEW_CALLS,
            *(41, 42, 43, 49, 50, 53, 288),  # socket connect accept bind listen socketpair accept4
            *(57, 58, 59, 322),  # fork vfork execve execveat
            *(101, 310, 311, 312),  # ptrace process_vm_readv process_vm_writev kcmp
            *(200, 129, 297),  # tkill rt_sigqueueinfo rt_tgsigqueueinfo
            *(321, 298, 323, 248, 249, 250),  # bpf perf_event_open userfaultfd add_key request_key keyctl
            *(165, 166, 155, 161, 272, 308, 304),  # mount umount2 pivot_root chroot unshare setns open_by_handle_at
            *(246, 320, 175, 313, 176),  # kexec_load kexec_file_load init_module finit_module delete_module
            *(90, 91, 268, 92, 93, 94, 260),  # chmod fchmod fchmodat chown fchown lchown fchownat
            *(188, 189, 190, 197, 198, 199),  # setxattr lsetxattr fsetxattr removexattr lremovexattr fremovexattr
            *(132, 235, 261, 280),  # utime utimes futimesat utimensat
        ),
        clone=56,
        clone3=435,
        to_itself=(62, 234),  # kill tgkill
        to_none=(302,),  # prlimit64
    ),
    "aarch64": _Machine(
        name=0xC00000B7,
        seccomp=277,
        refused=(
            *_NEW_CALLS,
            *(198, 203, 202, 200, 201, 199, 242),  # socket connect accept bind listen socketpair accept4
            *(221, 281),  # execve execveat
            *(117, 270, 271, 272),  # ptrace process_vm_readv process_vm_writev kcmp
            *(130, 138, 240),  # tkill rt_sigqueueinfo rt_tgsigqueueinfo
            *(280, 241, 282, 217, 218, 219),  # bpf perf_event_open userfaultfd add_key request_key keyctl
            *(40, 39, 41, 51, 97, 268, 265),  # mount umount2 pivot_root chroot unshare setns open_by_handle_at
            *(104, 294, 105, 273, 106),  # kexec_load kexec_file_load init_module finit_module delete_module
            *(52, 53, 54, 55),  # fchmod fchmodat fchownat fchown
            *(5, 6, 7, 14, 15, 16, 88),  # setxattr l f, removexattr l f, utimensat
        ),
        clone=220,
        clone3=435,
        to_itself=(129, 131),  # kill tgkill
        to_none=(261,),  # prlimit64
    ),
}


def _filter_calls(libc: ctypes.CDLL) -> None:
    """Install the filter of system calls in all threads.

    Raises:
        OSError: seccomp is missing or forbidden, or the architecture is unknown.
    """
    machine = _MACHINES.get(platform.machine())
    if machine is None or sys.maxsize < 1 << 32:
        raise OSError(errno.ENOSYS, f"no system call numbers for {platform.machine()}")
    instructions = _instructions(machine, os.getpid())
    code = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *each) for each in instructions))
    program = struct.pack("@HP", len(instructions), ctypes.addressof(code))
    _checked(libc.syscall(machine.seccomp, _SET_MODE_FILTER, _TO_ALL_THREADS, program))


def _instructions(machine: _Machine, pid: int) -> list[tuple[int, int, int, int]]:
    """Return the filter: code, jump offsets if true and if false, and operand of each instruction."""
    forbidden, unknown = (_RETURN, 0, 0, _REFUSE | errno.EPERM), (_RETURN, 0, 0, _REFUSE | errno.ENOSYS)
    allowed, load_number = (_RETURN, 0, 0, _ALLOW), (_LOAD, 0, 0, _NUMBER_AT)
    load_argument = (_LOAD, 0, 0, _ARGUMENT_AT)
    program = [(_LOAD, 0, 0, _MACHINE_AT), (_EQUAL, 1, 0, machine.name), (_RETURN, 0, 0, _KILL_PROCESS), load_number]
    program += [(_AT_LEAST, 0, 1, _OTHER_NUMBERS), forbidden, (_EQUAL, 0, 1, machine.clone3), unknown]
    program += [(_EQUAL, 0, 4, machine.clone), load_argument, (_ANY_BIT, 0, 1, _CLONE_THREAD), allowed, forbidden]
    for number, only in [*((each, pid) for each in machine.to_itself), *((each, 0) for each in machine.to_none)]:
        program += [(_EQUAL, 0, 4, number), load_argument, (_EQUAL, 0, 1, only), allowed, forbidden]
    for number in machine.refused:
        program += [(_EQUAL, 0, 1, number), forbidden]
    return [*program, allowed]


def _checked(result: int) -> int:
    """Return the result of a system call.

    Raises:
        OSError: the call failed.
    """
    if result < 0:
        raise OSError(ctypes.get_errno(), _last_error())
    return result


def _last_error() -> str:
    return os.strerror(ctypes.get_errno())
