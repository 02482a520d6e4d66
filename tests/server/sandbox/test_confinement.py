"""An attacker in a worker can read images, and reach no other file, network or process."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import json
import logging
import os
import signal
import socket
import subprocess
import sys
import termios
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from subprocess import DEVNULL, PIPE
from typing import Any

import pytest

from tests.server.calls.working import Value, answered, done
from tests.server.sandbox.trace import confined_calls
from tests.server_process import SERVE
from vehanchor_server.calls.job import Job
from vehanchor_server.calls.reply import Reply
from vehanchor_server.calls.task import work
from vehanchor_server.calls.workers import _confinement_message
from vehanchor_server.resources import Resources
from vehanchor_server.sandbox.confinement import Confinement
from vehanchor_server.sandbox.environment import KEPT, SEARCH_PATHS
from vehanchor_server.services import Services

CONFINE = """
import json, platform, sys
from vehanchor_server.sandbox import confinement
{before}
found = confinement.confine([])
print(json.dumps([found.landlock, found.seccomp, found.lacks]))
"""


def confined(before: str = "") -> tuple[int, bool, str]:
    """What a process of its own finds after it has confined itself."""
    done = subprocess.run(
        [sys.executable, "-c", CONFINE.format(before=before)],
        capture_output=True,
        text=True,
        check=True,
    )
    landlock, seccomp, lacks = json.loads(done.stdout)
    return landlock, seccomp, lacks


@pytest.fixture(scope="module")
def held() -> tuple[int, bool, str]:
    return confined()


@dataclass(frozen=True)
class Targets:
    """What a work tries to reach: a file outside the roots, and the server's process."""

    secret: str
    server: int


@work(Value)
def attempts(resources: Resources, job: Job, source: Any, targets: Targets) -> Reply[Value]:
    """Everything that a worker should be kept from, and some things that it needs; in a worker."""
    root = resources.settings.roots[0]
    secret = targets.secret
    server = targets.server
    libc = ctypes.CDLL(None, use_errno=True)

    def checked(result: int) -> None:
        if result < 0:
            raise OSError(ctypes.get_errno(), "")

    tries: dict[str, Callable[[], Any]] = {
        "read an image": (root / "cars.png").read_bytes,
        "read it by its descriptor": lambda: by_descriptor(root / "cars.png"),
        "list the root": lambda: list(root.iterdir()),
        "import what was not": lambda: __import__("xml.dom.pulldom"),
        "start a thread": lambda: started(threading.Thread(target=int)),
        "signal itself": lambda: os.kill(os.getpid(), 0),
        "read /etc/passwd": Path("/etc/passwd").read_bytes,
        "list /etc": lambda: list(Path("/etc").iterdir()),
        "read a secret": Path(secret).read_bytes,
        "read it by a link": (root / "to_secret").read_bytes,
        "read the server's environment": Path(f"/proc/{server}/environ").read_bytes,
        "read the server's memory": Path(f"/proc/{server}/mem").read_bytes,
        "write below the root": lambda: (root / "new.png").write_bytes(b""),
        "write over an image": lambda: (root / "cars.png").open("r+b"),
        "write elsewhere": lambda: Path(secret).with_name("new").write_bytes(b""),
        "make a folder": (root / "new").mkdir,
        "delete an image": (root / "cars.png").unlink,
        "rename an image": lambda: (root / "cars.png").rename(root / "mine.png"),
        "cut an image off": lambda: os.truncate(root / "cars.png", 0),
        "open an image to all": lambda: (root / "cars.png").chmod(0o777),
        "set an image's time": lambda: os.utime(root / "cars.png"),
        "open a TCP socket": socket.socket,
        "open a Unix socket": lambda: socket.socket(socket.AF_UNIX),
        "open a raw socket": lambda: socket.socket(socket.AF_PACKET, socket.SOCK_RAW),
        "fetch": lambda: socket.create_connection(("127.0.0.1", 9), 1),
        "run a program": lambda: subprocess.run(["/bin/true"], check=True),
        "become a program": lambda: os.execv("/bin/true", ["true"]),
        "fork": lambda: checked(os.fork()),
        "kill the server": lambda: os.kill(server, signal.SIGCONT),
        "signal all": lambda: os.kill(-1, 0),
        "trace the server": lambda: checked(libc.ptrace(16, server, 0, 0)),
        "limit the server": lambda: checked(
            libc.prlimit(server, 7, None, ctypes.create_string_buffer(16))
        ),
        "enter a namespace": lambda: checked(libc.unshare(0x10000000)),
        "ask for io_uring": lambda: checked(libc.syscall(425, 4, ctypes.create_string_buffer(120))),
        "list its working directory": lambda: list(Path.cwd().iterdir()),
        "read its environment": Path("/proc/self/environ").read_bytes,
        "read the network's state": Path("/proc/self/net/tcp").read_bytes,
        "type into a terminal": lambda: fcntl.ioctl(2, termios.TIOCSTI, b"x"),
        "have a signal sent to the server": lambda: fcntl.fcntl(0, fcntl.F_SETOWN, server),
        "choose the signal": lambda: fcntl.fcntl(0, 10, signal.SIGKILL),
        "cut a file off while it is opened": lambda: os.open(
            root / "cars.png", os.O_RDONLY | os.O_TRUNC
        ),
        "set its own priority": lambda: checked(libc.setpriority(0, 0, 19)),
        "set the server's priority": lambda: checked(libc.setpriority(0, server, 19)),
        "bind the server to a processor": lambda: os.sched_setaffinity(server, {0}),
        "open a queue of messages": lambda: checked(libc.msgget(0, 0o1600)),
        "open shared memory": lambda: checked(libc.shmget(0, 4096, 0o1600)),
        "name the host": lambda: checked(libc.sethostname(b"mine", 4)),
    }
    outcomes = {}
    for name, attempt in tries.items():
        try:
            attempt()
            outcomes[name] = "done"
        except OSError as error:
            outcomes[name] = errno.errorcode[error.errno or 0]
    return answered(outcomes)


