"""Shared parts of the measuring tools: the source of the scale, and a hint about resized copies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, TypeAlias

from pydantic import Field

from vehanchor_server.calls.reply import MAX_SIDE_PX
from vehanchor_server.frozen import Flag, WholeNumber
from vehanchor_server.tools.scale_question import ScaleQuestion

if TYPE_CHECKING:
    from collections.abc import Iterable

    from vehanchor.measure.resolved_scale import ScaleInput
    from vehanchor.options import ScaleOptions
    from vehanchor_server.calls.job import Job
    from vehanchor_server.services import Services

OVERLAY_SIDE_PX = 1000
_LEAST_OVERLAY_PX = 256

OverlayArgument: TypeAlias = Annotated[Flag, Field(description="Also return a picture.")]
OverlaySideArgument: TypeAlias = Annotated[
    WholeNumber,
    Field(ge=_LEAST_OVERLAY_PX, le=MAX_SIDE_PX, description="Longer side of that picture, pixels, at most."),
]


@dataclass(frozen=True)
class ScaleArguments:
    """Arguments of a call that determine the scale.

    Attributes:
        question: options for an estimate, and the coordinate system.
        object_height_m: height of the object above ground.
    """

    question: ScaleQuestion
    object_height_m: float | None = None

    def resolve(self, services: Services, job: Job) -> tuple[ScaleOptions, ScaleInput]:
        """Return the options, and the measured scale or the detector that finds one.

        Raises:
            CallError: a model cannot be loaded.
            VehAnchorError: the arguments contradict each other.
        """
        from vehanchor.analysis.memory import RememberingDetector
        from vehanchor.analysis.pipeline import checked_detector
        from vehanchor.measure.resolved_scale import given_scale

        stated = self.question.stated
        if stated is not None and stated.basis == "measured":
            options = self.question.options(services.settings, None)
            given = given_scale(stated.gsd_m_per_px, None, options)
            assert given is not None
            return options, given
        options = self.question.options(services.settings, services.models)
        detector = checked_detector(services.models.detector(job.runtime), options)
        return options, RememberingDetector(detector, services.models.memory)


def copy_hint(
    places: Iterable[tuple[float, float]], question: ScaleQuestion, width_px: int, height_px: int
) -> list[str]:
    """Return a hint if the coordinates may belong to a resized copy of the image.

    Args:
        places: points in the caller's coordinates.
        question: names the coordinate system.
        width_px: width of the image.
        height_px: height of the image.
    """
    factor = MAX_SIDE_PX / max(width_px, height_px)
    if question.frame is not None or question.coordinates != "pixels" or factor >= 1:
        return []
    if any(x > width_px * factor or y > height_px * factor for x, y in places):
        return []
    return [f"Check: the image has {width_px} x {height_px} px. If you used a smaller copy, give its size as frame."]
