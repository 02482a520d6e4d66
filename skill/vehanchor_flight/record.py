"""Record of a flight."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vehanchor.analysis.pipeline import make_known_scale
from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.records.text import Advice, advice_for
from vehanchor.rulers.vehicles import Vehicles
from vehanchor.scale.defaults import USABLE_CHANCE
from vehanchor.scale.density import TOLERANCE
from vehanchor.scale.lengths import Z95
from vehanchor_flight.photograph import per_photograph_witnesses
from vehanchor_flight.pooling import pool
from vehanchor_flight.project import SCALE
from vehanchor_flight.records import FlightComponent, FlightEstimate, FlightPhotograph, FlightRuler

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from vehanchor.analysis.scale_analysis import ScaleAnalysis
    from vehanchor.detection.card import DetectorCard
    from vehanchor.errors import VehAnchorError
    from vehanchor.imagery.facts import ImageFacts
    from vehanchor.records import GsdEstimate, Reason, Status
    from vehanchor_flight.components import Component
    from vehanchor_flight.photograph import Photograph
    from vehanchor_flight.records import FlightLink

_MOST_RULERS = 4  # listed per photograph
# between two photographs of one camera: longer than a change of battery
_PAUSE = timedelta(minutes=20)
_EXIF_TIME = "%Y:%m:%d %H:%M:%S"


@dataclass(frozen=True)
class Failure:
    """Photograph that cannot be used.

    Attributes:
        name: as the caller named it.
        error: the reason.
    """

    name: str
    error: VehAnchorError


class _Support(NamedTuple):
    """Ruler that was measured in a member of a component."""

    ruler: str
    member: int
    strength: float


def conclude_flight(
    results: Sequence[Photograph | Failure],
    components: Sequence[Component],
    card: DetectorCard,
    *,
    same_scale: bool,
    links: Sequence[FlightLink] = (),
) -> FlightEstimate:
    """Make the record of a flight from its components.

    Args:
        results: the photographs; each usable one belongs to one component.
        components: the largest first.
        card: of the detector.
        same_scale: whether the caller stated one scale for all photographs.
        links: overlaps.

    Returns:
        The record.
    """
    sorties = _sorties(results)
    photographs: dict[int, FlightPhotograph] = {
        place: _failed(each) for place, each in enumerate(results) if isinstance(each, Failure)
    }
    pooled_components = []
    for number, component in enumerate(components):
        members = [
            found for place in component.members if not isinstance(found := results[place], Failure)
        ]
        pooled = pool(members, component.log_scales, component.reference, component.extra)
        estimate = pooled.estimate
        advice = _component_advice(
            estimate, unlinked=len(component) == 1 < len(sorties) and not same_scale
        )
        of_component = FlightComponent(
            number=number,
            n_photographs=len(component),
            reference=members[component.reference].name,
            pooled=estimate,
            advice=advice,
        )
        pooled_components.append(of_component)
        rulers = _supporting_rulers(members, component, pooled)
        for place, at in enumerate(component.members):
            record = _photograph(members[place], component, place, of_component, rulers[place])
            photographs[int(at)] = record.model_copy(update={"sortie": sorties[int(at)]})
    ordered = tuple(photographs[place] for place in range(len(results)))
    whole = pooled_components[0].pooled if same_scale else None
    scale: dict[str, Any] = {name: getattr(whole, name, None) for name in SCALE}
    return FlightEstimate(
        status=_status(ordered),
        same_scale=same_scale,
        **scale,
        confidence=min(each.confidence for each in ordered if each.confidence is not None),
        n_vehicles=sum(each.pooled.n_vehicles or 0 for each in pooled_components),
        photographs=ordered,
        components=tuple(pooled_components),
        links=tuple(links),
        model=card.name,
        model_sha256=card.sha256,
        warnings=(*whole.warnings, *_several_sorties(sorties.values())) if whole else (),
    )


def _sorties(results: Sequence[Photograph | Failure]) -> dict[int, int]:
    """Number the sorties of the usable photographs, by index of the photograph."""
    usable = [
        (place, result) for place, result in enumerate(results) if not isinstance(result, Failure)
    ]
    numbers = number_sorties([result.view.image for _, result in usable])
    return {place: number for (place, _), number in zip(usable, numbers, strict=True)}


def number_sorties(images: Sequence[ImageFacts]) -> list[int]:
    """Number the sorties of photographs.

    A sortie has one camera and no pause of more than 20 minutes. Photographs without a time belong
    to the first sortie of their camera.

    Args:
        images: their facts.

    Returns:
        The number of each photograph's sortie, from 0 on, in the order of the photographs.
    """
    places = []
    for place, image in enumerate(images):
        camera = image.camera
        kind = ("", "") if camera is None else (camera.make, camera.model)
        places.append((kind, _taken_at(image) or datetime.min, place))
    places.sort()
    found = {places[0][2]: 0} if places else {}
    sortie = 0
    for (kind_before, before, _), (kind, taken, place) in pairwise(places):
        sortie += kind != kind_before or (before > datetime.min and taken - before > _PAUSE)
        found[place] = sortie
    numbers: dict[int, int] = {}
    return [numbers.setdefault(found[place], len(numbers)) for place in range(len(images))]


def _taken_at(image: ImageFacts) -> datetime | None:
    """Read the camera's local time of a photograph; None without a valid one."""
    try:
        return (
            None if image.camera is None else datetime.strptime(image.camera.taken_at, _EXIF_TIME)
        )
    except ValueError:
        return None