def by_descriptor(path: Path) -> None:
    with path.open("rb") as file, Path(f"/proc/self/fd/{file.fileno()}").open("rb") as again:
        assert again.read()


def started(thread: threading.Thread) -> None:
    thread.start()
    thread.join()


@pytest.mark.promise("confinement")
@pytest.mark.slow
def test_a_worker_can_do_nothing_but_its_work(
    running: Services, held: tuple[int, bool, str], tmp_path: Path
) -> None:
    if not (held[0] and held[1]):
        pytest.skip(f"this system does not confine: {held[2]}")
    root = running.resources.settings.roots[0]
    secret = tmp_path / "token"
    secret.write_text("hunter2")
    (root / "cars.png").write_bytes(b"pixels")
    (root / "to_secret").symlink_to(secret)
    outcomes = done(running, attempts, Targets(str(secret), os.getpid()))
    needed = [
        "read an image",
        "read it by its descriptor",
        "list the root",
        "import what was not",
        "start a thread",
    ]
    assert {name for name, outcome in outcomes.items() if outcome == "done"} == {
        *needed,
        "signal itself",
    }
    # as on a kernel that is older than the call
    assert outcomes.pop("ask for io_uring") == "ENOSYS"
    assert set(outcomes.values()) == {"done", "EACCES", "EPERM"}
    assert outcomes["read /etc/passwd"] == outcomes["read it by a link"] == "EACCES"
    assert outcomes["open a TCP socket"] == outcomes["run a program"] == outcomes["fork"] == "EPERM"


