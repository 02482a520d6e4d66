"""Models of OpenSfM and OpenDroneMap: ``reconstruction.json``."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, TypeAlias

import cv2
import numpy as np

from vehanchor.errors import ReconstructionError
from vehanchor.storage.atomic import whole_file
from vehanchor_flight.reconstruction.model import Lens, Reconstruction, Shot

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    Vector: TypeAlias = NDArray[np.float64]
    """Vector ``[3]``."""

    Matrix: TypeAlias = NDArray[np.float64]
    """Rotation ``[3, 3]``."""

    Part: TypeAlias = dict[str, Any]
    """Connected part of a reconstruction: cameras, shots and points."""

_MAX_BYTES = 4 << 30
_RADIAL = ("k1", "k2")
_DISTORTIONS: dict[str, tuple[str, ...]] = {
    "perspective": _RADIAL,
    "simple_radial": ("k1",),
    "radial": _RADIAL,
    "brown": ("k1", "k2", "p1", "p2", "k3"),
    "fisheye": _RADIAL,
    "fisheye_opencv": ("k1", "k2", "k3", "k4"),
}
"""Coefficients of each projection type, in the order of OpenCV."""


def read_opensfm(path: Path) -> Reconstruction:
    """Read the largest part of a ``reconstruction.json``.

    Raises:
        ReconstructionError: the file is damaged, is not a reconstruction, or has an unsupported
            camera.
    """
    parts = _parts(path)
    part = _largest(parts)
    try:
        lenses = {name: _lens(camera) for name, camera in part["cameras"].items()}
        shots = tuple(
            Shot(
                name,
                lenses[shot["camera"]],
                rotation=_rotation(shot["rotation"]),
                translation=_vector(shot["translation"]),
            )
            for name, shot in part["shots"].items()
        )
        coordinates = [point["coordinates"] for point in _entries(part, "points")]
        points = np.array(coordinates, np.float64)
        origin = _origin(part)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ReconstructionError(
            f"{str(path)!r} is not a whole reconstruction of OpenSfM: {error!r}"
        ) from None
    return Reconstruction(
        "opensfm",
        path,
        shots=shots,
        points=points.reshape(-1, 3),
        n_parts=len(parts),
        origin=origin,
    )


def _largest(parts: list[Part]) -> Part:
    """Return the part with the most shots; the first of equals."""
    return max(parts, key=lambda part: len(part["shots"]))


def _entries(part: Part, name: str) -> Collection[Any]:
    """List the entries of a section of a part; none if it lacks the section."""
    section: Mapping[str, Any] = part.get(name, {})
    return section.values()


def _origin(part: Mapping[str, Any]) -> tuple[float, float, float] | None:
    """Read latitude, longitude and altitude of the origin; None without a position on Earth."""
    reference = part.get("reference_lla")
    if not reference:
        return None
    latitude = float(reference["latitude"])
    longitude = float(reference["longitude"])
    altitude = float(reference["altitude"])
    return latitude, longitude, altitude


def write_scaled_opensfm(source: Path, target: Path, factor: float) -> Path:
    """Write the largest part of a ``reconstruction.json``, scaled about its origin.

    Args:
        source: the file.
        target: folder for the new file; it exists.
        factor: metres per unit of the model.

    Returns:
        The new file.

    Raises:
        OutputError: the file cannot be written.
    """
    part = _largest(_parts(source))
    for shot in part["shots"].values():
        shot["translation"] = _scaled(shot["translation"], factor)
    for point in _entries(part, "points"):
        point["coordinates"] = _scaled(point["coordinates"], factor)
    # A rig of several cameras repeats the poses of its shots, and has offsets between its cameras.
    for instance in _entries(part, "rig_instances"):
        instance["translation"] = _scaled(instance["translation"], factor)
    for camera in _entries(part, "rig_cameras"):
        camera["translation"] = _scaled(camera["translation"], factor)
    scaled_file = target / source.name
    with whole_file(scaled_file) as partial:
        partial.write_text(json.dumps([part]), encoding="utf-8")
    return scaled_file


def _parts(path: Path) -> list[Part]:
    """Read the parts of a reconstruction, which are not connected with each other.

    Raises:
        ReconstructionError: the file cannot be read, or is not a reconstruction.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            limit_gib = _MAX_BYTES >> 30
            raise ReconstructionError(f"{str(path)!r} is larger than {limit_gib} GiB")
        parts = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise ReconstructionError(
            f"cannot read the reconstruction {str(path)!r}: {error}"
        ) from None
    if not isinstance(parts, list) or not parts:
        raise ReconstructionError(
            f"{str(path)!r} is not a reconstruction of OpenSfM, which is a list of its parts"
        )
    for part in parts:
        has_shots = isinstance(part, dict) and isinstance(part.get("shots"), dict)
        if not has_shots:
            raise ReconstructionError(
                f"{str(path)!r} is not a reconstruction of OpenSfM: a part has no shots"
            )
    return parts


def _lens(camera: Mapping[str, Any]) -> Lens:
    """Make a lens from a camera.

    OpenSfM states focal lengths and offsets of the principal point in longer sides of the image.
    """
    kind = camera.get("projection_type", "perspective")
    if kind not in _DISTORTIONS:
        supported = ", ".join(_DISTORTIONS)
        raise ReconstructionError(f"the camera is of type {kind!r}: supported are {supported}")
    width = float(camera["width"])
    height = float(camera["height"])
    if not width > 0 or not height > 0:
        raise ReconstructionError(f"a camera has {width:g} x {height:g} px: it must have a size")
    side = max(width, height)
    focal = camera.get("focal", 0)
    focal_x = float(camera.get("focal_x", focal))
    focal_y = float(camera.get("focal_y", focal_x))
    if not focal_x > 0 or not focal_y > 0:
        raise ReconstructionError(f"a camera has the focal length {focal_x:g}: it must be above 0")
    offset_x = float(camera.get("c_x", 0))
    offset_y = float(camera.get("c_y", 0))
    distortion = [float(camera.get(name, 0)) for name in _DISTORTIONS[kind]]
    return Lens(
        width,
        height,
        focal_x_px=focal_x * side,
        focal_y_px=focal_y * side,
        centre_x_px=width / 2 + offset_x * side,
        centre_y_px=height / 2 + offset_y * side,
        distortion=tuple(distortion),
        fisheye=kind.startswith("fisheye"),
    )


def _rotation(values: Any) -> Matrix:
    """Convert a rotation vector to a matrix ``[3, 3]``."""
    matrix, _ = cv2.Rodrigues(_vector(values))
    return np.asarray(matrix, dtype=np.float64)


def _vector(values: Any) -> Vector:
    """Convert a list of three finite numbers to a vector ``[3]``.

    Raises:
        ValueError: it is something else.
    """
    vector = np.array(values, dtype=np.float64)
    has_three = vector.shape == (3,)
    if not has_three or not np.isfinite(vector).all():
        raise ValueError(f"{values!r} is not a vector")
    return vector


def _scaled(values: Any, factor: float) -> list[float]:
    return [float(value) * factor for value in values]
