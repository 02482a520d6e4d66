"""Painter of one window of a world, from the ground up: ground, shadows, vehicles, roofs, trees."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import cast

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from research.scenes.fleet import VehicleModel
from research.scenes.raster import noise_texture, sample_noise
from research.scenes.roofs import paint_roof
from research.scenes.shadows import (
    roof_shadows,
    swept,
    tree_reach,
    vehicle_corners,
    vehicle_outline,
    vehicle_reach,
)
from research.scenes.sprites import CROWN_SPAN, VEHICLE_PAD, Sun, crown_sprite, vehicle_sprite
from research.scenes.tile import SUBPIXEL_BITS, Tile
from research.scenes.world import Box, Material, PlacedVehicle, Roof, Stain, Surface, Tree, World

_Layer = NDArray[np.float32]
_Pixels = NDArray[np.uint8]
# Lowest or highest x or y [n] of outlines.
_Ends = NDArray[np.float64]

# Light of the bluish sky relative to sun and sky.
_SHADE = (0.40, 0.44, 0.52)
VEHICLE_SHADOW_HEIGHT_M = {
    "van": 1.7, "suv": 1.3, "truck": 2.9, "bus": 2.9, "semitrailer": 3.3, "caravan": 2.3,
    "kei": 1.4, "minivan": 1.4, "kei truck": 1.4, "single cab": 1.3, "crew cab": 1.4,
    "flatbed": 1.6,
}  # fmt: skip

# Amplitudes of fine, middle and coarse noise, and the coarse noise's contribution to red, green and
# blue.
_TEXTURES: dict[Material, tuple[float, float, float, float, float, float]] = {
    Material.PLAIN: (0.02, 0.02, 0.02, 0, 0, 0),
    Material.ASPHALT: (0.05, 0.030, 0.055, 2, 1, -1),
    Material.PAVING: (0.04, 0.045, 0.055, 3, 1, -2),
    Material.PAINT: (0.05, 0.075, 0.05, 0, 0, 0),
    Material.LAWN: (0.09, 0.075, 0.06, 9, 2, 0),
    Material.MEADOW: (0.10, 0.11, 0.09, 19, 7, 4),
    Material.SOIL: (0.07, 0.08, 0.08, 6, 2, -1),
    Material.GRAVEL: (0.08, 0.05, 0.06, 3, 2, 0),
    Material.WATER: (0.015, 0.03, 0.03, -4, 0, 2),
    Material.COURT: (0.025, 0.02, 0.03, 0, 0, 0),
    Material.CROP: (0.08, 0.09, 0.06, 10, 4, 0),
}
# Crown sprites; the last two are conical.
_N_CROWNS = 9


@dataclass(eq=False)
class Painter:
    """Painter of tiles of one world; holds their shared textures and sprites."""

    world: World
    sun: Sun
    rng: Generator
    px_per_m: float
    """Resolution of the canvas before downsampling."""
    _sprites: dict[tuple[str, int], tuple[_Layer, float, float]] = field(default_factory=dict)
    _hulls: dict[int, NDArray[np.float64]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        rng = self.rng
        self._fine = noise_texture(rng, 512, 0.25)
        self._middle = noise_texture(rng, 512, 0.9)
        self._coarse = noise_texture(rng, 256, 1.5)
        largest = max((tree.radius for tree in self.world.trees), default=1.0)
        size = int(np.clip(2 ** math.ceil(math.log2(2 * largest * self.px_per_m)), 16, 512))
        looks = range(_N_CROWNS) if self.world.trees else ()
        self._crowns = [
            _pyramid(crown_sprite(rng, size, self.sun, conical=look >= _N_CROWNS - 2))
            for look in looks
        ]
        reach = np.array(self.sun.shadow(1.0))
        self._boxes = {
            "surfaces": _bounds([s.points for s in self.world.surfaces]),
            "stains": _bounds([s.points for s in self.world.stains]),
            "boxes": _bounds(
                [np.vstack([b.points, b.points + b.height * reach]) for b in self.world.boxes]
            ),
            "roofs": _bounds([np.vstack(roof_shadows(r, self.sun)) for r in self.world.roofs]),
            "trees": _bounds([tree_reach(t, reach) for t in self.world.trees]),
            "vehicles": _bounds([vehicle_reach(v, reach) for v in self.world.vehicles]),
        }

    def paint(self, x: float, y: float, width: int, height: int) -> Tile:
        """Draw the window of width x height pixels of the canvas that starts at (x, y) metres."""
        step = 1 / self.px_per_m
        noise = (
            sample_noise(self._fine, 0.03, x=x, y=y, step=step, width=width, height=height),
            sample_noise(self._middle, 0.16, x=x, y=y, step=step, width=width, height=height),
            sample_noise(self._coarse, 2.2, x=x, y=y, step=step, width=width, height=height),
        )
        rgb = np.zeros((height, width, 3), dtype=np.uint8)
        tile = Tile(
            x,
            y,
            step=step,
            width=width,
            height=height,
            rgb=rgb,
            crowns=np.zeros((height, width), dtype=np.uint8),
            noise=noise,
        )
        near = {name: self._near(name, tile) for name in self._boxes}
        world = self.world
        self._ground(
            tile,
            [world.surfaces[i] for i in near["surfaces"]],
            [world.stains[i] for i in near["stains"]],
        )
        boxes = [world.boxes[i] for i in near["boxes"]]
        vehicles = [world.vehicles[i] for i in near["vehicles"]]
        roofs = [world.roofs[i] for i in near["roofs"]]
        trees = [world.trees[i] for i in near["trees"]]
        self._low_shadows(tile, boxes, vehicles)
        for box in boxes:
            self._box(tile, box)
        for vehicle in vehicles:
            self._vehicle(tile, vehicle)
        self._tall_shadows(tile, roofs, trees)
        for roof in roofs:
            paint_roof(tile, roof, self.sun)
        for tree in sorted(trees, key=lambda tree: tree.height):
            self._crown(tile, tree)
        return tile

    def _near(self, name: str, tile: Tile) -> list[int]:
        low_x, low_y, high_x, high_y = self._boxes[name]
        right = tile.x + tile.width * tile.step
        bottom = tile.y + tile.height * tile.step
        hits = (high_x > tile.x) & (low_x < right) & (high_y > tile.y) & (low_y < bottom)
        return [int(index) for index in np.flatnonzero(hits)]

    def _ground(self, tile: Tile, surfaces: Sequence[Surface], stains: Sequence[Stain]) -> None:
        material = np.zeros((tile.height, tile.width), dtype=np.uint8)
        for surface in surfaces:
            points = tile.fixed(surface.points)
            if points is not None:
                cv2.fillPoly(tile.rgb, [points], surface.rgb, cv2.LINE_AA, SUBPIXEL_BITS)
                cv2.fillPoly(material, [points], int(surface.material), cv2.LINE_8, SUBPIXEL_BITS)
        stain = np.full((tile.height, tile.width), 128, dtype=np.uint8)
        for mark in stains:
            points = tile.fixed(mark.points)
            if points is not None:
                cv2.fillPoly(stain, [points], mark.level, cv2.LINE_AA, SUBPIXEL_BITS)
        blur = 0.06 * self.px_per_m
        if blur > 0.4:
            stain = cast("_Pixels", cv2.GaussianBlur(stain, (0, 0), min(blur, 6.0)))
        table = np.zeros((256, 6), dtype=np.float32)
        for entry, amplitudes in _TEXTURES.items():
            table[entry] = amplitudes
        gain = cv2.LUT(stain, np.arange(256, dtype=np.float32) / 128)
        texture: _Layer = np.ones_like(tile.noise[0])
        for index, field_ in enumerate(tile.noise):
            cv2.accumulateProduct(
                cast("_Layer", cv2.LUT(material, table[:, index].copy())), field_, texture
            )
        gain = cv2.multiply(gain, texture)
        for channel in range(3):
            value = cv2.multiply(tile.rgb[:, :, channel], gain, dtype=cv2.CV_32F)
            cv2.accumulateProduct(
                cast("_Layer", cv2.LUT(material, table[:, 3 + channel].copy())),
                tile.noise[2],
                value,
            )
            np.clip(value, 0, 255, out=value)
            tile.rgb[:, :, channel] = value

    def _low_shadows(
        self, tile: Tile, boxes: Sequence[Box], vehicles: Sequence[PlacedVehicle]
    ) -> None:
        shadow = np.zeros((tile.height, tile.width), dtype=np.uint8)
        for box in boxes:
            tile.fill(shadow, swept(box.points, self.sun.shadow(box.height)), 255)
        for vehicle in vehicles:
            height = VEHICLE_SHADOW_HEIGHT_M.get(vehicle.model.body, 1.15)
            outline = vehicle_outline(vehicle)
            tile.fill(shadow, swept(outline, self.sun.shadow(height)), 255)
        _darken(tile.rgb, shadow)

    def _tall_shadows(self, tile: Tile, roofs: Sequence[Roof], trees: Sequence[Tree]) -> None:
        shadow = np.zeros((tile.height, tile.width), dtype=np.uint8)
        for roof in roofs:
            for hull in roof_shadows(roof, self.sun):
                tile.fill(shadow, hull, 255)
        for tree in trees:
            dx, dy = self.sun.shadow(max(tree.height - tree.radius, 0.5 * tree.height))
            far_x, far_y = self.sun.shadow(0.45 * tree.height)
            for x, y in ((tree.x + far_x, tree.y + far_y), (tree.x + dx, tree.y + dy)):
                patch = self._crown_patch(tile, tree, x=x, y=y)
                if patch is not None:
                    (x0, y0, x1, y1), sprite = patch
                    target = shadow[y0:y1, x0:x1]
                    np.maximum(target, (sprite[:, :, 0] * 255).astype(np.uint8), out=target)
        _darken(tile.rgb, shadow)

    def _box(self, tile: Tile, box: Box) -> None:
        if box.rgb == (0, 0, 0):
            return
        tile.fill(tile.rgb, box.points, box.rgb)
        if box.leafy:
            pixels = tile.pixels(box.points)
            window = tile.window(pixels.min(axis=0), pixels.max(axis=0))
            if window is not None:
                x0, y0, x1, y1 = window
                mask = np.zeros((y1 - y0, x1 - x0), dtype=np.uint8)
                points = np.rint((pixels - (x0 + 0.5, y0 + 0.5)) * 16).astype(np.int32)
                cv2.fillPoly(mask, [points], 255, cv2.LINE_8, SUBPIXEL_BITS)
                first_noise = tile.noise[0][y0:y1, x0:x1]
                second_noise = tile.noise[1][y0:y1, x0:x1]
                gain = 1 + 0.22 * second_noise + 0.16 * first_noise
                patch = tile.rgb[y0:y1, x0:x1]
                lit = np.clip(patch * gain[:, :, None], 8, 235).astype(np.uint8)
                patch[mask > 0] = lit[mask > 0]

    def _vehicle(self, tile: Tile, vehicle: PlacedVehicle) -> None:
        model = vehicle.model
        sprite, sprite_length, sprite_width = self._vehicle_sprite(model, vehicle.angle)
        rows, columns = sprite.shape[:2]
        corners = tile.pixels(vehicle_corners(vehicle, 1 + 2 * VEHICLE_PAD))
        window = tile.window(corners.min(axis=0) - 1, corners.max(axis=0) + 1)
        if window is None:
            return
        x0, y0, x1, y1 = window
        cos = math.cos(vehicle.angle)
        sin = math.sin(vehicle.angle)
        # Canvas pixel -> metres along and across from the vehicle's centre -> sprite pixel.
        per_length = (
            columns
            / (sprite_length * (1 + 2 * VEHICLE_PAD))
            * sprite_length
            / model.length_m
            * tile.step
        )
        per_width = (
            rows
            / (sprite_width + 2 * VEHICLE_PAD * sprite_length)
            * sprite_width
            / model.width_m
            * tile.step
        )
        cx = (vehicle.x - tile.x) / tile.step - x0 - 0.5
        cy = (vehicle.y - tile.y) / tile.step - y0 - 0.5
        shift_x = columns / 2 - 0.5 - per_length * (cos * cx + sin * cy)
        shift_y = rows / 2 - 0.5 - per_width * (-sin * cx + cos * cy)
        matrix = np.array(
            [
                [per_length * cos, per_length * sin, shift_x],
                [-per_width * sin, per_width * cos, shift_y],
            ]
        )
        patch = cv2.warpAffine(
            sprite,
            matrix,
            (x1 - x0, y1 - y0),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderValue=(0, 0, 0, 0),
        )
        cover, paint, grey, red = (patch[:, :, channel, None] for channel in range(4))
        colour = np.array(model.paint, dtype=np.float32)
        glass = np.array((0.95, 1.0, 1.09), dtype=np.float32)
        lamp = np.array((1.0, 0.22, 0.2), dtype=np.float32)
        target = tile.rgb[y0:y1, x0:x1]
        blend = target * (1 - cover) + paint * colour + grey * glass + red * lamp
        target[:] = np.clip(blend + 0.5, 0, 255).astype(np.uint8)

    def _vehicle_sprite(self, model: VehicleModel, angle: float) -> tuple[_Layer, float, float]:
        """Get the body's sprite for the sun's octant, with the length and width of its drawing."""
        octant = round((angle - self.sun.azimuth) / (math.pi / 4)) % 8
        key = (model.body, octant)
        if key not in self._sprites:
            resolution = float(np.clip(1.3 * self.px_per_m, 4, 160))
            light = self.sun.light(self.sun.azimuth + octant * math.pi / 4)
            drawn = vehicle_sprite(
                model.body, model.length_m, width=model.width_m, px_per_m=resolution, light=light
            )
            self._sprites[key] = (drawn, model.length_m, model.width_m)
        return self._sprites[key]

    def _crown_patch(
        self, tile: Tile, tree: Tree, x: float, y: float
    ) -> tuple[tuple[int, int, int, int], _Layer] | None:
        radius = tree.radius / tile.step * CROWN_SPAN
        cx = (x - tile.x) / tile.step
        cy = (y - tile.y) / tile.step
        centre = np.array([cx, cy])
        window = tile.window(centre - radius, centre + radius)
        if window is None:
            return None
        x0, y0, x1, y1 = window
        levels = self._crowns[tree.look % _N_CROWNS]
        large = (sprite for sprite in reversed(levels) if sprite.shape[0] >= 1.4 * radius)
        level = next(large, levels[0])
        scale = level.shape[0] / (2 * radius)
        shift_x = scale * (x0 + 0.5 - cx + radius) - 0.5
        shift_y = scale * (y0 + 0.5 - cy + radius) - 0.5
        matrix = np.array([[scale, 0, shift_x], [0, scale, shift_y]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        sprite = cv2.warpAffine(level, matrix, (x1 - x0, y1 - y0), flags=flags, borderValue=(0, 0))
        return window, cast("_Layer", sprite.reshape(y1 - y0, x1 - x0, 2))

    def _crown(self, tile: Tile, tree: Tree) -> None:
        patch = self._crown_patch(tile, tree, x=tree.x, y=tree.y)
        if patch is None:
            return
        (x0, y0, x1, y1), sprite = patch
        cover = sprite[:, :, 0]
        light = sprite[:, :, 1]
        if self.px_per_m > 25:
            first_noise = tile.noise[0][y0:y1, x0:x1]
            second_noise = tile.noise[1][y0:y1, x0:x1]
            light = light * (1 + 0.12 * first_noise + 0.08 * second_noise)
        target = tile.rgb[y0:y1, x0:x1]
        leaves = light[:, :, None] * np.array(tree.rgb, dtype=np.float32)
        blend = target * (1 - cover[:, :, None]) + leaves
        target[:] = np.clip(blend + 0.5, 0, 255).astype(np.uint8)
        hidden = tile.crowns[y0:y1, x0:x1]
        np.maximum(hidden, (cover * 255).astype(np.uint8), out=hidden)


def _pyramid(sprite: _Layer) -> list[_Layer]:
    levels = [sprite]
    while levels[-1].shape[0] > 8:
        size = levels[-1].shape[0] // 2
        smaller = cv2.resize(levels[-1], (size, size), interpolation=cv2.INTER_AREA)
        levels.append(cast("_Layer", smaller))
    return levels


def _bounds(
    outlines: Sequence[NDArray[np.float64]],
) -> tuple[_Ends, _Ends, _Ends, _Ends]:
    low = np.array([outline.min(axis=0) for outline in outlines]).reshape(-1, 2)
    high = np.array([outline.max(axis=0) for outline in outlines]).reshape(-1, 2)
    return low[:, 0], low[:, 1], high[:, 0], high[:, 1]


def _darken(rgb: _Pixels, shadow: _Pixels) -> None:
    """Reduce the light in shadows to that of the sky."""
    for channel, share in enumerate(_SHADE):
        light = 1 - (1 - share) * np.arange(256) / 255
        table = np.rint(255 * light).astype(np.uint8)
        gain = cv2.LUT(shadow, table)
        rgb[:, :, channel] = cv2.multiply(rgb[:, :, channel], gain, scale=1 / 255)
