from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.skill.cut_off import CALIBRATION
from vehanchor.errors import OutputError
from vehanchor.storage.atomic import whole_file
from vehanchor_evaluation.calibration_file import save_calibration


def test_a_refused_flush_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "c.json"
    path.write_bytes(b"old")

    def refused(descriptor: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "fsync", refused)
    with pytest.raises(OutputError):
        save_calibration(path, CALIBRATION)
    assert path.read_bytes() == b"old"


KILLED = """
import os, signal, sys
from pathlib import Path
from vehanchor.storage.atomic import whole_file

with whole_file(Path(sys.argv[1])) as partial:
    with partial.open("wb") as file:
        file.write(b"new" * int(sys.argv[2]))
        file.flush()
        os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="Windows has no kill -9")
@pytest.mark.parametrize("n_bytes", [0, 100_000])
def test_a_killed_process_leaves_the_old_file(tmp_path: Path, n_bytes: int) -> None:
    path = tmp_path / "t.json"
    path.write_bytes(b"old")
    done = subprocess.run([sys.executable, "-c", KILLED, str(path), str(n_bytes)], check=False)
    assert done.returncode == -signal.SIGKILL
    assert path.read_bytes() == b"old"
    with whole_file(path) as partial:
        partial.write_bytes(b"new")
    assert path.read_bytes() == b"new"


@pytest.mark.promise("files")
@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGXFSZ"), reason="Windows has no limit of a file's size")
def test_no_file_is_half_written_wherever_the_disk_is_full_or_the_process_killed(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.skill.cut_off", str(tmp_path)]
    done = subprocess.run(command, cwd=Path(__file__).parents[3], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["wrong"] == []
    assert found["ends"]["refused"] > 100
    assert found["ends"]["killed"] > 40
