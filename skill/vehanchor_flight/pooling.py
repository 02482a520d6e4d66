"""Pooling: one scale from the evidence of many photographs whose ratios of scales are known.

One photograph is the reference. All that the other photographs measured is converted to the pixels
of the reference. Then the rulers and the posterior of a single photograph decide on the scale:

* Vehicles: the boxes of all photographs vote together for one scale (``pooled_detections``).
  A car that several photographs show counts once (``vehanchor_flight.common_ground``).
* Any other ruler, and the scene-scale prior: the densities of the photographs are shifted to the
  reference and multiplied (``combined_density``). The errors of photographs of one flight are
  correlated, so that n densities count as fewer than n; pictures of one ground count as one.

Scales are natural logs of metres per pixel. The *offset* of a photograph is its log scale less that
of the reference: one of its pixels is as long on the ground as ``exp(offset)`` of the reference's.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias, TypeVar

import numpy as np

from vehanchor.analysis.pipeline import conclude
from vehanchor.detection.detections import Appearance, Detections
from vehanchor.detection.scene_scale import SceneScalePrior
from vehanchor.records import KnownPlane
from vehanchor.rulers.active import ruler_class
from vehanchor.rulers.camera_tilt import with_scale
from vehanchor.rulers.ruler import View
from vehanchor.rulers.scene_scale import SceneScale
from vehanchor.rulers.witnesses import NO_ONE_SCALE_CODES, expected_scale, measure_all
from vehanchor.scale.density import quantile, shifted
from vehanchor.scale.posterior import Lack, Remark, Witness
from vehanchor_flight.common_ground import distinct_vehicles, n_distinct
from vehanchor_flight.photograph import constant_detail_share, per_photograph_witnesses

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import ArrayLike, NDArray

    from vehanchor.analysis.scale_analysis import ScaleAnalysis
    from vehanchor.imagery.facts import ImageFacts
    from vehanchor.scale.reliability import Shared
    from vehanchor_flight.common_ground import Placement
    from vehanchor_flight.photograph import Photograph

    Offsets: TypeAlias = NDArray[np.float64]
    """Logs ``[n]`` of each photograph's metres per pixel over the reference's."""

    OffsetWitness: TypeAlias = tuple[Witness, float]
    """Witness of a photograph, with the offset of that photograph."""

    Density: TypeAlias = NDArray[np.float64]
    """Probabilities ``[g]`` on the grid of scales."""

    Reductions: TypeAlias = NDArray[np.float64]
    """Reductions ``[n]`` of the images in which boxes were found."""

    Order: TypeAlias = NDArray[np.intp]
    """Indices ``[n]`` that sort boxes."""

    Flags: TypeAlias = NDArray[np.bool_]
    """Which of the boxes have an appearance."""

_MIN_PROBABILITY = 1e-12  # Keeps the log of a density finite.

AnyRemark = TypeVar("AnyRemark", bound=Remark)


def pool(
    members: Sequence[Photograph],
    log_scales: ArrayLike,
    reference: int,
    extra: Iterable[Witness] = (),
    placements: Sequence[Placement] = (),
) -> ScaleAnalysis:
    """Pool the evidence of photographs with known ratios of scales.

    Args:
        members: the photographs, at least one.
        log_scales: ``[n]`` natural logs of their metres per pixel, up to a constant.
        reference: index of the member that sets the pixels of the result.
        extra: evidence of rulers that only a flight has, in the reference's pixels.
        placements: ``[n]`` of the photographs on their ground; without any, no ground is common.

    Returns:
        The analysis, as if all evidence were from the reference.
    """
    flight_witnesses = tuple(extra)
    if len(members) == 1 and not flight_witnesses:
        return members[0].analysis
    logs = np.asarray(log_scales, dtype=np.float64)
    offsets = logs - logs[reference]
    photograph_witnesses = _pooled_witnesses(members, offsets, placements)
    witnesses = (*photograph_witnesses, *flight_witnesses)
    if placements:
        detections = distinct_vehicles(members, placements)
    else:
        detections = [member.rectified_detections for member in members]
    pooled_boxes = pooled_detections(detections, offsets)
    view = _pooled_view(
        members, offsets, reference=reference, witnesses=witnesses, detections=pooled_boxes
    )
    all_witnesses = measure_all(view, witnesses)
    pooled = conclude(view, all_witnesses)
    return _with_tilt_of(members[reference], pooled)


def _pooled_view(
    members: Sequence[Photograph],
    offsets: Offsets,
    reference: int,
    witnesses: Sequence[Witness],
    detections: Detections,
) -> View:
    """Make the input of the rulers: the reference, with boxes and priors of all photographs.

    Args:
        members: the photographs.
        offsets: ``[n]`` logs of each photograph's metres per pixel over the reference's.
        reference: index of the reference.
        witnesses: pooled evidence of the rulers that use no vehicles.
        detections: pooled boxes.
    """
    own_view = members[reference].view
    detail_share = _median_detail_share(members)
    # In an oblique view, the other rulers help to distinguish whole cars from parts of cars.
    expected = None
    if own_view.tilt is not None:
        expected = expected_scale(witnesses)
    # The view has no tilt, because the boxes of oblique photographs are rectified already.
    return View(
        _facts_with_all_notices(members, reference),
        detections,
        card=own_view.card,
        options=own_view.options,
        measure_detail_share=constant_detail_share(detail_share),
        prior=_pooled_prior(members, offsets),
        expected=expected,
    )


def _with_tilt_of(photograph: Photograph, pooled: ScaleAnalysis) -> ScaleAnalysis:
    """Add the reference's tilt, which the pooled view lacks, to the pooled record."""
    camera_tilt = photograph.view.tilt
    own = photograph.analysis.estimate
    if own.tilt is None or camera_tilt is None:
        return pooled
    estimate = pooled.estimate
    tilt = with_scale(own.tilt, own, estimate.gsd_m_per_px)
    scale = estimate.scale
    if scale is not None:
        plane = KnownPlane.model_validate(camera_tilt, from_attributes=True)
        scale = scale.model_copy(update={"plane": plane})
    estimate = estimate.model_copy(update={"tilt": tilt, "scale": scale})
    return replace(pooled, estimate=estimate)


