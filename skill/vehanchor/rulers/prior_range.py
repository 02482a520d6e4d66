"""Range of scales at which a ruler searches the image."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.scale.density import credible_interval
from vehanchor.scale.lengths import Interval

if TYPE_CHECKING:
    from vehanchor.rulers.view import View


def prior_range(view: View, resolved: Interval, share: float, farthest: float) -> Interval | None:
    """Compute the range of scales to search; None in a tilted view, without a prior, or outside the resolved scales.

    Args:
        view: of the image.
        resolved: metres per pixel between which the thing is resolved.
        share: of the scene-scale prior that the range holds.
        farthest: from the prior's median, as a factor.
    """
    if view.prior is None or view.plane is not None:
        return None
    middle = credible_interval(view.prior.density, 0.0).low
    low, high = credible_interval(view.prior.density, share)
    low, high = max(low, middle / farthest, resolved.low), min(high, middle * farthest, resolved.high)
    return Interval(low, high) if low < high else None
