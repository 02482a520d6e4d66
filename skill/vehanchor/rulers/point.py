"""Witnesses of rulers that state one scale with a lognormal error."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.scale.density import flat, lognormal, normalised, quantile
from vehanchor.scale.posterior import Lack, Witness
from vehanchor.scale.reliability import CALLER

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.scale.lengths import Interval
    from vehanchor.scale.posterior import Mark, Remark
    from vehanchor.scale.reliability import Shared


def unusable(kind: str, *notices: Remark) -> Witness:
    """Make the witness of a ruler that cannot measure; notices say why."""
    return Witness(kind, n=0, notices=notices)


def point_witness(
    kind: str,
    gsd_m_per_px: float,
    log_sd: float,
    chance_wrong: float,
    said: str,
    *,
    shared: Sequence[Shared] = (),
    n: int = 1,
    notices: Sequence[Remark] = (),
    marks: Sequence[Mark] = (),
) -> Witness:
    """Make a witness from a scale and its standard deviation.

    Args:
        kind: of the ruler.
        gsd_m_per_px: the scale, on the grid (see ``vehanchor.scale.density.on_grid``).
        log_sd: standard deviation of its log, without shared errors.
        chance_wrong: 0..1, chance that it measured something else.
        said: a sentence with the source and the measurement; ``{}`` in it stands for the scale and its interval.
        shared: errors in common with other witnesses.
        n: number of things measured.
        notices: warnings.
        marks: measured lines, for pictures.
    """
    witness = Witness(
        kind,
        gsd_m_per_px,
        lognormal(gsd_m_per_px, log_sd),
        chance_wrong,
        shared=tuple(shared),
        n=n,
        notices=tuple(notices),
        marks=tuple(marks),
    )
    assert witness.interval is not None
    return replace(witness, said=said.replace("{}", in_words(gsd_m_per_px, witness.interval)))


def assumed(witness: Witness, caller: Shared = CALLER) -> Witness:
    """Mark a witness as a guess of the caller, whose guesses may all be wrong together."""
    return replace(witness, assumed=True, shared=(*witness.shared, caller), lacks=(Lack("assumed", witness),))


def prior_witness(kind: str, density: NDArray[np.float64], power: float, n: int) -> Witness:
    """Make the witness of a prior; its floor is its chance to be wrong.

    Args:
        kind: of the ruler.
        density: ``[g]`` probabilities.
        power: exponent on the density, for a prior that counts elsewhere, too.
        n: number of things measured.
    """
    weighed = normalised(density**power)
    chance_wrong = float(weighed.min() / flat()[0])
    right = normalised(np.maximum(weighed - weighed.min(), 0.0)) if chance_wrong < 1.0 else flat()
    return Witness(kind, quantile(density, 0.5), right, min(chance_wrong, 1.0), sets_scale=False, n=n)


def in_words(gsd_m_per_px: float, interval: Interval) -> str:
    """Write a scale with its interval."""
    return f"{gsd_m_per_px:.4g} m/px ({interval.low:.3g} to {interval.high:.3g})"
