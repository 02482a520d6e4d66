"""Pooling: boxes and densities of many photographs, converted to the pixels of one of them.

If the ratios of the scales are known, the boxes of all photographs vote for one scale. Errors of
photographs of one flight are correlated, so that n densities of a ruler count as fewer than n.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from vehanchor.analysis.pipeline import conclude
from vehanchor.detection.detections import Appearance, Detections
from vehanchor.detection.scene_scale import SceneScalePrior
from vehanchor.records import KnownPlane
from vehanchor.rulers.active import ruler_class
from vehanchor.rulers.camera_tilt import with_scale
from vehanchor.rulers.ruler import View
from vehanchor.rulers.scene_scale import SceneScale
from vehanchor.rulers.witnesses import expected_scale, measure_all
from vehanchor.scale.density import quantile, shifted
from vehanchor.scale.posterior import Lack, Remark, Witness
from vehanchor_flight.photograph import of_photographs

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import ArrayLike, NDArray

    from vehanchor.analysis.scale_analysis import ScaleAnalysis
    from vehanchor.imagery.facts import ImageFacts
    from vehanchor_flight.photograph import Photograph

_LEAST = 1e-12
AnyRemark = TypeVar("AnyRemark", bound=Remark)


def pool(
    members: Sequence[Photograph],
    log_scales: ArrayLike,
    reference: int,
    extra: Iterable[Witness] = (),
) -> ScaleAnalysis:
    """Pool the evidence of photographs with known ratios of scales.

    Args:
        members: the photographs, at least one.
        log_scales: ``[n]`` natural logs of their metres per pixel, up to a constant.
        reference: index of the member that sets the pixels of the result.
        extra: evidence of rulers that only a flight has, in the reference's pixels.

    Returns:
        The analysis, as if all evidence were from the reference.
    """
    added = tuple(extra)
    if len(members) == 1 and not added:
        return members[0].analysis
    logs = np.asarray(log_scales, dtype=np.float64)
    offsets = logs - logs[reference]
    chief = members[reference].view
    detail_share = _detail_share(members)
    others = (*_pooled_others(members, offsets), *added)
    view = View(  # no tilt: the boxes are rectified
        _facts(members, reference),
        pooled_detections([member.measured for member in members], offsets),
        card=chief.card,
        options=chief.options,
        measure_detail_share=lambda _centres, _scale: detail_share,
        prior=_pooled_prior([member.view for member in members], offsets),
        expected=None if chief.tilt is None else expected_scale(others),
    )
    pooled = conclude(view, measure_all(view, others))
    own = members[reference].analysis.estimate
    if own.tilt is None or chief.tilt is None:
        return pooled
    tilt = with_scale(own.tilt, own, pooled.estimate.gsd_m_per_px)
    plane = KnownPlane.model_validate(chief.tilt, from_attributes=True)
    scale = pooled.estimate.scale and pooled.estimate.scale.model_copy(update={"plane": plane})
    return replace(
        pooled, estimate=pooled.estimate.model_copy(update={"tilt": tilt, "scale": scale})
    )


def pooled_detections(detections: Sequence[Detections], offsets: ArrayLike) -> Detections:
    """Pool boxes in the order of ``Detections``: boxes with looks first, then by score.

    Args:
        detections: of the photographs.
        offsets: ``[n]`` logs of each photograph's metres per pixel over the reference's.

    Returns:
        Boxes with sizes in pixels of the reference; their positions have no meaning.
    """
    factors = np.exp(np.asarray(offsets, dtype=np.float64))
    scores = np.concatenate([each.scores for each in detections])
    looked = [0 if each.appearance is None else len(each.appearance) for each in detections]
    known = np.concatenate(
        [np.arange(len(each.boxes)) < n for each, n in zip(detections, looked, strict=True)]
    )
    order = np.lexsort((-scores, ~known))
    boxes = np.concatenate(
        [each.boxes * [k, k, k, k, 1.0] for each, k in zip(detections, factors, strict=True)],
        dtype=np.float64,
    )
    scaled = any(each.reductions is not None for each in detections)
    scales = [
        (np.ones(len(each.boxes)) if each.reductions is None else each.reductions) / k
        for each, k in zip(detections, factors, strict=True)
    ]
    appearance = [each.appearance for each in detections if each.appearance is not None]
    place = (np.cumsum(known) - 1)[order[: int(known.sum())]]  # among boxes with looks
    ends = (each.stopped_because for each in detections if each.stopped_because is not None)
    return Detections(
        boxes[order],
        scores[order],
        n_tiles=sum(each.n_tiles for each in detections),
        n_capped_tiles=sum(each.n_capped_tiles for each in detections),
        reductions=np.concatenate(scales)[order] if scaled else None,
        appearance=Appearance.joined(appearance).take(place) if appearance else None,
        n_tiles_total=sum(each.n_tiles_total or each.n_tiles for each in detections),
        n_skipped=sum(each.n_skipped for each in detections),
        stopped_because=next(ends, None),
        stretch=_pooled_stretch(detections),
    )


def _pooled_stretch(detections: Sequence[Detections]) -> float | None:
    """Average the photographs' preferences for narrower or wider images by their vehicles; None if none has one."""
    known = [
        (each.stretch, len(each.boxes))
        for each in detections
        if each.stretch is not None and len(each.boxes)
    ]
    if not known:
        return None
    stretches, counts = np.array(known, dtype=np.float64).T
    return float(np.average(stretches, weights=counts))


