"""Rendering of scenes: layout, painting in tiles, camera model, ground truth."""

from __future__ import annotations

import math
from typing import cast, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from research.scenes.fleet import Fleet
from research.scenes.layout import lay_out
from research.scenes.painter import Painter
from research.scenes.raster import polygon_mask
from research.scenes.sprites import Sun
from research.scenes.truth import (
    CATEGORIES,
    Category,
    FleetKind,
    Layout,
    Scene,
    SceneCourt,
    SceneObject,
    SceneVehicle,
)
from research.scenes.world import PlacedCourt, PlacedVehicle, Target, World
from vehanchor.errors import InvalidParameterError

_TILE_PX = 1024
_MIN_SIZE_PX = 16
_MAX_SIZE_PX = 16384
_MIN_GSD = 0.005
_MAX_GSD = 2.0
_HIDDEN_SHARE = 0.4
_SMALL_VIEW_M = 60.0


def render_scene(
    gsd_m_per_px: float,
    *,
    width_px: int = 1024,
    height_px: int = 1024,
    seed: int = 0,
    n_vehicles: int | None = None,
    mean_vehicle_length_m: float = 4.6,
    layout: Layout | None = None,
    fleet_kind: FleetKind = "passenger",
) -> Scene:
    """Render an aerial scene of exactly known ground sampling distance.

    The fleet mixes five classes from city cars to vans. Their lengths have the given mean, a
    standard deviation of 8.7 % of it, and a mode of 1.010 times it. The arguments determine every
    byte of the result.

    Views of less than 60 m are moved so that a small vehicle is near their centre, if the scene has
    any.

    Args:
        gsd_m_per_px: size of a pixel on the ground, 0.005 to 2.
        width_px: image width, 16 to 16384.
        height_px: image height, 16 to 16384.
        seed: at least 0; determines the place, its colours, the sun and the camera.
        n_vehicles: maximum number of small vehicles; large ones are thinned by the same share. 0
            removes all vehicles, None keeps them all.
        mean_vehicle_length_m: mean length of the fleet, 2 to 8.
        layout: ``urban``, ``parking``, ``countryside``, ``sports``; None: one of the first three.
        fleet_kind: ``passenger``, or ``mixed``: also kei cars, minivans and work vehicles.

    Returns:
        The image and its ground truth.

    Raises:
        InvalidParameterError: a parameter is out of range or NaN, or the layout is unknown.
    """
    _check_all(
        gsd_m_per_px,
        width_px,
        height_px=height_px,
        seed=seed,
        n_vehicles=n_vehicles,
        mean_vehicle_length_m=mean_vehicle_length_m,
        layout=layout,
        fleet_kind=fleet_kind,
    )
    place_rng, thin_rng, paint_rng, camera_rng = np.random.default_rng(seed).spawn(4)
    chosen = cast("Layout", get_args(Layout)[int(place_rng.choice(3, p=(0.45, 0.3, 0.25)))])
    sun = Sun(float(place_rng.uniform(0, 2 * math.pi)), math.radians(place_rng.uniform(33, 64)))
    fleet = Fleet(mean_vehicle_length_m, place_rng, fleet_kind)
    width_m = width_px * gsd_m_per_px
    height_m = height_px * gsd_m_per_px
    world = lay_out(place_rng, layout or chosen, width_m, height_m, fleet)
    x0, y0 = _view_corner(world, width_m, height=height_m, rng=thin_rng)
    _thin(world, (x0, y0, x0 + width_m, y0 + height_m), limit=n_vehicles, rng=thin_rng)

    painter = Painter(
        world, sun, rng=paint_rng, px_per_m=_oversampling(gsd_m_per_px) / gsd_m_per_px
    )
    image, crowns = _paint(painter, x0, y0, gsd_m_per_px, width_px, height_px)
    image = _photograph(image, camera_rng)

    hidden = crowns > 127
    masks, objects = _masks(world.targets, x0, y0, gsd_m_per_px, hidden)
    vehicles = tuple(
        each
        for v in world.vehicles
        if (each := _record(v, x0, y0, gsd_m_per_px, hidden)) is not None
    )
    courts = tuple(
        court
        for each in world.courts
        if (court := _court(each, x0, y0, gsd_m_per_px, hidden)) is not None
    )
    parameters: dict[str, float | int | str | None] = {
        "layout": layout or chosen,
        "n_vehicles": n_vehicles,
        "mean_vehicle_length_m": mean_vehicle_length_m,
        **_drawn(sun, fleet_kind),
    }
    return Scene(
        image,
        float(gsd_m_per_px),
        vehicles=vehicles,
        masks=masks,
        objects=objects,
        seed=int(seed),
        parameters=parameters,
        courts=courts,
    )


