"""The option group ``Lengths``: statistics of the vehicles' lengths."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, get_args

from vehanchor.errors import InvalidParameterError
from vehanchor.options.option import Limits, Words, check_fields, option
from vehanchor.scale.defaults import OUTLIER_ALPHA, Aggregation


def number_or_none(text: str) -> float | None:
    """Read a number, or ``none`` (``off``) for no filter.

    Raises:
        InvalidParameterError: the text is neither.
    """
    if text.strip().lower() in ("none", "off"):
        return None
    try:
        return float(text)
    except ValueError:
        raise InvalidParameterError(f"--alpha is {text!r}: use a number >= 1, or 'none'") from None


@dataclass(frozen=True)
class Lengths:
    """Statistics of the vehicles' lengths.

    Attributes:
        alpha: outlier filter, ``P_i <= alpha * median`` (paper, equation 2), alpha >= 1; None switches it off.
        aggregation: ``kde``, ``weighted_kde``, ``median`` or ``mean`` (see ``vehanchor.scale.lengths.modal_length``);
            None for the model's own choice (``kde``, the paper's, for foreign models).

    Raises:
        InvalidParameterError: alpha is not a number >= 1, or the aggregation is unknown.
    """

    panel: ClassVar[str] = "Lengths"

    aggregation: Aggregation | None = field(
        default=None,
        metadata=option(
            "Statistic of the lengths; a KDE becomes the median below 5 vehicles. Default: the model's, or kde.",
            Words(get_args(Aggregation)),
        ),
    )
    alpha: float | None = field(
        default=OUTLIER_ALPHA,
        metadata=option(
            "Drop vehicles longer than X times the median; 'none' keeps all.",
            Limits(least=1),
            metavar="X|none",
            read=number_or_none,
        ),
    )

    def __post_init__(self) -> None:
        check_fields(self)
