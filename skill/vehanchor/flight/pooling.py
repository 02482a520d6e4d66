"""Many photographs as one body of evidence: boxes and densities brought to the pixels of one of them.

Where the ratios of the scales are known, a box of one photograph is as good as a box of another: all of them vote for
one scale. What the photographs of one flight get wrong they get wrong alike, though: ten pictures of the same fields
say less of the ground than ten places do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from vehanchor.analysis.pipeline import conclude
from vehanchor.detection.appearance import FleetAppearance
from vehanchor.detection.detections import Detections, Objects
from vehanchor.detection.scene_scale import SceneScalePrior
from vehanchor.imagery.raster import RasterNote
from vehanchor.records import Notice
from vehanchor.rulers.evidence import Evidence, View
from vehanchor.rulers.measurement import expected_scale, measure_all
from vehanchor.rulers.registry import ruler_class
from vehanchor.rulers.scene_scale import SceneScale
from vehanchor.scale.fusion import GRID, TOLERANCE, credible_interval, mass_within
from vehanchor.tilt.camera_tilt import known_plane, with_scale

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import ArrayLike, NDArray

    from vehanchor.analysis.scale import ScaleAnalysis
    from vehanchor.flight.photograph import Photograph
    from vehanchor.imagery.facts import ImageFacts

_LEAST = 1e-12
Remark = TypeVar("Remark", Notice, RasterNote)


@dataclass(frozen=True, eq=False)
class _PooledPrior(SceneScalePrior):
    """Scene-scale prior of many photographs, in the pixels of one.

    Attributes:
        pooled: ``[g]`` their density.
    """

    pooled: NDArray[np.float64]

    @cached_property
    def density(self) -> NDArray[np.float64]:
        """Probabilities on ``vehanchor.scale.fusion.GRID``."""
        return self.pooled


def pool(
    members: Sequence[Photograph], log_scales: ArrayLike, reference: int, extra: Iterable[Evidence] = ()
) -> ScaleAnalysis:
    """Put the evidence of photographs together whose ratios of scales are known.

    Args:
        members: the photographs, at least one.
        log_scales: ``[n]`` natural logs of their metres per pixel, but for a constant.
        reference: index of the member in whose pixels the answer is.
        extra: evidence of rulers that only a flight has, in those pixels.

    Returns:
        The analysis, as if all had been seen in that photograph.
    """
    added = tuple(extra)
    if len(members) == 1 and not added:
        return members[0].analysis
    logs = np.asarray(log_scales, dtype=np.float64)
    offsets = logs - logs[reference]
    chief, resolved = members[reference].view, _resolved(members)
    others = (*_pooled_others(members, offsets), *added)
    view = View(  # its boxes are rectified already: it has no tilt
        _facts(members, reference),
        pooled_sighting([member.measured for member in members], offsets),
        chief.card,
        chief.options,
        lambda _centres, _scale: resolved,
        prior=_pooled_prior([member.view for member in members], offsets),
        expected=None if chief.tilt is None else expected_scale(others),
    )
    pooled = conclude(view, *measure_all(view, others))
    own = members[reference].analysis.estimate
    if own.tilt is None:
        return pooled
    tilt = with_scale(own.tilt, own, pooled.estimate.gsd_m_per_px)
    scale = pooled.estimate.scale and pooled.estimate.scale.model_copy(update={"plane": known_plane(tilt)})
    return replace(pooled, estimate=pooled.estimate.model_copy(update={"tilt": tilt, "scale": scale}))


def pooled_sighting(detections: Sequence[Detections], offsets: ArrayLike) -> Detections:
    """Put boxes together: those whose look is known first, best first, as a sighting has them.

    Args:
        detections: of the photographs.
        offsets: ``[n]`` log of how much larger a pixel of each is than one of the pixels that the answer is in.

    Returns:
        Boxes in those pixels; their places mean nothing any more.
    """
    factors = np.exp(np.asarray(offsets, dtype=np.float64))
    scores = np.concatenate([each.scores for each in detections])
    looked = [0 if each.fleet is None else len(each.fleet.log_odds) for each in detections]
    known = np.concatenate([np.arange(len(each.boxes)) < n for each, n in zip(detections, looked, strict=True)])
    order = np.lexsort((-scores, ~known))
    boxes = np.concatenate(
        [each.boxes * [k, k, k, k, 1.0] for each, k in zip(detections, factors, strict=True)], dtype=np.float64
    )
    scaled = any(each.scales is not None for each in detections)
    scales = [
        (np.ones(len(each.boxes)) if each.scales is None else each.scales) / k
        for each, k in zip(detections, factors, strict=True)
    ]
    looks = [each.fleet for each in detections if each.fleet is not None]
    place = (np.cumsum(known) - 1)[order[: int(known.sum())]]  # among those whose look is known
    named = all(each.classes is not None for each in detections)
    classes = np.concatenate(
        [each.classes for each in detections if each.classes is not None] or [np.zeros(0, np.intp)]
    )
    return Detections(
        boxes[order],
        scores[order],
        sum(each.n_tiles for each in detections),
        sum(each.n_capped_tiles for each in detections),
        np.concatenate(scales)[order] if scaled else None,
        FleetAppearance(*(np.concatenate(part)[place] for part in zip(*looks, strict=True))) if looks else None,
        classes[order] if named else None,
        Objects.joined(),
    )


def combined_density(densities: Sequence[NDArray[np.float64]], gain: float) -> NDArray[np.float64]:
    """Multiply densities of one ruler in many photographs, which err alike.

    Args:
        densities: ``[g]`` probabilities each.
        gain: n of them are worth n ** gain: 0 where they say the same thing, 1 where they are independent.

    Returns:
        ``[g]`` probabilities.
    """
    mean = np.mean([np.log(np.maximum(density, _LEAST)) for density in densities], axis=0)
    total = mean * len(densities) ** gain
    combined = np.exp(total - total.max())
    return np.asarray(combined / combined.sum())


def shifted(density: NDArray[np.float64], offset: float) -> NDArray[np.float64]:
    """A density of one photograph's log scale as one of another's, whose own is less by ``offset``."""
    if offset == 0:
        return density
    moved = np.interp(GRID + offset, GRID, density)
    return np.asarray(moved / moved.sum())


def _resolved(members: Sequence[Photograph]) -> float:
    """Share of the resolution with detail: the median photograph's, each counted by its vehicles."""
    counts = np.array([member.analysis.estimate.n_vehicles for member in members], dtype=np.float64)
    if not counts.any():
        return 1.0
    values = np.array([member.analysis.resolved for member in members])
    order = np.argsort(values, kind="stable")
    return float(values[order][np.searchsorted(np.cumsum(counts[order]), counts.sum() / 2)])


