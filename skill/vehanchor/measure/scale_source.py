"""Resolve a measurement's scale: estimate, number, or earlier result."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias

from vehanchor.analysis.pipeline import georeference_notice, notices_of
from vehanchor.errors import InvalidParameterError, ScaleMismatchError, TooObliqueError
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.identity import image_id
from vehanchor.imagery.metadata.lens import lens
from vehanchor.options.rulers import GSD_M_PER_PX, OBJECT_HEIGHT_M
from vehanchor.records import KnownScale, Notice
from vehanchor.records.gsd_estimate import read_known_scale
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.camera import height_log_sd
from vehanchor.rulers.camera_tilt import ground_plane, metadata_tilt
from vehanchor.rulers.stated_scale import stated_witness
from vehanchor.scale.defaults import USABLE_CHANCE
from vehanchor.scale.lengths import Spread
from vehanchor.scale.posterior import answer
from vehanchor.scale.reliability import RELIABILITY

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.analysis.scale_analysis import ScaleAnalysis
    from vehanchor.imagery.metadata.lens import Lens
    from vehanchor.imagery.raster import Raster
    from vehanchor.options import ScaleOptions
    from vehanchor.records import GsdEstimate, ScaleSource, Status
    from vehanchor.scale.plane import GroundPlane

_COARSE_M_PER_PX = 3.0
"""From here on a car has fewer than two pixels: 5 to 30 cm are usual for aerial photographs, and easily typed."""

ScaleInput: TypeAlias = "Callable[[Raster, ScaleOptions], ScaleAnalysis] | float | KnownScale"
"""The known scale, or the analysis that finds it."""


@dataclass(frozen=True, eq=False)
class MeasurementScale:
    """Scale of a measurement and its confidence.

    Attributes:
        gsd_m_per_px: metres per pixel of the full image; None without a scale.
        spread: of its log; 0 for a number from the caller.
        confidence: 0..1; None for a number from the caller.
        source: source of the scale.
        analysis: the analysis behind it; None without a search.
        notices: warnings about the image and the scale.
        plane: ground plane of a tilted camera, with the scale of the image's centre; None if one
            scale holds.
        known: the scale of the ground, to give back; None for a number, and without a scale.
    """

    gsd_m_per_px: float | None
    spread: Spread
    confidence: float | None
    source: ScaleSource
    analysis: ScaleAnalysis | None = None
    notices: tuple[Notice, ...] = ()
    plane: GroundPlane | None = None
    known: KnownScale | None = None

    def gsd_over(self, mask: NDArray[np.bool_], left: int, top: int) -> float | None:
        """Compute metres per pixel over a mask, the root of the mean pixel area; None without a scale or a mask.

        Args:
            mask: ``[h, w]`` bool.
            left: first column of the mask in the image.
            top: first row of the mask in the image.
        """
        n_px = int(mask.sum())
        if self.gsd_m_per_px is None or not n_px:
            return None
        return (
            self.gsd_m_per_px
            if self.plane is None
            else math.sqrt(self.plane.area(mask, left, top) / n_px)
        )

    @property
    def estimate(self) -> GsdEstimate | None:
        """Record of the scale; None unless it was estimated now."""
        return None if self.analysis is None else self.analysis.estimate

    def fields(self, width_px: int, height_px: int) -> dict[str, Any]:
        """Make the fields that the records of areas and distances share, for an image of this size."""
        return {
            "scale_confidence": self.confidence,
            "gsd_m_per_px": self.gsd_m_per_px,
            "n_vehicles": None if self.estimate is None else self.estimate.n_vehicles,
            "scale_source": self.source,
            "image_width_px": width_px,
            "image_height_px": height_px,
            "scale": self.known,
            "estimate": self.estimate,
        }

    @property
    def status(self) -> Status:
        """Status of the scale."""
        if self.estimate is not None or self.gsd_m_per_px is None:
            return "no_scale" if self.estimate is None else self.estimate.status
        doubtful = self.confidence is not None and self.confidence < USABLE_CHANCE
        return "low_confidence" if doubtful else "ok"


def given_scale(
    gsd_m_per_px: float | None,
    scale: KnownScale | GsdEstimate | Mapping[str, Any] | None,
    options: ScaleOptions,
) -> float | KnownScale | None:
    """Check a known scale of the caller before the work; None if it must be estimated.

    Args:
        gsd_m_per_px: a number from the caller.
        scale: an earlier estimate of the same image, or its ``scale``.
        options: of the method.

    Raises:
        InvalidParameterError: both are given, one is given with lines of known length, or one is
            invalid.
    """
    known = [
        name
        for name, value in (("gsd_m_per_px", gsd_m_per_px), ("scale", scale))
        if value is not None
    ]
    if len(known) > 1:
        raise InvalidParameterError("give gsd_m_per_px or scale, not both")
    if known and options.rulers.known_lengths:
        raise InvalidParameterError(
            f"give {known[0]} or lines of known length, not both: a given scale is not measured "
            "again. To measure with "
            f"the lines, leave out {known[0]}"
        )
    if known and options.by_hand.given:
        raise InvalidParameterError(
            f"give {known[0]} or {options.by_hand.given}, not both: with a given scale no "
            "vehicles are searched"
        )
    if scale is not None:
        return read_known_scale(scale)
    return None if gsd_m_per_px is None else GSD_M_PER_PX.check("gsd_m_per_px", gsd_m_per_px)


def find_measurement_scale(
    raster: Raster,
    scale: ScaleInput,
    options: ScaleOptions,
    *,
    object_height_m: float | None = None,
) -> MeasurementScale:
    """Resolve the scale of an open image; the image is searched only if its scale is unknown.

    Args:
        raster: the image.
        scale: the known scale, or the analysis that finds it.
        options: all options of the method.
        object_height_m: height of the measured object above the ground; None for the ground.

    Returns:
        The scale at the height of the object.

    Raises:
        InvalidParameterError: the height is invalid, or the camera's height is unknown.
        ScaleMismatchError: the scale was measured on another image.
        TooObliqueError: the horizon is visible, or nearly so; or the object is higher than the
            camera.
        VehAnchorError: as ``Engine.estimate``.
    """
    if object_height_m is None:
        return _on_the_ground(raster, scale, options)
    camera = _camera_above(raster, options, object_height_m)
    return _raised(_on_the_ground(raster, scale, options), object_height_m, *camera)


def _on_the_ground(raster: Raster, scale: ScaleInput, options: ScaleOptions) -> MeasurementScale:
    stated = options.rulers.stated_scale
    if stated is not None and stated.basis == "measured":  # it leads, and the image is not searched
        found = answer([stated_witness(stated)])
        assert found is not None
        gsd = stated.gsd_m_per_px
        name = "the stated scale is"
        spread = Spread.of_interval(gsd, gsd - stated.tolerance, gsd + stated.tolerance)
        return _given(
            raster,
            options,
            MeasurementScale(gsd, spread, confidence=found.chance, source="given"),
            name,
        )
    if callable(scale):
        analysis = scale(raster, options)
        record = analysis.estimate
        plane = _plane(raster, record.scale)
        notices = record.warnings
        return MeasurementScale(
            record.gsd_m_per_px,
            _spread(record),
            confidence=record.confidence,
            source="estimated",
            analysis=analysis,
            notices=notices,
            plane=plane,
            known=record.scale,
        )
    if not isinstance(scale, KnownScale):
        return _given(
            raster,
            options,
            MeasurementScale(scale, Spread(), confidence=None, source="given"),
            "the given scale is",
        )
    seen = image_id(raster)
    if seen != scale.image_id:
        raise ScaleMismatchError(
            f"the scale was measured on another image ({scale.image_id}), this one is {seen}: "
            "estimate the scale "
            "of this image, or leave scale out"
        )
    reused = MeasurementScale(
        scale.gsd_m_per_px,
        _spread(scale),
        confidence=scale.confidence,
        source="reused",
        plane=_plane(raster, scale),
        known=scale,
    )
    return _given(raster, options, reused, "the scale given back is")


def _spread(scale: KnownScale | GsdEstimate) -> Spread:
    return Spread.of_interval(
        scale.gsd_m_per_px, scale.gsd_ci95_low_m_per_px, scale.gsd_ci95_high_m_per_px
    )


def _given(
    raster: Raster, options: ScaleOptions, found: MeasurementScale, name: str
) -> MeasurementScale:
    """Complete a scale from the caller: the plane by the image's metadata, and warnings about image and scale."""
    gsd = found.gsd_m_per_px
    own = raster.georeference_gsd_m_per_px
    assert gsd is not None
    unit = _unit_notice(gsd, own) if found.source == "given" else ()
    notices = (*notices_of(raster.warnings), *unit, *georeference_notice(own, gsd, name))
    image = ImageFacts(raster.width_px, raster.height_px, camera=raster.camera)
    tilt = metadata_tilt(image, options) if found.plane is None else None
    return replace(found, notices=notices, plane=tilt.plane(image, gsd) if tilt else found.plane)