def pooled_detections(detections: Sequence[Detections], offsets: ArrayLike) -> Detections:
    """Pool the boxes of photographs, in the order that ``Detections`` requires.

    Args:
        detections: of the photographs.
        offsets: ``[n]`` logs of each photograph's metres per pixel over the reference's.

    Returns:
        Boxes with sizes in pixels of the reference; their positions have no meaning.
    """
    log_factors = np.asarray(offsets, dtype=np.float64)
    factors = np.exp(log_factors)
    boxes = []
    reductions = []
    for part, factor in zip(detections, factors, strict=True):
        # Four lengths scale with the pixels of the reference; the angle does not.
        box_factors = [factor, factor, factor, factor, 1.0]
        boxes.append(part.boxes * box_factors)
        # The length at which the detector saw a box is length times reduction, and must not change.
        reductions.append(_reductions(part) / factor)
    scores = np.concatenate([part.scores for part in detections])
    has_appearance = np.concatenate([_has_appearance(part) for part in detections])
    # Detections begins with the boxes that have an appearance; within each group, scores fall.
    order = np.lexsort((-scores, ~has_appearance))
    pooled_reductions = None
    if any(part.reductions is not None for part in detections):
        pooled_reductions = np.concatenate(reductions)[order]
    reasons = [part.stopped_because for part in detections]
    stops = [reason for reason in reasons if reason is not None]
    first_stop = None
    if stops:
        first_stop = stops[0]
    n_tiles_total = None
    if all(part.were_searched for part in detections):
        n_tiles_total = sum(part.n_tiles_total or 0 for part in detections)
    return Detections(
        np.concatenate(boxes, dtype=np.float64)[order],
        scores[order],
        n_tiles=sum(part.n_tiles for part in detections),
        n_capped_tiles=sum(part.n_capped_tiles for part in detections),
        reductions=pooled_reductions,
        appearance=_pooled_appearance(detections, has_appearance, order),
        n_tiles_total=n_tiles_total,
        n_skipped=sum(part.n_skipped for part in detections),
        n_copies=sum(part.n_copies for part in detections),
        stopped_because=first_stop,
        stretch=_pooled_stretch(detections),
        stretch_log_odds=_pooled_log_odds(detections),
    )


def _reductions(detections: Detections) -> Reductions:
    """Return the reductions ``[n]`` in which boxes were found; 1 in a search at full resolution."""
    if detections.reductions is None:
        return np.ones(len(detections.boxes))
    return detections.reductions


def _has_appearance(detections: Detections) -> Flags:
    """Find the boxes ``[n]`` with an appearance: the first ones of a photograph."""
    n_with = 0
    if detections.appearance is not None:
        n_with = len(detections.appearance)
    return np.arange(len(detections.boxes)) < n_with


