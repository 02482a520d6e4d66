"""Scene scale: the ground itself says roughly how big a pixel is, a witness beside the vehicles.

It never makes a record by itself; it weighs groups of vehicles, and widens or narrows the interval.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.rulers.evidence import Evidence
from vehanchor.scale.fusion import credible_interval

if TYPE_CHECKING:
    from vehanchor.rulers.evidence import View


class SceneScale:
    """The ruler that every image has: a witness, never enough by itself."""

    kind = "scene_scale"

    def look(self, view: View) -> Evidence:
        """Tell the scale of the ground: the median of its density; nothing where nobody looked."""
        scene = view.detections.scene
        if scene is None:
            return Evidence(self.kind, None, None, 0, 0.0, ())
        density = scene.density
        median = credible_interval(density, probability=0.0).low
        n_tiles = sum(level.n_tiles for level in scene.levels)
        return Evidence(self.kind, median, credible_interval(density), n_tiles, 0.0, (), density)
