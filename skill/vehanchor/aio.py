"""The verbs for asynchronous programs: the same arguments and records; the work runs in a thread.

>>> import anyio, vehanchor.aio
>>> anyio.run(vehanchor.aio.estimate_gsd, "photo.jpg")  # doctest: +SKIP

If the caller is cancelled, the running model ends within a layer.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar, overload

import anyio
import anyio.to_thread

from vehanchor.engine import Cancellation, verbs

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from typing import Unpack

    from vehanchor.engine import (
        AreaKeywords,
        AreaMeasurement,
        DistanceMeasurement,
        EstimateKeywords,
        GsdEstimate,
        ImageSource,
        MeasureKeywords,
        Place,
        ScaleOptions,
    )

__all__ = ["estimate_gsd", "measure_area", "measure_distance"]

T = TypeVar("T")


@overload
async def estimate_gsd(
    image: ImageSource, options: ScaleOptions | None = None, **keywords: Unpack[EstimateKeywords]
) -> GsdEstimate: ...


@overload
async def estimate_gsd(
    image: list[Any] | tuple[Any, ...],
    options: ScaleOptions | None = None,
    **keywords: Unpack[EstimateKeywords],
) -> list[GsdEstimate]: ...


async def estimate_gsd(
    image: Any, options: ScaleOptions | None = None, **keywords: Unpack[EstimateKeywords]
) -> GsdEstimate | list[GsdEstimate]:
    """Estimate the scale of an image, or of each image of a list; see ``vehanchor.estimate_gsd``."""
    return await _in_thread(partial(verbs.estimate_gsd, image, options), keywords)


async def measure_area(
    image: ImageSource, options: ScaleOptions | None = None, **keywords: Unpack[AreaKeywords]
) -> AreaMeasurement:
    """Measure the area of an object; see ``vehanchor.measure_area``."""
    return await _in_thread(partial(verbs.measure_area, image, options), keywords)


async def measure_distance(
    image: ImageSource,
    path: Sequence[Place],
    options: ScaleOptions | None = None,
    **keywords: Unpack[MeasureKeywords],
) -> DistanceMeasurement:
    """Measure the length of a line on the ground; see ``vehanchor.measure_distance``."""
    return await _in_thread(partial(verbs.measure_distance, image, path, options), keywords)


async def _in_thread(verb: Callable[..., T], keywords: Mapping[str, Any]) -> T:
    """Run a verb in a thread; cancel the verb if the caller is cancelled."""
    cancellation = keywords.get("cancellation") or Cancellation()
    work = partial(verb, **{**keywords, "cancellation": cancellation})
    try:
        return await anyio.to_thread.run_sync(work, abandon_on_cancel=True)
    except anyio.get_cancelled_exc_class():
        cancellation.cancel()
        raise
