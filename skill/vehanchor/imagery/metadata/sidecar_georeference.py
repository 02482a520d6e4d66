"""Georeference in the files beside an image: world file, ``.prj`` and GDAL's ``.aux.xml``.

The files are untrusted. Of ``.aux.xml`` only the transform and the reference system are read; its
other parts, and some reference systems, can name any other file.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any, NamedTuple
from xml.parsers import expat

from vehanchor.errors import how_to_install

if TYPE_CHECKING:
    from vehanchor.imagery.metadata.georeference import AffineCoefficients

_N_COEFFICIENTS = 6
_ROOT = "PAMDataset"
_SYSTEM = "SRS"
_TRANSFORM = "GeoTransform"
_EPSG = re.compile(r"EPSG:(\d{4,6})", re.IGNORECASE)
_WKT = re.compile(r"(?:PROJ|GEOG|GEOD|COMPD|COMPOUND)[A-Z_]{2,8}\[", re.IGNORECASE)
# Parts of a reference system that name files of PROJ. Web Mercator's "@null" names none.
_NAMES_A_FILE = re.compile(r"grids(?!=@null)|PARAMETERFILE|\+init", re.IGNORECASE)


class UnusableSidecarError(ValueError):
    """A file beside an image cannot be used; the message is a clause."""


class PamGeoreference(NamedTuple):
    """What GDAL's ``.aux.xml`` states of the georeference; None for what it lacks."""

    transform: AffineCoefficients | None
    system: Any | None


def read_world_file(data: bytes) -> AffineCoefficients:
    """Read the transform of a world file, whose origin is the centre of the first pixel.

    Source: ESRI, "World files for raster datasets". A decimal comma is accepted.

    Raises:
        UnusableSidecarError: it does not have six numbers, or they are no transform.
    """
    words = _text(data).replace(",", ".").split()
    a, d, b, e, centre_x, centre_y = _numbers(words)
    left = centre_x - (a + b) / 2
    top = centre_y - (d + e) / 2
    return _checked((a, b, left, d, e, top))


def read_pam(data: bytes) -> PamGeoreference:
    """Read the transform and reference system of a ``.aux.xml`` file.

    Raises:
        UnusableSidecarError: it is damaged, declares entities, or its reference system is unusable.
    """
    texts = _children(data)
    transform = None
    if _TRANSFORM in texts:
        left, a, b, top, d, e = _numbers(texts[_TRANSFORM].split(","))
        transform = _checked((a, b, left, d, e, top))
    system = None
    if texts.get(_SYSTEM, "").strip():
        system = _system_of(texts[_SYSTEM].strip())
    return PamGeoreference(transform, system)


def read_projection_file(data: bytes) -> Any:
    """Read the reference system of a ``.prj`` file, in the WKT of ESRI or GDAL.

    Returns:
        A ``rasterio.crs.CRS``.

    Raises:
        UnusableSidecarError: the reference system is unusable.
    """
    return _system_of(_text(data).strip())


def _text(data: bytes) -> str:
    return data.decode("utf-8-sig", "replace").replace("\0", " ")


def _numbers(words: list[str]) -> list[float]:
    """Read six numbers.

    Raises:
        UnusableSidecarError: they are not six finite numbers.
    """
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    is_finite = all(math.isfinite(number) for number in numbers)
    if len(numbers) != _N_COEFFICIENTS or not is_finite:
        raise UnusableSidecarError("it does not have six numbers")
    return numbers


def _checked(transform: AffineCoefficients) -> AffineCoefficients:
    """Return a transform that has an inverse.

    Raises:
        UnusableSidecarError: it has none.
    """
    a, b, _, d, e, _ = transform
    determinant = a * e - b * d
    if determinant == 0 or not math.isfinite(determinant):
        raise UnusableSidecarError("its transform has no inverse")
    return transform


def _children(data: bytes) -> dict[str, str]:
    """Read the texts of the transform and the system, if the root has them as children.

    Raises:
        UnusableSidecarError: the file is not XML, or declares entities.
    """
    texts: dict[str, str] = {}
    path: list[str] = []

    def start(name: str, _: dict[str, str]) -> None:
        path.append(name)

    def end(_: str) -> None:
        path.pop()

    def collect(text: str) -> None:
        if len(path) == 2 and path[0] == _ROOT and path[1] in (_SYSTEM, _TRANSFORM):
            texts[path[1]] = texts.get(path[1], "") + text

    def refuse(*_: object) -> None:
        raise UnusableSidecarError("it declares a document type")

    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = collect
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise UnusableSidecarError("it is not XML") from error
    return texts


def _system_of(text: str) -> Any:
    """Make a reference system of WKT or an EPSG code; other forms can name files.

    Raises:
        UnusableSidecarError: the system is unknown or names a file, or rasterio is not installed.
    """
    try:
        from rasterio import Env
        from rasterio.crs import CRS
        from rasterio.errors import CRSError
    except ImportError as error:
        raise UnusableSidecarError(f"it needs rasterio: {how_to_install('geo')}") from error
    epsg = _EPSG.fullmatch(text)
    if epsg is None and _WKT.match(text) is None:
        raise UnusableSidecarError("its reference system is neither WKT nor an EPSG code")
    if _NAMES_A_FILE.search(text):
        raise UnusableSidecarError("its reference system names another file")
    try:
        # Within it, GDAL writes nothing of the file to stderr.
        with Env():
            system = CRS.from_epsg(int(epsg[1])) if epsg else _of_wkt(text)
    except (CRSError, ValueError) as error:
        raise UnusableSidecarError("its reference system is unknown") from error
    return system


def _of_wkt(text: str) -> Any:
    """Make a reference system of WKT by GDAL, or by ESRI, which leaves out authorities."""
    from rasterio.crs import CRS

    is_of_esri = "AUTHORITY[" not in text and "ID[" not in text
    return CRS.from_wkt(text, morph_from_esri_dialect=is_of_esri)
