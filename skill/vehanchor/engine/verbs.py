"""The methods of ``Engine`` as functions; they share the models that the process has loaded."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, overload

from vehanchor.engine.engine import Engine

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Unpack

    from vehanchor.analysis.measured import AreaAnalysis, DistanceAnalysis
    from vehanchor.analysis.scale import ScaleAnalysis
    from vehanchor.engine.keywords import AreaKeywords, EstimateKeywords, MeasureKeywords
    from vehanchor.imagery.sources.opening import ImageSource
    from vehanchor.options import ScaleOptions
    from vehanchor.options.coordinates import Place
    from vehanchor.records import AreaMeasurement, DistanceMeasurement, GsdEstimate


@overload
def estimate_gsd(
    image: ImageSource, options: ScaleOptions | None = None, **keywords: Unpack[EstimateKeywords]
) -> GsdEstimate: ...


@overload
def estimate_gsd(
    image: list[Any] | tuple[Any, ...],
    options: ScaleOptions | None = None,
    **keywords: Unpack[EstimateKeywords],
) -> list[GsdEstimate]: ...


def estimate_gsd(
    image: Any, options: ScaleOptions | None = None, **keywords: Unpack[EstimateKeywords]
) -> GsdEstimate | list[GsdEstimate]:
    """Estimate the scale of an image, or of each image of a list; see ``Engine.estimate``."""
    records: GsdEstimate | list[GsdEstimate] = Engine().estimate(image, options, **keywords)
    return records


def analyse_scale(
    image: ImageSource, options: ScaleOptions | None = None, **keywords: Unpack[EstimateKeywords]
) -> ScaleAnalysis:
    """Estimate the scale of one image, with its evidence; see ``Engine.analyse_scale``."""
    return Engine().analyse_scale(image, options, **keywords)


def measure_area(
    image: ImageSource, options: ScaleOptions | None = None, **keywords: Unpack[AreaKeywords]
) -> AreaMeasurement:
    """Measure the area of an object; see ``Engine.measure_area``."""
    return Engine().measure_area(image, options, **keywords)


def analyse_area(
    image: ImageSource, options: ScaleOptions | None = None, **keywords: Unpack[AreaKeywords]
) -> AreaAnalysis:
    """Measure the area of an object, with its mask; see ``Engine.analyse_area``."""
    return Engine().analyse_area(image, options, **keywords)


def measure_distance(
    image: ImageSource,
    path: Sequence[Place],
    options: ScaleOptions | None = None,
    **keywords: Unpack[MeasureKeywords],
) -> DistanceMeasurement:
    """Measure the length of a line on the ground; see ``Engine.measure_distance``."""
    return Engine().measure_distance(image, path, options, **keywords)


def analyse_distance(
    image: ImageSource,
    path: Sequence[Place],
    options: ScaleOptions | None = None,
    **keywords: Unpack[MeasureKeywords],
) -> DistanceAnalysis:
    """Measure the length of a line, with the analysis of the scale; see ``Engine.analyse_distance``."""
    return Engine().analyse_distance(image, path, options, **keywords)