def _drawn(sun: Sun, fleet_kind: FleetKind) -> dict[str, float | str]:
    """Collect the parameters that the seed determines, and the fleet unless it is the default."""
    drawn: dict[str, float | str] = {
        "sun_elevation_deg": round(math.degrees(sun.elevation), 3),
        "shadow_azimuth_deg": round(math.degrees(sun.azimuth), 3),
    }
    return drawn if fleet_kind == "passenger" else {**drawn, "fleet_kind": fleet_kind}


def _check_all(
    gsd_m_per_px: float,
    width_px: int,
    height_px: int,
    seed: int,
    n_vehicles: int | None,
    mean_vehicle_length_m: float,
    layout: Layout | None,
    fleet_kind: FleetKind,
) -> None:
    _check("gsd_m_per_px", gsd_m_per_px, _MIN_GSD, _MAX_GSD)
    _check("width_px", width_px, _MIN_SIZE_PX, _MAX_SIZE_PX)
    _check("height_px", height_px, _MIN_SIZE_PX, _MAX_SIZE_PX)
    _check("mean_vehicle_length_m", mean_vehicle_length_m, 2.0, 8.0)
    _check("seed", seed, 0, math.inf)
    if n_vehicles is not None:
        _check("n_vehicles", n_vehicles, 0, math.inf)
    if layout is not None and layout not in get_args(Layout):
        raise InvalidParameterError(
            f"layout must be one of {', '.join(get_args(Layout))}, or None, not {layout!r}"
        )
    if fleet_kind not in get_args(FleetKind):
        raise InvalidParameterError(
            f"fleet_kind must be one of {', '.join(get_args(FleetKind))}, not {fleet_kind!r}"
        )


def _check(name: str, value: float, low: float, high: float) -> None:
    if not (math.isfinite(value) and low <= value <= high):
        limit = f"from {low:g} to {high:g}" if math.isfinite(high) else f"at least {low:g}"
        raise InvalidParameterError(f"{name} must be {limit}, not {value!r}")


def _oversampling(gsd_m_per_px: float) -> int:
    """Choose how many times finer than requested a scene is drawn before downsampling."""
    return 3 if gsd_m_per_px >= 0.5 else 2 if gsd_m_per_px >= 0.02 else 1