def _unit_notice(gsd_m_per_px: float, own_m_per_px: float | None) -> tuple[Notice, ...]:
    """Ask about a number that looks like centimetres, unless the file has the same scale."""
    alike = own_m_per_px is not None and 0.1 < gsd_m_per_px / own_m_per_px < 10
    if gsd_m_per_px < _COARSE_M_PER_PX or alike:
        return ()
    return (
        Notice(
            code=NoticeCode.UNIT_MISTYPED,
            message=f"The given scale is {gsd_m_per_px:g} metres per pixel. Were centimetres "
            "meant? Then give "
            f"{gsd_m_per_px / 100:g}.",
        ),
    )


def _plane(raster: Raster, scale: KnownScale | None) -> GroundPlane | None:
    """Make the ground plane of an estimate; None for an image taken at nadir, or without a scale."""
    if scale is None or scale.plane is None:
        return None
    plane = ground_plane(
        scale.plane, raster.width_px, height_px=raster.height_px, gsd_m_per_px=scale.gsd_m_per_px
    )
    plane.check()
    return plane


def _camera_above(
    raster: Raster, options: ScaleOptions, object_height_m: float
) -> tuple[Lens | None, float | None, float]:
    """Collect data for the camera's height before the work.

    Returns:
        The lens, which gives the height from the scale; the stated height above the ground, or
        above take-off, metres; and the standard deviation of its log. None if unknown.

    Raises:
        InvalidParameterError: the object's height is invalid, or the camera's height is unknown.
    """
    OBJECT_HEIGHT_M.check("object_height_m", object_height_m)
    chosen = options.rulers
    camera = raster.camera if options.rulers.metadata else None
    seen = lens(ImageFacts(raster.width_px, raster.height_px), camera, chosen.focal_35mm)
    height = chosen.height_m or (camera.height_m if camera is not None else None)
    if seen is None and height is None:
        raise InvalidParameterError(
            "object_height_m needs the camera's height, which is in neither the file nor an "
            "option: give height_m, or "
            "measure on the ground"
        )
    given = RELIABILITY["measured height"].log_sd
    spread = (
        given if chosen.height_m is not None else 0.0 if height is None else height_log_sd(height)
    )
    return seen, height, spread