def _several_sorties(numbers: Iterable[int]) -> tuple[Notice, ...]:
    """Warn if photographs of a stated common scale are of several sorties."""
    sizes = Counter(numbers)
    if len(sizes) < 2:
        return ()
    counts = " and ".join(str(sizes[number]) for number in sorted(sizes))
    message = (
        f"By camera and time, these are {len(sizes)} sorties of {counts} photographs. Pool them "
        "only if all have the "
        "same scale; otherwise give each sortie alone, or leave out same_scale."
    )
    return (Notice(code=NoticeCode.SEVERAL_SORTIES, message=message),)


def _failed(failure: Failure) -> FlightPhotograph:
    return FlightPhotograph(
        photograph=failure.name,
        status="error",
        error_code=failure.error.code,
        error=str(failure.error),
    )


def _photograph(
    photograph: Photograph,
    component: Component,
    place: int,
    record: FlightComponent,
    rulers: tuple[FlightRuler, ...],
) -> FlightPhotograph:
    """Convert the scale of a component to one of its photographs."""
    pooled = record.pooled
    advice = record.advice
    reason: Reason | None = pooled.reason
    gsd = low = high = None
    status = pooled.status
    confidence = pooled.confidence
    if pooled.gsd_m_per_px is not None:
        gsd = pooled.gsd_m_per_px * math.exp(component.offsets[place])
        carried = Z95 * float(component.log_sds[place])
        if pooled.gsd_ci95_low_m_per_px and pooled.gsd_ci95_high_m_per_px:
            down = math.log(pooled.gsd_m_per_px / pooled.gsd_ci95_low_m_per_px)
            up = math.log(pooled.gsd_ci95_high_m_per_px / pooled.gsd_m_per_px)
            low = gsd * math.exp(-math.hypot(down, carried))
            high = gsd * math.exp(math.hypot(up, carried))
            confidence = _carried_chance(confidence, math.log(high / low), up + down)
        if status == "ok" and confidence < USABLE_CHANCE:
            status = "low_confidence"
            reason = "imprecise"
            advice = _carried_advice(maybe_tilted=component.maybe_tilted)
    return FlightPhotograph(
        photograph=photograph.name,
        status=status,
        gsd_m_per_px=gsd,
        gsd_ci95_low_m_per_px=low,
        gsd_ci95_high_m_per_px=high,
        confidence=confidence,
        reason=reason,
        advice=advice,
        component=record.number,
        supported_by=rulers,
        scale=make_known_scale(
            photograph.view,
            gsd,
            interval=None if low is None or high is None else (low, high),
            confidence=confidence,
        ),
        own=photograph.analysis.estimate,
    )


