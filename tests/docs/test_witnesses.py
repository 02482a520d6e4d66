"""The pictures of the ten scenes show the answers that the program gives today."""

from __future__ import annotations

import pytest
from PIL import Image

from docs.witnesses import LINE_M, Example, examples, picture_of, sentence
from tests.conftest import ROOT
from vehanchor import Engine
from vehanchor.records import GsdEstimate

# What the page states about each scene. A ruler stands for its scale, n for the number of cars.
_QUOTES: dict[str, tuple[str, ...]] = {
    "many_cars": ("Cars and prior have densities around {gsd:.2f} m/px", "{n} cars and the prior"),
    "one_car": ("One car gives {vehicles:.3f} m/px",),
    "one_lorry": (
        "One car gives {vehicles:.3f} m/px, the prior {scene_scale:.3f}",
        "lowers the chance to {chance:.2f}",
    ),
    "look_alikes": ("32 equal things give {vehicles:.3f} m/px", "stays at {chance:.2f}"),
    "line_leads": ("A line of {line:g} m gives a narrow posterior at {known_length:.2f} m/px",),
    "line_wrong": ("the chance falls to {chance:.2f}",),
    "line_assumed": ("prior have densities around {known_length:.2f} m/px",),
    "height_contradicts": ("give {camera:.3f} m/px, the cars {vehicles:.3f}", "{n} cars, and"),
    "height_repeated": (),
    "too_coarse": ("{n} cars of ten pixels give a wide density around {vehicles:.2f} m/px",),
}
# The scenes themselves take seconds, in each process that collects tests.
_NAMES = sorted(_QUOTES)


@pytest.fixture(scope="module")
def engine() -> Engine:
    return Engine()


@pytest.fixture(scope="module")
def scenes() -> dict[str, Example]:
    return {example.name: example for example in examples()}


def test_what_the_page_states_about_each_scene_is_listed(scenes: dict[str, Example]) -> None:
    assert sorted(scenes) == _NAMES


@pytest.mark.parametrize("name", _NAMES)
def test_a_picture_shows_the_answer_of_this_version(
    name: str, scenes: dict[str, Example], engine: Engine
) -> None:
    example = scenes[name]
    with Image.open(picture_of(example)) as picture:
        shown = picture.info.get("comment", b"").decode()
    analysis = engine.analyse_scale(example.image, **example.options)
    assert shown == sentence(analysis), "draw them again: python -m docs.witnesses"
    assert not _missing_quotes(example, analysis.estimate)


def _missing_quotes(example: Example, record: GsdEstimate) -> list[str]:
    """List what the page should state about a scene, and does not."""
    page = " ".join((ROOT / "docs/concepts.md").read_text(encoding="utf-8").split())
    values = {ruler.kind: ruler.gsd_m_per_px for ruler in record.rulers}
    values |= {"gsd": record.gsd_m_per_px or 0.0, "chance": record.confidence, "line": LINE_M}
    quotes = [quote.format(n=record.n_vehicles, **values) for quote in _QUOTES[example.name]]
    return [quote for quote in quotes if quote not in page]