def _raised(
    found: MeasurementScale,
    object_height_m: float,
    lens: Lens | None,
    camera_height_m: float | None,
    height_log_sd: float,
) -> MeasurementScale:
    """Convert the scale of the ground to a height above it, nearer to the camera.

    Raises:
        TooObliqueError: the object is higher than the camera.
    """
    if found.gsd_m_per_px is None or object_height_m == 0:
        return found
    focal_px = found.plane.focal_px if found.plane is not None else lens and lens.pixels
    if found.plane is not None:
        height = found.plane.height_m
    else:
        height = found.gsd_m_per_px * focal_px if focal_px else camera_height_m or math.inf
    share = object_height_m / height
    if share >= 1:
        raise TooObliqueError(
            f"an object {object_height_m:g} m above the ground lies above the camera, which is "
            f"{height:.0f} m up: give "
            "a lower height"
        )
    if focal_px:  # scale less height over focal length: the relative error grows with height
        lens_log_sd = lens.log_sd if lens else 0.0
        spread = found.spread.plus(share * lens_log_sd).times(1 / (1 - share))
    else:
        spread = found.spread.plus(share / (1 - share) * height_log_sd)
    gsd = found.gsd_m_per_px * (1 - share)
    return replace(
        found,
        gsd_m_per_px=gsd,
        spread=spread,
        plane=found.plane and replace(found.plane, gsd_m_per_px=gsd),
    )
