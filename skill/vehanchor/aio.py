"""The verbs for programs that wait: the same arguments and records, the work in a thread that ends when nobody waits.

>>> import anyio, vehanchor.aio
>>> anyio.run(vehanchor.aio.estimate_gsd, "photo.jpg")  # doctest: +SKIP
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import anyio
import anyio.to_thread

from vehanchor import estimate
from vehanchor.measure import area, distance
from vehanchor.models.session import stoppable
from vehanchor.options import ScaleOptions

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from vehanchor.analysis.measured import DistanceAnalysis
    from vehanchor.imagery.sources.opening import ImageSource
    from vehanchor.measure.coordinates import Place
    from vehanchor.records import AreaMeasurement, DistanceMeasurement, GsdEstimate

__all__ = ["estimate_gsd", "measure_area", "measure_distance"]

Result = TypeVar("Result")

_KEPT_APART = frozenset(
    {"detector", "segmenter", "threads", "providers", "progress"}
    | {"box", "points", "gsd_m_per_px", "scale", "object_height_m"}
)  # keywords of the verbs that are no options of the method


async def estimate_gsd(image: ImageSource, **keywords: Any) -> GsdEstimate:
    """Estimate the scale; the keywords, the record and the errors are those of ``vehanchor.estimate_gsd``."""
    return (await _ended_with_its_caller(estimate.analyse_scale, image, keywords)).estimate


async def measure_area(image: ImageSource, **keywords: Any) -> AreaMeasurement:
    """Measure an area; the keywords, the record and the errors are those of ``vehanchor.measure_area``."""
    return (await _ended_with_its_caller(area.analyse_area, image, keywords)).measurement


async def measure_distance(image: ImageSource, path: Sequence[Place], **keywords: Any) -> DistanceMeasurement:
    """Measure a distance; the keywords, the record and the errors are those of ``vehanchor.measure_distance``."""

    def analyse(image: ImageSource, options: ScaleOptions, **apart: Any) -> DistanceAnalysis:
        return distance.analyse_distance(image, path, options, **apart)

    return (await _ended_with_its_caller(analyse, image, keywords)).measurement


async def _ended_with_its_caller(verb: Callable[..., Result], image: ImageSource, keywords: dict[str, Any]) -> Result:
    """Run a verb in a thread; when its caller is cancelled, the running model ends within a layer."""
    apart = {name: value for name, value in keywords.items() if name in _KEPT_APART}
    options = ScaleOptions.of({name: value for name, value in keywords.items() if name not in _KEPT_APART})
    run_options = stoppable()
    work = partial(verb, image, options, run_options=run_options, **apart)
    try:
        return await anyio.to_thread.run_sync(work, abandon_on_cancel=True)
    except anyio.get_cancelled_exc_class():
        run_options.terminate = True
        raise
