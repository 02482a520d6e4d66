"""The pictures of the ten scenes show the answers that the program gives today."""

from __future__ import annotations

import pytest
from PIL import Image

from docs.witnesses import IMAGES, Example, examples, picture_of, sentence
from vehanchor import Engine

# By their pictures: the scenes themselves take seconds, in each process that collects tests.
_PREFIX = "witnesses_"
_NAMES = sorted(path.stem.removeprefix(_PREFIX) for path in IMAGES.glob(f"{_PREFIX}*.jpg"))


@pytest.fixture(scope="module")
def engine() -> Engine:
    return Engine()


@pytest.fixture(scope="module")
def scenes() -> dict[str, Example]:
    return {example.name: example for example in examples()}


def test_each_scene_has_a_picture(scenes: dict[str, Example]) -> None:
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
