"""Without its packages an example says in one line which one to install."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

_EXAMPLES = ROOT / "examples"
_SCRIPTS = [*_EXAMPLES.glob("*.py"), *(_EXAMPLES / "frameworks").glob("*.py")]
_SCRIPTS.remove(_EXAMPLES / "live_to_mavlink.py")  # it needs the standard library alone
_ALONE = """import runpy, sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] not in sys.stdlib_module_names:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Missing())
runpy.run_path(sys.argv[1], run_name="__main__")"""


@pytest.mark.parametrize("script", _SCRIPTS, ids=[path.name for path in _SCRIPTS])
def test_it_names_the_package_in_one_line(script: Path) -> None:
    done = subprocess.run([sys.executable, "-c", _ALONE, str(script)], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("this example needs the package '")
    assert ": pip install " in line