def _pooled_appearance(
    detections: Sequence[Detections],
    has_appearance: Flags,
    order: Order,
) -> Appearance | None:
    """Join the appearances of all photographs; None without any.

    Args:
        detections: of the photographs.
        has_appearance: ``[n]``, of their concatenated boxes.
        order: ``[n]``, which sorts the concatenated boxes; those with an appearance come first.
    """
    appearances = []
    for part in detections:
        if part.appearance is not None:
            appearances.append(part.appearance)
    if not appearances:
        return None
    # An appearance's row is the number of boxes with an appearance before its own box.
    rows = np.cumsum(has_appearance) - 1
    n_with = int(has_appearance.sum())
    pooled = Appearance.joined(appearances)
    return pooled.take(rows[order[:n_with]])


def _pooled_stretch(detections: Sequence[Detections]) -> float | None:
    """Average the stretches of the photographs by their vehicles; None if none has one.

    ``Detections.stretch`` states whether the vehicles look too wide or too high.
    """
    stretches = []
    counts = []
    for part in detections:
        if part.stretch is not None and len(part.boxes):
            stretches.append(part.stretch)
            counts.append(len(part.boxes))
    if not stretches:
        return None
    return float(np.average(stretches, weights=counts))


def _pooled_log_odds(detections: Sequence[Detections]) -> float | None:
    """Combine the log odds of a stretch: the mean, times the root of the number of photographs.

    Photographs of one flight share their vehicles and their errors in part.
    """
    log_odds = [part.stretch_log_odds for part in detections if part.stretch_log_odds is not None]
    if not log_odds:
        return None
    return float(np.mean(log_odds) * np.sqrt(len(log_odds)))


def combined_density(
    densities: Sequence[Density], gain: float, n_independent: float | None = None
) -> Density:
    """Multiply densities of one ruler in many photographs, with correlated errors.

    Args:
        densities: ``[g]`` probabilities each.
        gain: n densities count as n ** gain: 0 for a common error, 1 for independent errors.
        n_independent: number n of the densities, without those of common ground; None for all.

    Returns:
        ``[g]`` probabilities.
    """
    # The geometric mean of the densities counts once, whatever n. Its power n ** gain is between
    # this mean (gain 0) and the product of n independent densities (gain 1).
    if n_independent is None:
        n_independent = float(len(densities))
    floored = [np.maximum(density, _MIN_PROBABILITY) for density in densities]
    logs = [np.log(density) for density in floored]
    mean_logs = np.mean(logs, axis=0)
    combined_logs = mean_logs * n_independent**gain
    combined = np.exp(combined_logs - combined_logs.max())
    return np.asarray(combined / combined.sum())


def _median_detail_share(members: Sequence[Photograph]) -> float:
    """Compute the median share of resolution with detail, weighted by numbers of vehicles."""
    n_vehicles = [member.analysis.estimate.n_vehicles or 0 for member in members]
    counts = np.array(n_vehicles, dtype=np.float64)
    if not counts.any():
        return 1.0
    shares = np.array([member.analysis.detail_share for member in members])
    # Weighted median: the first share up to which half of all vehicles lie.
    order = np.argsort(shares, kind="stable")
    cumulative = np.cumsum(counts[order])
    middle = np.searchsorted(cumulative, counts.sum() / 2)
    return float(shares[order][middle])


def _pooled_prior(members: Sequence[Photograph], offsets: Offsets) -> SceneScalePrior | None:
    """Pool the scene-scale priors of photographs without a known tilt; None without any."""
    densities = []
    n_tiles = 0
    for member, offset in zip(members, offsets.tolist(), strict=True):
        view = member.view
        if view.prior is not None and view.tilt is None:
            densities.append(shifted(view.prior.density, offset))
            n_tiles += view.prior.n_tiles
    if not densities:
        return None
    density = combined_density(densities, SceneScale.pooling_gain)
    return SceneScalePrior(density, n_tiles)


def _pooled_witnesses(
    members: Sequence[Photograph], offsets: Offsets, placements: Sequence[Placement]
) -> list[Witness]:
    """Pool the witnesses of each ruler that measures photographs one by one."""
    by_kind: dict[str, list[OffsetWitness]] = {}
    grounds: dict[str, list[Placement]] = {}
    for k, member in enumerate(members):
        offset = float(offsets[k])
        for witness in per_photograph_witnesses(member.analysis.witnesses):
            of_kind = by_kind.setdefault(witness.kind, [])
            of_kind.append((witness, offset))
            if placements and witness.found:
                own_grounds = grounds.setdefault(witness.kind, [])
                own_grounds.append(placements[k])
    pooled = []
    for kind, witnesses in by_kind.items():
        n_grounds = None
        if kind in grounds:
            n_grounds = n_distinct(grounds[kind])
        pooled.append(_pooled_witness(kind, witnesses, n_grounds))
    return pooled