def _carried_chance(chance: float, width: float, pooled_width: float) -> float:
    """Lower a component's chance by the error of the links to a photograph: the interval's log width grows.

    Args:
        chance: of the component.
        width: of the photograph's interval.
        pooled_width: of the component's interval.
    """
    tolerance = 2 * Z95 * math.log1p(TOLERANCE)  # within 20 %, in widths of a normal
    within, pooled_within = (
        math.erf(tolerance / max(each, 1e-9) / math.sqrt(2)) for each in (width, pooled_width)
    )
    return chance * min(1.0, within / pooled_within)


def _status(photographs: Sequence[FlightPhotograph]) -> Status:
    said = [each.status for each in photographs if each.status != "error"]
    if all(status == "no_scale" for status in said):
        return "no_scale"
    return "ok" if all(status == "ok" for status in said) else "low_confidence"


def _supporting_rulers(
    members: Sequence[Photograph], component: Component, pooled: ScaleAnalysis
) -> list[tuple[FlightRuler, ...]]:
    """List each member's supporting rulers: its own, then those of the strongest member."""
    measured = _supports(members, component, pooled)
    of_flight = [each for each in component.extra if each.found]
    common = [
        _Support(each.kind, place, 1.0 - each.chance_wrong)
        for each in of_flight
        for place in range(len(members))
    ]
    supports = measured + common
    if not supports:
        return [()] * len(members)
    chances = {ruler.kind: ruler.p_right for ruler in pooled.estimate.rulers}
    supports.sort(key=lambda each: (-chances.get(each.ruler, 0.0), -each.strength))
    strongest = max(measured or common, key=lambda each: each.strength).member
    named = []
    for place in range(len(members)):
        own = [each for each in supports if each.member == place]
        others = [each for each in supports if each.member == strongest != place]
        chosen = [
            FlightRuler(ruler=each.ruler, photograph=members[each.member].name)
            for each in own + others
        ]
        named.append(tuple(chosen[:_MOST_RULERS]))
    return named


def _supports(
    members: Sequence[Photograph], component: Component, pooled: ScaleAnalysis
) -> list[_Support]:
    """List the rulers that support the component's scale, with the photograph of each."""
    supports = []
    vehicles = pooled.vehicles
    lengths = np.zeros(0) if vehicles is None else vehicles.fleet.lengths
    for place, member in enumerate(members):
        detections = member.rectified_detections
        own = detections.boxes[:, 2] * math.exp(component.offsets[place])
        among: NDArray[np.bool_] = (
            (own >= lengths.min()) & (own <= lengths.max())
            if len(lengths)
            else np.zeros(len(own), dtype=bool)
        )
        strength = float((detections.scores[among] ** 2).sum())
        if strength > 0:
            supports.append(_Support(Vehicles.kind, place, strength))
        supports += [
            _Support(other.kind, place, 1.0 - other.chance_wrong)
            for other in per_photograph_witnesses(member.analysis.witnesses)
            if other.found and other.sets_scale
        ]
    return supports


def _component_advice(pooled: GsdEstimate, *, unlinked: bool) -> str | None:
    """Give the advice for a component; None if its scale is usable.

    Args:
        pooled: its scale.
        unlinked: whether it is a single photograph of a flight with more.
    """
    advice = advice_for(pooled)
    if advice is None:
        return None
    if unlinked:
        advice = Advice(
            f"{advice.why}, and no other photograph overlaps it",
            f"{advice.helps}; or fly with more overlap",
        )
    return _sentence(advice)


def _carried_advice(*, maybe_tilted: bool) -> str:
    """Give the advice for a photograph whose scale comes from another one, with too wide an interval.

    Args:
        maybe_tilted: whether the ratios of the scales may be those of a tilted camera.
    """
    if maybe_tilted:
        return _sentence(
            Advice(
                "the overlaps fit a tilted camera as well as one that climbs",
                "give photographs with the camera's angle in their metadata, or taken straight "
                "down",
            )
        )
    return _sentence(
        Advice(
            "its rulers are in other photographs, and the overlaps in between widen the interval",
            "add photographs between them, or give the height",
        )
    )


def _sentence(advice: Advice) -> str:
    return f"{advice.why[0].upper()}{advice.why[1:]}: {advice.helps}."
