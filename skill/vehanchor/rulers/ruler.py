"""Parts of a ruler: its input, its base class, and witnesses from a scale or from a prior.

To add a ruler, subclass ``Ruler`` in a file of its own and name it in
``vehanchor.records.ruler_registry``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from vehanchor.scale.density import flat, lognormal, normalised, quantile
from vehanchor.scale.posterior import Lack, Mark, Witness
from vehanchor.scale.reliability import CALLER, FILE

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.detections import Detections
    from vehanchor.detection.scene_scale import SceneScalePrior
    from vehanchor.imagery.facts import ImageFacts
    from vehanchor.imagery.raster import Raster
    from vehanchor.models.runtime import Runtime
    from vehanchor.options import ScaleOptions
    from vehanchor.rulers.camera_tilt import CameraTilt
    from vehanchor.scale.density import Density
    from vehanchor.scale.lengths import Interval
    from vehanchor.scale.plane import GroundPlane
    from vehanchor.scale.posterior import Remark
    from vehanchor.scale.reliability import Shared

    Centres: TypeAlias = NDArray[np.float64]
    """``[n, 2]`` x, y in pixels of the image."""


@dataclass(frozen=True, eq=False)
class View:
    """Input of a ruler.

    Attributes:
        image: facts of the image.
        detections: result of the search.
        card: card of the detector.
        options: all options of the method.
        measure_detail_share: function of centres ``[n, 2]`` in pixels and of the reduction in which
            they were found; it returns the share of the resolution at which there is detail
            (``vehanchor.imagery.detail``).
        raster: the open image, for a ruler that reads pixels; None if only search results are kept.
        runtime: runtime of a ruler's own model.
        prior: the scene-scale prior; None without one.
        tilt: tilt of the camera; None for an image taken at nadir, or of unknown tilt.
        drawing_chance: 0..1, chance that the image is drawn and no photograph
            (``vehanchor.imagery.drawing``).
        expected: ``[g]`` density of the scale in a tilted view, from rulers that do not depend on
            vehicles; None without any.
    """

    image: ImageFacts
    detections: Detections
    card: DetectorCard
    options: ScaleOptions
    measure_detail_share: Callable[[Centres, float], float]
    raster: Raster | None = None
    runtime: Runtime | None = None
    prior: SceneScalePrior | None = None
    tilt: CameraTilt | None = None
    drawing_chance: float = 0.0
    expected: Density | None = None

    @cached_property
    def plane(self) -> GroundPlane | None:
        """Ground plane of a tilted view, with 1 m/px at the image's centre; None at nadir."""
        if self.tilt is None:
            return None
        return self.tilt.plane(self.image)

    def at_nadir(self) -> View:
        """Copy the view without its tilt."""
        return replace(self, tilt=None)


class Ruler:
    """Method to measure the scale of an image.

    Subclasses define ``measure``, and declare these attributes for the rest of the library.

    Attributes:
        kind: name in options and records.
        label: name in messages and pictures, as a noun.
        plural: whether the label is a plural.
        help: what the ruler needs, in a few words; ``vehanchor models --rulers`` prints it.
        colour: colour of its curve in plots, ``#rrggbb``.
        pooling_gain: n photographs of a flight count as n to this power: 0 if all have the same
            error, 1 if their errors are independent. None: the ruler measures the boxes of all
            photographs together. It then measures after the other rulers, whose
            ``View.expected`` separates cars from parts of cars in a tilted view.
        needs_search: whether it measures detections, so that the detector must run.
        reads_metadata: whether it is left out if the caller forbids metadata.
        fact: field of ``vehanchor.options.Rulers`` that it measures with, and without which it is
            left out; None for a ruler that needs no fact from the caller.
        reads_scene: whether it measures what the photograph shows, so that a picture that is no
            photograph misleads it.
        uses_plane: whether it measures on ``View.plane``; if not, it is left out in a tilted view.
        sets_scale: whether it can set the scale by itself; if not, it is a prior, which only weighs
            other rulers.
    """

    kind: ClassVar[str]
    label: ClassVar[str]
    help: ClassVar[str]
    plural: ClassVar[bool] = False
    colour: ClassVar[str] = "#8C6D31"
    pooling_gain: ClassVar[float | None] = 0.5
    needs_search: ClassVar[bool] = False
    reads_metadata: ClassVar[bool] = False
    fact: ClassVar[str | None] = None
    reads_scene: ClassVar[bool] = False
    uses_plane: ClassVar[bool] = False
    sets_scale: ClassVar[bool] = True

    def measure(self, view: View) -> Witness | None:
        """Measure the scale; in a tilted view, the scale of the image's centre.

        Args:
            view: view of the image.

        Returns:
            The witness, or ``unusable`` with the cause; None if there is nothing to report.
        """
        raise NotImplementedError

    @classmethod
    def subject_and_verb(cls) -> str:
        """Begin a sentence, such as "the courts give"."""
        verb = "give" if cls.plural else "gives"
        return f"the {cls.label} {verb}"


