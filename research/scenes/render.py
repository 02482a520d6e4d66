"""Rendering of scenes: layout, painting in tiles, camera model, ground truth."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple, TypeAlias, cast, get_args

import cv2
import numpy as np
from numpy.random import Generator
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

Points: TypeAlias = NDArray[np.float64]
"""Points x, y ``[n, 2]``."""

Picture: TypeAlias = NDArray[np.uint8]
"""RGB picture ``[h, w, 3]``."""

Labels: TypeAlias = NDArray[np.uint16]
"""Numbers ``[h, w]`` of objects; 0 is the background."""

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
    # The random layout is drawn even if it is not used, so that a seed always gives one sun.
    place_rng, thin_rng, paint_rng, camera_rng = np.random.default_rng(seed).spawn(4)
    random_layout = int(place_rng.choice(3, p=(0.45, 0.3, 0.25)))
    layout = layout or cast("Layout", get_args(Layout)[random_layout])
    sun = Sun.draw(place_rng)
    fleet = Fleet(mean_vehicle_length_m, place_rng, fleet_kind)
    width_m = width_px * gsd_m_per_px
    height_m = height_px * gsd_m_per_px
    world = lay_out(place_rng, layout, width_m=width_m, height_m=height_m, fleet=fleet)
    x0, y0 = _view_corner(world, width_m, height=height_m, rng=thin_rng)
    _thin(world, (x0, y0, x0 + width_m, y0 + height_m), limit=n_vehicles, rng=thin_rng)

    return photograph_world(
        world,
        sun,
        gsd_m_per_px=gsd_m_per_px,
        width_px=width_px,
        height_px=height_px,
        corner_m=(x0, y0),
        paint_rng=paint_rng,
        camera_rng=camera_rng,
        seed=int(seed),
        parameters={
            "layout": layout,
            "n_vehicles": n_vehicles,
            "mean_vehicle_length_m": mean_vehicle_length_m,
            **_sun_and_fleet(sun, fleet_kind),
        },
    )


def photograph_world(
    world: World,
    sun: Sun,
    *,
    gsd_m_per_px: float,
    width_px: int,
    height_px: int,
    corner_m: tuple[float, float] = (0.0, 0.0),
    paint_rng: Generator,
    camera_rng: Generator,
    seed: int,
    parameters: dict[str, float | int | str | None],
) -> Scene:
    """Paint a view of a world, and apply the camera.

    Args:
        world: its primitives.
        sun: its light.
        gsd_m_per_px: ground sampling distance.
        width_px: width of the image.
        height_px: height of the image.
        corner_m: top left corner of the view, metres.
        paint_rng: random numbers of textures and sprites.
        camera_rng: random numbers of the camera.
        seed: seed to record.
        parameters: parameters to record.
    """
    x0, y0 = corner_m
    px_per_m = _oversampling(gsd_m_per_px) / gsd_m_per_px
    painter = Painter(world, sun, rng=paint_rng, px_per_m=px_per_m)
    image, crowns = _paint(
        painter, x0, y0, gsd_m_per_px=gsd_m_per_px, width_px=width_px, height_px=height_px
    )
    image = _photograph(image, camera_rng)
    view = _View(x0, y0, gsd_m_per_px=gsd_m_per_px, hidden=crowns > 127)
    return _scene(image, world, view, seed=seed, parameters=parameters)


def _scene(
    image: Picture,
    world: World,
    view: _View,
    *,
    seed: int,
    parameters: dict[str, float | int | str | None],
) -> Scene:
    """Put the image and the ground truth of what it shows together."""
    masks, objects = _masks(world.targets, view)
    vehicles = [_vehicle(vehicle, view) for vehicle in world.vehicles]
    courts = [_court(court, view) for court in world.courts]
    return Scene(
        image,
        float(view.gsd_m_per_px),
        vehicles=tuple(vehicle for vehicle in vehicles if vehicle is not None),
        masks=masks,
        objects=objects,
        seed=seed,
        parameters=parameters,
        courts=tuple(court for court in courts if court is not None),
    )


def _sun_and_fleet(sun: Sun, fleet_kind: FleetKind) -> dict[str, float | str]:
    """Collect the sun that the seed determines, and the fleet unless it is the default."""
    parameters: dict[str, float | str] = {
        "sun_elevation_deg": round(math.degrees(sun.elevation), 3),
        "shadow_azimuth_deg": round(math.degrees(sun.azimuth), 3),
    }
    if fleet_kind != "passenger":
        parameters["fleet_kind"] = fleet_kind
    return parameters


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
    if gsd_m_per_px >= 0.5:
        return 3
    if gsd_m_per_px >= 0.02:
        return 2
    return 1


def _paint(
    painter: Painter, x0: float, y0: float, *, gsd_m_per_px: float, width_px: int, height_px: int
) -> tuple[Picture, Picture]:
    """Paint the view from (x0, y0) metres on.

    Returns:
        The image, uint8 [H,W,3], and the cover by crowns, uint8 [H,W].
    """
    over = _oversampling(gsd_m_per_px)
    image = np.zeros((height_px, width_px, 3), dtype=np.uint8)
    crowns = np.zeros((height_px, width_px), dtype=np.uint8)
    tile_px = _TILE_PX * 2 // over if over > 1 else _TILE_PX
    for top in range(0, height_px, tile_px):
        for left in range(0, width_px, tile_px):
            rows = min(tile_px, height_px - top)
            columns = min(tile_px, width_px - left)
            tile_x = x0 + left * gsd_m_per_px
            tile_y = y0 + top * gsd_m_per_px
            tile = painter.paint(tile_x, tile_y, columns * over, rows * over)
            area = (columns, rows)
            cell = (slice(top, top + rows), slice(left, left + columns))
            image[cell] = cv2.resize(tile.rgb, area, interpolation=cv2.INTER_AREA)
            crowns[cell] = cv2.resize(tile.crowns, area, interpolation=cv2.INTER_AREA)
    return image, crowns


def _view_corner(world: World, width: float, height: float, rng: Generator) -> tuple[float, float]:
    """Choose the view's top left corner; small views move to the vehicle nearest the centre."""
    jitter = rng.uniform(-0.2, 0.2, 2)
    if max(width, height) >= _SMALL_VIEW_M or not world.vehicles:
        return 0.0, 0.0
    small = [vehicle for vehicle in world.vehicles if vehicle.model.kind == "small-vehicle"]
    centres = np.array([(vehicle.x, vehicle.y) for vehicle in small])
    if len(centres) == 0:
        return 0.0, 0.0
    from_centre = centres - (width / 2, height / 2)
    distances = np.hypot(from_centre[:, 0], from_centre[:, 1])
    x, y = centres[int(np.argmin(distances))]
    jitter_x, jitter_y = jitter
    corner_x = x - width * (0.5 + jitter_x)
    corner_y = y - height * (0.5 + jitter_y)
    return float(corner_x), float(corner_y)


