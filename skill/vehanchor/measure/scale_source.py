"""Resolve a measurement's scale: estimate, number, or earlier result."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from vehanchor.analysis.pipeline import GEOREFERENCE_TOLERANCE, georeference_notice, notices_of
from vehanchor.errors import InvalidParameterError, ScaleMismatchError, TooObliqueError
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.identity import image_id
from vehanchor.imagery.metadata.lens import lens
from vehanchor.imagery.photograph import find_photographs
from vehanchor.imagery.raster import Window
from vehanchor.options.rulers import GSD_M_PER_PX, OBJECT_HEIGHT_M, StatedScale
from vehanchor.records import KnownScale, Notice
from vehanchor.records.gsd_estimate import read_known_scale
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.camera import height_log_sd
from vehanchor.rulers.camera_tilt import ground_plane, metadata_tilt
from vehanchor.rulers.stated_scale import is_comparable, stated_witness
from vehanchor.scale.defaults import MAX_GSD_M_PER_PX, MIN_GSD_M_PER_PX, USABLE_CHANCE
from vehanchor.scale.lengths import Z95, Spread
from vehanchor.scale.posterior import judge
from vehanchor.scale.reliability import GEOREFERENCE_LOG_SD, RELIABILITY

if TYPE_CHECKING:
    from collections.abc import Callable

    from vehanchor.analysis.scale_analysis import ScaleAnalysis
    from vehanchor.imagery.metadata.lens import Lens
    from vehanchor.imagery.raster import Raster
    from vehanchor.options import ScaleOptions
    from vehanchor.options.pixel_grid import PixelGrid
    from vehanchor.records import GsdEstimate, ScaleSource, Status
    from vehanchor.scale.density import Density
    from vehanchor.scale.plane import GroundPlane
    from vehanchor.segmentation.shape import Mask

# A caller who types 5 to 30, the usual centimetres per pixel of aerial photographs, means another
# unit. At this scale a car has fewer than two pixels.
_MIN_COARSE_M_PER_PX = 3.0
# A number this close to the file's own scale, as a factor either way, is in the right unit.
_SAME_UNIT_FACTOR = 10
# The camera in a georeferenced file contradicts its scale beyond this many standard deviations of
# the camera's own. A choice, as for photographs of one scale.
_CONTRADICTING_SDS = 3.0
# Georeferenced files of at most so many pixels are searched for what contradicts their scale, which
# takes seconds. A survey of 10,000 megapixels would take minutes for one roof. A choice.
_MAX_COMPARED_PX = 25_000_000

ScaleInput: TypeAlias = "Callable[[Raster, ScaleOptions], ScaleAnalysis] | float | KnownScale"
"""The known scale, or the analysis that finds it."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasurementScale:
    """Scale of a measurement and its confidence.

    Attributes:
        gsd_m_per_px: metres per pixel of the full image; None without a scale.
        spread: uncertainty of its log; 0 for a number from the caller.
        confidence: 0..1; None for a number from the caller.
        source: origin of the scale: ``estimated``, ``given``, ``reused`` or ``file``.
        analysis: the analysis behind it; None without a search.
        notices: warnings about the image and the scale.
        plane: ground plane of a tilted camera, with the scale of the image's centre; None if one
            scale holds.
        known: the scale of the ground, which the caller can give back; None for a number, and
            without a scale.
        posterior: ``[g]`` whole posterior of the scale; None for a number, a scale that was given
            back, and the preset ``paper``.
        file_gsd_m_per_px: the file's own scale, whether used or not; None without one.
        n_compared: vehicles that the file's own scale was compared with; None without a comparison.
        part: the photograph for which an estimate holds; None if all of the picture is one.
    """

    gsd_m_per_px: float | None
    spread: Spread
    confidence: float | None
    source: ScaleSource
    analysis: ScaleAnalysis | None = None
    notices: tuple[Notice, ...] = ()
    plane: GroundPlane | None = None
    known: KnownScale | None = None
    posterior: Density | None = None
    file_gsd_m_per_px: float | None = None
    n_compared: int | None = None
    part: Window | None = None

    def gsd_over(self, mask: Mask, left: int, top: int) -> float | None:
        """Compute metres per pixel over a mask: the square root of the mean area of its pixels.

        Args:
            mask: ``[h, w]`` bool.
            left: first column of the mask in the image.
            top: first row of the mask in the image.

        Returns:
            None without a scale or a mask.
        """
        n_px = int(mask.sum())
        if self.gsd_m_per_px is None or n_px == 0:
            return None
        if self.plane is None:
            return self.gsd_m_per_px
        area_m2 = self.plane.area(mask, left, top)
        return math.sqrt(area_m2 / n_px)

    @property
    def estimate(self) -> GsdEstimate | None:
        """Record of the scale; None unless it was estimated now."""
        if self.analysis is None:
            return None
        return self.analysis.estimate

    def fields(self, grid: PixelGrid) -> dict[str, Any]:
        """Make the fields that records of areas and distances share, for the image's pixels."""
        estimate = self.estimate
        return {
            "scale_confidence": self.confidence,
            "gsd_m_per_px": self.gsd_m_per_px,
            "n_vehicles": self.n_compared if estimate is None else estimate.n_vehicles,
            "scale_source": self.source,
            "georeference_gsd_m_per_px": self.file_gsd_m_per_px,
            "image_width_px": grid.width_px,
            "image_height_px": grid.height_px,
            "pixel_aspect": grid.stated_aspect,
            "scale": self.known,
            "estimate": estimate,
        }

    @property
    def status(self) -> Status:
        """Status of the scale."""
        if self.estimate is not None:
            return self.estimate.status
        if self.gsd_m_per_px is None:
            return "no_scale"
        if self.confidence is not None and self.confidence < USABLE_CHANCE:
            return "low_confidence"
        return "ok"


