"""Models of COLMAP, text and binary: cameras, images and points3D.

The layouts are those of https://colmap.github.io/format.html. Rigs and frames, which newer versions
add, are not read; COLMAP makes them anew from a model without them.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from vehanchor.errors import ReconstructionError
from vehanchor.storage.atomic import whole_file
from vehanchor_flight.reconstruction.model import Lens, Reconstruction, Shot

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

_FILES = ("cameras", "images", "points3D")
_MOST_BYTES = 8 << 30
_POSE = struct.Struct("<I7dI")
_NAME_BYTES = 1024
_THREE = struct.Struct("<3d")
_POINT = struct.Struct("<Q3d3BdQ")


class _CameraModel(NamedTuple):
    """Camera model of COLMAP: its number in binary files, focal lengths (1 or 2), and parameters in all."""

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
_NAMES = {model.number: name for name, model in _MODELS.items()}


def is_colmap(folder: Path) -> bool:
    """Tell whether a folder holds a model of COLMAP."""
    return any(
        all((folder / f"{name}{suffix}").is_file() for name in _FILES)
        for suffix in (".txt", ".bin")
    )


def read_colmap(folder: Path) -> Reconstruction:
    """Read a model of COLMAP; the text if both are there.

    Raises:
        ReconstructionError: a file is damaged, or a camera is not supported.
    """
    text = (folder / "images.txt").is_file()
    try:
        if text:
            lenses = dict(map(_text_camera, _rows(folder / "cameras.txt")))
            # the others hold the points of an image
            rows = list(_rows(folder / "images.txt", points=True))[::2]
            shots = tuple(_text_shot(row, lenses) for row in rows if row.strip())
            points = np.array(
                [row.split()[1:4] for row in _rows(folder / "points3D.txt")], np.float64
            )
        else:
            lenses = _binary_cameras(_bytes(folder / "cameras.bin"))
            images = _bytes(folder / "images.bin")
            shots = tuple(_binary_shot(images, at, lenses) for at in _image_offsets(images))
            found = _bytes(folder / "points3D.bin")
            points = np.array(
                [_POINT.unpack_from(found, at)[1:4] for at in _point_offsets(found)], np.float64
            )
    except (ValueError, IndexError, KeyError, struct.error, OverflowError) as error:
        if isinstance(error, ReconstructionError):
            raise
        raise ReconstructionError(
            f"{str(folder)!r} is not a whole model of COLMAP: {error!r}"
        ) from None
    return Reconstruction(
        "colmap_text" if text else "colmap_binary",
        folder,
        shots=shots,
        points=points.reshape(-1, 3),
    )


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
    ending = ".txt" if text else ".bin"
    cameras, images, points = (folder / f"{name}{ending}" for name in _FILES)
    _write(target / cameras.name, _bytes(cameras))
    if text:
        _write(target / images.name, _scaled_text(images, 5, factor, every=2))
        _write(target / points.name, _scaled_text(points, 1, factor))
    else:
        _write(
            target / images.name, _scaled_binary(images, _image_offsets, first=36, factor=factor)
        )
        _write(target / points.name, _scaled_binary(points, _point_offsets, first=8, factor=factor))
    return target


def _write(path: Path, content: bytes | bytearray) -> None:
    with whole_file(path) as partial:
        partial.write_bytes(content)


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
    return int(number), _lens(
        kind, float(width), float(height), [float(each) for each in parameters]
    )


def _text_shot(row: str, lenses: dict[int, Lens]) -> Shot:
    values = row.split(maxsplit=9)
    pose = [float(each) for each in values[1:8]]
    return _shot(values[9], lenses[int(values[8])], pose)


def _binary_cameras(found: bytearray) -> dict[int, Lens]:
    (n,) = struct.unpack_from("<Q", found)
    at = 8
    lenses = {}
    for _ in range(n):
        number, kind, width, height = struct.unpack_from("<IiQQ", found, at)
        at += 24
        name = _NAMES.get(kind, f"number {kind}")
        n_parameters = _supported(name).n_parameters
        lenses[number] = _lens(
            name, width, height, struct.unpack_from(f"<{n_parameters}d", found, at)
        )
        at += 8 * n_parameters
    return lenses


def _supported(kind: str) -> _CameraModel:
    if kind not in _MODELS:
        raise ReconstructionError(
            f"a camera has COLMAP's model {kind}: supported are {', '.join(_MODELS)}"
        )
    return _MODELS[kind]


def _lens(kind: str, width: float, height: float, parameters: Sequence[float]) -> Lens:
    _, n_focals, n_parameters = _supported(kind)
    if (
        len(parameters) != n_parameters
        or not all(np.isfinite(parameters))
        or min(parameters[:n_focals]) <= 0
    ):
        raise ValueError(f"parameters of a camera {kind}: {parameters}")
    focal_x = parameters[0]
    focal_y = parameters[n_focals - 1]
    centre_x, centre_y, *distortion = parameters[n_focals:]
    return Lens(
        width,
        height,
        focal_x,
        focal_y,
        centre_x,
        centre_y,
        tuple(distortion),
        kind.endswith("FISHEYE"),
    )


def _image_offsets(found: bytearray) -> Iterator[int]:
    (n,) = struct.unpack_from("<Q", found)
    at = 8
    for _ in range(n):
        yield at
        end = found.index(b"\0", at + _POSE.size) + 1
        (n_points,) = struct.unpack_from("<Q", found, end)
        at = end + 8 + 24 * n_points
    _check_end(found, at)


def _binary_shot(found: bytearray, at: int, lenses: dict[int, Lens]) -> Shot:
    _, *pose, camera = _POSE.unpack_from(found, at)
    start = at + _POSE.size
    name = found[start : found.index(b"\0", start, start + _NAME_BYTES)].decode()
    return _shot(name, lenses[camera], pose)


def _point_offsets(found: bytearray) -> Iterator[int]:
    (n,) = struct.unpack_from("<Q", found)
    at = 8
    for _ in range(n):
        yield at
        at += _POINT.size + 8 * _POINT.unpack_from(found, at)[-1]
    _check_end(found, at)


def _check_end(found: bytearray, at: int) -> None:
    if at != len(found):
        raise ValueError(f"{len(found)} bytes instead of {at}")


def _shot(name: str, lens: Lens, pose: Sequence[float]) -> Shot:
    """Make a shot from a quaternion (w first) and a translation."""
    if not np.isfinite(pose).all():
        raise ValueError(f"the pose of {name!r} is {pose}")
    w, *axis = pose[:4]
    return Shot(
        name,
        lens,
        rotation=Rotation.from_quat([*axis, w]).as_matrix(),
        translation=np.array(pose[4:], dtype=np.float64),
    )


def _scaled_text(path: Path, first: int, factor: float, every: int = 1) -> bytes:
    """Scale three columns of every row, or of every second one; comments are kept."""
    rows = []
    number = 0
    for row in _bytes(path).decode().splitlines():
        if not row.startswith("#"):
            if number % every == 0 and row.strip():
                cells = row.split(maxsplit=first + 3)
                cells[first : first + 3] = [
                    repr(float(cell) * factor) for cell in cells[first : first + 3]
                ]
                row = " ".join(cells)
            number += 1
        rows.append(row)
    return ("\n".join(rows) + "\n").encode()


def _scaled_binary(
    path: Path, offsets: Callable[[bytearray], Iterator[int]], first: int, factor: float
) -> bytearray:
    """Scale three numbers of every entry, ``first`` bytes after its beginning."""
    found = _bytes(path)
    for at in offsets(found):
        _THREE.pack_into(
            found, at + first, *(factor * each for each in _THREE.unpack_from(found, at + first))
        )
    return found
