"""Measurement of an image with all rulers: first those that do not depend on vehicles, then the others."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.point import unusable
from vehanchor.rulers.registry import active_rulers
from vehanchor.scale.density import product

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.rulers.ruler import Ruler
    from vehanchor.rulers.view import View
    from vehanchor.scale.posterior import Witness


def measure_all(view: View, known: Sequence[Witness] | None = None) -> tuple[Witness, ...]:
    """Measure an image with all rulers that the caller allows.

    Args:
        view: of the image, with its tilt.
        known: earlier witnesses of all rulers but those that measure the boxes of a flight together; None without any.

    Returns:
        The witnesses; those of boxes first.
    """
    rulers = [ruler for ruler in active_rulers(view.options.rulers) if not ruler.of_flights]
    first = known
    if first is None:
        first = _measured([ruler for ruler in rulers if not ruler.measured_last], view)
    if view.expected is None and view.plane is not None:
        view = replace(view, expected=expected_scale(first))
    last = [ruler for ruler in rulers if ruler.measured_last and (known is None or ruler.pooling_gain is None)]
    return (*_measured(last, view), *first)


def expected_scale(witnesses: Iterable[Witness]) -> NDArray[np.float64] | None:
    """Multiply the densities of rulers that do not depend on vehicles, for a tilted view.

    In oblique views the detector often finds parts of cars; the camera's height or a court identifies the whole ones.

    Args:
        witnesses: of these rulers, measured on the ground plane.

    Returns:
        ``[g]`` probabilities on ``vehanchor.scale.density.GRID``; None if no ruler found anything.
    """
    densities = [each.density for each in witnesses if each.found]
    return product(*densities) if densities else None


def _measured(rulers: Iterable[Ruler], view: View) -> list[Witness]:
    witnesses = (_witness(ruler, view) for ruler in rulers)
    return [each for each in witnesses if each is not None]


def _witness(ruler: Ruler, view: View) -> Witness | None:
    """Measure with one ruler; a ruler for nadir images is left out in a tilted view."""
    if view.plane is None or ruler.uses_plane:
        return ruler.measure(view)
    at_nadir = ruler.measure(view.at_nadir())
    if at_nadir is None or not at_nadir.found:
        return None
    message = (
        f"The camera was tilted by {view.plane.tilt_deg:.0f} degrees: the ruler {ruler.label} is left out, because it "
        "only measures nadir images."
    )
    return unusable(ruler.kind, Notice(code=NoticeCode.CAMERA_TILTED, message=message))