def _pooled_witness(
    kind: str, witnesses: Sequence[OffsetWitness], n_grounds: float | None = None
) -> Witness:
    """Pool the witnesses of one ruler.

    Args:
        kind: of the ruler.
        witnesses: of the photographs, each with the offset of its photograph.
        n_grounds: number of photographs that show different ground; None if all do. What several
            photographs show is measured once.

    Returns:
        One witness. The errors that it shares with other rulers are those of the first photograph,
        with the mean chance of all.
    """
    all_notices = (notice for witness, _ in witnesses for notice in witness.notices)
    notices = _first_of_each_code(all_notices)
    measured = [(witness, offset) for witness, offset in witnesses if witness.found]
    if not measured:
        return Witness(kind, n=0, notices=notices)
    first, first_offset = measured[0]
    if len(measured) == 1:
        moved = _moved(first, first_offset)
        return replace(moved, notices=notices)
    densities = []
    for witness, offset in measured:
        if witness.right is not None:
            densities.append(shifted(witness.right, offset))
    gain = ruler_class(kind).pooling_gain
    assert gain is not None  # Rulers without a gain measure the pooled boxes.
    if n_grounds is None:
        n_grounds = float(len(measured))
    right = combined_density(densities, gain, n_grounds)
    # A lack holds the witness as it would be without one doubt; its density is pooled, too.
    lacks = []
    for lack in first.lacks:
        without = replace(lack.without, right=right)
        lacks.append(Lack(lack.reason, without))
    pooled = [witness for witness, _ in measured]
    shared = [witness.shared for witness in pooled]
    numbers = [witness.n for witness in pooled]
    chances_wrong = [witness.chance_wrong for witness in pooled]
    return replace(
        first,
        gsd_m_per_px=quantile(right, 0.5),
        right=right,
        chance_wrong=sum(chances_wrong) / len(measured),
        shared=_with_mean_chances(first.shared, shared),
        n=_n_measured(numbers, n_grounds),
        lacks=tuple(lacks),
        # The sentence and the lines in the picture are those of a single photograph.
        statement=None,
        marks=(),
        notices=notices,
    )


def _with_mean_chances(
    errors: Iterable[Shared], of_photographs: Sequence[Sequence[Shared]]
) -> tuple[Shared, ...]:
    """Give errors the mean chance that each has in several photographs."""
    chances: defaultdict[str, float] = defaultdict(float)
    for of_photograph in of_photographs:
        for error in of_photograph:
            chances[error.name] += error.chance_wrong
    n_photographs = len(of_photographs)
    return tuple(
        error._replace(chance_wrong=chances[error.name] / n_photographs) for error in errors
    )


def _n_measured(counts: Sequence[int], n_grounds: float) -> int:
    """Count the things that photographs measured, without those of common ground."""
    mean = sum(counts) / len(counts)
    return max(1, round(mean * n_grounds))


def _moved(witness: Witness, offset: float) -> Witness:
    """Convert a witness to the pixels of the reference."""
    if offset == 0.0 or witness.gsd_m_per_px is None or witness.right is None:
        return witness
    lacks = []
    for lack in witness.lacks:
        without = _moved(lack.without, offset)
        lacks.append(Lack(lack.reason, without))
    return replace(
        witness,
        gsd_m_per_px=witness.gsd_m_per_px * math.exp(-offset),
        right=shifted(witness.right, offset),
        lacks=tuple(lacks),
        statement=None,
        marks=(),
    )


def _facts_with_all_notices(members: Sequence[Photograph], reference: int) -> ImageFacts:
    """Return the facts of the reference, with the notices of all photographs.

    A doubt that an image has one scale concerns all photographs only if at least half have it.
    """
    facts = [member.view.image for member in members]
    all_notices = [notice for own in facts for notice in own.notices]
    counts = Counter(notice.code for notice in all_notices)
    least = len(members) / 2
    rare = {code for code in NO_ONE_SCALE_CODES if counts[code] < least}
    kept = (notice for notice in all_notices if notice.code not in rare)
    return facts[reference]._replace(notices=_first_of_each_code(kept))


def _first_of_each_code(notices: Iterable[AnyRemark]) -> tuple[AnyRemark, ...]:
    """Keep the first notice of each code: photographs of one camera have the same notices."""
    by_code: dict[str, AnyRemark] = {}
    for notice in notices:
        by_code.setdefault(notice.code, notice)
    return tuple(by_code.values())
