"""Stated scale as a ruler: metres per pixel from the caller, such as those of a map."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from vehanchor.errors import InvalidParameterError
from vehanchor.rulers.ruler import Ruler, as_assumed, point_witness
from vehanchor.scale.density import GRID, on_grid
from vehanchor.scale.lengths import Z95
from vehanchor.scale.reliability import MEASURING, RELIABILITY

if TYPE_CHECKING:
    from vehanchor.options.rulers import StatedScale as Stated
    from vehanchor.rulers.ruler import View
    from vehanchor.scale.posterior import Witness


class StatedScale(Ruler):
    """Metres per pixel that the caller states."""

    kind = "stated_scale"
    label = "stated scale"
    help = "a scale from elsewhere, such as a map or a sister photograph"
    colour = "#56B4E9"
    pooling_gain = 0.0  # one statement: one error
    fact = "stated_scale"
    uses_plane = True

    def measure(self, view: View) -> Witness:
        """Take the stated scale with its tolerance.

        Raises:
            InvalidParameterError: as ``stated_witness``.
        """
        stated = view.options.rulers.stated_scale
        assert stated is not None
        return stated_witness(stated)


def is_comparable(stated: Stated) -> bool:
    """Test whether rulers can have all scales within the tolerance of a stated one."""
    low = stated.gsd_m_per_px - stated.tolerance
    high = stated.gsd_m_per_px + stated.tolerance
    return on_grid(low) and on_grid(high)


def stated_witness(stated: Stated) -> Witness:
    """Make the witness of a stated scale.

    Raises:
        InvalidParameterError: the scale is not comparable with rulers.
    """
    # A density that the end of the grid cuts would have another median than the stated scale.
    if not is_comparable(stated):
        raise InvalidParameterError(
            f"gsd_m_per_px is {stated.gsd_m_per_px:g} +- {stated.tolerance:.2g}: rulers are "
            f"compared from {math.exp(GRID[0]):.3g} to {math.exp(GRID[-1]):.3g} m/px. Check its "
            "unit; areas and distances need no estimate if gsd_basis is measured"
        )
    witness = point_witness(
        StatedScale.kind,
        stated.gsd_m_per_px,
        log_sd=stated.tolerance / stated.gsd_m_per_px / Z95,
        chance_wrong=RELIABILITY[stated.basis].chance_wrong,
        statement=f"The stated scale, {stated.basis}, is {{}}.",
        shared=[MEASURING] if stated.basis == "measured" else [],
    )
    return as_assumed(witness) if stated.basis == "assumed" else witness
