"""Files of a reconstruction: reading in any format, the rescaled copy and ``geo.txt``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.errors import OutputError, ReconstructionError
from vehanchor.imagery.metadata.georeference import WGS84_FLATTENING, WGS84_SEMI_MAJOR_AXIS_M
from vehanchor.storage.atomic import whole_file
from vehanchor_flight.reconstruction.colmap import is_colmap, read_colmap, write_scaled_colmap
from vehanchor_flight.reconstruction.opensfm import read_opensfm, write_scaled_opensfm

if TYPE_CHECKING:
    import os

    from numpy.typing import NDArray

    from vehanchor_flight.reconstruction.model import Reconstruction

_JSON = ("reconstruction.json", "opensfm/reconstruction.json")
_COLMAP = (".", "sparse/0", "sparse", "0")
_IMAGES = ("images", "../images", "../../images", "../../../images", ".")
_TURNS = 6  # of the latitude's iteration, each 150 times closer


def read_model(path: str | os.PathLike[str]) -> Reconstruction:
    """Read a model of OpenSfM, OpenDroneMap or COLMAP.

    Args:
        path: the project's folder, its ``reconstruction.json``, or the folder of COLMAP's files.

    Raises:
        ReconstructionError: there is no model, or it is damaged.
    """
    given = Path(path)
    files = [
        each
        for each in (given, *map(given.joinpath, _JSON))
        if each.suffix.lower() == ".json" and each.is_file()
    ]
    found = next(iter([*files, *filter(is_colmap, map(given.joinpath, _COLMAP))]), None)
    if found is None:
        raise ReconstructionError(
            f"there is no reconstruction in {str(path)!r}: name a reconstruction.json of "
            "OpenSfM or OpenDroneMap, or a "
            "folder with COLMAP's cameras, images and points3D; an orthophoto goes to "
            "'vehanchor estimate --geotiff'"
        )
    model = read_opensfm(found) if found.suffix.lower() == ".json" else read_colmap(found)
    if not model.shots:
        raise ReconstructionError(f"the reconstruction in {str(path)!r} has no photographs")
    return model


def images_of(model: Reconstruction) -> Path:
    """Find the folder of a model's photographs near its files.

    Raises:
        ReconstructionError: no folder has any of them.
    """
    base = model.path if model.path.is_dir() else model.path.parent
    for folder in (base / name for name in _IMAGES):
        if any((folder / shot.name).is_file() for shot in model.shots):
            return folder
    raise ReconstructionError(
        f"no photograph of the model, as {model.shots[0].name!r}, is near {str(base)!r}: name "
        "their folder with "
        "--images"
    )


def write_rescaled(model: Reconstruction, target: Path, factor: float) -> Path:
    """Write a copy of a model in metres, in its own format.

    Args:
        model: the model.
        target: folder to create; it must not exist, or be empty.
        factor: metres per unit.

    Returns:
        The file of OpenSfM, or the folder of COLMAP.

    Raises:
        OutputError: the folder is not empty, or cannot be written.
    """
    check_project_path(target)
    try:
        target.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot create {str(target)!r}: {error.strerror or error}") from error
    write = write_scaled_opensfm if model.kind == "opensfm" else write_scaled_colmap
    return write(model.path, target, factor)


def check_project_path(target: Path) -> None:
    """Check, before the work, that a project can be written to a folder.

    Raises:
        OutputError: the folder above it does not exist, or it is not empty.
    """
    if not target.parent.is_dir() or (target.exists() and not target.is_dir()):
        raise OutputError(
            f"cannot write a project to {str(target)!r}: name a new folder in a folder that exists"
        )
    if target.is_dir() and any(target.iterdir()):
        raise OutputError(f"{str(target)!r} is not empty: name a new folder")


def write_geo(path: Path, model: Reconstruction, factor: float) -> None:
    """Write the cameras' rescaled positions as OpenDroneMap's ``geo.txt``.

    Args:
        path: the file.
        model: with an origin.
        factor: metres per unit. The positions are scaled about their mean, which stays where it is.

    Raises:
        ReconstructionError: the model has no origin on Earth, or its photographs' names have
            spaces.
        OutputError: the file cannot be written.
    """
    if model.origin is None:
        raise ReconstructionError(
            "the model has no position on Earth (reference_lla), and geo.txt needs one"
        )
    spaced = [shot.name for shot in model.shots if any(letter.isspace() for letter in shot.name)]
    if spaced:
        raise ReconstructionError(
            f"geo.txt separates columns by spaces, and the photograph {spaced[0]!r} has one"
        )
    centres = np.array([shot.centre for shot in model.shots])
    mean = centres.mean(axis=0)
    places = on_earth(mean + factor * (centres - mean), model.origin)
    rows = [
        f"{shot.name} {east:.9f} {north:.9f} {up:.4f}"
        for shot, (north, east, up) in zip(model.shots, places.tolist(), strict=True)
    ]
    with whole_file(path) as partial:
        partial.write_text("\n".join(["EPSG:4326", *rows, ""]), encoding="utf-8")


def on_earth(
    points: NDArray[np.float64], origin: tuple[float, float, float]
) -> NDArray[np.float64]:
    """Convert local metres to latitude, longitude and altitude on WGS 84.

    Args:
        points: ``[n, 3]`` metres east, north and up of the origin.
        origin: its latitude, longitude (degrees) and altitude (metres).

    Returns:
        ``[n, 3]`` degrees, degrees and metres.
    """
    squared = WGS84_FLATTENING * (2 - WGS84_FLATTENING)
    phi = math.radians(origin[0])
    theta = math.radians(origin[1])
    east = np.array([-math.sin(theta), math.cos(theta), 0.0])
    up = np.array([math.cos(phi) * math.cos(theta), math.cos(phi) * math.sin(theta), math.sin(phi)])
    prime = WGS84_SEMI_MAJOR_AXIS_M / math.sqrt(1 - squared * math.sin(phi) ** 2)
    base = (prime + origin[2]) * up - [0, 0, squared * prime * math.sin(phi)]
    x, y, z = (base + np.asarray(points) @ np.array([east, np.cross(up, east), up])).T
    across = np.hypot(x, y)
    latitude = np.full(len(x), phi)
    for _ in range(_TURNS):
        primes = WGS84_SEMI_MAJOR_AXIS_M / np.sqrt(1 - squared * np.sin(latitude) ** 2)
        latitude = np.arctan2(z + squared * primes * np.sin(latitude), across)
    primes = WGS84_SEMI_MAJOR_AXIS_M / np.sqrt(1 - squared * np.sin(latitude) ** 2)
    altitude = (
        across * np.cos(latitude)
        + (z + squared * primes * np.sin(latitude)) * np.sin(latitude)
        - primes
    )
    return np.column_stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), altitude])
