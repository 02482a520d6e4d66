"""Models of COLMAP, text and binary: cameras, images and points3D.

The layouts are those of https://colmap.github.io/format.html. Rigs and frames, which newer versions
add, are not read; COLMAP makes them anew from a model without them.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from vehanchor.errors import ReconstructionError
from vehanchor.storage.atomic import whole_file
from vehanchor_flight.reconstruction.model import Lens, Reconstruction, Shot

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from vehanchor_flight.records import ModelSource

    Points: TypeAlias = NDArray[np.float64]
    """Points ``[n, 3]`` in model units."""

    Lenses: TypeAlias = dict[int, Lens]
    """Lenses by the camera's id."""

    FindStarts: TypeAlias = Callable[[bytearray], Iterator[int]]
    """Yields the position of each entry of a binary file."""

_FILES = ("cameras", "images", "points3D")
_MAX_BYTES = 8 << 30
_MAX_NAME_BYTES = 1024
# Binary entries. COLMAP writes little-endian numbers without padding.
_COUNT = struct.Struct("<Q")  # Number of entries, or of the points of an image.
_CAMERA = struct.Struct("<IiQQ")  # Id, model, width, height; its parameters follow.
_POSE = struct.Struct("<I7dI")  # Image id, quaternion, translation, camera id; its name follows.
_POINT_OF_IMAGE_BYTES = 24  # x, y and the id of a point.
_POINT = struct.Struct("<Q3d3BdQ")  # Id, position, colour, error, length of its track.
_TRACK_ENTRY_BYTES = 8
_POSITION = struct.Struct("<3d")
# Bytes from the beginning of an entry to its three lengths.
_TRANSLATION_OFFSET = 36
_POSITION_OFFSET = 8
# Columns of a row that hold the first of three lengths.
_TRANSLATION_COLUMN = 5
_POSITION_COLUMN = 1


class _CameraModel(NamedTuple):
    """Camera model of COLMAP.

    Attributes:
        number: in binary files.
        n_focals: number of focal lengths, 1 or 2.
        n_parameters: number of all parameters.
    """

    number: int
    n_focals: int
    n_parameters: int


_MODELS = {
    "SIMPLE_PINHOLE": _CameraModel(0, 1, 3),
    "PINHOLE": _CameraModel(1, 2, 4),
    "SIMPLE_RADIAL": _CameraModel(2, 1, 4),
    "RADIAL": _CameraModel(3, 1, 5),
    "OPENCV": _CameraModel(4, 2, 8),
    "OPENCV_FISHEYE": _CameraModel(5, 2, 8),
    "FULL_OPENCV": _CameraModel(6, 2, 12),
    "SIMPLE_RADIAL_FISHEYE": _CameraModel(8, 1, 4),
    "RADIAL_FISHEYE": _CameraModel(9, 1, 5),
}
_MODEL_NAMES = {model.number: name for name, model in _MODELS.items()}


def is_colmap(folder: Path) -> bool:
    """Check whether a folder holds a model of COLMAP."""
    return _has_files(folder, ".txt") or _has_files(folder, ".bin")


def _has_files(folder: Path, suffix: str) -> bool:
    return all((folder / f"{name}{suffix}").is_file() for name in _FILES)


def read_colmap(folder: Path) -> Reconstruction:
    """Read a model of COLMAP; the text if both are there.

    Raises:
        ReconstructionError: a file is damaged, or a camera is not supported.
    """
    model_format: ModelSource = "colmap_binary"
    read_model = _read_binary
    if _is_text(folder):
        model_format = "colmap_text"
        read_model = _read_text
    try:
        shots, points = read_model(folder)
    except (ValueError, IndexError, KeyError, struct.error, OverflowError) as error:
        if isinstance(error, ReconstructionError):
            raise
        raise ReconstructionError(
            f"{str(folder)!r} is not a whole model of COLMAP: {error!r}"
        ) from None
    return Reconstruction(
        model_format,
        folder,
        shots=shots,
        points=points.reshape(-1, 3),
    )


def _is_text(folder: Path) -> bool:
    return (folder / "images.txt").is_file()


def _read_text(folder: Path) -> tuple[tuple[Shot, ...], Points]:
    """Read the shots and the positions of the points from text."""
    cameras = _rows(folder / "cameras.txt")
    lenses = dict(_text_camera(row) for row in cameras)
    # An image has two rows: its pose, and its points, which may be none.
    image_rows = list(_rows(folder / "images.txt", keep_empty=True))
    poses = image_rows[::2]
    # A file can end with an empty row.
    shots = [_text_shot(row, lenses) for row in poses if row.strip()]
    columns = slice(_POSITION_COLUMN, _POSITION_COLUMN + 3)
    points = _rows(folder / "points3D.txt")
    positions = [row.split()[columns] for row in points]
    return tuple(shots), np.array(positions, np.float64)