def _thin(
    world: World,
    view: tuple[float, float, float, float],
    limit: int | None,
    rng: Generator,
) -> None:
    """Remove vehicles: keep at most ``limit`` small ones in view, and that share of all others."""
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
    kept_inside = {id(inside[index]) for index in order}
    kept_others = {id(vehicle) for vehicle in others if rng.random() < share}
    kept = kept_inside | kept_others
    world.vehicles[:] = [vehicle for vehicle in world.vehicles if id(vehicle) in kept]


def _photograph(image: Picture, rng: Generator) -> Picture:
    """Apply lens, haze, sensor and compression."""
    sigma = rng.uniform(0.45, 0.85)
    blurred = cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
    image = cast("Picture", blurred)
    # Sharpening in post-processing.
    if rng.random() < 0.35:
        soft = cv2.GaussianBlur(image, (0, 0), 1.2, borderType=cv2.BORDER_REFLECT)
        amount = rng.uniform(0.3, 0.9)
        image = cast("Picture", cv2.addWeighted(image, 1 + amount, soft, -amount, 0))
    gamma = rng.uniform(0.88, 1.12)
    gain = rng.uniform(0.9, 1.12)
    haze = rng.uniform(0, 16)
    cast_rgb = 1 + np.clip(rng.normal(0, 0.018, 3), -0.04, 0.04)
    saturation = rng.uniform(0.75, 1.1)
    noise_sd = rng.uniform(0.8, 3.6)
    colour_sd = rng.uniform(0.2, 1.2)
    # Gamma, gain, haze and colour cast act on each value, so a table of 256 values holds them.
    levels = np.arange(256) / 255
    tables = [
        haze + (levels**gamma) * 255 * gain * factor * (1 - haze / 300) for factor in cast_rgb
    ]
    table = np.clip(np.stack(tables, axis=1), 0, 255).astype(np.uint8)[None]
    out = np.empty_like(image)
    # Strips bound the memory of the noise.
    strip = 256
    for top in range(0, image.shape[0], strip):
        part = cv2.LUT(image[top : top + strip], table).astype(np.float32)
        grey = part.mean(axis=2, keepdims=True)
        part = grey + (part - grey) * np.float32(saturation)
        noise = rng.standard_normal(part.shape[:2], dtype=np.float32)
        part += noise[:, :, None] * np.float32(noise_sd)
        colour_noise = rng.standard_normal(part.shape, dtype=np.float32)
        part += colour_noise * np.float32(colour_sd)
        out[top : top + strip] = np.clip(part + 0.5, 0, 255).astype(np.uint8)
    if rng.random() < 0.6:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(78, 96))]
        _, encoded = cv2.imencode(".jpg", out, quality)
        out = cast("Picture", cv2.imdecode(encoded, cv2.IMREAD_COLOR))
    return out