def _pooled_prior(views: Sequence[View], offsets: NDArray[np.float64]) -> SceneScalePrior | None:
    """Scene-scale prior of the photographs that were taken at nadir."""
    priors = [
        (view.prior, float(offset))
        for view, offset in zip(views, offsets, strict=True)
        if view.prior is not None and view.tilt is None
    ]
    if not priors:
        return None
    density = combined_density([shifted(prior.density, offset) for prior, offset in priors], SceneScale.pooling_gain)
    levels = tuple(level for prior, _ in priors for level in prior.levels)
    return _PooledPrior(levels, priors[0][0].calibration, density)


def _pooled_others(members: Sequence[Photograph], offsets: NDArray[np.float64]) -> list[Evidence]:
    """The other rulers, each ruler's photographs put together."""
    kinds = dict.fromkeys(other.kind for member in members for other in member.analysis.others)
    pooled = []
    for kind in kinds:
        found = [
            (other, float(offset))
            for member, offset in zip(members, offsets, strict=True)
            for other in member.analysis.others
            if other.kind == kind
        ]
        pooled.append(_pooled_evidence(kind, found))
    return pooled


def _pooled_evidence(kind: str, found: Sequence[tuple[Evidence, float]]) -> Evidence:
    notices = _distinct(notice for other, _ in found for notice in other.notices)
    said = [(other, offset) for other, offset in found if other.density is not None and other.gsd_m_per_px is not None]
    if not said:
        return Evidence(kind, None, None, 0, 0.0, notices)
    if len(said) == 1 and said[0][1] == 0.0:
        return replace(said[0][0], notices=notices)
    densities = [shifted(other.density, offset) for other, offset in said if other.density is not None]
    density = combined_density(densities, ruler_class(kind).pooling_gain)
    median = credible_interval(density, probability=0.0).low
    cue = all(other.confidence == 0 for other, _ in said)
    confidence = 0.0 if cue else min(1.0, mass_within(density, median, TOLERANCE))
    n = sum(other.n for other, _ in said)
    return Evidence(kind, median, credible_interval(density), n, confidence, notices, density)


def _facts(members: Sequence[Photograph], reference: int) -> ImageFacts:
    """Facts of the reference, with the notices of all."""
    notices = _distinct(notice for member in members for notice in member.view.image.notices)
    return members[reference].view.image._replace(notices=notices)


def _distinct(notices: Iterable[Remark]) -> tuple[Remark, ...]:
    """First remark of each code: the photographs of one camera repeat the same remarks."""
    first: dict[str, Remark] = {}
    for notice in notices:
        first.setdefault(notice.code, notice)
    return tuple(first.values())