def _read_binary(folder: Path) -> tuple[tuple[Shot, ...], Points]:
    """Read the shots and the positions of the points from binary files."""
    lenses = _binary_cameras(_read_bytes(folder / "cameras.bin"))
    images = _read_bytes(folder / "images.bin")
    shots = []
    for start in _image_starts(images):
        shots.append(_binary_shot(images, start, lenses))
    points = _read_bytes(folder / "points3D.bin")
    positions = []
    for start in _point_starts(points):
        _, x, y, z, *_ = _POINT.unpack_from(points, start)
        positions.append((x, y, z))
    return tuple(shots), np.array(positions, np.float64)


def write_scaled_colmap(folder: Path, target: Path, factor: float) -> Path:
    """Write a model of COLMAP, scaled about its origin, in the format of the source.

    Args:
        folder: of the model.
        target: folder for the new files; it exists.
        factor: metres per unit of the model.

    Returns:
        The folder.

    Raises:
        OutputError: a file cannot be written.
    """
    is_text = _is_text(folder)
    suffix = ".bin"
    if is_text:
        suffix = ".txt"
    files = [folder / f"{name}{suffix}" for name in _FILES]
    cameras, images, points = files
    _write(target / cameras.name, _read_bytes(cameras))
    if is_text:
        scaled_images = _scaled_text(images, _TRANSLATION_COLUMN, factor, every=2)
        _write(target / images.name, scaled_images)
        scaled_points = _scaled_text(points, _POSITION_COLUMN, factor)
        _write(target / points.name, scaled_points)
        return target
    scaled = _scaled_binary(images, _image_starts, _TRANSLATION_OFFSET, factor=factor)
    _write(target / images.name, scaled)
    scaled = _scaled_binary(points, _point_starts, _POSITION_OFFSET, factor=factor)
    _write(target / points.name, scaled)
    return target


def _write(path: Path, content: bytes | bytearray) -> None:
    with whole_file(path) as partial:
        partial.write_bytes(content)


def _read_bytes(path: Path) -> bytearray:
    try:
        if path.stat().st_size > _MAX_BYTES:
            limit_gib = _MAX_BYTES >> 30
            raise ReconstructionError(f"{str(path)!r} is larger than {limit_gib} GiB")
        return bytearray(path.read_bytes())
    except OSError as error:
        problem = error.strerror or error
        raise ReconstructionError(f"cannot read {str(path)!r}: {problem}") from None


def _rows(path: Path, *, keep_empty: bool = False) -> Iterator[str]:
    """Yield the rows of a text file without comments.

    Args:
        path: of the file.
        keep_empty: whether to yield empty rows, too.
    """
    for row in _read_bytes(path).decode().splitlines():
        if row.startswith("#"):
            continue
        if keep_empty or row.strip():
            yield row


def _text_camera(row: str) -> tuple[int, Lens]:
    """Read the id and the lens of a camera."""
    number, kind, width, height, *cells = row.split()
    parameters = [float(cell) for cell in cells]
    lens = _lens(kind, float(width), float(height), parameters)
    return int(number), lens


def _text_shot(row: str, lenses: Lenses) -> Shot:
    """Read a shot; its name comes last, and may have blanks."""
    cells = row.split(maxsplit=9)
    pose = [float(cell) for cell in cells[1:8]]
    camera = int(cells[8])
    return _shot(cells[9], lenses[camera], pose)


def _binary_cameras(content: bytearray) -> Lenses:
    """Read the lenses of all cameras, by id."""
    (n_cameras,) = _COUNT.unpack_from(content)
    position = _COUNT.size
    lenses = {}
    for _ in range(n_cameras):
        number, model_number, width, height = _CAMERA.unpack_from(content, position)
        position += _CAMERA.size
        kind = _MODEL_NAMES.get(model_number, f"number {model_number}")
        n_parameters = _supported(kind).n_parameters
        layout = struct.Struct(f"<{n_parameters}d")
        parameters = layout.unpack_from(content, position)
        lenses[number] = _lens(kind, width, height, parameters)
        position += layout.size
    return lenses


def _supported(kind: str) -> _CameraModel:
    """Return the camera model of that name.

    Raises:
        ReconstructionError: it is not supported.
    """
    if kind not in _MODELS:
        supported = ", ".join(_MODELS)
        raise ReconstructionError(f"a camera has COLMAP's model {kind}: supported are {supported}")
    return _MODELS[kind]


