"""Estimate the tilt of the camera from all cues: metadata, courts in perspective, sizes of vehicles."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.imagery.metadata.lens import taken_ratio
from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.tilt.camera_tilt import NADIR_TOLERANCE_DEG, TILT_SD_DEG, CameraTilt
from vehanchor.tilt.focal import Focal, focal_of, usual_focal
from vehanchor.tilt.posterior import GimbalCue, tilt_posterior
from vehanchor.tilt.vehicle_cue import vehicle_cue

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.detection.detections import Detections
    from vehanchor.imagery.facts import ImageFacts
    from vehanchor.imagery.metadata.camera import CameraMetadata
    from vehanchor.options import ScaleOptions
    from vehanchor.tilt.posterior import TiltCue, TiltPosterior

_DOUBTED = 0.3  # chance of a tilt above ten degrees from which courts are searched in tilted views, too
NEARLY_CERTAIN = 0.99  # chance of a tilt above ten degrees from which it is reported


def estimate_tilt(
    stated: CameraTilt | None,
    cues: Sequence[TiltCue],
    image: ImageFacts,
    options: ScaleOptions,
    detections: Detections,
) -> CameraTilt | None:
    """Combine the tilt of the metadata with other cues and with the vehicles.

    Args:
        stated: tilt by the metadata; None for nadir, or without an angle.
        cues: cues of rulers, such as courts in perspective.
        image: size and metadata of the image.
        options: which metadata may be used.
        detections: vehicles in pixels of the image.

    Returns:
        None for an image taken at nadir, and if vehicles are the only cue: they give a notice (``tilt_notice``).

    Raises:
        TooObliqueError: the horizon is in the image, or the tilt is too uncertain to exclude that.
    """
    if stated is None and (_nadir_is_known(image, options) or not cues):
        return None
    seen: list[TiltCue] = list(cues)
    if stated is not None:
        seen.insert(0, GimbalCue(stated.tilt_deg, stated.roll_deg, TILT_SD_DEG))
    vehicles = vehicle_cue(detections, image.width_px, image.height_px)
    if vehicles is not None:
        seen.append(vehicles)
    if stated is not None and len(seen) == 1:
        return stated
    focal = focal_of(image, options)
    posterior = tilt_posterior(seen, focal)
    if posterior is None or (stated is None and posterior.chance_above(NADIR_TOLERANCE_DEG) < NEARLY_CERTAIN):
        return stated
    source = ", ".join(dict.fromkeys(each.kind for each in seen)) + focal.doubt
    interval = posterior.low_deg, posterior.high_deg
    found = CameraTilt(posterior.tilt_deg, posterior.roll_deg, posterior.focal_px, source, interval)
    (found if stated else found._replace(tilt_deg=posterior.high_deg)).plane(image).check()
    return found


def may_be_tilted(image: ImageFacts, options: ScaleOptions, detections: Detections) -> bool:
    """Test whether metadata, georeference and vehicles leave a tilt possible."""
    if _nadir_is_known(image, options):
        return False
    seen = _vehicle_posterior(image, options, detections)
    return seen is None or seen[1].chance_above(NADIR_TOLERANCE_DEG) >= _DOUBTED


def tilt_from_vehicles(
    detections: Detections, width_px: int, height_px: int, focal_px: float | None = None
) -> TiltPosterior | None:
    """Estimate the tilt from vehicles alone.

    Args:
        detections: vehicles in pixels of the image.
        width_px: of the image.
        height_px: of the image.
        focal_px: focal length, pixels; None if it is unknown.

    Returns:
        None for fewer than 25 certain cars that lie whole in the image.
    """
    cue = vehicle_cue(detections, width_px, height_px)
    focal = Focal(focal_px, 0.0) if focal_px else usual_focal(width_px, height_px)
    return None if cue is None else tilt_posterior([cue], focal)


def tilt_notice(image: ImageFacts, options: ScaleOptions, detections: Detections) -> tuple[Notice, ...]:
    """Warn of a tilt that only the vehicles show, or that the metadata state for a crop.

    Args:
        image: its size and metadata.
        options: which metadata may be used.
        detections: vehicles in pixels of the image.

    Returns:
        One notice, or none.
    """
    camera = _camera(image, options)
    if image.georeference_gsd_m_per_px is not None:
        return ()
    if camera is not None and camera.off_nadir_deg is not None:
        tilted = camera.off_nadir_deg > NADIR_TOLERANCE_DEG and taken_ratio(image, camera) is None
        return (_crop_of_tilted(camera.off_nadir_deg),) if tilted else ()
    seen = _vehicle_posterior(image, options, detections)
    if seen is None or seen[1].chance_above(NADIR_TOLERANCE_DEG) < NEARLY_CERTAIN:
        return ()
    n_cars, found = seen
    message = (
        f"The camera seems to be tilted by about {found.tilt_deg:.0f} degrees ({found.low_deg:.0f} to "
        f"{found.high_deg:.0f}): {n_cars} cars are larger on one side of the image. Scales differ over the image, and "
        "areas and lengths far from its centre are wrong. Give the original file, whose metadata state the tilt, or a "
        "crop around the object."
    )
    return (Notice(code=NoticeCode.TILT_SUSPECTED, message=message),)


def _camera(image: ImageFacts, options: ScaleOptions) -> CameraMetadata | None:
    return image.camera if options.rulers.metadata else None


def _nadir_is_known(image: ImageFacts, options: ScaleOptions) -> bool:
    """Test whether a georeference or the metadata determine the tilt."""
    camera = _camera(image, options)
    return image.georeference_gsd_m_per_px is not None or (camera is not None and camera.off_nadir_deg is not None)


def _vehicle_posterior(
    image: ImageFacts, options: ScaleOptions, detections: Detections
) -> tuple[int, TiltPosterior] | None:
    """Compute the number of cars and a coarse posterior of the tilt from them."""
    cue = vehicle_cue(detections, image.width_px, image.height_px)
    found = None if cue is None else tilt_posterior([cue], focal_of(image, options), n_passes=2)
    return None if cue is None or found is None else (len(cue.sizes), found)


def _crop_of_tilted(off_nadir_deg: float) -> Notice:
    message = (
        f"By its metadata the camera was tilted by {off_nadir_deg:.0f} degrees, and the image is a crop at an unknown "
        "place of that picture. It is measured as if taken at nadir: scales differ over it, and areas and lengths may "
        "be wrong. Give the original file."
    )
    return Notice(code=NoticeCode.TILT_SUSPECTED, message=message)
