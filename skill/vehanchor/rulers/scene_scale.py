"""Scene-scale prior as a ruler: the texture of the ground gives a rough scale.

It never sets the scale. It weighs groups of vehicles, and widens or narrows the interval.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.rulers.evidence import Evidence
from vehanchor.rulers.ruler import Ruler
from vehanchor.scale.fusion import credible_interval

if TYPE_CHECKING:
    from vehanchor.rulers.evidence import View


class SceneScale(Ruler):
    """Prior for every image taken at nadir."""

    kind = "scene_scale"
    label = "scene-scale prior"
    help = "nothing; it is a prior and never sets the scale"
    colour = "#999999"
    pooling_gain = 0.0  # photographs of one place: one error
    uses_plane = True  # it gives no evidence in tilted views, which its training data lack
    independent_of_vehicles = True
    sets_scale = False

    def measure(self, view: View) -> Evidence:
        """Take the median of the prior; without a prior or in a tilted view, give no evidence."""
        if view.prior is None or view.plane is not None:
            return Evidence(self.kind, None, None, 0, 0.0, ())
        density = view.prior.density
        median = credible_interval(density, probability=0.0).low
        n_tiles = sum(level.n_tiles for level in view.prior.levels)
        return Evidence(self.kind, median, credible_interval(density), n_tiles, 0.0, (), density)
