"""Prior of the focal length, before the tilt is estimated."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from vehanchor.imagery.metadata.lens import equivalent_lens, lens

if TYPE_CHECKING:
    from vehanchor.imagery.facts import ImageFacts
    from vehanchor.options import ScaleOptions

_USUAL_FOCAL_35MM = 26.0  # of drones' cameras
_USUAL_LOG_SD = 0.2  # 20 to 35 mm


class Focal(NamedTuple):
    """Focal length with its uncertainty.

    Attributes:
        pixels: of the image.
        log_sd: standard deviation of its log.
        known: False for the assumed focal length of most drones.
    """

    pixels: float
    log_sd: float
    known: bool = True

    @property
    def doubt(self) -> str:
        """Suffix of the tilt's source if the focal length is only assumed."""
        return "" if self.known else "; focal length unknown"


def focal_of(image: ImageFacts, options: ScaleOptions) -> Focal:
    """Take the focal length from the caller or the metadata; without either, assume that of most drones.

    Args:
        image: size and camera of the image.
        options: the caller's focal length, and whether the metadata may be used.
    """
    given, camera = options.rulers.focal_35mm, image.camera if options.rulers.metadata else None
    seen = None if camera is None else lens(image, camera)
    if given is not None:
        seen = equivalent_lens(image.width_px, image.height_px, given)
    if seen is not None:
        return Focal(seen.pixels, seen.log_sd)
    return usual_focal(image.width_px, image.height_px)


def usual_focal(width_px: int, height_px: int) -> Focal:
    """Return the focal length of most drones' cameras, 26 mm +- 20 %."""
    return Focal(equivalent_lens(width_px, height_px, _USUAL_FOCAL_35MM).pixels, _USUAL_LOG_SD, known=False)
