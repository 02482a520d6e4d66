"""The transcripts state what the tools answer today."""

from __future__ import annotations

import pytest

from tests.conftest import ROOT
from vehanchor import Engine
from vehanchor_server.tools.messages import answer_of

PHOTOGRAPH = ROOT / "examples/scenes/safe.jpg"
REWRITE = "write them again: python -m tests.examples.transcript"


@pytest.fixture(scope="module")
def answers() -> list[str]:
    """The sentences about the scale, the area and the distance."""
    engine = Engine()
    area = engine.measure_area(PHOTOGRAPH, box=(255, 160, 535, 470))
    distance = engine.measure_distance(PHOTOGRAPH, [(255, 160), (535, 160)])
    assert area.estimate is not None
    return [answer_of([record], (), "short").text for record in (area.estimate, area, distance)]


@pytest.mark.parametrize("name", ["claude_tool_use", "openai_tool_use"])
def test_a_transcript_has_the_answers_of_this_version(name: str, answers: list[str]) -> None:
    transcript = (ROOT / f"docs/transcripts/{name}.txt").read_text(encoding="utf-8")
    missing = [answer for answer in answers if f"tool  {answer}\n" not in transcript]
    assert not missing, REWRITE
