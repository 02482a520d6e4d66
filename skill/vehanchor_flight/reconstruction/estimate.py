"""Factor that gives a reconstruction its size: one posterior over the rulers of all photographs.

The rulers of a photograph measure metres per pixel at its centre, and the reconstruction knows the
model units per pixel there. The quotient, metres per unit, is the same for all photographs.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from vehanchor.errors import ImageNotFoundError, ReconstructionError, VehAnchorError
from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.active import uses
from vehanchor.rulers.known_length_table import with_lines_of
from vehanchor.rulers.positions import Positions, baseline, camera_positions_m
from vehanchor.storage.journal import Source
from vehanchor_flight.photograph import reference_member
from vehanchor_flight.pooling import pool
from vehanchor_flight.reconstruction.ground import model_plane
from vehanchor_flight.reconstruction.photograph import (
    SearchedPhotograph,
    merge_cars,
    search_photograph,
)
from vehanchor_flight.record import Failure, pooled_advice
from vehanchor_flight.records import ModelPhotograph, ModelRuler, ModelScale

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.detection.detector import Detector
    from vehanchor.options import ScaleOptions
    from vehanchor.options.rulers import Rulers
    from vehanchor.records import GsdEstimate, RulerScale
    from vehanchor.rulers.known_length_table import KnownLengthTable
    from vehanchor.scale.posterior import Witness
    from vehanchor.storage.journal import Journal
    from vehanchor_flight.photograph import StoredPhotograph
    from vehanchor_flight.reconstruction.model import Reconstruction

# A photograph carries the factor if the ratio of its interval's ends is not larger.
_MAX_INTERVAL_RATIO = 2.0
# A factor beyond this, or below its inverse, means that the model is not in metres.
_MAX_METRIC_FACTOR = 1.5


class _Factor(NamedTuple):
    """Factor with its 95 % interval, as fields of records; None without a scale."""

    factor: float | None = None
    factor_ci95_low: float | None = None
    factor_ci95_high: float | None = None


def conclude_model(
    model: Reconstruction,
    results: Sequence[SearchedPhotograph | Failure],
    images: Path,
    *,
    by_positions: bool = False,
) -> ModelScale:
    """Make the record of searched photographs.

    Args:
        model: the reconstruction.
        results: its photographs.
        images: folder of the photographs.
        by_positions: whether the positions in their metadata are a ruler.

    Raises:
        VehAnchorError: none of them can be used.
    """
    searched = [result for result in results if isinstance(result, SearchedPhotograph)]
    if not searched:
        failures = [result for result in results if isinstance(result, Failure)]
        raise _nothing_usable(failures, images)
    members = merge_cars(searched)
    reference = reference_member(members)
    # The model knows the ratios of the scales: the photographs pool like those of a flight.
    model_gsds = [photograph.gsd for photograph in searched]
    extra: tuple[Witness, ...] = ()
    if by_positions:
        extra = _positions_witness(model, searched, model_gsds[reference])
    analysis = pool(members, np.log(model_gsds), reference, extra)
    pooled = analysis.estimate
    factor = _factor(pooled, model_gsds[reference])
    photographs = []
    for result in results:
        if isinstance(result, Failure):
            photographs.append(_failed(result))
        else:
            photographs.append(_photograph(result, factor))
    return ModelScale(
        status=pooled.status,
        source=model.kind,
        **factor._asdict(),
        confidence=pooled.confidence,
        reason=pooled.reason,
        advice=pooled_advice(pooled),
        verdict=verdict(*factor, usable=pooled.status == "ok"),
        n_photographs=len(model.shots),
        n_vehicles=pooled.n_vehicles or 0,
        rulers=_rulers(pooled, model_gsds[reference]),
        photographs=tuple(photographs),
        model=pooled.model,
        model_sha256=pooled.details.model_sha256,
        warnings=(*pooled.warnings, *_parts_notice(model)),
    )


def uses_positions(model: Reconstruction, rulers: Rulers) -> bool:
    """Decide whether the positions in the photographs' metadata give a model its size.

    A model with a position on Earth has its size from them: they would confirm themselves. They are
    used for it only if the caller names them.
    """
    if rulers.rulers is None and model.origin is not None:
        return False
    return uses(rulers, Positions.kind)


def _positions_witness(
    model: Reconstruction, searched: Sequence[SearchedPhotograph], model_gsd: float
) -> tuple[Witness, ...]:
    """Compare the cameras of the model with the positions in metres; no witness if they differ.

    Args:
        model: the reconstruction.
        searched: its photographs.
        model_gsd: model units per pixel of the reference.
    """
    positions = camera_positions_m([photograph.view.image for photograph in searched])
    if positions is None:
        return ()
    normal = model_plane(model).normal
    # Axes in the ground plane, seen from above: x to the right, y down. Their turn about the
    # vertical is free, so that x can be any horizontal direction.
    flattest_axis = np.argmin(np.abs(normal))
    unit = np.eye(3)[flattest_axis]
    right = np.cross(unit, normal)
    right /= np.linalg.norm(right)
    down = np.cross(right, normal)
    centres = np.array([photograph.above_ground.shot.centre for photograph in searched])
    x = centres @ right
    y = centres @ down
    layout = (x + 1j * y) / model_gsd
    # The model knows the poses, so that the aim of the cameras adds no error.
    witness = baseline(layout, positions, width_px=0.0)
    if witness is None:
        return ()
    return (witness,)


def _parts_notice(model: Reconstruction) -> list[Notice]:
    """Warn of a model in several parts."""
    if model.n_parts == 1:
        return []
    message = (
        f"The model has {model.n_parts} parts that are not connected, each with a size of its "
        "own. This factor is that of the largest part."
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
) -> list[SearchedPhotograph | Failure]:
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
    report_progress = detector.runtime.report_progress
    silent_runtime = replace(detector.runtime, progress=None)
    silent_detector = detector.under(silent_runtime)
    report_progress(0, len(files))
    whole_plane = model_plane(model)
    results: list[SearchedPhotograph | Failure] = []
    for n_done, (shot, file) in enumerate(zip(model.shots, files, strict=True)):
        report_progress(n_done, len(files))
        key = (shot.name, *Source.of(file))
        own_options = with_lines_of(options, lines, file)
        is_seen = shot.sees(model.points)
        points = model.points[is_seen]
        stored = None
        if journal is not None:
            stored = journal.get(key)
        result = stored
        try:
            if result is None:
                result = search_photograph(
                    file,
                    shot,
                    points=points,
                    whole_plane=whole_plane,
                    detector=silent_detector,
                    options=own_options,
                )
            searched = SearchedPhotograph.of(
                result,
                shot,
                points=points,
                whole_plane=whole_plane,
                card=detector.card,
                options=own_options,
            )
        except VehAnchorError as error:
            results.append(Failure(shot.name, error))
            continue
        results.append(searched)
        if journal is not None and stored is None:
            journal.add(key, result)
    report_progress(len(files), len(files))
    return results


def model_sha256(model: Reconstruction) -> str:
    """Compute the checksum of a model.

    In a journal, results of another model then count as results of other options.
    """
    digest = hashlib.sha256(model.points.tobytes())
    for shot in model.shots:
        digest.update(f"{shot.name} {shot.lens}".encode())
        digest.update(shot.rotation.tobytes())
        digest.update(shot.translation.tobytes())
    return digest.hexdigest()


def _inside(name: str) -> str:
    """Check that the name of a photograph leads to a file inside the folder.

    Raises:
        ReconstructionError: it does not.
    """
    path = PurePosixPath(name)
    is_inside = bool(path.parts) and ".." not in path.parts
    is_relative = is_inside and not path.is_absolute()
    if not is_relative or "\\" in name or "\0" in name:
        raise ReconstructionError(
            f"the model names a photograph {name!r}: names must be relative to one folder"
        )
    return name


def _nothing_usable(failures: Sequence[Failure], images: Path) -> VehAnchorError:
    """Choose the error of a model without a usable photograph."""
    if not failures:
        return ReconstructionError("the model has no photographs")
    if all(isinstance(failure.error, ImageNotFoundError) for failure in failures):
        return ReconstructionError(
            f"no photograph of the model, such as {failures[0].name!r}, is in {str(images)!r}: "
            "name their folder with --images"
        )
    return failures[0].error


def _factor(scale: GsdEstimate | RulerScale, model_gsd: float) -> _Factor:
    """Divide a scale in metres per pixel by that of the model.

    Args:
        scale: with its interval.
        model_gsd: model units per pixel at the same place.
    """
    gsd = scale.gsd_m_per_px
    low = scale.gsd_ci95_low_m_per_px
    high = scale.gsd_ci95_high_m_per_px
    if gsd is None or low is None or high is None:
        return _Factor()
    return _Factor(gsd / model_gsd, low / model_gsd, high / model_gsd)


def _rulers(estimate: GsdEstimate, model_gsd: float) -> tuple[ModelRuler, ...]:
    """List the rulers that can set a scale; ``model_gsd`` as in ``_factor``."""
    rulers = []
    for ruler in estimate.rulers:
        if ruler.sets_scale:
            fields: dict[str, Any] = _factor(ruler, model_gsd)._asdict()
            record = ModelRuler(
                kind=ruler.kind,
                label=ruler.label,
                **fields,
                n=ruler.n,
                p_right=ruler.p_right,
            )
            rulers.append(record)
    return tuple(rulers)


def _photograph(searched: SearchedPhotograph, model_factor: _Factor) -> ModelPhotograph:
    """Make the record of a photograph, with its factor beside that of the model."""
    estimate = searched.alone().analysis.estimate
    own_factor = _factor(estimate, searched.gsd)
    rulers = [ruler.kind for ruler in estimate.rulers if ruler.sets_scale]
    return ModelPhotograph(
        photograph=searched.name,
        status=_status(own_factor, model_factor),
        **own_factor._asdict(),
        rulers=tuple(rulers),
        n_vehicles=estimate.n_vehicles or 0,
        camera_height=searched.above_ground.height,
        tilt_deg=searched.above_ground.tilt.tilt_deg,
    )


def _status(own: _Factor, of_model: _Factor) -> Literal["used", "unclear", "outlier", "nothing"]:
    """Compare a photograph's own factor with that of the model."""
    _, own_low, own_high = own
    _, model_low, model_high = of_model
    if own_low is None or own_high is None or model_low is None or model_high is None:
        return "nothing"
    if own_low > model_high or own_high < model_low:
        return "outlier"
    # A wide interval agrees with any factor, so its photograph does not support this one.
    if own_high > _MAX_INTERVAL_RATIO * own_low:
        return "unclear"
    return "used"