def mark_of_height(image: ImageFacts, height_m: float) -> Mark:
    """Mark the height of the camera in the middle of the image."""
    centre = (image.width_px / 2, image.height_px / 2)
    return Mark((centre,), f"{height_m:.4g} m up")


def unusable(kind: str, *notices: Remark) -> Witness:
    """Make the witness of a ruler that cannot measure; the notices give the cause."""
    return Witness(kind, n=0, notices=notices)


def point_witness(
    kind: str,
    gsd_m_per_px: float,
    log_sd: float,
    chance_wrong: float,
    statement: str,
    *,
    shared: Sequence[Shared] = (),
    n: int = 1,
    notices: Sequence[Remark] = (),
    marks: Sequence[Mark] = (),
) -> Witness:
    """Make a witness from a scale with a lognormal error.

    Args:
        kind: kind of the ruler.
        gsd_m_per_px: the scale, on the grid (see ``vehanchor.scale.density.on_grid``).
        log_sd: standard deviation of its log, without shared errors.
        chance_wrong: 0..1, chance that it measured something else.
        statement: sentence with the source and the measurement; ``{}`` in it stands for the scale
            and its interval.
        shared: errors in common with other witnesses.
        n: number of things measured.
        notices: warnings.
        marks: measured lines, for pictures.
    """
    witness = Witness(
        kind,
        gsd_m_per_px,
        right=lognormal(gsd_m_per_px, log_sd),
        chance_wrong=chance_wrong,
        shared=tuple(shared),
        n=n,
        notices=tuple(notices),
        marks=tuple(marks),
    )
    assert witness.interval is not None
    words = in_words(gsd_m_per_px, witness.interval)
    return replace(witness, statement=statement.replace("{}", words))


def as_assumed(witness: Witness, caller: Shared = CALLER) -> Witness:
    """Mark a witness as a guess of the caller.

    The guesses of a caller may all be wrong together, and all be read off the file.
    """
    return replace(
        witness,
        assumed=True,
        shared=(*witness.shared, caller, FILE),
        lacks=(Lack("assumed", witness),),
    )


def prior_witness(kind: str, density: Density, power: float, n: int) -> Witness:
    """Make the witness of a prior.

    Its chance to be wrong is the mass of its floor, the part that supports all scales alike.

    Args:
        kind: kind of the ruler.
        density: ``[g]`` probabilities.
        power: exponent on the density, for a prior that counts elsewhere, too.
        n: number of things measured.
    """
    weighed = normalised(density**power)
    floor = weighed.min()
    chance_wrong = float(floor / flat()[0])
    right = flat()
    if chance_wrong < 1.0:
        right = normalised(np.maximum(weighed - floor, 0.0))
    return Witness(
        kind,
        quantile(density, 0.5),
        right=right,
        chance_wrong=min(chance_wrong, 1.0),
        sets_scale=False,
        n=n,
    )


def in_words(gsd_m_per_px: float, interval: Interval) -> str:
    """Write a scale with its interval."""
    return f"{gsd_m_per_px:.4g} m/px ({interval.low:.3g} to {interval.high:.3g})"