@pytest.mark.promise("warning")
@pytest.mark.skipif(sys.platform != "linux", reason="made for what a Linux may lack")
@pytest.mark.parametrize(
    ("before", "words", "landlock", "seccomp"),
    [
        (
            "confinement._CREATE_RULESET = 4095",
            "Landlock: Function not implemented, so that a worker can read",
            False,
            True,
        ),
        (
            "platform.machine = lambda: 'pdp11'",
            "seccomp: no system call numbers for pdp11",
            True,
            False,
        ),
        ("sys.platform = 'darwin'", "darwin has neither Landlock nor seccomp", False, False),
    ],
)
def test_missing_confinement_is_stated_beside_the_rest(
    before: str, words: str, landlock: bool, seccomp: bool, held: tuple[int, bool, str]
) -> None:
    result = confined(before)
    assert words in result[2]
    assert bool(result[0]) == (landlock and bool(held[0]))
    assert result[1] == (seccomp and held[1])


@pytest.mark.promise("warning")
@pytest.mark.parametrize(
    ("isolation", "words"),
    [
        ("unconfined", "workers are not confined (the operator's settings)"),
        ("in-process", "there are no workers (isolation in-process)"),
    ],
)
def test_a_server_without_confinement_says_so_at_its_start(isolation: str, words: str) -> None:
    with subprocess.Popen(
        [*SERVE, "--isolation", isolation], stdin=PIPE, stdout=DEVNULL, stderr=PIPE, text=True
    ) as server:
        assert server.stderr is not None
        line = next(line for line in server.stderr if '"warning"' in line)
        server.kill()
    assert words in json.loads(line)["message"]


@pytest.mark.promise("warning")
@pytest.mark.parametrize(
    ("confinement", "level", "text"),
    [
        (Confinement(6, seccomp=True), logging.INFO, "confined by Landlock 6 and seccomp"),
        (Confinement(0, seccomp=True, lacks="x"), logging.WARNING, "confined by seccomp (x)"),
        (Confinement(lacks="x"), logging.WARNING, "workers are not confined (x)"),
    ],
)
def test_incomplete_confinement_is_logged_as_a_warning(
    confinement: Confinement, level: int, text: str
) -> None:
    logged_level, logged_text = _confinement_message(confinement)
    assert logged_level == level
    assert logged_text.endswith(text)


@work(Value)
def inherited(resources: Resources, job: Job, source: Any, _: None) -> Reply[Value]:
    """The descriptors and the environment variables of a worker."""
    folder = Path("/proc/self/fd")
    names = {int(link.name): str(link.readlink()) for link in folder.iterdir() if link.is_symlink()}
    return answered({"descriptors": names, "variables": dict(os.environ)})


@pytest.fixture(scope="module")
def inheritance(running: Services) -> dict[str, Any]:
    """The descriptors and the environment variables of a worker."""
    answer: dict[str, Any] = done(running, inherited)
    return answer


@pytest.mark.promise("inheritance")
@pytest.mark.slow
def test_a_worker_inherits_no_secret(inheritance: dict[str, Any]) -> None:
    of_terminals = {"LINES", "COLUMNS"}  # variables of the C library
    assert set(inheritance["variables"]) - of_terminals <= KEPT | set(SEARCH_PATHS)


@pytest.mark.promise("inheritance")
@pytest.mark.slow
def test_the_streams_of_a_worker_lead_to_its_log(inheritance: dict[str, Any]) -> None:
    descriptors = inheritance["descriptors"]
    assert descriptors["0"] == os.devnull
    assert descriptors["1"] == descriptors["2"]
    assert descriptors["1"].startswith("pipe:")


@pytest.mark.promise("inheritance")
@pytest.mark.slow
def test_a_worker_inherits_no_socket_but_its_own(inheritance: dict[str, Any]) -> None:
    descriptors = inheritance["descriptors"]
    sockets = [target for target in descriptors.values() if target.startswith("socket:")]
    assert len(sockets) == 1
    others = [
        target
        for number, target in descriptors.items()
        if number not in ("0", "1", "2") and target not in sockets
    ]
    own = ("/proc/", "anon_inode:", "pipe:")
    assert all(target.startswith(own) for target in others), others


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
