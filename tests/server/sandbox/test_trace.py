from __future__ import annotations

from vehanchor_server.sandbox.trace import confined_calls


def test_calls_count_from_the_filter_on_with_those_of_later_threads() -> None:
    lines = [
        '10 openat(AT_FDCWD, "/etc/passwd", O_RDONLY) = 3',
        "10 seccomp(SECCOMP_SET_MODE_FILTER, SECCOMP_FILTER_FLAG_TSYNC, {len=1, filter=0x1}) = 0",
        "10 clone(child_stack=0x7f, flags=CLONE_VM|CLONE_THREAD <unfinished ...>",
        "11 futex(0x7f, FUTEX_WAIT <unfinished ...>",
        "10 <... clone resumed>, parent_tid=[12]) = 12",
        "12 mmap(NULL, 4096) = 0x7f0000000000",
        "11 socket(AF_INET, SOCK_STREAM) = 4",
        "+++ exited with 0 +++",
    ]
    assert confined_calls(lines) == {"clone", "mmap"}
