"""Render a scene: ``python -m research.scenes OUT.png --gsd 0.15 [--seed 3]``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, cast, get_args

import typer

from research.scenes import Layout, render_scene
from vehanchor.cli.terminal import exit_on_error, printable
from vehanchor.errors import OutputError
from vehanchor.pictures.scale import check_picture_path

app = typer.Typer(add_completion=False)


@app.command()
def scene(
    out: Annotated[
        Path,
        typer.Argument(
            metavar="OUT.png",
            help="Image to write, .png or .jpg; its ground truth goes next to it.",
        ),
    ],
    gsd: Annotated[
        float,
        typer.Option(
            metavar="M/PX", help="Ground sampling distance, metres per pixel: 0.005 to 2."
        ),
    ],
    size: Annotated[
        tuple[int, int], typer.Option(metavar="W H", help="Size of the image, pixels.")
    ] = (1024, 1024),
    seed: Annotated[
        int, typer.Option(metavar="N", help="The same seed and options give the same image.")
    ] = 0,
    vehicles: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Maximum number of cars; 0 removes all vehicles. Default: as many as the place "
            "has.",
        ),
    ] = None,
    fleet: Annotated[
        float, typer.Option(metavar="M", help="Mean length of the cars, metres: 2 to 8.")
    ] = 4.6,
    layout: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help=f"Kind of place: {', '.join(get_args(Layout))}. Default: the seed decides.",
        ),
    ] = None,
) -> None:
    """Render an aerial scene of exactly known scale.

    The ground truth has the GSD, oriented boxes (DOTA text) and masks.
    """
    with exit_on_error():
        check_picture_path(out)
        drawn = render_scene(
            gsd,
            width_px=size[0],
            height_px=size[1],
            seed=seed,
            n_vehicles=vehicles,
            mean_vehicle_length_m=fleet,
            layout=cast("Layout | None", layout),
        )
        try:
            written = drawn.write(out)
        except OSError as error:
            raise OutputError(f"cannot write {str(out)!r}: {error.strerror or error}") from error
        n_small = sum(vehicle.kind == "small-vehicle" for vehicle in drawn.vehicles)
        n_large = len(drawn.vehicles) - n_small
        print(
            f"{size[0]} x {size[1]} px at {gsd:g} m/px, {n_small} small and {n_large} large "
            "vehicles:"
        )
        for path in written:
            print(printable(f"  {path}"))


if __name__ == "__main__":
    app(prog_name="python -m research.scenes")
