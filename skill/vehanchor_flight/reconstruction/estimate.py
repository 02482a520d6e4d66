"""The factor that gives a reconstruction its size: one posterior over the rulers of all its photographs."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from vehanchor.errors import ImageNotFoundError, ReconstructionError, VehAnchorError
from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.known_length_table import with_lines_of
from vehanchor.storage.journal import Source
from vehanchor_flight.photograph import chief_member
from vehanchor_flight.pooling import pool
from vehanchor_flight.reconstruction.ground import model_plane
from vehanchor_flight.reconstruction.photograph import SeenPhotograph, distinct, search_photograph
from vehanchor_flight.record import Failure
from vehanchor_flight.records import ModelPhotograph, ModelRuler, ModelScale

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.detection.detector import Detector
    from vehanchor.options import ScaleOptions
    from vehanchor.records import GsdEstimate, RulerScale
    from vehanchor.rulers.known_length_table import KnownLengthTable
    from vehanchor.storage.journal import Journal
    from vehanchor_flight.photograph import StoredPhotograph
    from vehanchor_flight.reconstruction.model import Reconstruction

# largest ratio of the ends of a photograph's interval, with which it carries the factor
_WIDEST_USED = 2.0
# a factor beyond this, or below its inverse, means that the model is not in metres
_OWN_UNITS = 1.5


def conclude_model(
    model: Reconstruction, results: Sequence[SeenPhotograph | Failure], images: Path
) -> ModelScale:
    """Make the record of searched photographs.

    Raises:
        VehAnchorError: none of them can be used.
    """
    seen = [each for each in results if isinstance(each, SeenPhotograph)]
    if not seen:
        raise _nothing_usable([each for each in results if isinstance(each, Failure)], images)
    members = distinct(seen)
    chief = chief_member(members)
    gsd = seen[chief].sight.gsd
    pooled = pool(members, np.log([each.sight.gsd for each in seen]), chief).estimate
    factors = _factors(pooled, gsd)
    photographs = [
        _failed(each) if isinstance(each, Failure) else _photograph(each, factors)
        for each in results
    ]
    return ModelScale(
        status=pooled.status,
        source=model.kind,
        **factors,
        confidence=pooled.confidence,
        reason=pooled.reason,
        verdict=verdict(*factors.values(), usable=pooled.status == "ok"),
        n_photographs=len(model.shots),
        n_vehicles=pooled.n_vehicles or 0,
        rulers=_rulers(pooled, gsd),
        photographs=tuple(photographs),
        model=pooled.model,
        model_sha256=pooled.details.model_sha256,
        warnings=(*pooled.warnings, *_parts_notice(model)),
    )


def _parts_notice(model: Reconstruction) -> list[Notice]:
    if model.n_parts == 1:
        return []
    message = (
        f"The model has {model.n_parts} parts that are not connected, each with a size of its "
        "own. This factor is that "
        "of the largest part."
    )
    return [Notice(code=NoticeCode.NOT_LINKED, message=message)]


def photograph_files(model: Reconstruction, images: Path) -> list[Path]:
    """List the files of a model's photographs.

    Raises:
        ReconstructionError: a name leads out of the folder.
    """
    return [images / _inside(shot.name) for shot in model.shots]


def search_model(
    model: Reconstruction,
    images: Path,
    detector: Detector,
    options: ScaleOptions,
    lines: KnownLengthTable,
    journal: Journal[StoredPhotograph] | None = None,
) -> list[SeenPhotograph | Failure]:
    """Search the photographs of a model one by one; arguments as in ``rescale``.

    Args:
        model: the reconstruction.
        images: folder of its photographs.
        detector: finds the vehicles.
        options: of the method, without metadata.
        lines: lines of known length by photograph.
        journal: earlier results; each new result is added at once.
    """
    files = photograph_files(model, images)
    tell = detector.runtime.tell
    silent = detector.under(replace(detector.runtime, progress=None))
    tell(0, len(files))
    whole = model_plane(model)
    found: list[SeenPhotograph | Failure] = []
    for number, (shot, file) in enumerate(zip(model.shots, files, strict=True)):
        tell(number, len(files))
        key = (shot.name, *Source.of(file))
        own = with_lines_of(options, lines, file)
        points = model.points[shot.sees(model.points)]
        kept = None if journal is None else journal.get(key)
        try:
            result = kept or search_photograph(
                file, shot, points=points, whole=whole, detector=silent, options=own
            )
            found.append(SeenPhotograph.of(result, shot, points, whole, detector.card, own))
        except VehAnchorError as error:
            found.append(Failure(shot.name, error))
            continue
        if journal is not None and kept is None:
            journal.add(key, result)
    tell(len(files), len(files))
    return found


def model_sha256(model: Reconstruction) -> str:
    """Compute the checksum of a model; in a journal, results of another model count as other options."""
    digest = hashlib.sha256(model.points.tobytes())
    for shot in model.shots:
        digest.update(
            f"{shot.name} {shot.lens}".encode()
            + shot.rotation.tobytes()
            + shot.translation.tobytes()
        )
    return digest.hexdigest()


def _inside(name: str) -> str:
    """Check that the name of a photograph leads to a file inside the folder.

    Raises:
        ReconstructionError: it does not.
    """
    path = PurePosixPath(name)
    if not path.parts or path.is_absolute() or ".." in path.parts or "\\" in name or "\0" in name:
        raise ReconstructionError(
            f"the model names a photograph {name!r}: names must be relative to one folder"
        )
    return name


def _nothing_usable(failures: Sequence[Failure], images: Path) -> VehAnchorError:
    """Choose the error of a model without a usable photograph."""
    if failures and all(isinstance(each.error, ImageNotFoundError) for each in failures):
        return ReconstructionError(
            f"no photograph of the model, such as {failures[0].name!r}, is in {str(images)!r}: "
            "name their folder "
            "with --images"
        )
    return failures[0].error if failures else ReconstructionError("the model has no photographs")


def _factors(scaled: GsdEstimate | RulerScale, gsd: float) -> dict[str, Any]:
    """Divide a scale and its interval by ``gsd``, model units per pixel, into fields of records; all None without."""
    found = scaled.gsd_m_per_px, scaled.gsd_ci95_low_m_per_px, scaled.gsd_ci95_high_m_per_px
    factors = [None if each is None or None in found else each / gsd for each in found]
    return dict(zip(("factor", "factor_ci95_low", "factor_ci95_high"), factors, strict=True))


def _rulers(estimate: GsdEstimate, gsd: float) -> tuple[ModelRuler, ...]:
    """List the rulers that can set a scale."""
    return tuple(
        ModelRuler(
            kind=each.kind,
            label=each.label,
            **_factors(each, gsd),
            n=each.n,
            p_right=each.p_right,
        )
        for each in estimate.rulers
        if each.sets_scale
    )


def _photograph(seen: SeenPhotograph, whole: dict[str, Any]) -> ModelPhotograph:
    estimate = seen.alone().analysis.estimate
    own = _factors(estimate, seen.sight.gsd)
    return ModelPhotograph(
        photograph=seen.name,
        status=_status(own, whole),
        **own,
        rulers=tuple(each.kind for each in estimate.rulers if each.sets_scale),
        n_vehicles=estimate.n_vehicles or 0,
        camera_height=seen.sight.height,
        tilt_deg=seen.sight.tilt.tilt_deg,
    )


def _status(
    own: dict[str, Any], whole: dict[str, Any]
) -> Literal["used", "unclear", "outlier", "nothing"]:
    """Compare a photograph's own factor with that of the model."""
    if None in (own["factor"], whole["factor"]):
        return "nothing"
    low = own["factor_ci95_low"]
    high = own["factor_ci95_high"]
    if low > whole["factor_ci95_high"] or high < whole["factor_ci95_low"]:
        return "outlier"
    return "used" if high <= _WIDEST_USED * low else "unclear"


