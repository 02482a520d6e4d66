"""What the tools that measure by a scale have in common: where the scale comes from, and a copy taken for the image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from vehanchor.records import KnownScale
from vehanchor_server.tools.scale_question import ScaleQuestion

if TYPE_CHECKING:
    from collections.abc import Iterable

    from vehanchor.measure.resolved_scale import ScaleInput
    from vehanchor.options import ScaleOptions
    from vehanchor_server.calls.job import Job
    from vehanchor_server.services import Services

_SEEN_SIDE_PX = 1568  # hosts reduce larger images for their models


@dataclass(frozen=True)
class MeasuredBy:
    """A caller's words about the scale that it measures by.

    Attributes:
        gsd_m_per_px: the scale where the caller knows it.
        scale: the scale of an earlier answer.
        question: how the scale is found otherwise, and how places are written.
        object_height_m: of what is measured, above the ground.
    """

    gsd_m_per_px: float | None
    scale: KnownScale | None
    question: ScaleQuestion
    object_height_m: float | None = None

    def resolve(self, services: Services, job: Job) -> tuple[ScaleOptions, ScaleInput]:
        """The method's options, and what finds the scale or is it; a model is loaded only where one is needed.

        Raises:
            CallError: a model cannot be loaded.
            VehAnchorError: the arguments contradict each other.
        """
        from vehanchor.estimate import check_region
        from vehanchor.measure.resolved_scale import given_scale

        searched = self.gsd_m_per_px is None and self.scale is None
        options = self.question.options(services.settings, services.models if searched else None)
        given = given_scale(self.gsd_m_per_px, self.scale, options)
        return options, check_region(services.models.detector(job.runtime), options) if given is None else given


def copy_hint(
    places: Iterable[tuple[float, float]], question: ScaleQuestion, width_px: int, height_px: int
) -> list[str]:
    """A sentence for a caller whose pixels may be those of a reduced copy; none where they cannot be.

    Args:
        places: in the caller's coordinates.
        question: says what these are.
        width_px: of the image.
        height_px: of the image.
    """
    factor = _SEEN_SIDE_PX / max(width_px, height_px)
    if question.frame is not None or question.coordinates != "pixels" or factor >= 1:
        return []
    if any(x > width_px * factor or y > height_px * factor for x, y in places):
        return []
    return [
        f"Check: the image has {width_px} x {height_px} px. If you pointed in a smaller copy, give its size as frame."
    ]
