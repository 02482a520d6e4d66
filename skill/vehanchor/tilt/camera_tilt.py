"""Tilt of the camera: its value, the ground plane that it implies, and its form in records."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from vehanchor.errors import TooObliqueError
from vehanchor.imagery.metadata.lens import equivalent_lens, lens, taken_ratio
from vehanchor.records import KnownPlane, TiltEstimate
from vehanchor.scale.lengths import Z95
from vehanchor.scale.plane import GroundPlane

if TYPE_CHECKING:
    from vehanchor.imagery.facts import ImageFacts
    from vehanchor.options import ScaleOptions
    from vehanchor.records import GsdEstimate

NADIR_TOLERANCE_DEG = 10.0  # an image with a smaller tilt counts as taken at nadir
TILT_SD_DEG = 1.5  # of a gimbal's angle and of nearly level ground
_USUAL_FOCAL_35MM = 26.0  # of drones' cameras


class CameraTilt(NamedTuple):
    """Tilt of a camera that was not at nadir.

    Attributes:
        tilt_deg: angle between its axis and straight down.
        roll_deg: direction of the tilt in the image, clockwise from its upper side.
        focal_px: focal length, pixels of the image.
        source: of the angle, in words.
    """

    tilt_deg: float
    roll_deg: float
    focal_px: float
    source: str

    def plane(self, image: ImageFacts, gsd_m_per_px: float = 1.0) -> GroundPlane:
        """Ground plane of an image, with a scale at its centre."""
        return GroundPlane(gsd_m_per_px, self.tilt_deg, self.focal_px, image.width_px, image.height_px, self.roll_deg)

    def known_plane(self) -> KnownPlane:
        """Tilt as a known scale carries it."""
        return KnownPlane(tilt_deg=self.tilt_deg, roll_deg=self.roll_deg, focal_length_px=self.focal_px)

    def record(self, image: ImageFacts, gsd_m_per_px: float | None) -> TiltEstimate:
        """Tilt as records show it, with the range of scales if the scale at the centre is known."""
        least, largest = (None, None) if gsd_m_per_px is None else self.plane(image, gsd_m_per_px).gsd_range
        reach = Z95 * TILT_SD_DEG
        return TiltEstimate(
            tilt_deg=self.tilt_deg,
            tilt_ci95_low_deg=max(0.0, self.tilt_deg - reach),
            tilt_ci95_high_deg=min(90.0, self.tilt_deg + reach),
            roll_deg=self.roll_deg,
            focal_length_px=self.focal_px,
            source=self.source,
            gsd_least_m_per_px=least,
            gsd_largest_m_per_px=largest,
        )


def metadata_tilt(image: ImageFacts, options: ScaleOptions) -> CameraTilt | None:
    """Read the tilt from the metadata.

    Args:
        image: with its camera.
        options: whether the metadata may be used.

    Returns:
        None up to ten degrees, without an angle, and for a crop. If the focal length is unknown, that of most drones is
        assumed, and the source says so.

    Raises:
        TooObliqueError: the horizon is in the image or close to it.
    """
    camera = image.camera
    if camera is None or camera.off_nadir_deg is None or not options.rulers.metadata:
        return None
    if camera.off_nadir_deg <= NADIR_TOLERANCE_DEG or taken_ratio(image, camera) is None:
        return None
    focal_px, known = focal_length(image, options)
    source = "metadata" if known else "metadata; focal length unknown"
    found = CameraTilt(camera.off_nadir_deg, camera.roll_deg or 0.0, focal_px, source)
    try:
        found.plane(image).check()
    except TooObliqueError as error:
        remedy = (
            "If the metadata are wrong, leave them out: --no-metadata, metadata=False, or metadata: false in a tool"
        )
        raise TooObliqueError(f"by the metadata, {error}. {remedy}") from None
    return found


def focal_length(image: ImageFacts, options: ScaleOptions) -> tuple[float, bool]:
    """Take the focal length from the caller or the metadata; without either, assume that of most drones.

    Args:
        image: size and camera of the image.
        options: the caller's focal length, and whether the metadata may be used.

    Returns:
        Pixels of the image, and whether it is known.
    """
    given, camera = options.rulers.focal_35mm, image.camera if options.rulers.metadata else None
    if given is not None:
        return equivalent_lens(image.width_px, image.height_px, given).pixels, True
    seen = None if camera is None else lens(image, camera)
    if seen is not None:
        return seen.pixels, True
    return equivalent_lens(image.width_px, image.height_px, _USUAL_FOCAL_35MM).pixels, False


def plane_of_record(record: GsdEstimate) -> GroundPlane | None:
    """Ground plane of an estimated image; None for an image taken at nadir, or without a scale."""
    tilt, gsd = record.tilt, record.gsd_m_per_px
    return None if tilt is None or gsd is None else _plane(tilt, record, gsd)


def with_scale(tilt: TiltEstimate, record: GsdEstimate, gsd_m_per_px: float | None) -> TiltEstimate:
    """Recalculate the range of scales of a tilt for another scale at the centre.

    Args:
        tilt: of an image.
        record: of that image.
        gsd_m_per_px: the other scale; None for none.
    """
    least, largest = (None, None) if gsd_m_per_px is None else _plane(tilt, record, gsd_m_per_px).gsd_range
    return tilt.model_copy(update={"gsd_least_m_per_px": least, "gsd_largest_m_per_px": largest})


def known_plane(tilt: TiltEstimate) -> KnownPlane:
    """Tilt of a record as a known scale carries it."""
    return KnownPlane(tilt_deg=tilt.tilt_deg, roll_deg=tilt.roll_deg, focal_length_px=tilt.focal_length_px)


def _plane(tilt: TiltEstimate, record: GsdEstimate, gsd_m_per_px: float) -> GroundPlane:
    size = record.image_width_px, record.image_height_px
    return GroundPlane(gsd_m_per_px, tilt.tilt_deg, tilt.focal_length_px, *size, tilt.roll_deg)