def _failed(failure: Failure) -> ModelPhotograph:
    return ModelPhotograph(
        photograph=failure.name,
        status="error",
        error_code=failure.error.code,
        error=str(failure.error),
    )


def verdict(factor: float | None, low: float | None, high: float | None, *, usable: bool) -> str:
    """Put a factor in a sentence.

    Args:
        factor: metres per unit of the model; None without one.
        low: lower end of its 95 % interval.
        high: upper end.
        usable: whether the confidence suffices.
    """
    if factor is None or low is None or high is None:
        return "The model shows nothing of known size: its size remains unknown."
    said = _size(factor, low, high)
    return said if usable else f"Uncertain, do not use: {said[0].lower()}{said[1:]}"


def _size(factor: float, low: float, high: float) -> str:
    spread = f"+- {50 * (high - low) / factor:.2g} %"
    if not 1 / _OWN_UNITS <= factor <= _OWN_UNITS:
        return f"One unit of the model is {factor:.4g} m, {spread}."
    percent = 100 * (1 / factor - 1)  # the size that it has over the size that it should have
    off = f"{abs(percent):.1f} % too {'small' if percent < 0 else 'large'}, {spread}"
    return (
        f"The model has its size: {off}."
        if low <= 1 <= high
        else f"The model is {off}: multiply its lengths by {factor:.4g}."
    )
