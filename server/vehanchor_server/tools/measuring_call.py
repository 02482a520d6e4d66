"""A measuring call: its work, its records in words, and hints about its coordinates."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from vehanchor.records import GsdEstimate
from vehanchor.records.text import significant
from vehanchor_server.calls.reply import MAX_SIDE_PX
from vehanchor_server.errors import CallError
from vehanchor_server.tools.messages import answer_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mcp.server.mcpserver import Context

    from vehanchor_server.calls.reply import Detail, Reply
    from vehanchor_server.calls.task import Work
    from vehanchor_server.images.argument import AnyImage
    from vehanchor_server.services import Services
    from vehanchor_server.tools.messages import Answer, AnyRecord
    from vehanchor_server.tools.scale_arguments import CallerOptions, Question

_LARGE_PX = 1000  # longer side of images in which nobody points at the first 100 px alone
_PER_CENT = 100
# Largest tolerance, as a share of the scale, with which a measured scale is usable.
_USABLE_TOLERANCE = 0.18


async def run_measuring_call(
    services: Services,
    ctx: Context[Any, Any],
    *,
    image: AnyImage,
    work: Work[Any],
    question: Question[Any],
    points: Sequence[tuple[float, float]] = (),
    more: Sequence[AnyImage] = (),
    target_gsd_m_per_px: float | None = None,
    detail: Detail,
) -> tuple[Reply[Any], Answer]:
    """Run the work of a call, and describe its records in words.

    Args:
        services: the server's parts.
        ctx: the call's context.
        image: the image argument.
        work: the work.
        question: its question.
        points: points of the subjects, in the caller's coordinates.
        more: other images.
        target_gsd_m_per_px: scale for which the caller wants to resample; None for none.
        detail: extent of the answer.

    Raises:
        CallError: ``invalid_prompt`` for probable fractions, or as ``Services.run_call``.
    """
    options = question.options
    all_points = [*points, *_points_of_options(options)]
    _refuse_probable_fractions(all_points, options)
    reply = await services.run_call(ctx, image, work=work, question=question, more=more)
    hints = [
        *_hints_about_scale(options),
        *_hints_about_resampling(target_gsd_m_per_px, reply.record),
        *_hints_about_coordinates(all_points, options, reply.record),
    ]
    if more:
        hints += _hints_about_flight(reply.record)
    return reply, answer_of(reply.records, hints, detail)


def _points_of_options(options: CallerOptions) -> list[tuple[float, float]]:
    """Return both ends of the lines and vehicles among the options."""
    known_lengths = options.get("known_lengths", ())
    added_vehicles = options.get("add", ())
    points = []
    for line in (*known_lengths, *added_vehicles):
        points.append((line.x1, line.y1))
        points.append((line.x2, line.y2))
    return points


def _refuse_probable_fractions(
    points: Sequence[tuple[float, float]], options: CallerOptions
) -> None:
    """Refuse coordinates that look like fractions, unless the caller names their units.

    Raises:
        CallError: ``invalid_prompt``.
    """
    if not points or "coordinates" in options:
        return
    if all(0 <= value <= 1 for point in points for value in point):
        raise CallError(
            "invalid_prompt",
            "all coordinates lie in 0 to 1. For shares of the sides give coordinates: "
            '"fraction", for pixels "pixels".',
        )


def _hints_about_scale(options: CallerOptions) -> list[str]:
    """State what the call made of a stated scale."""
    hints = []
    if "gsd_m_per_px" in options and "gsd_tolerance" not in options:
        hints.append("The stated scale is taken as +- 10 %.")
    return hints


def _hints_about_flight(record: AnyRecord) -> list[str]:
    """State how a scale from several images is used to measure in the first of them."""
    if not isinstance(record, GsdEstimate) or record.status != "ok":
        return []
    scale = record.scale
    assert scale is not None  # every usable scale can be given back
    half_width = (scale.gsd_ci95_high_m_per_px - scale.gsd_ci95_low_m_per_px) / 2
    # The chance that all rulers are wrong counts once more in a measured scale.
    half_width = min(half_width, _USABLE_TOLERANCE * scale.gsd_m_per_px)
    return [
        f"To measure in this image, give gsd_m_per_px {significant(scale.gsd_m_per_px)}, "
        f'gsd_tolerance {significant(half_width, 2)} and gsd_basis "measured".'
    ]


def _hints_about_resampling(target_gsd_m_per_px: float | None, record: AnyRecord) -> list[str]:
    """State by which factor to resample the image, or the caller's copy, for a target scale."""
    if target_gsd_m_per_px is None or not isinstance(record, GsdEstimate):
        return []
    target = f"{target_gsd_m_per_px:g} m/px"
    if record.status != "ok" or record.gsd_m_per_px is None:
        return [f"Do not resample for {target}: the scale is not usable."]
    gsd = record.gsd_m_per_px
    picture = "the image"
    if record.frame is not None and record.frame.gsd_m_per_px is not None:
        gsd = record.frame.gsd_m_per_px
        picture = "your copy"
    factor = gsd / target_gsd_m_per_px
    hint = f"For {target}, resample {picture} by {significant(factor)}."
    from vehanchor.export import MAX_ENLARGEMENT

    if factor > MAX_ENLARGEMENT:
        hint += " Enlarging adds no detail."
    return [hint]


def _hints_about_coordinates(
    points: Sequence[tuple[float, float]], options: CallerOptions, record: AnyRecord
) -> list[str]:
    """Warn of coordinates that may be percentages, or pixels of a smaller copy.

    Naming the units, or a frame, silences both warnings.
    """
    if not points or "frame" in options or "coordinates" in options:
        return []
    width = record.image_width_px
    height = record.image_height_px
    size = f"The image has {width} x {height} px"
    may_be_shares = all(x <= _PER_CENT and y <= _PER_CENT for x, y in points)
    if max(width, height) > _LARGE_PX and may_be_shares:
        return [
            f"{size}, all coordinates lie in 0 to 100. If they are pixels, give coordinates: "
            '"pixels".'
        ]
    # A host may have shown its model a copy of at most MAX_SIDE_PX.
    reduction = MAX_SIDE_PX / max(width, height)
    copy_width = width * reduction
    copy_height = height * reduction
    if reduction < 1 and all(x <= copy_width and y <= copy_height for x, y in points):
        return [f"{size}. If you used a smaller copy, give its size as frame."]
    return []
