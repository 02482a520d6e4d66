"""``vehanchor scalebar``: photograph with a scale bar, and a GeoTIFF for GIS programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vehanchor.cli.cli_options import ParsedOptions, Photograph, scale_command
from vehanchor.cli.given_scale import GivenGsd, ScaleFile, read_scale
from vehanchor.cli.terminal import NOT_OK, exit_on_error, facts_table, print_table, scale_text, tile_progress
from vehanchor.storage.atomic import check_apart

if TYPE_CHECKING:
    from vehanchor.measure.resolved_scale import ResolvedScale


@scale_command()
def scalebar(
    image: Photograph,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="OUT.png", help="Picture to write, .png or .jpg.")],
    geotiff: Annotated[
        Path | None,
        typer.Option(
            metavar="OUT.tif", help="Write the photograph in full size, without the bar, as a GeoTIFF in local metres."
        ),
    ] = None,
    gsd: GivenGsd = None,
    scale: ScaleFile = None,
    *,
    chosen: ParsedOptions,
) -> None:
    """Write the photograph with a scale bar; nothing when the photograph has no single usable scale (status 3)."""
    with exit_on_error():
        from vehanchor.export.geotiff import check_copy_path, write_metric_copy
        from vehanchor.imagery.sources.opening import open_raster
        from vehanchor.measure.resolved_scale import given_scale, resolve_scale
        from vehanchor.pictures.scale import (
            check_picture_path,
            draw_scale_bar,
            fit_for_eyes,
            read_reduced,
            write_picture,
        )

        for path in (check_picture_path(output), None if geotiff is None else check_copy_path(geotiff)):
            if path is not None:
                check_apart(path, image)
        options, known = chosen.options(), read_scale(scale, image)
        given = given_scale(gsd, known, options)
        with tile_progress(1, lines_on_terminal=False) as step:
            source = chosen.engine(progress=step(0, image)).detector if given is None else given
            with open_raster(image, bands=options.reading.bands, limits=options.reading.limits) as raster:
                found = resolve_scale(raster, source, options)
                if found.gsd_m_per_px is None or found.status != "ok" or found.plane is not None:
                    typer.echo(f"no bar: {_refusal(found)}; nothing was written", err=True)
                    raise typer.Exit(NOT_OK)
                picture = fit_for_eyes(read_reduced(raster))
                width_px = raster.width_px
                if geotiff is not None:
                    write_metric_copy(geotiff, raster, found.gsd_m_per_px)
        drawn_gsd = found.gsd_m_per_px * width_px / picture.shape[1]
        draw_scale_bar(picture, drawn_gsd)
        write_picture(output, picture)
        written = [output, geotiff]
        confidence = "as given" if found.confidence is None else f"{found.confidence:.2f}"
        facts = [("scale", scale_text(found.gsd_m_per_px, None, None)), ("confidence", confidence)]
        facts.extend(("written", str(path)) for path in written if path is not None)
        print_table(facts_table(image, facts))


def _refusal(found: ResolvedScale) -> str:
    if found.status == "ok" and found.plane is not None:
        return f"the camera was tilted by {found.plane.tilt_deg:.0f} degrees, and the scale varies"
    return "there is no scale" if found.status == "no_scale" else "the scale's confidence is below 0.5"