def _lens(kind: str, width: float, height: float, parameters: Sequence[float]) -> Lens:
    """Make a lens from the parameters of a camera, in COLMAP's order.

    Raises:
        ValueError: the parameters are too few, too many, or not possible.
        ReconstructionError: the camera model is not supported.
    """
    _, n_focals, n_parameters = _supported(kind)
    is_complete = len(parameters) == n_parameters
    is_valid = is_complete and all(np.isfinite(parameters))
    if is_valid:
        is_valid = min(parameters[:n_focals]) > 0
    if not is_valid:
        raise ValueError(f"parameters of a camera {kind}: {parameters}")
    # One focal length holds in both directions.
    focal_x = parameters[0]
    focal_y = parameters[n_focals - 1]
    centre_x, centre_y, *distortion = parameters[n_focals:]
    return Lens(
        width,
        height,
        focal_x_px=focal_x,
        focal_y_px=focal_y,
        centre_x_px=centre_x,
        centre_y_px=centre_y,
        distortion=tuple(distortion),
        fisheye=kind.endswith("FISHEYE"),
    )


def _image_starts(content: bytearray) -> Iterator[int]:
    """Yield the position of each image in ``images.bin``.

    Raises:
        ValueError: the file has more bytes or fewer than its images.
    """
    (n_images,) = _COUNT.unpack_from(content)
    position = _COUNT.size
    for _ in range(n_images):
        yield position
        # The name ends with a zero byte; then the points of the image follow.
        name_end = content.index(b"\0", position + _POSE.size) + 1
        (n_points,) = _COUNT.unpack_from(content, name_end)
        position = name_end + _COUNT.size + _POINT_OF_IMAGE_BYTES * n_points
    _check_end(content, position)


def _binary_shot(content: bytearray, start: int, lenses: Lenses) -> Shot:
    """Read the shot of the image that begins at ``start``."""
    _, *pose, camera = _POSE.unpack_from(content, start)
    name_start = start + _POSE.size
    name_end = content.index(b"\0", name_start, name_start + _MAX_NAME_BYTES)
    name = content[name_start:name_end].decode()
    return _shot(name, lenses[camera], pose)


def _point_starts(content: bytearray) -> Iterator[int]:
    """Yield the position of each point in ``points3D.bin``.

    Raises:
        ValueError: the file has more bytes or fewer than its points.
    """
    (n_points,) = _COUNT.unpack_from(content)
    position = _COUNT.size
    for _ in range(n_points):
        yield position
        *_, track_length = _POINT.unpack_from(content, position)
        position += _POINT.size + _TRACK_ENTRY_BYTES * track_length
    _check_end(content, position)


def _check_end(content: bytearray, end: int) -> None:
    if end != len(content):
        raise ValueError(f"{len(content)} bytes instead of {end}")


def _shot(name: str, lens: Lens, pose: Sequence[float]) -> Shot:
    """Make a shot from a quaternion (w first) and a translation.

    Raises:
        ValueError: the pose is not finite.
    """
    if not np.isfinite(pose).all():
        raise ValueError(f"the pose of {name!r} is {pose}")
    w, x, y, z, *translation = pose
    rotation = Rotation.from_quat([x, y, z, w])
    return Shot(
        name,
        lens,
        rotation=rotation.as_matrix(),
        translation=np.array(translation, dtype=np.float64),
    )


def _scaled_text(path: Path, first: int, factor: float, every: int = 1) -> bytes:
    """Scale three columns of a text file; comments are kept.

    Args:
        path: of the file.
        first: index of the first of the columns.
        factor: to multiply by.
        every: 1 for all rows; 2 for the first, the third and so on.

    Returns:
        The new content.
    """
    rows = []
    number = 0
    for row in _read_bytes(path).decode().splitlines():
        if row.startswith("#"):
            rows.append(row)
            continue
        is_scaled = number % every == 0
        if is_scaled and row.strip():
            rows.append(_scaled_row(row, first, factor))
        else:
            rows.append(row)
        number += 1
    text = "\n".join(rows) + "\n"
    return text.encode()


def _scaled_row(row: str, first: int, factor: float) -> str:
    """Scale three columns of a row; what follows them stays as it is."""
    end = first + 3
    cells = row.split(maxsplit=end)
    scaled = [float(cell) * factor for cell in cells[first:end]]
    cells[first:end] = [repr(number) for number in scaled]
    return " ".join(cells)


def _scaled_binary(
    path: Path,
    find_starts: FindStarts,
    offset: int,
    factor: float,
) -> bytearray:
    """Scale three numbers of every entry of a binary file.

    Args:
        path: of the file.
        find_starts: yields the position of each entry.
        offset: bytes from the beginning of an entry to its numbers.
        factor: to multiply by.

    Returns:
        The new content.
    """
    content = _read_bytes(path)
    for start in find_starts(content):
        position = start + offset
        numbers = _POSITION.unpack_from(content, position)
        scaled = [factor * number for number in numbers]
        _POSITION.pack_into(content, position, *scaled)
    return content
