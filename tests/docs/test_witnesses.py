"""The pictures of the ten scenes show the answers that the program gives today."""

from __future__ import annotations

import pytest
from PIL import Image

from docs.witnesses import Example, examples, picture_of, sentence
from vehanchor import Engine

_EXAMPLES = examples()
_IDS = [example.name for example in _EXAMPLES]


@pytest.fixture(scope="module")
def engine() -> Engine:
    return Engine()


@pytest.mark.parametrize("example", _EXAMPLES, ids=_IDS)
def test_a_picture_shows_the_answer_of_this_version(example: Example, engine: Engine) -> None:
    with Image.open(picture_of(example)) as picture:
        shown = picture.info.get("comment", b"").decode()
    analysis = engine.analyse_scale(example.image, **example.options)
    assert shown == sentence(analysis), "draw them again: python -m docs.witnesses"
