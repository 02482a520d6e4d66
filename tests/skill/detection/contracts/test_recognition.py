from __future__ import annotations

import pytest

from vehanchor.detection.contracts import recognise_contract
from vehanchor.detection.contracts.end_to_end import EndToEnd
from vehanchor.detection.contracts.raw import Raw
from vehanchor.errors import ModelContractError


@pytest.mark.parametrize(
    ("shape", "named", "kind"),
    [
        ((1, 6, 21504), {0}, Raw),
        ((1, 20, 21504), range(15), Raw),
        ((1, 20, 21504), (), Raw),
        ((1, 7, 7), {0, 1}, Raw),  # the names decide
        ((1, 300, 7), {0}, EndToEnd),
        ((1, 300, 7), {3}, EndToEnd),
        ((1, 300, 7), (), EndToEnd),
        ((1, 6, 7), (), EndToEnd),
    ],
)
def test_a_layout_is_told_by_its_shape_and_the_named_classes(shape: tuple[int, ...], named: range, kind: type) -> None:
    assert type(recognise_contract([shape], named)) is kind


@pytest.mark.parametrize(
    ("shape", "named"),
    [
        ((1, 3), ()),
        ((1, 84, 8400), range(80)),  # upright boxes: no angle
        ((1, 5, 8400), ()),
        ((1, 7, 8400), {1, 2}),  # the second score is of class 1, there is none of class 2
        ((1, 300, 6), ()),
    ],
)
def test_other_layouts_are_refused_with_what_was_found_and_what_is_expected(
    shape: tuple[int, ...], named: range
) -> None:
    with pytest.raises(ModelContractError) as refused:
        recognise_contract([shape], named)
    message = str(refused.value)
    assert str(list(shape)) in message
    assert f"{len(named)} class names" in message
    assert "[1, 4+classes+1, anchors] or [1, n, 7]" in message
