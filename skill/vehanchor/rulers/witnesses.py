"""Witnesses of an image, from all rulers: first those that do not depend on vehicles, then the others."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import permutations
from typing import TYPE_CHECKING

from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.active import active_rulers, ruler_class
from vehanchor.rulers.ruler import unusable
from vehanchor.rulers.vehicles import Vehicles
from vehanchor.scale.defaults import PROBABLY_RIGHT
from vehanchor.scale.density import product
from vehanchor.scale.posterior import with_shared_error
from vehanchor.scale.reliability import NO_CARS, NO_ONE_SCALE

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.rulers.ruler import Ruler, View
    from vehanchor.scale.posterior import Answer, Remark, Witness

# centimetres for metres; scenes tell a factor of two
_UNIT_RATIO = math.log(100.0)
_UNIT_TOLERANCE = math.log(2.0)


def measure_all(view: View, known: Sequence[Witness] | None = None) -> tuple[Witness, ...]:
    """Measure an image with all rulers that the caller allows.

    Args:
        view: of the image, with its tilt.
        known: earlier witnesses of all rulers but those that measure the boxes of a flight
            together; None without any.

    Returns:
        The witnesses; those of boxes first.
    """
    rulers = active_rulers(view.options.rulers)
    first = known
    if first is None:
        first = _measured([ruler for ruler in rulers if ruler.pooling_gain is not None], view)
    if view.expected is None and view.plane is not None:
        view = replace(view, expected=expected_scale(first))
    last = [ruler for ruler in rulers if ruler.pooling_gain is None]
    return (*_measured(last, view), *first)


def expected_scale(witnesses: Iterable[Witness]) -> NDArray[np.float64] | None:
    """Multiply the densities of rulers that do not depend on vehicles, for a tilted view.

    In oblique views the detector often finds parts of cars; the camera's height or a court
    identifies the whole ones.

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
        f"The camera was tilted by {view.plane.tilt_deg:.0f} degrees: the ruler {ruler.label} "
        "is left out, because it "
        "only measures nadir images."
    )
    return unusable(ruler.kind, Notice(code=NoticeCode.CAMERA_TILTED, message=message))


def with_doubts(
    witnesses: Sequence[Witness], notices: Iterable[Remark] = ()
) -> tuple[Witness, ...]:
    """Give witnesses the errors that doubts make common.

    An image without one scale misleads all of them; look-alikes mislead the vehicles, and a prior
    that agrees.

    Args:
        witnesses: of an image, with their own doubts.
        notices: further doubts.
    """
    codes = {
        notice.code for notice in (*(own for each in witnesses for own in each.notices), *notices)
    }
    no_one_scale = NoticeCode.STRETCHED in codes or NoticeCode.TILT_SUSPECTED in codes
    found = []
    for each in witnesses:
        one = (
            with_shared_error(each, NO_ONE_SCALE, removes="disagree")
            if no_one_scale and each.found
            else each
        )
        if (
            NoticeCode.LOOK_ALIKES in codes
            and each.found
            and (each.kind == Vehicles.kind or not each.sets_scale)
        ):
            one = with_shared_error(one, NO_CARS, removes="not_cars")
        found.append(one)
    return tuple(found)


def disagreements(witnesses: Sequence[Witness], found: Answer) -> list[Notice]:
    """Warn of rulers that are probably wrong, and of stated facts whose unit is probably wrong.

    Args:
        witnesses: of all rulers.
        found: their answer.
    """
    heard = [each for each in witnesses if each.found]
    setting = [(each, p) for each, p in zip(heard, found.p_right, strict=True) if each.sets_scale]
    doubted = [each for each, p_right in setting if p_right < PROBABLY_RIGHT]
    if found.reason == "disagree" and not doubted and len(setting) > 1:
        doubted = [each for each, _ in setting]
    notices = [
        Notice(
            code=NoticeCode.RULERS_DISAGREE,
            message=f"{_says(each)} m/px, and all rulers together {found.gsd_m_per_px:.2g}. "
            "Check which is wrong "
            "before using either.",
        )
        for each in doubted
        if len(setting) > 1
    ]
    return notices + _unit_notices(heard)


def _unit_notices(heard: Sequence[Witness]) -> list[Notice]:
    """Warn of stated facts that differ from another ruler by a factor of about 100."""
    notices = {}
    for fact, other in permutations(heard, 2):
        if (
            ruler_class(fact.kind).fact is None
            or fact.gsd_m_per_px is None
            or other.gsd_m_per_px is None
        ):
            continue
        off = math.log(fact.gsd_m_per_px / other.gsd_m_per_px)
        if abs(abs(off) - _UNIT_RATIO) <= _UNIT_TOLERANCE:
            message = (
                f"{_says(fact)} m/px, another ruler {other.gsd_m_per_px:.2g}: some 100 times "
                f"{'less' if off > 0 else 'more'}. Its unit is probably wrong: give metres"
                f"{', not centimetres' if off > 0 else ''}."
            )
            notices[fact.kind] = Notice(code=NoticeCode.UNIT_MISTYPED, message=message)
    return list(notices.values())


def _says(witness: Witness) -> str:
    return f"{ruler_class(witness.kind).says().capitalize()} {witness.gsd_m_per_px:.2g}"
