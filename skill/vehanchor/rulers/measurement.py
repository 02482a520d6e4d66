"""Measurement of an image with all rulers: first those that do not depend on vehicles, then the others."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.point import no_evidence
from vehanchor.rulers.registry import active_rulers
from vehanchor.rulers.vehicles import Vehicles, VehicleWitness
from vehanchor.scale.density import product

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.rulers.ruler import Ruler
    from vehanchor.rulers.view import View
    from vehanchor.scale.posterior import Witness


def measure_all(view: View, known: Sequence[Witness] = ()) -> tuple[VehicleWitness, tuple[Witness, ...]]:
    """Measure an image with all rulers that the caller allows.

    Args:
        view: of the image, with its tilt.
        known: earlier witnesses, which are not measured again.

    Returns:
        The witness of the vehicles, empty if the caller excludes them, and those of the other rulers.
    """
    kinds = {each.kind for each in known}
    rulers = [ruler for ruler in _of_images(view) if ruler.kind not in kinds]
    independent = [ruler for ruler in rulers if ruler.independent_of_vehicles]
    others = [*known, *(_measured(ruler, view) for ruler in independent)]
    if view.expected is None and view.plane is not None:
        view = replace(view, expected=expected_scale(others))
    measured = [*others, *(_measured(ruler, view) for ruler in rulers if not ruler.independent_of_vehicles)]
    vehicles = next((each for each in measured if isinstance(each, VehicleWitness)), None)
    others = [each for each in measured if each is not vehicles]
    return vehicles or Vehicles().not_measured(view), tuple(others)


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


def _of_images(view: View) -> list[Ruler]:
    return [ruler for ruler in active_rulers(view.options.rulers) if not ruler.of_flights]


def _measured(ruler: Ruler, view: View) -> Witness:
    """Measure with one ruler; a ruler for nadir images gives no evidence in a tilted view."""
    if view.plane is None or ruler.uses_plane:
        return ruler.measure(view)
    if not ruler.measure(view.at_nadir()).found:
        return no_evidence(ruler.kind)
    message = (
        f"The camera was tilted by {view.plane.tilt_deg:.0f} degrees: the ruler {ruler.label} is left out, because it "
        "only measures nadir images."
    )
    return no_evidence(ruler.kind, Notice(code=NoticeCode.RULER_NEEDS_NADIR, message=message))
