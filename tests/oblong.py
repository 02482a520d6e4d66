"""Images whose pixels are not square on the ground, rendered: GeoTIFFs and an anamorphic film."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray

from vehanchor.imagery.metadata.georeference import metres_per_degree

LATITUDE_DEG = 47.0
ASPECT = 1.45
"""Height of a pixel over its width, on the ground."""


def write_geotiff(
    path: Path, pixels: NDArray[np.uint8], crs: str, transform: Affine, **profile: Any
) -> Path:
    """Write pixels ``[h, w, 3]`` as a georeferenced TIFF."""
    height, width = pixels.shape[:2]
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=width,
        height=height,
        count=3,
        dtype="uint8",
        crs=crs,
        transform=transform,
        **profile,
    ) as dataset:
        dataset.write(pixels.transpose(2, 0, 1))
    return path


def in_degrees(path: Path, scene: NDArray[np.uint8], gsd_m_per_px: float) -> Path:
    """Write a scene of square pixels as a GeoTIFF in degrees, ``ASPECT`` times as wide as high."""
    height, width = scene.shape[:2]
    size = (width, round(height / ASPECT))
    stretched = np.asarray(cv2.resize(scene, size, interpolation=cv2.INTER_AREA), np.uint8)
    latitude_m, longitude_m = metres_per_degree(LATITUDE_DEG)
    across_deg = gsd_m_per_px / longitude_m
    down_deg = gsd_m_per_px * ASPECT / latitude_m
    top_deg = LATITUDE_DEG + down_deg * size[1] / 2
    transform = Affine(across_deg, 0, 11.0, 0, -down_deg, top_deg)
    return write_geotiff(path, stretched, "EPSG:4326", transform)


def anamorphic_film(path: Path, frames: list[NDArray[np.uint8]], sar: tuple[int, int]) -> Path:
    """Write frames ``[h, w, 3]`` RGB as an MP4 with a sample aspect ratio."""
    height, width = frames[0].shape[:2]
    film = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10, (width, height))
    for frame in frames:
        film.write(frame[:, :, ::-1])
    film.release()
    data = bytearray(path.read_bytes())
    # The box of the ratio comes at the end of the track's format; all boxes around it grow.
    pixel_aspect = struct.pack(">I4sII", 16, b"pasp", *sar)
    entry = data.index(b"mp4v") - 4
    end = entry + struct.unpack_from(">I", data, entry)[0]
    data[end:end] = pixel_aspect
    for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", b"mp4v"):
        start = data.rindex(name, 0, entry + 8) - 4
        (size,) = struct.unpack_from(">I", data, start)
        struct.pack_into(">I", data, start, size + len(pixel_aspect))
    path.write_bytes(data)
    return path


def turn_film(path: Path) -> None:
    """Ask in an MP4 for a display turned clockwise by 90 degrees."""
    data = bytearray(path.read_bytes())
    # The matrix of the track's header, in fixed-point numbers of 16 and 2 whole bits.
    matrix = data.index(b"tkhd") + 44
    one = 1 << 16
    struct.pack_into(">9i", data, matrix, 0, one, 0, -one, 0, 0, 0, 0, 1 << 30)
    path.write_bytes(data)


def rotated(side_across: float, side_down: float, degrees: float) -> Affine:
    """Make a transform of metres whose rows are turned."""
    place = Affine.translation(5e5, 5.2e6)
    return place @ Affine.rotation(degrees) @ Affine.scale(side_across, -side_down)


def longitude_pixel(side_px_deg: float, latitude_deg: float) -> Affine:
    """Make a transform of degrees with square pixels in degrees, centred at a latitude."""
    return Affine(side_px_deg, 0, 11.0, 0, -side_px_deg, latitude_deg)


def cosine_of(latitude_deg: float) -> float:
    """Compute the length of a degree of longitude over that of latitude, on a sphere."""
    return math.cos(math.radians(latitude_deg))