def _paint(
    painter: Painter, x0: float, y0: float, gsd_m_per_px: float, width_px: int, height_px: int
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Paint the view from (x0, y0) metres on: uint8 [H,W,3], and the cover by crowns, uint8 [H,W]."""
    over = _oversampling(gsd_m_per_px)
    image = np.zeros((height_px, width_px, 3), dtype=np.uint8)
    crowns = np.zeros((height_px, width_px), dtype=np.uint8)
    tile_px = _TILE_PX * 2 // over if over > 1 else _TILE_PX
    for top in range(0, height_px, tile_px):
        for left in range(0, width_px, tile_px):
            rows = min(tile_px, height_px - top)
            columns = min(tile_px, width_px - left)
            tile = painter.paint(
                x0 + left * gsd_m_per_px, y0 + top * gsd_m_per_px, columns * over, rows * over
            )
            area = (columns, rows)
            cell = (slice(top, top + rows), slice(left, left + columns))
            image[cell] = cv2.resize(tile.rgb, area, interpolation=cv2.INTER_AREA)
            crowns[cell] = cv2.resize(tile.crowns, area, interpolation=cv2.INTER_AREA)
    return image, crowns


def _view_corner(
    world: World, width: float, height: float, rng: np.random.Generator
) -> tuple[float, float]:
    """Choose the view's top left corner; small views move to the vehicle nearest to their centre."""
    jitter = rng.uniform(-0.2, 0.2, 2)
    if max(width, height) >= _SMALL_VIEW_M or not world.vehicles:
        return 0.0, 0.0
    spots = np.array(
        [
            (vehicle.x, vehicle.y)
            for vehicle in world.vehicles
            if vehicle.model.kind == "small-vehicle"
        ]
    )
    if len(spots) == 0:
        return 0.0, 0.0
    nearest = spots[int(np.argmin(np.hypot(spots[:, 0] - width / 2, spots[:, 1] - height / 2)))]
    return float(nearest[0] - width * (0.5 + jitter[0])), float(
        nearest[1] - height * (0.5 + jitter[1])
    )


def _thin(
    world: World,
    view: tuple[float, float, float, float],
    limit: int | None,
    rng: np.random.Generator,
) -> None:
    """Remove vehicles: keep at most ``limit`` small ones in view, and the same share of all others."""
    if limit is None:
        return
    left, top, right, bottom = view

    def counts(vehicle: PlacedVehicle) -> bool:
        return (
            vehicle.model.kind == "small-vehicle"
            and left <= vehicle.x < right
            and top <= vehicle.y < bottom
        )

    inside = [vehicle for vehicle in world.vehicles if counts(vehicle)]
    others = [vehicle for vehicle in world.vehicles if not counts(vehicle)]
    share = 0.0 if limit == 0 else min(limit / max(len(inside), 1), 1.0)
    order = rng.permutation(len(inside))[:limit]
    kept = {id(inside[index]) for index in order} | {id(v) for v in others if rng.random() < share}
    world.vehicles[:] = [vehicle for vehicle in world.vehicles if id(vehicle) in kept]


def _photograph(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Apply lens, haze, sensor and compression."""
    sigma = float(rng.uniform(0.45, 0.85))
    image = cast(
        "NDArray[np.uint8]", cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
    )
    if rng.random() < 0.35:  # sharpened in post-processing
        soft = cv2.GaussianBlur(image, (0, 0), 1.2, borderType=cv2.BORDER_REFLECT)
        amount = float(rng.uniform(0.3, 0.9))
        image = cast("NDArray[np.uint8]", cv2.addWeighted(image, 1 + amount, soft, -amount, 0))
    gamma = rng.uniform(0.88, 1.12)
    gain = rng.uniform(0.9, 1.12)
    haze = rng.uniform(0, 16)
    cast_rgb = 1 + np.clip(rng.normal(0, 0.018, 3), -0.04, 0.04)
    saturation = float(rng.uniform(0.75, 1.1))
    noise_sd = float(rng.uniform(0.8, 3.6))
    colour_sd = float(rng.uniform(0.2, 1.2))
    levels = np.arange(256) / 255
    tables = [
        haze + (levels**gamma) * 255 * gain * factor * (1 - haze / 300) for factor in cast_rgb
    ]
    table = np.clip(np.stack(tables, axis=1), 0, 255).astype(np.uint8)[None]
    out = np.empty_like(image)
    strip = 256
    for top in range(0, image.shape[0], strip):
        part = cv2.LUT(image[top : top + strip], table).astype(np.float32)
        grey = part.mean(axis=2, keepdims=True)
        part = grey + (part - grey) * np.float32(saturation)
        part += rng.standard_normal(part.shape[:2], dtype=np.float32)[:, :, None] * np.float32(
            noise_sd
        )
        part += rng.standard_normal(part.shape, dtype=np.float32) * np.float32(colour_sd)
        out[top : top + strip] = np.clip(part + 0.5, 0, 255).astype(np.uint8)
    if rng.random() < 0.6:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(78, 96))]
        _, encoded = cv2.imencode(".jpg", out, quality)
        out = cast("NDArray[np.uint8]", cv2.imdecode(encoded, cv2.IMREAD_COLOR))
    return out


def _masks(
    targets: list[Target], x0: float, y0: float, gsd: float, hidden: NDArray[np.bool_]
) -> tuple[dict[Category, NDArray[np.uint16]], tuple[SceneObject, ...]]:
    height, width = hidden.shape
    masks: dict[Category, NDArray[np.uint16]] = {
        c: np.zeros((height, width), dtype=np.uint16) for c in CATEGORIES
    }
    full: dict[Category, list[float]] = {category: [] for category in CATEGORIES}
    for target in targets:
        outlines = [(polygon - (x0, y0)) / gsd for polygon in target.polygons]
        mask = masks[target.category]
        number = len(full[target.category]) + 1
        drawn = False
        for outline in outlines:
            low = np.maximum(np.floor(outline.min(axis=0)), 0).astype(int)
            high = np.minimum(np.ceil(outline.max(axis=0)), (width, height)).astype(int)
            if (low >= high).any():
                continue
            inside = polygon_mask(outline - low, int(high[0] - low[0]), int(high[1] - low[1]))
            if target.category in ("swimming-pool", "building"):
                inside &= ~hidden[low[1] : high[1], low[0] : high[0]]
            mask[low[1] : high[1], low[0] : high[0]][inside] = number
            drawn |= bool(inside.any())
        if drawn:
            full[target.category].append(target.area)
    objects: list[SceneObject] = []
    for category, mask in masks.items():
        pixels = np.bincount(mask.ravel(), minlength=len(full[category]) + 1)
        for index, area in enumerate(full[category]):
            objects.append(
                SceneObject(
                    category,
                    index + 1,
                    area_m2=float(pixels[index + 1]) * gsd**2,
                    full_area_m2=area,
                )
            )
    return masks, tuple(objects)


def _record(
    placed: PlacedVehicle, x0: float, y0: float, gsd: float, hidden: NDArray[np.bool_]
) -> SceneVehicle | None:
    height, width = hidden.shape
    x = (placed.x - x0) / gsd
    y = (placed.y - y0) / gsd
    if not (0 <= x < width and 0 <= y < height):
        return None
    angle = math.remainder(placed.angle, 2 * math.pi)
    size = (placed.model.length_m / gsd, placed.model.width_m / gsd)
    whole = SceneVehicle(placed.model.kind, x, y, *size, angle)
    corners = whole.corners()
    cut = bool((corners < 0).any() or (corners > (width, height)).any())
    low = np.clip(np.floor(corners.min(axis=0)), 0, (width - 1, height - 1)).astype(int)
    high = np.clip(np.ceil(corners.max(axis=0)), low + 1, (width, height)).astype(int)
    body = polygon_mask(corners - low, int(high[0] - low[0]), int(high[1] - low[1]))
    below = hidden[low[1] : high[1], low[0] : high[0]][body]
    covered = bool(below.size and below.mean() > _HIDDEN_SHARE)
    return SceneVehicle(placed.model.kind, x, y, *size, angle, cut or covered, placed.model.body)


def _court(
    placed: PlacedCourt, x0: float, y0: float, gsd: float, hidden: NDArray[np.bool_]
) -> SceneCourt | None:
    height, width = hidden.shape
    corners = (placed.corners - (x0, y0)) / gsd
    if (
        not (np.zeros(2) <= corners.mean(axis=0)).all()
        or not (corners.mean(axis=0) < (width, height)).all()
    ):
        return None
    cut = bool((corners < 0).any() or (corners > (width, height)).any())
    low = np.clip(np.floor(corners.min(axis=0)), 0, (width - 1, height - 1)).astype(int)
    high = np.clip(np.ceil(corners.max(axis=0)), low + 1, (width, height)).astype(int)
    inside = polygon_mask(corners - low, int(high[0] - low[0]), int(high[1] - low[1]))
    below = hidden[low[1] : high[1], low[0] : high[0]][inside]
    return SceneCourt(
        placed.kind, corners, hidden_share=float(below.mean()) if below.size else 0.0, cut=cut
    )