def combined_density(densities: Sequence[NDArray[np.float64]], gain: float) -> NDArray[np.float64]:
    """Multiply densities of one ruler in many photographs, with correlated errors.

    Args:
        densities: ``[g]`` probabilities each.
        gain: n densities count as n ** gain: 0 for a common error, 1 for independent errors.

    Returns:
        ``[g]`` probabilities.
    """
    mean = np.mean([np.log(np.maximum(density, _LEAST)) for density in densities], axis=0)
    total = mean * len(densities) ** gain
    combined = np.exp(total - total.max())
    return np.asarray(combined / combined.sum())


def _detail_share(members: Sequence[Photograph]) -> float:
    """Compute the median share of resolution with detail, weighted by the photographs' numbers of vehicles."""
    counts = np.array(
        [member.analysis.estimate.n_vehicles or 0 for member in members], dtype=np.float64
    )
    if not counts.any():
        return 1.0
    values = np.array([member.analysis.detail_share for member in members])
    order = np.argsort(values, kind="stable")
    return float(values[order][np.searchsorted(np.cumsum(counts[order]), counts.sum() / 2)])


def _pooled_prior(views: Sequence[View], offsets: NDArray[np.float64]) -> SceneScalePrior | None:
    """Pool the scene-scale priors of the photographs taken at nadir."""
    priors = [
        (view.prior, float(offset))
        for view, offset in zip(views, offsets, strict=True)
        if view.prior is not None and view.tilt is None
    ]
    if not priors:
        return None
    density = combined_density(
        [shifted(prior.density, offset) for prior, offset in priors], SceneScale.pooling_gain
    )
    return SceneScalePrior(density, sum(prior.n_tiles for prior, _ in priors))


def _pooled_others(members: Sequence[Photograph], offsets: NDArray[np.float64]) -> list[Witness]:
    """Pool the witnesses of each ruler that measures each photograph."""
    others = [of_photographs(member.analysis.witnesses) for member in members]
    kinds = dict.fromkeys(other.kind for own in others for other in own)
    pooled = []
    for kind in kinds:
        found = [
            (other, float(offset))
            for own, offset in zip(others, offsets, strict=True)
            for other in own
            if other.kind == kind
        ]
        pooled.append(_pooled_witness(kind, found))
    return pooled


def _pooled_witness(kind: str, found: Sequence[tuple[Witness, float]]) -> Witness:
    """Pool one ruler's witnesses; their shared errors are those of the first."""
    notices = _distinct(notice for other, _ in found for notice in other.notices)
    heard = [(other, offset) for other, offset in found if other.found]
    if not heard:
        return Witness(kind, n=0, notices=notices)
    first = heard[0][0]
    if len(heard) == 1:
        return replace(_moved(*heard[0]), notices=notices)
    densities = [shifted(other.right, offset) for other, offset in heard if other.right is not None]
    gain = ruler_class(kind).pooling_gain
    assert gain is not None
    right = combined_density(densities, gain)
    return replace(
        first,
        gsd_m_per_px=quantile(right, 0.5),
        right=right,
        chance_wrong=sum(other.chance_wrong for other, _ in heard) / len(heard),
        n=sum(other.n for other, _ in heard),
        lacks=tuple(Lack(each.reason, replace(each.without, right=right)) for each in first.lacks),
        statement=None,
        marks=(),
        notices=notices,
    )


def _moved(witness: Witness, offset: float) -> Witness:
    """Convert a witness to the pixels of another photograph."""
    if offset == 0.0 or witness.gsd_m_per_px is None or witness.right is None:
        return witness
    right = shifted(witness.right, offset)
    lacks = tuple(Lack(each.reason, _moved(each.without, offset)) for each in witness.lacks)
    moved_gsd = witness.gsd_m_per_px * math.exp(-offset)
    return replace(
        witness, gsd_m_per_px=moved_gsd, right=right, lacks=lacks, statement=None, marks=()
    )


def _facts(members: Sequence[Photograph], reference: int) -> ImageFacts:
    """Take the facts of the reference, with the notices of all photographs."""
    notices = _distinct(notice for member in members for notice in member.view.image.notices)
    return members[reference].view.image._replace(notices=notices)


def _distinct(notices: Iterable[AnyRemark]) -> tuple[AnyRemark, ...]:
    """Keep the first notice of each code: photographs of one camera have the same notices."""
    first: dict[str, AnyRemark] = {}
    for notice in notices:
        first.setdefault(notice.code, notice)
    return tuple(first.values())
