"""Aerial scenes of exactly known ground sampling distance, for demos, tests and training.

``layout`` lays out a scene in metres (``streets``, with ``blocks`` between them) and ``fleet``
draws vehicles from a known length distribution. ``painter``, ``roofs``, ``sprites`` and ``shadows``
draw tiles at up to three times the requested resolution. ``render`` downsamples them and applies a
camera model. ``truth`` holds the exact ground truth.
"""

from research.scenes.render import render_scene
from research.scenes.truth import (
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
