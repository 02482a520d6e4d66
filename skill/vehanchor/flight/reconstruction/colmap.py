"""Models of COLMAP, text and binary: cameras, images and points3D.

The layouts are those of https://colmap.github.io/format.html. Rigs and frames, which newer versions add, are not read;
COLMAP makes them anew from a model without them.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.errors import ReconstructionError
from vehanchor.flight.reconstruction.model import Lens, Reconstruction, Shot
from vehanchor.storage.atomic import whole_file

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

_FILES = ("cameras", "images", "points3D")
_MOST_BYTES = 8 << 30
_POSE, _NAME_BYTES = struct.Struct("<I7dI"), 1024
_POINT = struct.Struct("<Q3d3BdQ")


class _CameraModel(NamedTuple):
    """Camera model of COLMAP.

    Attributes:
        n_focals: focal lengths, 1 or 2, before the principal point.
        n_parameters: all parameters.
        fisheye: whether it is a fisheye.
    """

    n_focals: int
    n_parameters: int
    fisheye: bool = False


_MODELS = {
    "SIMPLE_PINHOLE": _CameraModel(1, 3),
    "PINHOLE": _CameraModel(2, 4),
    "SIMPLE_RADIAL": _CameraModel(1, 4),
    "RADIAL": _CameraModel(1, 5),
    "OPENCV": _CameraModel(2, 8),
    "OPENCV_FISHEYE": _CameraModel(2, 8, fisheye=True),
    "FULL_OPENCV": _CameraModel(2, 12),
    "SIMPLE_RADIAL_FISHEYE": _CameraModel(1, 4, fisheye=True),
    "RADIAL_FISHEYE": _CameraModel(1, 5, fisheye=True),
}
_NUMBERS = {0: "SIMPLE_PINHOLE", 1: "PINHOLE", 2: "SIMPLE_RADIAL", 3: "RADIAL", 4: "OPENCV", 5: "OPENCV_FISHEYE"}
_NUMBERS |= {6: "FULL_OPENCV", 8: "SIMPLE_RADIAL_FISHEYE", 9: "RADIAL_FISHEYE"}


def is_colmap(folder: Path) -> bool:
    """Tell whether a folder holds a model of COLMAP."""
    return any(all((folder / f"{name}{suffix}").is_file() for name in _FILES) for suffix in (".txt", ".bin"))


def read_colmap(folder: Path) -> Reconstruction:
    """Read a model of COLMAP; the text if both are there.

    Raises:
        ReconstructionError: a file is damaged, or a camera is not supported.
    """
    text = (folder / "images.txt").is_file()
    try:
        if text:
            lenses = dict(map(_text_camera, _rows(folder / "cameras.txt")))
            rows = list(_rows(folder / "images.txt", points=True))[::2]  # the others hold the points of an image
            shots = tuple(_text_shot(row, lenses) for row in rows if row.strip())
            points = np.array([row.split()[1:4] for row in _rows(folder / "points3D.txt")], np.float64)
        else:
            lenses = _binary_cameras(_bytes(folder / "cameras.bin"))
            images = _bytes(folder / "images.bin")
            shots = tuple(_binary_shot(images, at, lenses) for at in _image_offsets(images))
            found = _bytes(folder / "points3D.bin")
            points = np.array([_POINT.unpack_from(found, at)[1:4] for at in _point_offsets(found)], np.float64)
    except (ValueError, IndexError, KeyError, struct.error, OverflowError) as error:
        if isinstance(error, ReconstructionError):
            raise
        raise ReconstructionError(f"{str(folder)!r} is not a whole model of COLMAP: {error!r}") from None
    return Reconstruction("colmap_text" if text else "colmap_binary", folder, shots, points.reshape(-1, 3))


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
    text = (folder / "images.txt").is_file()
    scaled: dict[str, Callable[[Path], bytes]] = {
        "cameras": Path.read_bytes,
        "images": lambda path: _scaled_text(path, 5, factor, every=2) if text else _scaled_images(path, factor),
        "points3D": lambda path: _scaled_text(path, 1, factor) if text else _scaled_points(path, factor),
    }
    for name, convert in scaled.items():
        file = f"{name}{'.txt' if text else '.bin'}"
        with whole_file(target / file) as partial:
            partial.write_bytes(convert(folder / file))
    return target


def _bytes(path: Path) -> bytearray:
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ReconstructionError(f"{str(path)!r} is larger than {_MOST_BYTES >> 30} GiB")
        return bytearray(path.read_bytes())
    except OSError as error:
        raise ReconstructionError(f"cannot read {str(path)!r}: {error.strerror or error}") from None


def _rows(path: Path, *, points: bool = False) -> Iterator[str]:
    """Yield the lines without comments; with ``points``, also empty ones, for an image may have no points."""
    for row in _bytes(path).decode().splitlines():
        if not row.startswith("#") and (points or row.strip()):
            yield row


def _text_camera(row: str) -> tuple[int, Lens]:
    number, kind, width, height, *parameters = row.split()
    return int(number), _lens(kind, float(width), float(height), [float(each) for each in parameters])


def _text_shot(row: str, lenses: dict[int, Lens]) -> Shot:
    values = row.split(maxsplit=9)
    pose = [float(each) for each in values[1:8]]
    return _shot(values[9], lenses[int(values[8])], pose)


def _binary_cameras(found: bytearray) -> dict[int, Lens]:
    (n,), at = struct.unpack_from("<Q", found), 8
    lenses = {}
    for _ in range(n):
        number, kind, width, height = struct.unpack_from("<IiQQ", found, at)
        at += 24
        if kind not in _NUMBERS:
            raise ReconstructionError(f"a camera has COLMAP's model number {kind}: supported are {', '.join(_MODELS)}")
        n_parameters = _MODELS[_NUMBERS[kind]].n_parameters
        parameters = struct.unpack_from(f"<{n_parameters}d", found, at)
        at += 8 * n_parameters
        lenses[number] = _lens(_NUMBERS[kind], float(width), float(height), parameters)
    return lenses


def _lens(kind: str, width: float, height: float, parameters: Sequence[float]) -> Lens:
    if kind not in _MODELS:
        raise ReconstructionError(f"a camera has COLMAP's model {kind}: supported are {', '.join(_MODELS)}")
    n_focals, n_parameters, fisheye = _MODELS[kind]
    if len(parameters) != n_parameters or not all(np.isfinite(parameters)) or min(parameters[:n_focals]) <= 0:
        raise ValueError(f"parameters of a camera {kind}: {parameters}")
    focal_x, focal_y = parameters[0], parameters[n_focals - 1]
    distortion = tuple(parameters[n_focals + 2 :])
    distortion += (0.0,) * (4 - len(distortion))
    centre_x, centre_y = parameters[n_focals : n_focals + 2]
    return Lens(width, height, focal_x, focal_y, centre_x, centre_y, distortion, fisheye)


def _image_offsets(found: bytearray) -> Iterator[int]:
    (n,), at = struct.unpack_from("<Q", found), 8
    for _ in range(n):
        yield at
        end = found.index(b"\0", at + _POSE.size) + 1
        (n_points,) = struct.unpack_from("<Q", found, end)
        at = end + 8 + 24 * n_points


def _binary_shot(found: bytearray, at: int, lenses: dict[int, Lens]) -> Shot:
    _, *pose, camera = _POSE.unpack_from(found, at)
    start = at + _POSE.size
    name = found[start : found.index(b"\0", start, start + _NAME_BYTES)].decode()
    return _shot(name, lenses[camera], pose)


def _point_offsets(found: bytearray) -> Iterator[int]:
    (n,), at = struct.unpack_from("<Q", found), 8
    for _ in range(n):
        yield at
        at += _POINT.size + 8 * _POINT.unpack_from(found, at)[-1]


def _shot(name: str, lens: Lens, pose: Sequence[float]) -> Shot:
    """Make a shot from a quaternion (w first) and a translation."""
    if not np.isfinite(pose).all():
        raise ValueError(f"the pose of {name!r} is {pose}")
    return Shot(name, lens, _rotation(pose[:4]), np.array(pose[4:], dtype=np.float64))


def _rotation(quaternion: Sequence[float]) -> NDArray[np.float64]:
    w, x, y, z = np.asarray(quaternion) / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _scaled_text(path: Path, first: int, factor: float, every: int = 1) -> bytes:
    """Scale three columns of every row, or of every second one; comments are kept."""
    rows, number = [], 0
    for row in _bytes(path).decode().splitlines():
        if not row.startswith("#"):
            if number % every == 0 and row.strip():
                cells = row.split(maxsplit=first + 3)
                cells[first : first + 3] = [repr(float(cell) * factor) for cell in cells[first : first + 3]]
                row = " ".join(cells)
            number += 1
        rows.append(row)
    return ("\n".join(rows) + "\n").encode()


def _scaled_images(path: Path, factor: float) -> bytes:
    found = _bytes(path)
    for at in list(_image_offsets(found)):
        _scale_three(found, at + 4 + 32, factor)
    return bytes(found)


def _scaled_points(path: Path, factor: float) -> bytes:
    found = _bytes(path)
    for at in list(_point_offsets(found)):
        _scale_three(found, at + 8, factor)
    return bytes(found)


def _scale_three(found: bytearray, at: int, factor: float) -> None:
    struct.pack_into("<3d", found, at, *(value * factor for value in struct.unpack_from("<3d", found, at)))
