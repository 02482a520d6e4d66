"""The scale as commands are given it: a number, or an earlier ``vehanchor estimate --json``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

from vehanchor.errors import InvalidParameterError
from vehanchor.options.given_scale import GSD, OBJECT_HEIGHT

if TYPE_CHECKING:
    from vehanchor.records import KnownScale

GivenGsd: TypeAlias = Annotated[
    float | None,
    typer.Option(f"--{GSD.flag}", metavar=GSD.metavar, help=GSD.help),
]

KnownLengthsFile: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.csv", help="Lines of known length: file,x1,y1,x2,y2,metres, files relative to the table."
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
        help="What 'vehanchor estimate --json' printed for this image, or 'vehanchor flight --out' wrote: its scale is "
        "taken, and no car is searched.",
    ),
]


def read_scale(path: Path | None, image: str) -> KnownScale | None:
    """Read the scale in a record's file; None without a file.

    Args:
        path: of the file.
        image: that is to be measured: which photograph it is, of a flight.

    Raises:
        InvalidParameterError: it cannot be read, or holds no scale.
    """
    if path is None:
        return None
    from pydantic import ValidationError

    from vehanchor.records import KnownScale

    try:
        record: Any = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InvalidParameterError(
            f"--scale {str(path)!r} cannot be read: {error}. Give what 'vehanchor estimate IMAGE --json' prints"
        ) from None
    if isinstance(record, dict) and "photographs" in record:
        from vehanchor.flight.io import photograph_in, read_record

        return photograph_in(read_record(path), image).scale
    found = record.get("scale", record) if isinstance(record, dict) else record
    try:
        return KnownScale.model_validate(found)
    except ValidationError:
        raise InvalidParameterError(
            f"--scale {str(path)!r} holds no scale: give what 'vehanchor estimate IMAGE --json' prints of an image "
            "with an anchor"
        ) from None
