"""Aerial scenes of exactly known ground sampling distance, for demos, tests, benchmarks and training.

A scene is laid out in metres (``layout``: ``streets``, and ``blocks`` between them) with a fleet of a known length
distribution (``fleet``). It is drawn in tiles (``painter``, ``roofs``, ``sprites``, ``shadows``) at up to three times
the resolution asked for, averaged down and photographed (``render``). ``truth`` keeps what was drawn, exactly.
"""

from vehanchor_scenes.render import render_scene
from vehanchor_scenes.truth import CATEGORIES, Category, Layout, Scene, SceneObject, SceneVehicle, VehicleKind

__all__ = [
    "CATEGORIES",
    "Category",
    "Layout",
    "Scene",
    "SceneObject",
    "SceneVehicle",
    "VehicleKind",
    "render_scene",
]
