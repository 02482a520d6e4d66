"""Scale that a georeferenced file states, and its comparison with what the image shows."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.lens import lens
from vehanchor.options.rulers import StatedScale
from vehanchor.rulers.camera import height_log_sd
from vehanchor.rulers.camera_tilt import metadata_tilt
from vehanchor.rulers.stated_scale import chance_alone, stated_witness
from vehanchor.scale.defaults import MAX_GSD_M_PER_PX, MIN_GSD_M_PER_PX, USABLE_CHANCE
from vehanchor.scale.density import mass_within, on_grid, product
from vehanchor.scale.lengths import Z95
from vehanchor.scale.reliability import GEOREFERENCE_LOG_SD, MAX_CHANCE

if TYPE_CHECKING:
    from vehanchor.imagery.raster import Raster
    from vehanchor.options import ScaleOptions
    from vehanchor.scale.density import Density
    from vehanchor.scale.posterior import Answer

# The camera in a georeferenced file contradicts its scale beyond this many standard deviations of
# the camera's own. A choice, as for photographs of one scale.
_CONTRADICTING_SDS = 3.0


class Comparison(NamedTuple):
    """Scales of the file and of the image, weighed against each other.

    Attributes:
        file_chance: 0..1, chance that the file's scale is within 20 % of the true one.
        estimate_chance: 0..1, chance that the estimate is; 0 without one.
        posterior: ``[g]`` posterior of the scale by both; None off the grid of the rulers.
    """

    file_chance: float
    estimate_chance: float
    posterior: Density | None

    @property
    def prefers_file(self) -> bool:
        """Whether the file's scale is usable, or at least as likely as the estimate."""
        return self.file_chance >= USABLE_CHANCE or self.file_chance >= self.estimate_chance


def compare(stated: StatedScale, estimate: Answer | None) -> Comparison:
    """Weigh the scale of a file against the estimate by the image.

    The georeference shares no error with the rulers, which never use it. Of 438 photographs with
    vehicles, none loses its right georeference. With that of a picture 1.67 times as large, 39 are
    still measured by it, each with less than five vehicles.

    Args:
        stated: the file's scale.
        estimate: the answer of the rulers in the image; None if they found nothing.
    """
    if not on_grid(stated.gsd_m_per_px):
        return _compare_off_grid(stated, estimate)
    posterior = stated_witness(stated).density
    by_image = 0.0
    if estimate is not None:
        posterior = product(posterior, estimate.posterior)
        by_image = mass_within(posterior, estimate.gsd_m_per_px)
    by_file = mass_within(posterior, stated.gsd_m_per_px)
    return Comparison(min(by_file, MAX_CHANCE), min(by_image, MAX_CHANCE), posterior)


def _compare_off_grid(stated: StatedScale, estimate: Answer | None) -> Comparison:
    """Prefer a usable estimate to a scale that no ruler can show, such as a satellite's."""
    if estimate is not None and estimate.usable:
        return Comparison(1.0 - estimate.chance, estimate.chance, None)
    return Comparison(chance_alone(stated), 0.0, None)


def read_file_scale(raster: Raster, options: ScaleOptions) -> StatedScale | None:
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
