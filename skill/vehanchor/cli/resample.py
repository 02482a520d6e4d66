"""``vehanchor resample``: copies at the scale that a model expects."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from vehanchor.cli.cli_options import OF_ONE_IMAGE, ParsedOptions, scale_command
from vehanchor.cli.terminal import FAILED, printable, report
from vehanchor.errors import OutputError, VehAnchorError
from vehanchor.export import MAX_ENLARGEMENT
from vehanchor.imagery.sources.files import find_images
from vehanchor.records.text import count

TABLE = "resampled.csv"
_COLUMNS: dict[str, type] = {
    "photograph": str,
    "copy": str,
    "factor": float,
    "gsd_m_per_px": float,
    "gsd_ci95_low_m_per_px": float,
    "gsd_ci95_high_m_per_px": float,
    "confidence": float,
    "scale_source": str,
    "error_code": str,
    "error": str,
}


@scale_command(without=OF_ONE_IMAGE)
def resample(
    inputs: Annotated[
        list[str],
        typer.Argument(metavar="PHOTO_OR_FOLDER...", show_default=False),
    ],
    to: Annotated[
        float, typer.Option(metavar="M_PER_PX", help="Scale of the copies, metres per pixel.")
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the copies.")],
    max_enlargement: Annotated[
        float, typer.Option(metavar="FACTOR", help="Photographs that would grow more are skipped.")
    ] = MAX_ENLARGEMENT,
    *,
    chosen: ParsedOptions,
) -> None:
    """Write copies of photographs at a scale that another model expects.

    Photographs without a usable scale are skipped and named. A table in the folder lists all.
    """
    from vehanchor.batch.table import write_table
    from vehanchor.export.resample import make_folder

    engine = chosen.engine()
    images = find_images(inputs)
    make_folder(out)
    rows = []
    names: set[str] = set()
    for image in images:
        row: dict[str, Any] = dict.fromkeys(_COLUMNS)
        row["photograph"] = image
        try:
            if Path(image).stem in names:
                raise OutputError(
                    f"another photograph is called {Path(image).stem!r}: use another folder"
                )
            copy = engine.resample(image, gsd_m_per_px=to, max_enlargement=max_enlargement)
            row["copy"] = copy.write(out).name
            names.add(Path(image).stem)
            row |= {name: copy.facts[name] for name in _COLUMNS if name in copy.facts}
        except VehAnchorError as error:
            row["error_code"] = error.code
            row["error"] = str(error)
            report(error, image)
        rows.append(row)
    write_table(out / TABLE, rows, _COLUMNS)
    photographs = count(len(rows), "photograph")
    table = printable(str(out / TABLE))
    print(f"wrote {table}: {len(names)} of {photographs} resampled", file=sys.stderr)
    if not names:
        raise typer.Exit(FAILED)
