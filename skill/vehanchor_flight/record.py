"""Record of a flight."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from vehanchor.analysis.pipeline import make_known_scale
from vehanchor.records import Notice
from vehanchor.records.advice import Advice, advice_for
from vehanchor.records.notices import NoticeCode
from vehanchor.records.text import with_capital
from vehanchor.rulers.vehicles import Vehicles
from vehanchor.scale.defaults import USABLE_CHANCE
from vehanchor.scale.density import TOLERANCE
from vehanchor.scale.lengths import Z95
from vehanchor_flight.photograph import per_photograph_witnesses
from vehanchor_flight.pooling import pool
from vehanchor_flight.project import SCALE_FIELDS
from vehanchor_flight.records import FlightComponent, FlightEstimate, FlightPhotograph, FlightRuler

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from vehanchor.analysis.scale_analysis import ScaleAnalysis
    from vehanchor.detection.card import DetectorCard
    from vehanchor.errors import VehAnchorError
    from vehanchor.imagery.facts import ImageFacts
    from vehanchor.imagery.metadata.camera import CameraMetadata
    from vehanchor.records import GsdEstimate, Reason, Status
    from vehanchor_flight.components import Component
    from vehanchor_flight.photograph import Photograph
    from vehanchor_flight.records import FlightLink

    Lengths: TypeAlias = NDArray[np.float64]
    """Lengths ``[n]`` of boxes in pixels."""

    Flags: TypeAlias = NDArray[np.bool_]
    """Which of the boxes have a property."""

    Results: TypeAlias = Sequence["Photograph | Failure"]
    """Searched photographs of a flight, or why they cannot be used."""

_MAX_RULERS = 4  # Listed for each photograph.
# A longer pause between two photographs of one camera begins a sortie; a change of battery is
# shorter.
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
    """Ruler that was measured in a member of a component.

    Attributes:
        ruler: its kind.
        member: index of the member.
        strength: weight of its evidence, to compare members.
    """

    ruler: str
    member: int
    strength: float


class _CarriedScale(NamedTuple):
    """Scale of a component, converted to the pixels of one of its photographs.

    Attributes:
        gsd_m_per_px: metres per pixel; None without a scale.
        low: lower end of the 95 % interval; None without one.
        high: upper end of it; None without one.
        confidence: chance of an error below 20 %.
    """

    gsd_m_per_px: float | None
    low: float | None
    high: float | None
    confidence: float


class _Exposure(NamedTuple):
    """Time and camera of a photograph; exposures sort by camera, then by time.

    Attributes:
        camera: make and model.
        taken: local time; ``datetime.min`` if unknown.
        photograph: its index.
    """

    camera: tuple[str, str]
    taken: datetime
    photograph: int

    def begins_sortie(self, before: _Exposure) -> bool:
        """Check whether a sortie begins between the exposure before and this one."""
        if self.camera != before.camera:
            return True
        has_time = before.taken > datetime.min
        return has_time and self.taken - before.taken > _PAUSE


def conclude_flight(
    results: Results,
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
    has_others = len(sorties) > 1 and not same_scale
    photographs: dict[int, FlightPhotograph] = {}
    for index, result in enumerate(results):
        if isinstance(result, Failure):
            photographs[index] = _failed(result)
    component_records = []
    for number, component in enumerate(components):
        members = _members(results, component)
        pooled = pool(
            members,
            component.log_scales,
            reference=component.reference,
            extra=component.extra,
            placements=component.placements,
        )
        is_unlinked = has_others and len(component) == 1
        component_record = FlightComponent(
            number=number,
            n_photographs=len(component),
            reference=members[component.reference].name,
            pooled=pooled.estimate,
            advice=pooled_advice(pooled.estimate, unlinked=is_unlinked),
        )
        component_records.append(component_record)
        rulers = _supporting_rulers(members, component, pooled)
        for k, index in enumerate(component.members.tolist()):
            photographs[index] = _photograph(
                members[k],
                component_record,
                offset=float(component.offsets[k]),
                log_sd=float(component.log_sds[k]),
                maybe_tilted=component.maybe_tilted,
                rulers=rulers[k],
                sortie=sorties[index],
            )
    ordered = tuple(photographs[index] for index in range(len(results)))
    common: GsdEstimate | None = None
    warnings: tuple[Notice, ...] = ()
    if same_scale:
        common = component_records[0].pooled
        warnings = (*common.warnings, *_several_sorties(sorties.values()))
    scale: dict[str, Any] = {name: getattr(common, name, None) for name in SCALE_FIELDS}
    confidences = [record.confidence for record in ordered if record.confidence is not None]
    n_vehicles = [record.pooled.n_vehicles or 0 for record in component_records]
    return FlightEstimate(
        status=_status(ordered),
        same_scale=same_scale,
        **scale,
        confidence=min(confidences),
        n_vehicles=sum(n_vehicles),
        photographs=ordered,
        components=tuple(component_records),
        links=tuple(links),
        model=card.name,
        model_sha256=card.sha256,
        warnings=warnings,
    )


def _members(results: Results, component: Component) -> list[Photograph]:
    """Return the photographs of a component, which are all usable."""
    members = [results[index] for index in component.members]
    return [member for member in members if not isinstance(member, Failure)]


def _sorties(results: Results) -> dict[int, int]:
    """Number the sorties of the usable photographs, by index of the photograph."""
    indices = []
    images = []
    for index, result in enumerate(results):
        if not isinstance(result, Failure):
            indices.append(index)
            images.append(result.view.image)
    return dict(zip(indices, number_sorties(images), strict=True))


def number_sorties(images: Sequence[ImageFacts]) -> list[int]:
    """Number the sorties of photographs.

    A sortie has one camera and no pause of more than 20 minutes. Photographs without a time belong
    to the first sortie of their camera.

    Args:
        images: their facts.

    Returns:
        The number of each photograph's sortie, from 0 on, in the order of the photographs.
    """
    if not images:
        return []
    exposures = [_exposure(image, index) for index, image in enumerate(images)]
    exposures.sort()
    sortie = 0
    sortie_of = {exposures[0].photograph: sortie}
    for before, exposure in pairwise(exposures):
        if exposure.begins_sortie(before):
            sortie += 1
        sortie_of[exposure.photograph] = sortie
    # Number the sorties again, in the order in which the photographs show them first.
    numbers: dict[int, int] = {}
    numbers_in_order = []
    for index in range(len(images)):
        number = numbers.setdefault(sortie_of[index], len(numbers))
        numbers_in_order.append(number)
    return numbers_in_order


def _exposure(image: ImageFacts, index: int) -> _Exposure:
    """Read camera and time of a photograph."""
    camera = image.camera
    if camera is None:
        return _Exposure(("", ""), datetime.min, index)
    make_and_model = (camera.make, camera.model)
    return _Exposure(make_and_model, _taken_at(camera), index)


def _taken_at(camera: CameraMetadata) -> datetime:
    """Read the camera's local time of a photograph; ``datetime.min`` without a valid one."""
    try:
        return datetime.strptime(camera.taken_at, _EXIF_TIME)
    except ValueError:
        return datetime.min


