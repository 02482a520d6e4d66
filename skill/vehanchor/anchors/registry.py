"""The rulers beside vehicles, one line each: every image is measured with all of them that its caller wants."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.anchors.camera import Camera
from vehanchor.anchors.courts import Courts
from vehanchor.anchors.known_length import GivenHeight, KnownLengths
from vehanchor.anchors.scene_scale import SceneScale

if TYPE_CHECKING:
    from vehanchor.anchors.evidence import Anchor

__all__ = ["OTHER_ANCHORS"]

OTHER_ANCHORS: tuple[Anchor, ...] = (
    SceneScale(),
    Camera(),
    KnownLengths(),
    GivenHeight(),
    Courts(),
)