def _failed(failure: Failure) -> ModelPhotograph:
    return ModelPhotograph(
        photograph=failure.name,
        status="error",
        error_code=failure.error.code,
        error=str(failure.error),
    )


def verdict(
    factor: float | None,
    low: float | None,
    high: float | None,
    *,
    usable: bool,
) -> str:
    """Put a factor in a sentence.

    Args:
        factor: metres per unit of the model; None without one.
        low: lower end of its 95 % interval.
        high: upper end.
        usable: whether the confidence suffices.
    """
    if factor is None or low is None or high is None:
        return "The model shows nothing of known size: its size remains unknown."
    sentence = _size_sentence(factor, low, high)
    if usable:
        return sentence
    initial = sentence[0].lower()
    return f"Uncertain, do not use: {initial}{sentence[1:]}"


def _size_sentence(factor: float, low: float, high: float) -> str:
    """Put a factor in a sentence; arguments as in ``verdict``."""
    # Half of the interval.
    spread_percent = 50 * (high - low) / factor
    spread = f"+- {spread_percent:.2g} %"
    if not 1 / _MAX_METRIC_FACTOR <= factor <= _MAX_METRIC_FACTOR:
        return f"One unit of the model is {factor:.4g} m, {spread}."
    # Its size over the size that it should have.
    percent = 100 * (1 / factor - 1)
    direction = "large"
    if percent < 0:
        direction = "small"
    error = f"{abs(percent):.1f} % too {direction}, {spread}"
    if low <= 1 <= high:
        return f"The model has its size: {error}."
    return f"The model is {error}: multiply its lengths by {factor:.4g}."
