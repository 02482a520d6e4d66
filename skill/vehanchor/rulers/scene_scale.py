"""Scene-scale prior as a ruler: the texture of the ground gives a rough scale, never the answer."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.rulers.ruler import Ruler, prior_witness
from vehanchor.scale.reliability import PRIOR_POWER

if TYPE_CHECKING:
    from vehanchor.rulers.ruler import View
    from vehanchor.scale.posterior import Witness


class SceneScale(Ruler):
    """Prior for every image taken at nadir."""

    kind = "scene_scale"
    label = "scene-scale prior"
    help = "nothing; a prior, which never sets the scale"
    colour = "#999999"
    pooling_gain = 0.0  # photographs of one place: one error
    reads_scene = True
    uses_plane = True  # it measures nothing in tilted views, which its training data lack
    sets_scale = False

    def measure(self, view: View) -> Witness | None:
        """Weigh the prior's density; None without a prior, or in a tilted view."""
        if view.prior is None or view.plane is not None:
            return None
        return prior_witness(self.kind, view.prior.density, power=PRIOR_POWER, n=view.prior.n_tiles)
