"""Options for a known scale: a number, or the output of ``vehanchor estimate --json``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

from vehanchor.errors import InvalidParameterError
from vehanchor.options.rulers import GSD, OBJECT_HEIGHT
from vehanchor.storage.text import decoded

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from vehanchor.records import KnownScale

GivenGsd: TypeAlias = Annotated[
    float | None,
    typer.Option(f"--{GSD.flag}", metavar=GSD.metavar, help=GSD.help),
]

KnownLengthsFile: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.csv",
        help="CSV of known lengths: photograph,x1,y1,x2,y2,metres; paths relative to the table.",
    ),
]

ObjectHeight: TypeAlias = Annotated[
    float | None,
    typer.Option(f"--{OBJECT_HEIGHT.flag}", metavar=OBJECT_HEIGHT.metavar, help=OBJECT_HEIGHT.help),
]

ScaleFile: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        "--scale",
        metavar="FILE",
        help="Use the scale in the output of 'vehanchor estimate --json' for this image, or of "
        "'vehanchor flight --out', without a search for cars.",
    ),
]

SearchAnyway: TypeAlias = Annotated[
    bool,
    typer.Option(
        "--search",
        help="Measure in a georeferenced file with the estimate, not with the file's own scale.",
    ),
]


def read_scale(path: Path | None, image: str) -> KnownScale | None:
    """Read the scale from a record's file; None without a file.

    Args:
        path: path of the file.
        image: the image to measure; it selects the photograph of a flight.

    Raises:
        InvalidParameterError: the file cannot be read, or has no scale.
    """
    if path is None:
        return None
    from vehanchor.records.gsd_estimate import read_known_scale

    try:
        text = decoded(path.read_bytes())
        record: Any = json.loads(text)
        if isinstance(record, dict) and "photographs" in record:
            record = _scale_in(record["photographs"], image)
        return read_known_scale(record)
    # An InvalidParameterError is a ValueError, too.
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise InvalidParameterError(
            f"--scale {str(path)!r} has no scale ({error}): give the output of 'vehanchor estimate "
            "IMAGE --json'"
        ) from None


def _scale_in(photographs: Sequence[Mapping[str, Any]], image: str) -> Any:
    """Find the scale of a photograph in the record of a flight, by its path or its unique name.

    Raises:
        InvalidParameterError: the photograph is not in the record, or several have its name.
    """
    path = Path(image)
    by_path = []
    by_name = []
    for photograph in photographs:
        photograph_path = Path(photograph["photograph"])
        scale = photograph["scale"]
        if photograph_path.absolute() == path.absolute():
            by_path.append(scale)
        if photograph_path.name == path.name:
            by_name.append(scale)
    scales = by_path or by_name
    if len(scales) != 1:
        count = f"there {len(scales)} times" if scales else "not there"
        raise InvalidParameterError(
            f"{image!r} is {count} in the flight: name a photograph of it by its path"
        )
    return scales[0]
