"""The rulers beside vehicles, one line each: every image is measured with all of them that its caller wants."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.rulers.camera import Camera
from vehanchor.rulers.courts import Courts
from vehanchor.rulers.known_length import GivenHeight, KnownLengths
from vehanchor.rulers.scene_scale import SceneScale

if TYPE_CHECKING:
    from vehanchor.rulers.evidence import Ruler

OTHER_RULERS: tuple[Ruler, ...] = (
    SceneScale(),
    Camera(),
    KnownLengths(),
    GivenHeight(),
    Courts(),
)
