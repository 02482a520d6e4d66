"""System calls that a worker can make: those that decoders and networks need.

The seccomp filter allows the calls in ``ALLOWED``, some with certain arguments only. It refuses all
others with an error. ``tests/server/sandbox/trace.py`` showed 49 of the calls in a worker that read
JPEG, PNG, WebP, AVIF, JPEG 2000, BMP and GeoTIFF, ran all networks, measured and drew. The other
allowed calls are their equivalents in other C libraries and on other processors.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import struct
import sys
from typing import NamedTuple, TypeAlias

# linux/seccomp.h, linux/filter.h, asm/unistd.h
_SET_MODE_FILTER = 1
_TO_ALL_THREADS = 1
# Verdicts; a refusal has the number of the error in its lower bits.
_ALLOW = 0x7FFF0000
_KILL_PROCESS = 0x80000000
_REFUSE = 0x00050000
# Instructions: load a word, jump on a comparison, return a verdict.
_LOAD = 0x20
_EQUAL = 0x15
_AT_LEAST = 0x35
_ANY_BIT = 0x45
_RETURN = 0x06
# Offsets in struct seccomp_data; arguments have eight bytes.
_NUMBER_AT = 0
_MACHINE_AT = 4
_ARGUMENTS_AT = 16
_OTHER_NUMBERS = 0x40000000  # of x32, a second set on x86_64
_FIRST_NEW = 424  # later calls have the same number on all architectures; C libraries fall back
_CLONE_THREAD = 0x10000
_CREATE_OR_TRUNCATE = 0o100 | 0o1000 | 0o20000000  # O_CREAT, O_TRUNC, O_TMPFILE
_OWN_PROCESS = -1  # placeholder for the process id in a rule


_Instruction: TypeAlias = tuple[int, int, int, int]
"""Code, jump offset if true, jump offset if false, operand (struct sock_filter)."""


class _Rule(NamedTuple):
    """A condition on one argument of a call.

    Attributes:
        argument: index of the argument.
        values: allowed values; with ``bits``, a bit mask.
        bits: None compares the value; True requires one of the bits, False forbids them.
    """

    argument: int
    values: tuple[int, ...]
    bits: bool | None = None


# TCGETS TIOCGWINSZ FIONREAD FIONBIO FIO(N)CLEX
_TERMINAL_QUESTIONS = (0x5401, 0x5413, 0x541B, 0x5421, 0x5450, 0x5451)
# F_DUPFD F_GETFD F_SETFD F_GETFL F_SETFL F_DUPFD_CLOEXEC
_DESCRIPTOR_COMMANDS = (0, 1, 2, 3, 4, 1030)
_THREAD_NAMES = (15, 16, 0x53564D41)  # PR_SET_NAME PR_GET_NAME PR_SET_VMA

# Call: numbers on x86_64 and aarch64 (None if missing), and a rule on its arguments.
ALLOWED: dict[str, tuple[int | None, int | None, _Rule | None]] = {
    # memory
    "mmap": (9, 222, None),
    "mprotect": (10, 226, None),
    "munmap": (11, 215, None),
    "brk": (12, 214, None),
    "mremap": (25, 216, None),
    "mincore": (27, 232, None),
    "madvise": (28, 233, None),
    "mbind": (237, 235, None),
    "get_mempolicy": (239, 236, None),
    "membarrier": (324, 283, None),
    # open files
    "read": (0, 63, None),
    "write": (1, 64, None),
    "close": (3, 57, None),
    "fstat": (5, 80, None),
    "poll": (7, None, None),
    "lseek": (8, 62, None),
    "ioctl": (16, 29, _Rule(1, _TERMINAL_QUESTIONS)),
    "pread64": (17, 67, None),
    "readv": (19, 65, None),
    "writev": (20, 66, None),
    "select": (23, None, None),
    "dup": (32, 23, None),
    "dup2": (33, None, None),
    "dup3": (292, 24, None),
    "fcntl": (72, 25, _Rule(1, _DESCRIPTOR_COMMANDS)),
    "fadvise64": (221, 223, None),
    "getdents64": (217, 61, None),
    "epoll_wait": (232, None, None),
    "epoll_ctl": (233, 21, None),
    "pselect6": (270, 72, None),
    "ppoll": (271, 73, None),
    "epoll_pwait": (281, 22, None),
    "eventfd2": (290, 19, None),
    "epoll_create1": (291, 20, None),
    "pipe2": (293, 59, None),
    "preadv": (295, 69, None),
    "fstatfs": (138, 44, None),
    # files by name, for reading
    "open": (2, None, _Rule(1, (_CREATE_OR_TRUNCATE,), bits=False)),
    "stat": (4, None, None),
    "lstat": (6, None, None),
    "access": (21, None, None),
    "getcwd": (79, 17, None),
    "readlink": (89, None, None),
    "statfs": (137, 43, None),
    "openat": (257, 56, _Rule(2, (_CREATE_OR_TRUNCATE,), bits=False)),
    "newfstatat": (262, 79, None),
    "readlinkat": (267, 78, None),
    "faccessat": (269, 48, None),
    "statx": (332, 291, None),
    "faccessat2": (439, 439, None),
    # threads
    "sched_yield": (24, 124, None),
    "clone": (56, 220, _Rule(0, (_CLONE_THREAD,), bits=True)),
    "exit": (60, 93, None),
    "gettid": (186, 178, None),
    "futex": (202, 98, None),
    "sched_getaffinity": (204, 123, None),
    "set_tid_address": (218, 96, None),
    "exit_group": (231, 94, None),
    "set_robust_list": (273, 99, None),
    "get_robust_list": (274, 100, None),
    "getcpu": (309, 168, None),
    "rseq": (334, 293, None),
    "arch_prctl": (158, None, None),
    "prctl": (157, 167, _Rule(0, _THREAD_NAMES)),
    # signals, to itself
    "rt_sigaction": (13, 134, None),
    "rt_sigprocmask": (14, 135, None),
    "rt_sigreturn": (15, 139, None),
    "kill": (62, 129, _Rule(0, (_OWN_PROCESS,))),
    "sigaltstack": (131, 132, None),
    "restart_syscall": (219, 128, None),
    "tgkill": (234, 131, _Rule(0, (_OWN_PROCESS,))),
    # time
    "nanosleep": (35, 101, None),
    "gettimeofday": (96, 169, None),
    "clock_gettime": (228, 113, None),
    "clock_getres": (229, 114, None),
    "clock_nanosleep": (230, 115, None),
    # information on machine and process, and limits
    "getpid": (39, 172, None),
    "uname": (63, 160, None),
    "getrlimit": (97, 163, None),
    "getrusage": (98, 165, None),
    "sysinfo": (99, 179, None),
    "times": (100, 153, None),
    "getuid": (102, 174, None),
    "getgid": (104, 176, None),
    "geteuid": (107, 175, None),
    "getegid": (108, 177, None),
    "getppid": (110, 173, None),
    "setrlimit": (160, 164, None),
    "prlimit64": (302, 261, _Rule(0, (0,))),
    "getrandom": (318, 278, None),
}
_VERDICT_FORBIDDEN = (_RETURN, 0, 0, _REFUSE | errno.EPERM)
_VERDICT_UNKNOWN = (_RETURN, 0, 0, _REFUSE | errno.ENOSYS)
_VERDICT_ALLOWED = (_RETURN, 0, 0, _ALLOW)


class _Machine(NamedTuple):
    """Processor architecture.

    Attributes:
        column: index of its numbers in ``ALLOWED``.
        audit_name: its value in struct seccomp_data.
        seccomp: number of the system call that installs a filter.
    """

    column: int
    audit_name: int
    seccomp: int


_MACHINES = {
    "x86_64": _Machine(0, audit_name=0xC000003E, seccomp=317),
    "aarch64": _Machine(1, audit_name=0xC00000B7, seccomp=277),
}


def filter_system_calls(libc: ctypes.CDLL) -> None:
    """Install the filter in all threads.

    Raises:
        OSError: seccomp is missing or forbidden, or the architecture is unknown.
    """
    machine = _MACHINES.get(platform.machine())
    if machine is None or sys.maxsize < 1 << 32:
        raise OSError(errno.ENOSYS, f"no system call numbers for {platform.machine()}")
    instructions = _instructions(machine, os.getpid())
    packed = [struct.pack("=HBBI", *instruction) for instruction in instructions]
    code = ctypes.create_string_buffer(b"".join(packed))
    program = struct.pack("@HP", len(instructions), ctypes.addressof(code))
    checked(libc.syscall(machine.seccomp, _SET_MODE_FILTER, _TO_ALL_THREADS, program))


def _instructions(machine: _Machine, pid: int) -> list[_Instruction]:
    """Return the program of the filter, which the kernel runs for each system call."""
    # Refuse the call numbers of another architecture, which would mean other calls.
    program = [
        (_LOAD, 0, 0, _MACHINE_AT),
        (_EQUAL, 1, 0, machine.audit_name),
        (_RETURN, 0, 0, _KILL_PROCESS),
        (_LOAD, 0, 0, _NUMBER_AT),
        (_AT_LEAST, 0, 1, _OTHER_NUMBERS),
        _VERDICT_FORBIDDEN,
    ]
    # For each allowed call: jump over its verdict if the number is another.
    for *numbers, rule in ALLOWED.values():
        number = numbers[machine.column]
        if number is None:
            continue
        verdict = [_VERDICT_ALLOWED]
        if rule is not None:
            verdict = _checks(rule, pid)
        program += [(_EQUAL, 0, len(verdict), number), *verdict]
    # All others: a new call does not exist, so that C libraries fall back to an older one.
    return [*program, (_AT_LEAST, 0, 1, _FIRST_NEW), _VERDICT_UNKNOWN, _VERDICT_FORBIDDEN]


def _checks(rule: _Rule, pid: int) -> list[_Instruction]:
    """Return the instructions that check the lower half of an argument."""
    load = (_LOAD, 0, 0, _ARGUMENTS_AT + 8 * rule.argument)
    if rule.bits is not None:
        if_set = _VERDICT_ALLOWED if rule.bits else _VERDICT_FORBIDDEN
        if_clear = _VERDICT_FORBIDDEN if rule.bits else _VERDICT_ALLOWED
        return [load, (_ANY_BIT, 0, 1, rule.values[0]), if_set, if_clear]
    comparisons = []
    for position, value in enumerate(rule.values):
        operand = pid if value == _OWN_PROCESS else value
        # An equal value jumps over the later comparisons and the refusal.
        comparisons.append((_EQUAL, len(rule.values) - position, 0, operand))
    return [load, *comparisons, _VERDICT_FORBIDDEN, _VERDICT_ALLOWED]


def checked(result: int) -> int:
    """Return the result of a system call.

    Raises:
        OSError: the call failed.
    """
    if result < 0:
        raise OSError(ctypes.get_errno(), last_error())
    return result


def last_error() -> str:
    """Return the message of the last error of a system call."""
    return os.strerror(ctypes.get_errno())
