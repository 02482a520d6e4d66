"""Models of OpenSfM and OpenDroneMap: ``reconstruction.json``."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from vehanchor.errors import ReconstructionError
from vehanchor.storage.atomic import whole_file
from vehanchor_flight.reconstruction.model import Lens, Reconstruction, Shot

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

_MOST_BYTES = 4 << 30
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
        ReconstructionError: the file is damaged, is no reconstruction, or has an unsupported
            camera.
    """
    parts = _parts(path)
    part = max(parts, key=lambda each: len(each["shots"]))
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
        points = np.array(
            [point["coordinates"] for point in part.get("points", {}).values()], np.float64
        )
        at = part.get("reference_lla")
        origin = (
            None
            if not at
            else (float(at["latitude"]), float(at["longitude"]), float(at["altitude"]))
        )
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
    part = max(_parts(source), key=lambda each: len(each["shots"]))
    for shot in part["shots"].values():
        shot["translation"] = _scaled(shot["translation"], factor)
    for point in part.get("points", {}).values():
        point["coordinates"] = _scaled(point["coordinates"], factor)
    for instance in part.get("rig_instances", {}).values():
        instance["translation"] = _scaled(instance["translation"], factor)
    for camera in part.get("rig_cameras", {}).values():
        camera["translation"] = _scaled(camera["translation"], factor)
    written = target / source.name
    with whole_file(written) as partial:
        partial.write_text(json.dumps([part]), encoding="utf-8")
    return written


def _parts(path: Path) -> list[dict[str, Any]]:
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ReconstructionError(f"{str(path)!r} is larger than {_MOST_BYTES >> 30} GiB")
        parts = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise ReconstructionError(
            f"cannot read the reconstruction {str(path)!r}: {error}"
        ) from None
    if not isinstance(parts, list) or not parts:
        raise ReconstructionError(
            f"{str(path)!r} is not a reconstruction of OpenSfM, which is a list of its parts"
        )
    if not all(isinstance(part, dict) and isinstance(part.get("shots"), dict) for part in parts):
        raise ReconstructionError(
            f"{str(path)!r} is not a reconstruction of OpenSfM: a part has no shots"
        )
    return parts


def _lens(camera: Mapping[str, Any]) -> Lens:
    kind = camera.get("projection_type", "perspective")
    if kind not in _DISTORTIONS:
        raise ReconstructionError(
            f"the camera is of type {kind!r}: supported are {', '.join(_DISTORTIONS)}"
        )
    width = float(camera["width"])
    height = float(camera["height"])
    side = max(width, height)
    focal_x = float(camera.get("focal_x", camera.get("focal", 0)))
    focal_y = float(camera.get("focal_y", focal_x))
    if not focal_x > 0 or not focal_y > 0:
        raise ReconstructionError(f"a camera has the focal length {focal_x:g}: it must be above 0")
    return Lens(
        width,
        height,
        focal_x * side,
        focal_y * side,
        width / 2 + float(camera.get("c_x", 0)) * side,
        height / 2 + float(camera.get("c_y", 0)) * side,
        tuple(float(camera.get(name, 0)) for name in _DISTORTIONS[kind]),
        fisheye=kind.startswith("fisheye"),
    )


def _rotation(vector: Any) -> NDArray[np.float64]:
    return np.asarray(cv2.Rodrigues(_vector(vector))[0], dtype=np.float64)


def _vector(values: Any) -> NDArray[np.float64]:
    found = np.array(values, dtype=np.float64)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise ValueError(f"{values!r} is not a vector")
    return found


def _scaled(values: Any, factor: float) -> list[float]:
    return [float(value) * factor for value in values]