class _View(NamedTuple):
    """Part of a world that an image shows.

    Attributes:
        x0: left edge, metres.
        y0: top edge, metres.
        gsd_m_per_px: ground sampling distance.
        hidden: ``[h, w]`` pixels that crowns of trees hide.
    """

    x0: float
    y0: float
    gsd_m_per_px: float
    hidden: NDArray[np.bool_]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        height, width = self.hidden.shape
        return width, height

    def pixels(self, points: Points) -> Points:
        """Convert points in metres to pixels."""
        return np.asarray((points - (self.x0, self.y0)) / self.gsd_m_per_px)

    def is_cut(self, corners: Points) -> bool:
        """Return whether the image's edge cuts a polygon in pixels."""
        return bool((corners < 0).any() or (corners > self.size).any())

    def hidden_share(self, corners: Points) -> float:
        """Compute the share of a polygon's pixels that crowns hide; 0 without pixels."""
        width, height = self.size
        first = np.floor(corners.min(axis=0))
        last = np.ceil(corners.max(axis=0))
        low = np.clip(first, 0, (width - 1, height - 1)).astype(int)
        high = np.clip(last, low + 1, (width, height)).astype(int)
        columns, rows = (high - low).tolist()
        inside = polygon_mask(corners - low, columns, rows)
        window = np.s_[low[1] : high[1], low[0] : high[0]]
        hidden = self.hidden[window][inside]
        return float(hidden.mean()) if hidden.size else 0.0


def _masks(
    targets: list[Target], view: _View
) -> tuple[dict[Category, Labels], tuple[SceneObject, ...]]:
    """Number the visible pixels of each object by category, and measure its areas."""
    width, height = view.size
    masks: dict[Category, Labels] = {
        category: np.zeros((height, width), dtype=np.uint16) for category in CATEGORIES
    }
    full_areas: dict[Category, list[float]] = {category: [] for category in CATEGORIES}
    for target in targets:
        number = len(full_areas[target.category]) + 1
        if _draw_target(masks[target.category], target, number=number, view=view):
            full_areas[target.category].append(target.area)
    objects: list[SceneObject] = []
    for category, mask in masks.items():
        n_pixels = np.bincount(mask.ravel(), minlength=len(full_areas[category]) + 1)
        for number, full_area in enumerate(full_areas[category], start=1):
            area_m2 = float(n_pixels[number]) * view.gsd_m_per_px**2
            objects.append(SceneObject(category, number, area_m2=area_m2, full_area_m2=full_area))
    return masks, tuple(objects)


def _draw_target(mask: Labels, target: Target, number: int, view: _View) -> bool:
    """Write a target's number into its visible pixels; return whether there are any."""
    width, height = view.size
    is_visible = False
    for polygon in target.polygons:
        outline = view.pixels(polygon)
        low = np.maximum(np.floor(outline.min(axis=0)), 0).astype(int)
        last = np.ceil(outline.max(axis=0))
        high = np.minimum(last, (width, height)).astype(int)
        if (low >= high).any():
            continue
        window = np.s_[low[1] : high[1], low[0] : high[0]]
        columns, rows = (high - low).tolist()
        inside = polygon_mask(outline - low, columns, rows)
        if target.category in ("swimming-pool", "building"):
            inside &= ~view.hidden[window]
        mask[window][inside] = number
        is_visible |= bool(inside.any())
    return is_visible


def _vehicle(placed: PlacedVehicle, view: _View) -> SceneVehicle | None:
    """Record a vehicle in pixels; None if its centre is outside the image."""
    width, height = view.size
    gsd = view.gsd_m_per_px
    x = (placed.x - view.x0) / gsd
    y = (placed.y - view.y0) / gsd
    if not (0 <= x < width and 0 <= y < height):
        return None
    whole = SceneVehicle(
        placed.model.kind,
        x,
        y,
        length_px=placed.model.length_m / gsd,
        width_px=placed.model.width_m / gsd,
        angle_rad=math.remainder(placed.angle, 2 * math.pi),
        body=placed.model.body,
    )
    corners = whole.corners()
    is_hidden = view.hidden_share(corners) > _HIDDEN_SHARE
    return replace(whole, difficult=view.is_cut(corners) or is_hidden)


def _court(placed: PlacedCourt, view: _View) -> SceneCourt | None:
    """Record a court in pixels; None if its centre is outside the image."""
    corners = view.pixels(placed.corners)
    centre = corners.mean(axis=0)
    if not (centre >= 0).all() or not (centre < view.size).all():
        return None
    return SceneCourt(
        placed.kind,
        corners,
        hidden_share=view.hidden_share(corners),
        cut=view.is_cut(corners),
    )
