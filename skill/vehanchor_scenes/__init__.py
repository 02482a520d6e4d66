"""Aerial scenes of exactly known ground sampling distance, for demos, tests, benchmarks and training.

``layout`` lays out a scene in metres (``streets``, with ``blocks`` between them) and ``fleet`` draws vehicles from a
known length distribution. ``painter``, ``roofs``, ``sprites`` and ``shadows`` draw tiles at up to three times the
requested resolution. ``render`` downsamples them and applies a camera model. ``truth`` holds the exact ground truth.
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


def __getattr__(name: str) -> Any:  # on first use: the command's help does not load OpenCV
    if name in __all__:
        return getattr(importlib.import_module(f"{__name__}.{'render' if name == 'render_scene' else 'truth'}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