def _several_sorties(numbers: Iterable[int]) -> tuple[Notice, ...]:
    """Warn if photographs of a stated common scale are of several sorties."""
    sizes = Counter(numbers)
    if len(sizes) < 2:
        return ()
    counts_in_order = [str(sizes[number]) for number in sorted(sizes)]
    counts = " and ".join(counts_in_order)
    message = (
        f"By camera and time, these are {len(sizes)} sorties of {counts} photographs. Pool them "
        "only if all have the same scale; otherwise give each sortie alone, or leave out "
        "same_scale."
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
    component: FlightComponent,
    *,
    offset: float,
    log_sd: float,
    maybe_tilted: bool,
    rulers: tuple[FlightRuler, ...],
    sortie: int,
) -> FlightPhotograph:
    """Make the record of a photograph from the scale of its component.

    Args:
        photograph: with its own analysis.
        component: record of the component.
        offset: log of its metres per pixel over those of the component's reference.
        log_sd: standard deviation of the offset.
        maybe_tilted: whether the offset may be that of a tilted camera.
        rulers: which support its scale.
        sortie: its number.
    """
    pooled = component.pooled
    carried = _carried_scale(pooled, offset, log_sd)
    status = pooled.status
    reason: Reason | None = pooled.reason
    advice = component.advice
    # The component's scale is usable, but not after the links to this photograph.
    if status == "ok" and carried.confidence < USABLE_CHANCE:
        status = "low_confidence"
        reason = "imprecise"
        advice = _carried_advice(maybe_tilted=maybe_tilted)
    interval = None
    if carried.low is not None and carried.high is not None:
        interval = (carried.low, carried.high)
    return FlightPhotograph(
        photograph=photograph.name,
        status=status,
        gsd_m_per_px=carried.gsd_m_per_px,
        gsd_ci95_low_m_per_px=carried.low,
        gsd_ci95_high_m_per_px=carried.high,
        confidence=carried.confidence,
        reason=reason,
        advice=advice,
        sortie=sortie,
        component=component.number,
        supported_by=rulers,
        scale=make_known_scale(
            photograph.view,
            carried.gsd_m_per_px,
            interval=interval,
            confidence=carried.confidence,
        ),
        own=photograph.analysis.estimate,
    )


