"""Files of a reconstruction: reading in any format, the rescaled copy and ``geo.txt``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

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

    Points: TypeAlias = NDArray[np.float64]
    """Points ``[n, 3]``, in metres or on Earth."""

    Angles: TypeAlias = NDArray[np.float64]
    """Latitudes ``[n]`` in radians."""

    Radii: TypeAlias = NDArray[np.float64]
    """Radii of curvature ``[n]`` in metres."""

    Origin: TypeAlias = tuple[float, float, float]
    """Latitude, longitude (degrees) and altitude (metres) of a model's origin."""

# Where the files of a project lie, relative to its folder, in the order of the search.
_OPENSFM_FILES = ("reconstruction.json", "opensfm/reconstruction.json")
_COLMAP_FOLDERS = (".", "sparse/0", "sparse", "0")
# Where the photographs lie, relative to the files of the model.
_IMAGE_FOLDERS = ("images", "../images", "../../images", "../../../images", ".")
_SQUARED_ECCENTRICITY = WGS84_FLATTENING * (2 - WGS84_FLATTENING)  # Of the ellipsoid.
_N_LATITUDE_STEPS = 6  # Each step of the iteration comes 150 times closer.


def read_model(path: str | os.PathLike[str]) -> Reconstruction:
    """Read a model of OpenSfM, OpenDroneMap or COLMAP.

    Args:
        path: the project's folder, its ``reconstruction.json``, or the folder of COLMAP's files.

    Raises:
        ReconstructionError: there is no model, or it is damaged.
    """
    model_path = _find_model(Path(path))
    if model_path is None:
        raise ReconstructionError(
            f"there is no reconstruction in {str(path)!r}: name a reconstruction.json of "
            "OpenSfM or OpenDroneMap, or a folder with COLMAP's cameras, images and points3D; an "
            "orthophoto goes to 'vehanchor estimate --geotiff'"
        )
    if _is_json(model_path):
        model = read_opensfm(model_path)
    else:
        model = read_colmap(model_path)
    if not model.shots:
        raise ReconstructionError(f"the reconstruction in {str(path)!r} has no photographs")
    return model


def _find_model(path: Path) -> Path | None:
    """Find the file of OpenSfM, or else the folder of COLMAP; None if there is neither."""
    project_files = [path / name for name in _OPENSFM_FILES]
    for file in (path, *project_files):
        if _is_json(file) and file.is_file():
            return file
    for folder in (path / name for name in _COLMAP_FOLDERS):
        if is_colmap(folder):
            return folder
    return None


def _is_json(path: Path) -> bool:
    return path.suffix.lower() == ".json"


def images_of(model: Reconstruction) -> Path:
    """Find the folder of a model's photographs near its files.

    Raises:
        ReconstructionError: no folder has any of them.
    """
    base = model.path
    if not base.is_dir():
        base = base.parent
    for folder in (base / name for name in _IMAGE_FOLDERS):
        photographs = (folder / shot.name for shot in model.shots)
        if any(photograph.is_file() for photograph in photographs):
            return folder
    raise ReconstructionError(
        f"no photograph of the model, such as {model.shots[0].name!r}, is near {str(base)!r}: name "
        "their folder with --images"
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
        problem = error.strerror or error
        raise OutputError(f"cannot create {str(target)!r}: {problem}") from error
    if model.kind == "opensfm":
        return write_scaled_opensfm(model.path, target, factor)
    return write_scaled_colmap(model.path, target, factor)


def check_project_path(target: Path) -> None:
    """Check, before the work, that a project can be written to a folder.

    Raises:
        OutputError: the folder is not empty, or the one above it does not exist.
    """
    is_file = target.exists() and not target.is_dir()
    if is_file or not target.parent.is_dir():
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
    for shot in model.shots:
        has_space = any(letter.isspace() for letter in shot.name)
        if has_space:
            raise ReconstructionError(
                f"geo.txt separates columns by spaces, and the photograph {shot.name!r} has one"
            )
    centres = np.array([shot.centre for shot in model.shots])
    mean = centres.mean(axis=0)
    scaled = mean + factor * (centres - mean)
    positions = on_earth(scaled, model.origin)
    rows = ["EPSG:4326"]
    for shot, position in zip(model.shots, positions.tolist(), strict=True):
        latitude, longitude, altitude = position
        rows.append(f"{shot.name} {longitude:.9f} {latitude:.9f} {altitude:.4f}")
    with whole_file(path) as partial:
        text = "\n".join(rows) + "\n"
        partial.write_text(text, encoding="utf-8")


def on_earth(points: Points, origin: Origin) -> Points:
    """Convert local metres to latitude, longitude and altitude on WGS 84.

    Args:
        points: ``[n, 3]`` metres east, north and up of the origin.
        origin: its latitude, longitude (degrees) and altitude (metres).

    Returns:
        ``[n, 3]`` degrees, degrees and metres.
    """
    geocentric = _geocentric(np.asarray(points), origin)
    x, y, z = geocentric.T
    # Geodetic latitude: iterate tan(latitude) = (z + e^2 N sin(latitude)) / distance from the axis,
    # in which e is the eccentricity, and N the radius of curvature in the prime vertical.
    axis_distance = np.hypot(x, y)
    origin_latitude_deg, _, _ = origin
    latitude = np.full(len(x), math.radians(origin_latitude_deg))
    for _ in range(_N_LATITUDE_STEPS):
        radius = _prime_radius(latitude)
        raised_z = z + _SQUARED_ECCENTRICITY * radius * np.sin(latitude)
        latitude = np.arctan2(raised_z, axis_distance)
    radius = _prime_radius(latitude)
    sine = np.sin(latitude)
    cosine = np.cos(latitude)
    raised_z = z + _SQUARED_ECCENTRICITY * radius * sine
    altitude = axis_distance * cosine + raised_z * sine - radius
    longitude = np.arctan2(y, x)
    latitude_deg = np.degrees(latitude)
    longitude_deg = np.degrees(longitude)
    return np.column_stack([latitude_deg, longitude_deg, altitude])


def _geocentric(points: Points, origin: Origin) -> Points:
    """Convert local metres to geocentric coordinates; arguments as in ``on_earth``.

    Returns:
        ``[n, 3]`` metres: z along the axis of the Earth, x towards the meridian of Greenwich.
    """
    latitude_deg, longitude_deg, altitude_m = origin
    latitude = math.radians(latitude_deg)
    longitude = math.radians(longitude_deg)
    sine = math.sin(latitude)
    cosine = math.cos(latitude)
    sine_east = math.sin(longitude)
    cosine_east = math.cos(longitude)
    east = np.array([-sine_east, cosine_east, 0.0])
    up = np.array([cosine * cosine_east, cosine * sine_east, sine])
    north = np.cross(up, east)
    root = math.sqrt(1 - _SQUARED_ECCENTRICITY * sine**2)
    radius = WGS84_SEMI_MAJOR_AXIS_M / root
    # The normal of the ellipsoid meets the axis below the equatorial plane.
    depth = _SQUARED_ECCENTRICITY * radius * sine
    below_equator = np.array([0, 0, depth])
    geocentric_origin = (radius + altitude_m) * up - below_equator
    axes = np.array([east, north, up])
    return np.asarray(geocentric_origin + points @ axes)


def _prime_radius(latitude: Angles) -> Radii:
    """Compute the ellipsoid's radius of curvature in the prime vertical, ``[n]`` metres."""
    sine = np.sin(latitude)
    squares = 1 - _SQUARED_ECCENTRICITY * sine**2
    return np.asarray(WGS84_SEMI_MAJOR_AXIS_M / np.sqrt(squares))
