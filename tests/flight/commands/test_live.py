from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.flight.photographs import write_flight
from tests.models import write_detector
from vehanchor.cli import app as cli
from vehanchor_flight.records import LiveScale

if TYPE_CHECKING:
    from pathlib import Path

    from typer.testing import Result

FLEET = list(30.0 * (1 + 0.06 * np.linspace(-1, 1, 9) ** 3))


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Runs ``vehanchor flight live`` in a folder with one photograph of cars."""
    write_flight(tmp_path, [FLEET])
    write_detector(tmp_path / "detector.onnx")
    monkeypatch.chdir(tmp_path)

    def invoke(*arguments: object) -> Result:
        return CliRunner().invoke(cli.app, ["flight", "live", *map(str, arguments), "--detector", "detector.onnx"])

    return invoke


def test_each_frame_is_one_line_of_json(run: Any) -> None:
    done = run(".", "--idle", 1)
    assert done.exit_code == 0, done.output
    (line,) = done.stdout.splitlines()
    record = LiveScale.model_validate(json.loads(line))
    assert record.frame == "0.png"
    assert record.gsd_m_per_px == pytest.approx(0.168, rel=0.02)


@pytest.mark.parametrize(
    "arguments",
    [
        ("nowhere",),
        (".", "--hold", "0"),
        (".", "--idle", "-1"),
    ],
)
def test_a_wrong_argument_is_refused_before_the_work(run: Any, arguments: tuple[str, ...]) -> None:
    done = run(*arguments)
    assert done.exit_code == 2
    assert done.stderr.startswith("error[")