def _carried_scale(pooled: GsdEstimate, offset: float, log_sd: float) -> _CarriedScale:
    """Convert the scale of a component to a photograph, with the error of the links to it.

    Args:
        pooled: scale of the component's reference.
        offset: log of the photograph's metres per pixel over those of the reference.
        log_sd: standard deviation of the offset.
    """
    pooled_gsd = pooled.gsd_m_per_px
    pooled_low = pooled.gsd_ci95_low_m_per_px
    pooled_high = pooled.gsd_ci95_high_m_per_px
    if pooled_gsd is None:
        return _CarriedScale(None, low=None, high=None, confidence=pooled.confidence)
    gsd = pooled_gsd * math.exp(offset)
    if not pooled_low or not pooled_high:
        return _CarriedScale(gsd, low=None, high=None, confidence=pooled.confidence)
    # The error of the links is independent of that of the pooled scale: on each side, both reaches
    # of the interval add in quadrature, in logs.
    link_reach = Z95 * log_sd
    reach_down = math.log(pooled_gsd / pooled_low)
    reach_up = math.log(pooled_high / pooled_gsd)
    carried_down = math.hypot(reach_down, link_reach)
    carried_up = math.hypot(reach_up, link_reach)
    low = gsd * math.exp(-carried_down)
    high = gsd * math.exp(carried_up)
    # The confidence falls as the chance of an error below 20 % does in a wider normal distribution.
    within = _chance_within_tolerance(math.log(high / low))
    pooled_within = _chance_within_tolerance(reach_up + reach_down)
    confidence_share = min(1.0, within / pooled_within)
    confidence = pooled.confidence * confidence_share
    return _CarriedScale(gsd, low=low, high=high, confidence=confidence)


def _chance_within_tolerance(log_width: float) -> float:
    """Compute the chance of an error below 20 %, of a lognormal scale.

    Args:
        log_width: width of its 95 % interval, in logs: 2 ``Z95`` standard deviations.
    """
    tolerance = 2 * Z95 * math.log1p(TOLERANCE)
    width = max(log_width, 1e-9)
    return math.erf(tolerance / width / math.sqrt(2))


def _status(photographs: Sequence[FlightPhotograph]) -> Status:
    # An unreadable photograph says nothing about the scale of the others.
    statuses = {record.status for record in photographs}
    statuses.discard("error")
    if statuses <= {"no_scale"}:
        return "no_scale"
    if statuses == {"ok"}:
        return "ok"
    return "low_confidence"


