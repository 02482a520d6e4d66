"""The figure of the method shows the numbers that the program gives today."""

from __future__ import annotations

import json
import re

import cv2
import pytest
from PIL import Image
from typer.testing import CliRunner

from docs.figures import IMAGE, METHOD_FIGURE, draw, drawn_texts
from vehanchor import analyse_scale
from vehanchor.cli import app as cli

REDRAW = "draw it again: python -m docs.figures image_to_number"


@pytest.fixture(scope="module")
def shown() -> list[str]:
    """Texts in the figure, which its program wrote into the file."""
    with Image.open(METHOD_FIGURE) as figure:
        description: str = figure.info.get("Description", "")
    return description.splitlines()


def test_the_figure_is_drawn_from_this_version(shown: list[str]) -> None:
    pixels = cv2.imread(str(IMAGE))
    assert pixels is not None
    assert shown == drawn_texts(draw(analyse_scale(IMAGE), pixels)), REDRAW


def test_the_figure_shows_what_the_command_prints(shown: list[str]) -> None:
    arguments = ["estimate", str(IMAGE)]
    printed = CliRunner().invoke(cli.app, arguments, env={"COLUMNS": "120", "NO_COLOR": "1"}).stdout
    # Two or more blanks separate the name of a fact from its value.
    rows = [re.split(" {2,}", line.strip(), maxsplit=1) for line in printed.splitlines()]
    facts = dict(row for row in rows if len(row) == 2)
    by_title = dict(line.partition(": ")[::2] for line in shown)
    assert facts["scale"].startswith(f"{by_title['with the other rulers']} m/px")
    assert f"95 %: {by_title['95 %']}" in facts["scale"]
    assert facts["modal length"].startswith(by_title["2. Their modal length"])
    assert f"of {by_title['1. Cars as oriented boxes']} found" in facts["vehicles"]


def test_the_figure_shows_the_true_scale(shown: list[str]) -> None:
    scene = json.loads(IMAGE.with_suffix(".json").read_text())
    assert f"true scale: {scene['gsd_m_per_px']:.4f}" in shown
