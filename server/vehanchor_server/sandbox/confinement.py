"""Confinement of a worker: the files that it can read and the system calls that it can make.

A compromised decoder has all rights of the worker process. On Linux the process therefore drops
most rights before it loads a model or sees an image, and cannot regain them. It drops all
capabilities. Landlock limits it to reading certain files. Seccomp limits it to the system calls of
decoders and networks (``system_calls``). A refused call fails with an error, like a missing
permission, so that a library that merely probes continues.

``ctypes`` makes the calls. The libraries ``landlock`` and ``py-landlock`` are alphas,
``landlockpy`` is a beta; ``pyseccomp`` needs the system's libseccomp, which slim images lack and
which is under the LGPL.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
import sys
import sysconfig
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from vehanchor_server.sandbox.environment import absolute_folders
from vehanchor_server.sandbox.system_calls import checked, filter_system_calls, last_error

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

    Call it while the process has one thread: Landlock applies to the calling thread and those that
    it starts.

    Args:
        readable: files and folders to allow besides those of the system, Python and its packages.
    """
    if sys.platform != "linux":
        return Confinement(lacks=f"{sys.platform} has neither Landlock nor seccomp")
    libc = ctypes.CDLL(None, use_errno=True)
    _drop_capabilities(libc)
    if libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0):
        return Confinement(lacks=f"no_new_privs: {last_error()}")
    landlock = 0
    seccomp = False
    lacks = []
    try:
        landlock = _restrict_files(libc, [*_needed_files(), *readable])
    except OSError as error:
        lacks.append(f"Landlock: {error.strerror}, so that a worker can read the files of its user")
    try:
        filter_system_calls(libc)
        seccomp = True
    except OSError as error:
        lacks.append(
            f"seccomp: {error.strerror}, so that a worker can open sockets, start programs and "
            "signal others"
        )
    if lacks:
        lacks.append(f"kernel {platform.release()}")
    return Confinement(landlock, seccomp, lacks="; ".join(lacks))


def _drop_capabilities(libc: ctypes.CDLL) -> None:
    """Drop all capabilities; without any, do nothing."""
    for capability in range(_MAX_CAPABILITIES):
        libc.prctl(_PR_CAPBSET_DROP, capability, 0, 0, 0)
    header = struct.pack("=Ii", _CAPABILITIES_VERSION, 0)  # 0 is this process
    no_capabilities = bytes(24)
    libc.capset(header, no_capabilities)


# linux/prctl.h
_PR_SET_NO_NEW_PRIVS = 38
_PR_CAPBSET_DROP = 24
# linux/capability.h, version 3
_MAX_CAPABILITIES = 64
_CAPABILITIES_VERSION = 0x20080522
_SYSTEM_FILES = (
    "/usr",
    "/lib",
    "/lib64",
    "/nix/store",
    "/gnu/store",
    "/etc/ld.so.cache",
    "/etc/localtime",
    "/proc/cpuinfo",
    "/proc/meminfo",
    "/proc/stat",
    "/proc/sys/vm",
    "/proc/self/cgroup",
    "/proc/self/fd",
    "/proc/self/maps",
    "/proc/self/mountinfo",
    "/proc/self/stat",
    "/proc/self/statm",
    "/proc/self/status",
    "/sys/devices/system",
    "/sys/fs/cgroup",
    "/dev/null",
    "/dev/zero",
    "/dev/random",
    "/dev/urandom",
)
"""Shared libraries, and what C libraries read for processors, memory and random numbers."""


def _needed_files() -> Iterator[Path]:
    """List files of the system, Python and packages: modules and libraries load on first use."""
    yield from map(Path, _SYSTEM_FILES)
    yield from map(Path, absolute_folders(os.environ.get("LD_LIBRARY_PATH", "")))
    interpreter = {sys.prefix, sys.base_prefix, sys.exec_prefix, *sysconfig.get_paths().values()}
    yield from map(Path, interpreter)
    # An editable installation has its packages elsewhere; vehanchor_flight may be missing.
    for package in ("vehanchor", "vehanchor_flight", "vehanchor_server"):
        with suppress(ModuleNotFoundError):
            spec = find_spec(package)
            if spec is not None and spec.submodule_search_locations:
                yield from map(Path, spec.submodule_search_locations)
    # Python itself may have added the working directory, which can have the user's files.
    working = Path.cwd()
    home = Path.home()
    for entry in sys.path:
        if not entry:
            continue
        folder = Path(entry)
        if not (working.is_relative_to(folder) or home.is_relative_to(folder)):
            yield folder


# Landlock: linux/landlock.h. The numbers of its system calls are the same on every machine.
_CREATE_RULESET = 444
_ADD_RULE = 445
_RESTRICT_SELF = 446
_VERSION_FLAG = 1
_PATH_BENEATH = 1
_READ_FILE = 1 << 2
_READ_DIR = 1 << 3
_WRITE_FILE = 1 << 1
_FILE_RIGHTS = {1: 13, 2: 14, 3: 15, 5: 16}  # version: number of rights since then
_BIND_AND_CONNECT = 0b11  # TCP, since version 4
_SCOPES = 0b11  # abstract sockets and signals, since version 6


def _restrict_files(libc: ctypes.CDLL, readable: Sequence[Path]) -> int:
    """Limit this thread, and those that it starts, to reading these files.

    Returns:
        Landlock's version.

    Raises:
        OSError: Landlock is missing or forbidden.
    """
    version = checked(libc.syscall(_CREATE_RULESET, None, ctypes.c_size_t(0), _VERSION_FLAG))
    n_rights = max(number for since, number in _FILE_RIGHTS.items() if since <= version)
    # The rights that the rules govern: all that this version knows.
    handled = [(1 << n_rights) - 1]
    if version >= 4:
        handled.append(_BIND_AND_CONNECT)
    if version >= 6:
        handled.append(_SCOPES)
    attributes = struct.pack(f"={len(handled)}Q", *handled)
    ruleset = checked(
        libc.syscall(_CREATE_RULESET, attributes, ctypes.c_size_t(len(attributes)), 0)
    )
    try:
        for path in readable:
            _allow(libc, ruleset, path)
        checked(libc.syscall(_RESTRICT_SELF, ruleset, 0))
    finally:
        os.close(ruleset)
    return version


def _allow(libc: ctypes.CDLL, ruleset: int, path: Path) -> None:
    """Allow reading a file or a folder; ignore missing paths and the file system's root."""
    if path.resolve() == Path(path.anchor):
        return
    with suppress(OSError):
        descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
        rights = _READ_FILE
        if path.is_dir():
            rights |= _READ_DIR
        if path == Path(os.devnull):
            rights |= _WRITE_FILE
        rule = struct.pack("=Qi", rights, descriptor)
        checked(libc.syscall(_ADD_RULE, ruleset, _PATH_BENEATH, rule, 0))
        # The kernel drops an entry of /proc/self, with its rule, that nothing holds open.
        if not path.is_relative_to("/proc/self"):
            os.close(descriptor)
