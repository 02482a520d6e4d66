"""Photographs with a scale bar, and GeoTIFFs in local metres for GIS programs."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from vehanchor.analysis.scale import ScaleAnalysis
    from vehanchor.records import GsdEstimate


def refusal(record: GsdEstimate) -> str | None:
    """Say why the photograph has no single usable scale; None if it has one."""
    if record.scale is None:
        return "there is no scale"
    if record.status != "ok":
        return "the scale is not usable"
    if record.scale.plane is not None:
        return f"the camera was tilted by {record.scale.plane.tilt_deg:.0f} degrees, and the scale varies"
    return None


def write_metric_outputs(analysis: ScaleAnalysis, scale_bar: Path | None, geotiff: Path | None) -> None:
    """Write the photograph with a scale bar, and in full size with the size of its pixels.

    Args:
        analysis: of a photograph with a single usable scale; see ``refusal``.
        scale_bar: picture to write; None for none.
        geotiff: GeoTIFF to write; None for none.

    Raises:
        OutputError: a file cannot be written.
        ImageError: the photograph cannot be read again.
    """
    from vehanchor.export.geotiff import write_metric_copy
    from vehanchor.imagery.sources.opening import open_raster
    from vehanchor.options import Reading
    from vehanchor.pictures.scale import draw_scale_bar, fit_for_eyes, read_reduced, write_picture

    gsd, reading = analysis.estimate.gsd_m_per_px, analysis.reading or Reading()
    assert gsd is not None
    assert analysis.image is not None
    with open_raster(analysis.image, bands=reading.bands, limits=reading.limits) as raster:
        if scale_bar is not None:
            picture = fit_for_eyes(read_reduced(raster))
            draw_scale_bar(picture, gsd * raster.width_px / picture.shape[1])
            write_picture(scale_bar, picture)
        if geotiff is not None:
            write_metric_copy(geotiff, raster, gsd)
