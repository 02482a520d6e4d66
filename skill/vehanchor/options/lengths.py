"""The option group ``Lengths``: statistics of the vehicles' lengths."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

from pydantic import BeforeValidator

from vehanchor.options.option import Limits, Option, group
from vehanchor.scale.defaults import OUTLIER_ALPHA, Aggregation


def _number_or_none(value: Any) -> Any:
    """Read ``none`` or ``off`` as no filter."""
    return None if isinstance(value, str) and value.strip().lower() in ("none", "off") else value


@group(frozen=True)
class Lengths:
    """Statistics of the vehicles' lengths.

    Attributes:
        aggregation: ``kde``, ``weighted_kde``, ``median`` or ``mean`` (see ``vehanchor.scale.lengths.modal_length``);
            None for the model's own choice (``kde``, the paper's, for foreign models).
        alpha: outlier filter, ``P_i <= alpha * median`` (paper, equation 2), alpha >= 1; None switches it off.

    Raises:
        InvalidParameterError: alpha is not a number >= 1, or the aggregation is unknown.
    """

    panel: ClassVar[str] = "Lengths"

    aggregation: Annotated[
        Aggregation | None,
        Option("Statistic of the lengths; a KDE becomes the median below 5 vehicles. Default: the model's, or kde."),
    ] = None
    alpha: Annotated[
        Annotated[float, Limits(least=1)] | None,
        BeforeValidator(_number_or_none),
        Option("Drop vehicles longer than X times the median; 'none' keeps all.", metavar="X|none"),
    ] = OUTLIER_ALPHA
