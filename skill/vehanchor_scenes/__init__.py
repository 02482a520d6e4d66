"""Aerial scenes of exactly known ground sampling distance, for demos, tests, benchmarks and training.

A scene is laid out in metres (``layout``: ``streets``, and ``blocks`` between them) with a fleet of a known length
distribution (``fleet``). It is drawn in tiles (``painter``, ``roofs``, ``sprites``, ``shadows``) at up to three times
the resolution asked for, averaged down and photographed (``render``). ``truth`` keeps what was drawn, exactly.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vehanchor_scenes.render import render_scene
    from vehanchor_scenes.truth import (
        CATEGORIES,
        Category,
        Layout,
        Scene,
        SceneCourt,
        SceneObject,
        SceneVehicle,
        VehicleKind,
    )

__all__ = [
    "CATEGORIES",
    "Category",
    "Layout",
    "Scene",
    "SceneCourt",
    "SceneObject",
    "SceneVehicle",
    "VehicleKind",
    "render_scene",
]


def __getattr__(name: str) -> Any:  # on first use, so that the command's help need not wait for OpenCV
    if name in __all__:
        return getattr(importlib.import_module(f"{__name__}.{'render' if name == 'render_scene' else 'truth'}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
