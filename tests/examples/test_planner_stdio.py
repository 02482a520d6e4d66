"""The planner follows its rules, and decides on the shipped scenes as their README states."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import jsonschema
import pytest
from mcp.types import CallToolResult

from tests.conftest import ROOT
from vehanchor.records import Reason
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings
from vehanchor_server.tools.registry import create_tools

SCENES = ROOT / "examples" / "scenes"
_README = (SCENES / "README.md").read_text(encoding="utf-8")
_ROWS = re.findall(
    r"^\| `(\w+\.jpg)` .*`--zone ([\d ]+)` \| `(\w+)` \|$", _README, flags=re.MULTILINE
)
_RENDERINGS = re.findall(
    r"^\$ python -m research\.scenes ((\w+\.jpg) .*)$", _README, flags=re.MULTILINE
)


def _record(**changes: Any) -> dict[str, Any]:
    record = {
        "status": "ok",
        "scale_confidence": 0.95,
        "fit": {"fit_probability": 0.94, "center": {"x_px": 40.5, "y_px": 30.5}},
    }
    return record | changes


@pytest.fixture(scope="module")
def planner() -> Any:
    """The example, a script, imported as a module."""
    path = ROOT / "examples" / "planner_stdio.py"
    spec = importlib.util.spec_from_file_location("example_planner_stdio", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look up their module.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def decide_zone(planner: Any) -> Callable[[dict[str, Any]], Any]:
    ruler = planner.Ruler("the ruler")
    zone = planner.Zone(0, 0, x_max=80, y_max=60)
    craft = planner.Craft(4.0, 2.0)
    return lambda record: planner.decide_zone(record, ruler, zone, craft)


@pytest.mark.parametrize("reason", get_args(Reason))
def test_an_unusable_scale_holds_altitude_whatever_the_size(
    decide_zone: Callable[[dict[str, Any]], Any], reason: str
) -> None:
    record = _record(status="low_confidence", scale_confidence=0.89, reason=reason)
    fit = {**record["fit"], "fit_probability": 1.0}
    decision = decide_zone(record | {"fit": fit})
    assert decision.action == "hold_altitude"
    assert "confidence 0.89" in decision.reason
    assert f": {reason}; " in decision.reason


@pytest.mark.parametrize("reason", get_args(Reason))
def test_only_a_coarse_image_advises_to_fly_lower(
    decide_zone: Callable[[dict[str, Any]], Any], reason: str
) -> None:
    record = _record(status="low_confidence", scale_confidence=0.89, reason=reason)
    assert ("fly lower" in decide_zone(record).reason) == (reason == "too_coarse")


@pytest.mark.parametrize("gsd_m_per_px", [None, 0.1])
@pytest.mark.anyio
async def test_the_planner_uses_listed_arguments_only(
    planner: Any, gsd_m_per_px: float | None
) -> None:
    calls = []

    class Recorder:
        async def call_tool(self, name: str, arguments: dict[str, Any]) -> CallToolResult:
            calls.append((name, arguments))
            record = {"status": "no_scale", "reason": "too_few"}
            return CallToolResult(content=[], structured_content=record)

    await planner.decide(
        Recorder(),
        Path("a.jpg"),
        zones=[planner.Zone(1, 2, x_max=30, y_max=40)],
        rulers=[planner.Ruler("a ruler", gsd_m_per_px)],
        craft=planner.Craft(4.0, 2.0),
        region="europe",
    )
    tools = create_tools(create_services(Settings(roots=(ROOT,))))
    (measure_area,) = [tool for tool in tools if tool.name == "measure_area"]
    ((name, arguments),) = calls
    assert name == "measure_area"
    jsonschema.validate(arguments, measure_area.parameters)


def _planned(*arguments: str) -> tuple[dict[str, Any], str]:
    """Run the planner; return its decision and its log."""
    done = subprocess.run(
        [sys.executable, str(ROOT / "examples" / "planner_stdio.py"), *arguments],
        cwd=SCENES,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    decision: dict[str, Any] = json.loads(done.stdout)
    return decision, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(("image", "zone", "action"), _ROWS)
def test_a_shipped_scene_gets_the_decision_of_its_readme(
    image: str, zone: str, action: str
) -> None:
    decision, log = _planned(image, "--zone", *zone.split())
    assert decision["action"] == action, decision["reason"]
    assert f"planner: decision: {action}, because {decision['reason']}" in log
    if action == "land":
        assert decision["needed_m"] == 8.0
        assert decision["fit_probability"] >= 0.9


@pytest.mark.slow
def test_the_log_is_the_planners_only() -> None:
    image, zone, _ = _ROWS[0]
    _, log = _planned(image, "--zone", *zone.split())
    assert all(line.startswith("planner: ") for line in log.splitlines())


def _reason_for(image: str) -> str:
    (zone,) = [row[1] for row in _ROWS if row[0] == image]
    reason: str = _planned(image, "--zone", *zone.split())[0]["reason"]
    return reason


@pytest.mark.slow
def test_an_image_without_cars_gives_no_usable_scale() -> None:
    # The detector may find something that it takes for cars.
    reason = _reason_for("no_cars.jpg")
    no_scale = reason.startswith("no scale from vehicles in the image")
    assert no_scale or "is not ok" in reason


@pytest.mark.slow
def test_a_coarse_image_advises_to_fly_lower() -> None:
    assert "too_coarse; fly lower" in _reason_for("too_coarse.jpg")


def test_the_readme_has_all_four_cases() -> None:
    assert {row[0] for row in _ROWS} == {path.name for path in SCENES.glob("*.jpg")}
    assert {row[2] for row in _ROWS} == {"land", "next_zone", "hold_altitude"}
    assert len(_ROWS) == len(_RENDERINGS) == 4


@pytest.mark.slow
def test_the_planner_tries_the_next_zone() -> None:
    small = ("48", "1", "168", "30")
    roof = ("255", "160", "535", "470")
    decision, _ = _planned("safe.jpg", "--zone", *small, "--zone", *roof)
    assert (decision["action"], decision["zone"]["x_min"]) == ("land", 255)


@pytest.mark.slow
def test_the_planner_tries_the_next_ruler() -> None:
    roof = ("318", "48", "406", "100")
    barometer = ("--altitude", "60", "--focal", "120")
    decision, log = _planned("too_coarse.jpg", "--zone", *roof, *barometer)
    assert "planner: trying the next ruler: barometer" in log
    assert (decision["action"], decision["ruler"]) == ("land", "barometer")


@pytest.mark.slow
def test_an_error_of_the_server_holds_altitude() -> None:
    decision, _ = _planned("no such.jpg", "--zone", "0", "0", "9", "9")
    assert decision["action"] == "hold_altitude"
    assert "image_not_found" in decision["reason"]


def test_a_zone_that_fits_with_a_high_probability_is_landed_on(
    decide_zone: Callable[[dict[str, Any]], Any],
) -> None:
    decision = decide_zone(_record())
    assert decision.action == "land"
    assert (decision.center_x_px, decision.center_y_px, decision.needed_m) == (40.5, 30.5, 8.0)
    assert (
        decision.reason == "a circle of 8.0 m fits by the ruler with probability 0.94, 0.90 needed"
    )


def test_a_probability_below_the_limit_is_not_enough(
    decide_zone: Callable[[dict[str, Any]], Any],
) -> None:
    fit = {"fit_probability": 0.899, "center": {"x_px": 40.5, "y_px": 30.5}}
    decision = decide_zone(_record(fit=fit))
    assert decision.action == "next_zone"
    assert decision.reason.startswith("too small: a circle of 8.0 m fits")


def test_a_zone_without_room_for_any_circle_is_too_small(
    decide_zone: Callable[[dict[str, Any]], Any],
) -> None:
    decision = decide_zone(_record(fit={"fit_probability": 0.0}))
    assert (decision.action, decision.center_x_px) == ("next_zone", None)
