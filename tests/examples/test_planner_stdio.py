"""The planner: its rules one by one, and its decisions on the shipped scenes, as the scenes' README says."""

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
        "inscribed_diameter_m": 10.0,
        "inscribed_diameter_ci95_low_m": 8.5,
        "inscribed_center": {"x_px": 40.5, "y_px": 30.5},
    }
    return record | changes


@pytest.fixture
def decide_zone(example: Callable[[str], Any]) -> Callable[..., Any]:
    planner = example("planner_stdio")

    def decided(record: dict[str, Any]) -> Any:
        return planner.decide_zone(
            record,
            planner.Ruler("the ruler"),
            planner.Zone(0, 0, x_max=80, y_max=60),
            planner.Craft(4.0, 2.0),
        )

    return decided


@pytest.mark.parametrize("reason", get_args(Reason))
def test_on_a_scale_that_is_not_ok_it_holds_whatever_the_size_and_says_what_helps(
    decide_zone: Callable[..., Any], reason: str
) -> None:
    record = _record(status="low_confidence", scale_confidence=0.89, reason=reason)
    decision = decide_zone(record | {"inscribed_diameter_ci95_low_m": 100.0})
    assert decision.action == "hold_altitude"
    assert "confidence 0.89" in decision.reason
    assert f": {reason}; " in decision.reason
    assert ("fly lower" in decision.reason) == (reason == "too_coarse")


@pytest.mark.parametrize("gsd_m_per_px", [None, 0.1])
@pytest.mark.anyio
async def test_the_planner_uses_listed_arguments_alone(
    example: Callable[[str], Any], gsd_m_per_px: float | None
) -> None:
    planner = example("planner_stdio")
    asked = []

    class Recorder:
        async def call_tool(self, name: str, arguments: dict[str, Any]) -> CallToolResult:
            asked.append((name, arguments))
            return CallToolResult(
                content=[], structured_content={"status": "no_scale", "reason": "too_few"}
            )

    ruler = planner.Ruler("a ruler", gsd_m_per_px)
    craft = planner.Craft(4.0, 2.0)
    await planner.decide(
        Recorder(),
        Path("a.jpg"),
        zones=[planner.Zone(1, 2, x_max=30, y_max=40)],
        rulers=[ruler],
        craft=craft,
        region="europe",
    )
    by_name = {tool.name: tool for tool in create_tools(create_services(Settings(roots=(ROOT,))))}
    assert [name for name, _ in asked] == ["measure_area"]
    for name, arguments in asked:
        jsonschema.validate(arguments, by_name[name].parameters)


def _planned(*arguments: str) -> tuple[dict[str, Any], str]:
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
def test_the_shipped_scenes_get_the_decisions_of_their_readme(
    image: str, zone: str, action: str
) -> None:
    decision, log = _planned(image, "--zone", *zone.split())
    assert decision["action"] == action, decision["reason"]
    assert f"planner: decision: {action}, because {decision['reason']}" in log
    assert all(line.startswith("planner: ") for line in log.splitlines()), (
        "the server's log is not the planner's"
    )
    if action == "land":
        assert decision["diameter_low_m"] >= decision["needed_m"] == 8.0
    # what the detector takes for cars there, if anything, is never to be trusted
    if image == "no_cars.jpg":
        no_scale = decision["reason"].startswith("no scale from vehicles in the image")
        assert no_scale or "is not ok" in decision["reason"]
    if image == "too_coarse.jpg":
        assert "too_coarse; fly lower" in decision["reason"]


def test_the_readme_has_all_four_cases() -> None:
    assert {row[0] for row in _ROWS} == {path.name for path in SCENES.glob("*.jpg")}
    assert {row[2] for row in _ROWS} == {"land", "next_zone", "hold_altitude"}
    assert len(_ROWS) == len(_RENDERINGS) == 4


@pytest.mark.slow
def test_it_tries_the_next_zone_and_then_the_next_ruler() -> None:
    small = "48 1 168 30"
    roof = "255 160 535 470"
    decision, _ = _planned("safe.jpg", "--zone", *small.split(), "--zone", *roof.split())
    assert (decision["action"], decision["zone"]["x_min"]) == ("land", 255)
    roof_there = "318 48 406 100"
    decision, log = _planned(
        "too_coarse.jpg", "--zone", *roof_there.split(), "--altitude", "60", "--focal", "120"
    )
    assert "planner: trying the next ruler: barometer" in log
    assert (decision["action"], decision["ruler"]) == ("land", "barometer")


@pytest.mark.slow
def test_an_error_of_the_server_holds_altitude_and_is_told() -> None:
    decision, _ = _planned("no such.jpg", "--zone", "0", "0", "9", "9")
    assert decision["action"] == "hold_altitude"
    assert "image_not_found" in decision["reason"]


EXAMPLES = ROOT / "examples"


@pytest.fixture
def example() -> Callable[[str], Any]:
    """Imports an example, which is a script, as a module."""

    def load(name: str) -> Any:
        spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module  # dataclasses look their module up
        spec.loader.exec_module(module)
        return module

    return load


def test_it_lands_where_the_lower_bound_fits_and_says_where(
    decide_zone: Callable[..., Any],
) -> None:
    decision = decide_zone(_record())
    assert decision.action == "land"
    assert (decision.center_x_px, decision.center_y_px, decision.needed_m) == (40.5, 30.5, 8.0)
    assert (
        decision.reason
        == "a circle of at least 8.5 m fits by the ruler (estimate 10.0 m), 8.0 m needed"
    )


def test_an_estimate_that_fits_is_not_enough(decide_zone: Callable[..., Any]) -> None:
    decision = decide_zone(_record(inscribed_diameter_ci95_low_m=7.9))
    assert decision.action == "next_zone"
    assert decision.reason.startswith("too small: a circle of at least 7.9 m")