def read_scale_argument(
    gsd_m_per_px: float | None,
    scale: KnownScale | GsdEstimate | Mapping[str, Any] | None,
    options: ScaleOptions,
) -> float | KnownScale | None:
    """Check a known scale of the caller before the work; None if it must be estimated.

    Args:
        gsd_m_per_px: a number from the caller.
        scale: an earlier estimate of the same image, or its ``scale``.
        options: all options of the method.

    Raises:
        InvalidParameterError: both are given, one is given with lines of known length, or one is
            invalid.
    """
    if gsd_m_per_px is not None and scale is not None:
        raise InvalidParameterError("give gsd_m_per_px or scale, not both")
    if gsd_m_per_px is None and scale is None:
        return None
    name = "gsd_m_per_px" if scale is None else "scale"
    if options.rulers.known_lengths:
        raise InvalidParameterError(
            f"give {name} or lines of known length, not both: a given scale is not measured "
            f"again. To measure with the lines, leave out {name}"
        )
    if options.by_hand.given:
        raise InvalidParameterError(
            f"give {name} or {options.by_hand.given}, not both: with a given scale no vehicles "
            "are searched"
        )
    if scale is not None:
        return read_known_scale(scale)
    return GSD_M_PER_PX.check("gsd_m_per_px", gsd_m_per_px)


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
        VehAnchorError: see ``Engine.estimate``.
    """
    if object_height_m is None:
        return _ground_scale_of(raster, scale, options)
    # Before the search, because an unknown height of the camera ends the call.
    camera = _camera_above_ground(raster, options, object_height_m)
    ground_scale = _ground_scale_of(raster, scale, options)
    return _scale_at_height(ground_scale, object_height_m, camera)


def _ground_scale_of(raster: Raster, scale: ScaleInput, options: ScaleOptions) -> MeasurementScale:
    """Resolve the scale of the ground, beside the one that the file states."""
    ground_scale = _ground_scale(raster, scale, options)
    return replace(ground_scale, file_gsd_m_per_px=raster.georeference_gsd_m_per_px)


def _ground_scale(raster: Raster, scale: ScaleInput, options: ScaleOptions) -> MeasurementScale:
    """Resolve the scale of the ground."""
    # A measured scale leads, and the image is not searched.
    stated = options.rulers.stated_scale
    if stated is not None and stated.basis == "measured":
        return _use_stated_scale(raster, stated, options)
    if callable(scale):
        file_scale = _file_scale(raster, options)
        if file_scale is None:
            return _estimate_scale(raster, scale(raster, options))
        if raster.width_px * raster.height_px > _MAX_COMPARED_PX:
            return _use_file_scale(raster, file_scale, options)
        analysis = scale(raster, options)
        if _is_contradicted(file_scale, analysis):
            return _estimate_scale(raster, analysis)
        compared = _use_file_scale(raster, file_scale, options)
        return replace(compared, n_compared=analysis.estimate.n_vehicles)
    if isinstance(scale, KnownScale):
        return _reuse_scale(raster, scale, options)
    number = MeasurementScale(gsd_m_per_px=scale, spread=Spread(), confidence=None, source="given")
    return _with_metadata(raster, options, number, "the given scale is")


def _file_scale(raster: Raster, options: ScaleOptions) -> StatedScale | None:
    """Take the scale of a georeferenced file, judged like one that the caller measured.

    Returns:
        None without a georeference, if the caller asks for an estimate, or if the camera's metadata
        contradict it.
    """
    gsd = raster.georeference_gsd_m_per_px
    if gsd is None or _asks_for_estimate(options):
        return None
    is_possible = MIN_GSD_M_PER_PX <= gsd <= MAX_GSD_M_PER_PX
    if not is_possible or _camera_contradicts(raster, gsd, options):
        return None
    return StatedScale(gsd, "measured", tolerance=Z95 * GEOREFERENCE_LOG_SD * gsd)


def _asks_for_estimate(options: ScaleOptions) -> bool:
    """Test whether the caller asks for an estimate, or states what only an estimate can use.

    A caller who does not trust the file's metadata does not trust its georeference either.
    """
    rulers = options.rulers
    if not rulers.file_scale or not rulers.metadata or rulers.rulers is not None:
        return True
    has_facts = rulers.height_m is not None or rulers.stated_scale is not None
    by_hand = bool(rulers.known_lengths) or options.by_hand.given is not None
    return has_facts or by_hand or options.method.preset is not None


def _camera_contradicts(raster: Raster, gsd_m_per_px: float, options: ScaleOptions) -> bool:
    """Test whether the camera in the file contradicts its georeference.

    A tilted camera has no single scale, so its picture is no map.
    """
    if raster.camera is None:
        return False
    image = ImageFacts(raster.width_px, raster.height_px, camera=raster.camera)
    if metadata_tilt(image, options) is not None:
        return True
    height_m = raster.camera.height_m
    camera_lens = lens(image, raster.camera, options.rulers.focal_35mm)
    if height_m is None or camera_lens is None:
        return False
    log_ratio = math.log(height_m / camera_lens.pixels / gsd_m_per_px)
    log_sd = math.hypot(height_log_sd(height_m), camera_lens.log_sd)
    return abs(log_ratio) > _CONTRADICTING_SDS * log_sd


def _is_contradicted(file_scale: StatedScale, analysis: ScaleAnalysis) -> bool:
    """Test whether vehicles, or another usable estimate, contradict the scale of a file.

    The scene alone does not count: it would refuse 15 of 154 right scales of photographs without
    cars. With cars, 1 of 323 right ones is refused, and 282 of 323 that are 1.5 times too coarse.
    """
    estimate = analysis.estimate
    if not estimate.n_vehicles and estimate.status != "ok":
        return False
    gsd = file_scale.gsd_m_per_px
    if not is_comparable(file_scale):
        return estimate.status == "ok"
    together = judge([*analysis.witnesses, stated_witness(file_scale)])
    assert together is not None
    difference = abs(together.gsd_m_per_px - gsd)
    return together.chance < USABLE_CHANCE or difference > GEOREFERENCE_TOLERANCE * gsd


def _use_file_scale(raster: Raster, stated: StatedScale, options: ScaleOptions) -> MeasurementScale:
    scale = _use_stated_scale(raster, stated, options)
    return replace(scale, source="file")


def _use_stated_scale(
    raster: Raster, stated: StatedScale, options: ScaleOptions
) -> MeasurementScale:
    gsd = stated.gsd_m_per_px
    # The chance depends on the relative tolerance alone, so that a scale off the grid of the
    # rulers, such as a satellite's, is judged like one on it.
    relative_tolerance = stated.tolerance / gsd
    judged = stated._replace(gsd_m_per_px=1.0, tolerance=relative_tolerance)
    decision = judge([stated_witness(judged)])
    assert decision is not None
    # Where no ruler can be, there is no posterior: interval and chance stand for it.
    posterior = None
    if is_comparable(stated):
        posterior = stated_witness(stated).density
    spread = Spread.of_interval(gsd, gsd - stated.tolerance, gsd + stated.tolerance)
    scale = MeasurementScale(
        gsd_m_per_px=gsd,
        spread=spread,
        confidence=decision.chance,
        source="given",
        posterior=posterior,
    )
    return _with_metadata(raster, options, scale, "the stated scale is")


def _estimate_scale(raster: Raster, analysis: ScaleAnalysis) -> MeasurementScale:
    record = analysis.estimate
    return MeasurementScale(
        gsd_m_per_px=record.gsd_m_per_px,
        spread=_spread(record),
        confidence=record.confidence,
        source="estimated",
        analysis=analysis,
        notices=record.warnings,
        plane=_ground_plane(raster, record.scale),
        known=record.scale,
        posterior=None if analysis.answer is None else analysis.answer.posterior,
        part=analysis.part,
    )


def _reuse_scale(raster: Raster, known: KnownScale, options: ScaleOptions) -> MeasurementScale:
    this_image = image_id(raster)
    if this_image != known.image_id:
        raise ScaleMismatchError(
            f"the scale was measured on another image ({known.image_id}), this one is "
            f"{this_image}: estimate the scale of this image, or leave scale out"
        )
    scale = MeasurementScale(
        gsd_m_per_px=known.gsd_m_per_px,
        spread=_spread(known),
        confidence=known.confidence,
        source="reused",
        plane=_ground_plane(raster, known),
        known=known,
        part=_only_photograph(raster),
    )
    return _with_metadata(raster, options, scale, "the scale given back is")


def _only_photograph(raster: Raster) -> Window | None:
    """Find the photograph in a picture; None if all of the picture is one, or it shows several."""
    photographs = find_photographs(raster)
    first = photographs[0]
    if len(photographs) > 1 or first is raster:
        return None
    return first.part


def _spread(scale: KnownScale | GsdEstimate) -> Spread:
    return Spread.of_interval(
        scale.gsd_m_per_px, scale.gsd_ci95_low_m_per_px, scale.gsd_ci95_high_m_per_px
    )


def _with_metadata(
    raster: Raster, options: ScaleOptions, scale: MeasurementScale, described: str
) -> MeasurementScale:
    """Complete a scale from the caller with the metadata of the image.

    Args:
        raster: the image.
        options: all options of the method.
        scale: the scale, without notices.
        described: the scale as subject and verb of a sentence.

    Returns:
        The scale with the warnings about it and the image, and with a ground plane if the image is
        tilted.
    """
    gsd = scale.gsd_m_per_px
    assert gsd is not None
    file_gsd = raster.georeference_gsd_m_per_px
    notices = [*notices_of(raster.warnings)]
    if scale.source == "given":
        notices += _unit_notices(gsd, file_gsd)
    notices += georeference_notice(file_gsd, gsd, described)
    plane = scale.plane
    if plane is None:
        image = ImageFacts(raster.width_px, raster.height_px, camera=raster.camera)
        tilt = metadata_tilt(image, options)
        if tilt is not None:
            plane = tilt.plane(image, gsd)
    return replace(scale, notices=tuple(notices), plane=plane)


def _unit_notices(gsd_m_per_px: float, file_m_per_px: float | None) -> list[Notice]:
    """Ask about a number that looks like centimetres, unless the file has a similar scale."""
    if gsd_m_per_px < _MIN_COARSE_M_PER_PX:
        return []
    if file_m_per_px is not None:
        ratio = gsd_m_per_px / file_m_per_px
        if 1 / _SAME_UNIT_FACTOR < ratio < _SAME_UNIT_FACTOR:
            return []
    question = Notice(
        code=NoticeCode.UNIT_MISTYPED,
        message=f"The given scale is {gsd_m_per_px:g} metres per pixel. Were centimetres meant? "
        f"Then give {gsd_m_per_px / 100:g}.",
    )
    return [question]


def _ground_plane(raster: Raster, scale: KnownScale | None) -> GroundPlane | None:
    """Make the ground plane of an estimate; None for an image taken at nadir, and without scale."""
    if scale is None or scale.plane is None:
        return None
    plane = ground_plane(
        scale.plane, raster.width_px, height_px=raster.height_px, gsd_m_per_px=scale.gsd_m_per_px
    )
    plane.check()
    return plane


class _CameraAboveGround(NamedTuple):
    """Data that give the camera's height above the ground.

    Attributes:
        lens: the lens, which gives the height from the scale; None if unknown.
        height_m: the stated height above the ground, or above take-off; None if unknown.
        height_log_sd: standard deviation of the log of the stated height.
    """

    lens: Lens | None
    height_m: float | None
    height_log_sd: float


def _camera_above_ground(
    raster: Raster, options: ScaleOptions, object_height_m: float
) -> _CameraAboveGround:
    """Collect data for the camera's height before the search.

    Raises:
        InvalidParameterError: the object's height is invalid, or the camera's height is unknown.
    """
    OBJECT_HEIGHT_M.check("object_height_m", object_height_m)
    rulers = options.rulers
    camera = raster.camera if rulers.metadata else None
    image = ImageFacts(raster.width_px, raster.height_px)
    camera_lens = lens(image, camera, rulers.focal_35mm)
    if rulers.height_m is not None:
        log_sd = RELIABILITY["measured height"].log_sd
        return _CameraAboveGround(camera_lens, rulers.height_m, log_sd)
    if camera is not None and camera.height_m is not None:
        log_sd = height_log_sd(camera.height_m)
        return _CameraAboveGround(camera_lens, camera.height_m, log_sd)
    if camera_lens is None:
        raise InvalidParameterError(
            "object_height_m needs the camera's height, which is in neither the file nor an "
            "option: give height_m, or measure on the ground"
        )
    return _CameraAboveGround(camera_lens, None, 0.0)


def _scale_at_height(
    ground_scale: MeasurementScale, object_height_m: float, camera: _CameraAboveGround
) -> MeasurementScale:
    """Convert the scale of the ground to a height above it, nearer to the camera.

    Raises:
        TooObliqueError: the object is higher than the camera.
    """
    ground_gsd = ground_scale.gsd_m_per_px
    if ground_gsd is None or object_height_m == 0:
        return ground_scale
    plane = ground_scale.plane
    focal_px = None
    lens_log_sd = 0.0
    if camera.lens is not None:
        focal_px = camera.lens.pixels
        lens_log_sd = camera.lens.log_sd
    if plane is not None:
        focal_px = plane.focal_px
        camera_height_m = plane.height_m
    elif focal_px:
        camera_height_m = ground_gsd * focal_px
    else:
        camera_height_m = camera.height_m or math.inf
    # Share of the camera's height: the scale falls in proportion to the distance from the camera.
    share = object_height_m / camera_height_m
    if share >= 1:
        raise TooObliqueError(
            f"an object at {object_height_m:g} m above the ground is above the camera, whose "
            f"height is {camera_height_m:.0f} m: give a lower height"
        )
    if focal_px:
        # gsd = ground_gsd - object_height / focal: the absolute error of ground_gsd stays, so its
        # relative error grows.
        with_lens_error = ground_scale.spread.plus(share * lens_log_sd)
        spread = with_lens_error.times(1 / (1 - share))
    else:
        # gsd = ground_gsd * (1 - object_height / camera_height).
        log_error = share / (1 - share) * camera.height_log_sd
        spread = ground_scale.spread.plus(log_error)
    gsd = ground_gsd * (1 - share)
    if plane is not None:
        plane = replace(plane, gsd_m_per_px=gsd)
    # The posterior is that of the ground; the spread has the errors of lens and height, too.
    return replace(ground_scale, gsd_m_per_px=gsd, spread=spread, plane=plane, posterior=None)
