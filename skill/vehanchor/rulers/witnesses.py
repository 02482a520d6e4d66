"""Witnesses of an image, from all rulers.

In a tilted view, rulers that do not depend on vehicles measure first: the vehicles need their
scale to separate cars from parts of cars.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import permutations
from typing import TYPE_CHECKING

from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.active import active_rulers, ruler_class
from vehanchor.rulers.ruler import unusable
from vehanchor.rulers.vehicles import Vehicles, VehicleWitness, vehicle_witness
from vehanchor.scale.defaults import PROBABLY_RIGHT
from vehanchor.scale.density import product
from vehanchor.scale.posterior import with_shared_error
from vehanchor.scale.reliability import NO_CARS, NO_ONE_SCALE, Shared, chance_of_stretch

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from vehanchor.rulers.ruler import Ruler, View
    from vehanchor.scale.density import Density
    from vehanchor.scale.posterior import Answer, Remark, Witness

# Log ratio of a length in centimetres that is stated as metres, and how exactly rulers show it.
_UNIT_LOG_RATIO = math.log(100.0)
_UNIT_LOG_TOLERANCE = math.log(2.0)
# Chance of a drawing below which it is not counted: 99 of 100 photographs have less.
_NEGLIGIBLE_CHANCE = 0.01

NO_PHOTOGRAPH = Notice(
    code=NoticeCode.NO_PHOTOGRAPH,
    message=(
        "The image is drawn, such as a page, a chart, a map or a program: most of it is flat, with "
        "sharp edges. What looks like cars, courts or ground in it shows no scale."
    ),
)
"""Warning about an image that is probably no photograph."""

NO_ONE_SCALE_CODES = frozenset(
    {
        NoticeCode.STRETCHED,
        NoticeCode.TILT_SUSPECTED,
        NoticeCode.NOT_PERSPECTIVE,
        NoticeCode.SEVERAL_PICTURES,
        NoticeCode.SEVERAL_SCALES,
    }
)
"""Codes of the notices that an image has no single scale."""


def measure_all(view: View, earlier: Sequence[Witness] | None = None) -> tuple[Witness, ...]:
    """Measure an image with all rulers that the caller allows.

    Args:
        view: view of the image, with its tilt.
        earlier: witnesses from before, of all rulers but those that measure the boxes of a flight
            together; None without any.

    Returns:
        The witnesses; those of boxes first.
    """
    rulers = active_rulers(view.options.rulers)
    if earlier is None:
        independent = [ruler for ruler in rulers if ruler.pooling_gain is not None]
        earlier = _measure(independent, view)
    if view.expected is None and view.plane is not None:
        view = replace(view, expected=expected_scale(earlier))
    of_boxes = [ruler for ruler in rulers if ruler.pooling_gain is None]
    by_boxes = _measure(of_boxes, view)
    return (*by_boxes, *earlier)


def expected_scale(witnesses: Iterable[Witness]) -> Density | None:
    """Multiply the densities of rulers that do not depend on vehicles, for a tilted view.

    In oblique views the detector often finds parts of cars; the camera's height or a court
    identifies the whole ones.

    Args:
        witnesses: witnesses of these rulers, measured on the ground plane.

    Returns:
        ``[g]`` probabilities on ``vehanchor.scale.density.GRID``; None if no ruler found anything.
    """
    densities = [witness.density for witness in witnesses if witness.found]
    if not densities:
        return None
    return product(*densities)


def _measure(rulers: Iterable[Ruler], view: View) -> list[Witness]:
    """Measure with several rulers, and leave out those that have nothing to report."""
    witnesses = []
    for ruler in rulers:
        witness = _witness(ruler, view)
        if witness is not None:
            witnesses.append(witness)
    return witnesses


def _witness(ruler: Ruler, view: View) -> Witness | None:
    """Measure with one ruler; a ruler for nadir images is left out in a tilted view."""
    if view.plane is None or ruler.uses_plane:
        return ruler.measure(view)
    at_nadir = ruler.measure(view.at_nadir())
    if at_nadir is None or not at_nadir.found:
        return None
    message = (
        f"The camera was tilted by {view.plane.tilt_deg:.0f} degrees: the ruler {ruler.label} "
        "is left out, because it only measures nadir images."
    )
    notice = Notice(code=NoticeCode.CAMERA_TILTED, message=message)
    return unusable(ruler.kind, notice)


def doubted_as_drawing(witnesses: Sequence[Witness], chance: float) -> tuple[Witness, ...]:
    """Doubt what rulers see in an image that may be drawn: a page, a chart, a map or a program.

    If it is probably drawn, what they see is no evidence, unless the caller stated that the
    vehicles are cars. If not, the chance of that is an error that they have in common.

    Args:
        witnesses: witnesses of an image.
        chance: 0..1, chance that it is drawn.
    """
    if chance < _NEGLIGIBLE_CHANCE:
        return tuple(witnesses)
    doubted = []
    for witness in witnesses:
        if not _sees_scene(witness):
            doubted.append(witness)
        elif chance >= PROBABLY_RIGHT:
            doubted.append(replace(witness, gsd_m_per_px=None, right=None, lacks=()))
        else:
            error = Shared("drawing", 0.0, chance)
            doubted.append(with_shared_error(witness, error, removes="no_photograph"))
    return tuple(doubted)


def without_findings(witnesses: Sequence[Witness]) -> tuple[Witness, ...]:
    """Take from witnesses what they found, in an image that has no scale; the notices stay."""
    return tuple(
        replace(witness, gsd_m_per_px=None, right=None, guess=None, lacks=())
        for witness in witnesses
    )


def _sees_scene(witness: Witness) -> bool:
    """Test whether a witness rests on the image, and not on what the caller states."""
    if not witness.found or not ruler_class(witness.kind).reads_scene:
        return False
    return not (isinstance(witness, VehicleWitness) and witness.fleet.is_stated)


def with_doubts(
    witnesses: Sequence[Witness], notices: Iterable[Remark] = (), *, tilt_chance: float = 0.0
) -> tuple[Witness, ...]:
    """Add to witnesses the errors that doubts make common.

    An image without a single scale misleads all rulers. Look-alikes mislead the vehicles, and a
    prior that agrees with them.

    Args:
        witnesses: witnesses of an image, with their own doubts as notices.
        notices: further doubts.
        tilt_chance: 0..1, chance that the image has no single scale because of an unknown tilt.
    """
    codes = {notice.code for notice in notices}
    for witness in witnesses:
        codes.update(notice.code for notice in witness.notices)
    no_one_scale = not NO_ONE_SCALE_CODES.isdisjoint(codes)
    several_scales_chance = 1.0 - (1.0 - _stretch_chance(witnesses)) * (1.0 - tilt_chance)
    vehicles = vehicle_witness(witnesses)
    p_look_alikes = 0.0
    if vehicles is not None and vehicles.found:
        p_look_alikes = vehicles.p_look_alikes
    no_cars = NO_CARS._replace(chance_wrong=p_look_alikes)
    doubted = []
    for witness in witnesses:
        if not witness.found:
            doubted.append(witness)
            continue
        shared = witness
        if no_one_scale:
            shared = with_shared_error(shared, NO_ONE_SCALE, removes="disagree")
        elif several_scales_chance > 0:
            # More cars would settle it.
            unsettled = NO_ONE_SCALE._replace(chance_wrong=several_scales_chance)
            shared = with_shared_error(shared, unsettled, removes="too_few")
        depends_on_cars = witness.kind == Vehicles.kind or not witness.sets_scale
        if no_cars.chance_wrong > 0 and depends_on_cars:
            shared = with_shared_error(shared, no_cars, removes="not_cars")
        doubted.append(shared)
    return tuple(doubted)


def _stretch_chance(witnesses: Sequence[Witness]) -> float:
    """Compute the chance that the image is stretched, by its vehicles; 0 if they do not tell."""
    vehicles = vehicle_witness(witnesses)
    if vehicles is None or vehicles.stretch_log_odds is None:
        return 0.0
    return chance_of_stretch(vehicles.stretch_log_odds)


def disagreements(witnesses: Sequence[Witness], answer: Answer) -> list[Notice]:
    """Warn of rulers that are probably wrong, and of stated facts with a probably wrong unit.

    Args:
        witnesses: witnesses of all rulers.
        answer: their answer.
    """
    informative = [witness for witness in witnesses if witness.found]
    setting = []
    doubted = []
    for witness, p_right in zip(informative, answer.p_right, strict=True):
        if not witness.sets_scale:
            continue
        setting.append(witness)
        # One that shares an error with all others, and has their scale, does not disagree.
        if p_right < PROBABLY_RIGHT and not witness.allows(answer.gsd_m_per_px):
            doubted.append(witness)
    if answer.reason == "disagree" and not doubted:
        # Rulers that allow the answer are contradicted by a prior, not by each other.
        doubted = [witness for witness in setting if not witness.allows(answer.gsd_m_per_px)]
    for pair in answer.contradictions:
        contradicting = [informative[k] for k in pair]
        doubted += [witness for witness in contradicting if witness not in doubted]
    notices = []
    # A single ruler has none to disagree with.
    if doubted and len(setting) > 1:
        stated = [f"{_stated_scale(witness)} m/px" for witness in doubted]
        first, *others = stated
        # A sentence begins with the first, and the others go on with it.
        scales = [first, *(f"{scale[0].lower()}{scale[1:]}" for scale in others)]
        message = (
            f"{', '.join(scales)}, and all rulers together {answer.gsd_m_per_px:.2g}. Check which "
            "is wrong before using either."
        )
        notices.append(Notice(code=NoticeCode.RULERS_DISAGREE, message=message))
    return notices + _unit_notices(informative)


def _unit_notices(witnesses: Sequence[Witness]) -> list[Notice]:
    """Warn of stated facts that differ from another ruler by a factor of about 100.

    A prior alone is too rough to doubt a unit.
    """
    notices = {}
    for fact, other in permutations(witnesses, 2):
        is_fact = ruler_class(fact.kind).fact is not None
        if not is_fact or not other.sets_scale:
            continue
        if fact.gsd_m_per_px is None or other.gsd_m_per_px is None:
            continue
        log_ratio = math.log(fact.gsd_m_per_px / other.gsd_m_per_px)
        if abs(abs(log_ratio) - _UNIT_LOG_RATIO) > _UNIT_LOG_TOLERANCE:
            continue
        comparison = "more"
        remedy = "give metres"
        if log_ratio > 0:
            comparison = "less"
            remedy = "give metres, not centimetres"
        message = (
            f"{_stated_scale(fact)} m/px, another ruler {other.gsd_m_per_px:.2g}: some 100 times "
            f"{comparison}. Its unit is probably wrong: {remedy}."
        )
        notices[fact.kind] = Notice(code=NoticeCode.UNIT_MISTYPED, message=message)
    return list(notices.values())


def _stated_scale(witness: Witness) -> str:
    """Begin a sentence with a ruler and its scale, such as "The courts give 0.1"."""
    subject_and_verb = ruler_class(witness.kind).subject_and_verb()
    return f"{subject_and_verb.capitalize()} {witness.gsd_m_per_px:.2g}"