def _supporting_rulers(
    members: Sequence[Photograph],
    component: Component,
    pooled: ScaleAnalysis,
) -> list[tuple[FlightRuler, ...]]:
    """List each member's supporting rulers: its own, then those of the strongest member."""
    measured = _supports(members, component, pooled)
    of_flight = _supports_of_flight(component)
    supports = measured + of_flight
    if not supports:
        return [()] * len(members)
    candidates = measured or of_flight
    strongest = max(candidates, key=_strength).member
    # Rulers that are probably right come first, and of one ruler the strongest photograph.
    p_right = {ruler.kind: ruler.p_right for ruler in pooled.estimate.rulers}

    def rank(support: _Support) -> tuple[float, float]:
        return -p_right.get(support.ruler, 0.0), -support.strength

    supports.sort(key=rank)
    rulers_of_members = []
    for member in range(len(members)):
        own = [support for support in supports if support.member == member]
        others = []
        if member != strongest:
            others = [support for support in supports if support.member == strongest]
        rulers = []
        for support in (own + others)[:_MAX_RULERS]:
            photograph = members[support.member].name
            ruler = FlightRuler(ruler=support.ruler, photograph=photograph)
            rulers.append(ruler)
        rulers_of_members.append(tuple(rulers))
    return rulers_of_members


def _strength(support: _Support) -> float:
    return support.strength


def _supports_of_flight(component: Component) -> list[_Support]:
    """List the rulers that only a flight has: they support each member alike."""
    supports = []
    for witness in component.extra:
        if witness.found:
            strength = 1.0 - witness.chance_wrong
            for member in range(len(component)):
                supports.append(_Support(witness.kind, member, strength))
    return supports


def _supports(
    members: Sequence[Photograph],
    component: Component,
    pooled: ScaleAnalysis,
) -> list[_Support]:
    """List the rulers that support the component's scale, with the photograph of each."""
    supports = []
    for index, member in enumerate(members):
        detections = member.rectified_detections
        factor = math.exp(component.offsets[index])
        lengths = detections.boxes[:, 2] * factor
        in_fleet = _is_in_fleet(lengths, pooled)
        scores = detections.scores[in_fleet]
        strength = float((scores**2).sum())
        if strength > 0:
            supports.append(_Support(Vehicles.kind, index, strength))
        for witness in per_photograph_witnesses(member.analysis.witnesses):
            if witness.found and witness.sets_scale:
                strength = 1.0 - witness.chance_wrong
                supports.append(_Support(witness.kind, index, strength))
    return supports


def _is_in_fleet(lengths: Lengths, pooled: ScaleAnalysis) -> Flags:
    """Find lengths ``[n]``, in pixels of the reference, among those behind the pooled scale."""
    if pooled.vehicles is None:
        return np.zeros(len(lengths), dtype=bool)
    fleet_lengths = pooled.vehicles.fleet.lengths
    if not len(fleet_lengths):
        return np.zeros(len(lengths), dtype=bool)
    shortest = fleet_lengths.min()
    longest = fleet_lengths.max()
    is_between = (lengths >= shortest) & (lengths <= longest)
    return np.asarray(is_between)


def pooled_advice(pooled: GsdEstimate, *, unlinked: bool = False) -> str | None:
    """Give the advice for pooled photographs; None if its scale is usable.

    Args:
        pooled: its scale.
        unlinked: whether it is a single photograph of a flight with more.
    """
    advice = advice_for(pooled)
    if advice is None:
        return None
    if unlinked:
        advice = advice._replace(
            why=f"{advice.why}, and no other photograph overlaps it",
            also="fly with more overlap",
        )
    return _sentence(advice)


def _carried_advice(*, maybe_tilted: bool) -> str:
    """Give the advice for a photograph whose scale comes from others and is too uncertain.

    Args:
        maybe_tilted: whether the ratios of the scales may be those of a tilted camera.
    """
    if maybe_tilted:
        advice = Advice(
            "the overlaps fit a tilted camera as well as one that climbs",
            (),
            also="give photographs taken straight down, or with the camera's angle in the metadata",
        )
    else:
        advice = Advice(
            "its rulers are in other photographs, and the overlaps in between widen the interval",
            (),
            also="add photographs between them, or give the height",
        )
    return _sentence(advice)


def _sentence(advice: Advice) -> str:
    return f"{with_capital(advice.why)}: {advice.helps}."
