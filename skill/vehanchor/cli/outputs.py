"""Files that a command writes beside its result, by the names of their options."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.sources.files import canonical_path
from vehanchor.storage.atomic import check_output_path

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from vehanchor.analysis.scale_analysis import ScaleAnalysis

# GeoJSON files.
_SHAPES = ("boxes", "line", "outline")
# Files in metres, which need one usable scale for the whole photograph.
_METRIC = ("scale_bar", "geotiff")


def check_outputs(images: Iterable[str], outputs: Iterable[tuple[str, Path]]) -> None:
    """Check, before the work, suffixes, folders and conflicts of output files.

    Args:
        images: inputs, which no output may replace.
        outputs: files with the names of their options.

    Raises:
        OutputError: a suffix is wrong, or a folder does not exist.
        InvalidParameterError: a file is an image, or is named twice.
        MissingExtraError: matplotlib or rasterio is not installed.
    """
    inputs = {canonical_path(source) for source in images}
    targets: set[str] = set()
    for name, path in outputs:
        _check_output(name, path)
        target = canonical_path(path)
        if target in inputs:
            raise InvalidParameterError(
                f"{str(path)!r} is one of the images: writing there would destroy it"
            )
        if target in targets:
            raise InvalidParameterError(
                f"two files would both be written to {str(path)!r}: choose other names"
            )
        targets.add(target)


def _check_output(name: str, path: Path) -> None:
    """Check suffix and folder of one file, and the packages that write it."""
    check: Callable[[Path], object]
    if name in _SHAPES:
        from vehanchor.export.geojson import check_geojson_path as check
    elif name == "geotiff":
        from vehanchor.export.geotiff import check_copy_path as check
    else:
        from vehanchor.pictures.scale import check_picture_path as check
    check(path)
    if name == "mask":
        check_output_path(path, (".png",), kind="a mask", also="it is lossless")
    if name == "plot":
        from vehanchor.pictures.plot import require_plots

        require_plots()


def write_outputs(analysis: Any, outputs: Mapping[str, Path]) -> tuple[list[Path], str | None]:
    """Write the files of an analysis.

    Args:
        analysis: a ``ScaleAnalysis``, ``AreaAnalysis`` or ``DistanceAnalysis``.
        outputs: files by the names of their options, checked by ``check_outputs``.

    Returns:
        The files that were written; why those in metres were not, None if all were.

    Raises:
        OutputError: a file cannot be written.
        ImageError: the photograph cannot be read again.
    """
    from vehanchor.export.geojson import write_shapes
    from vehanchor.export.resample import why_not_resampled
    from vehanchor.pictures.scale import write_picture

    for name, path in outputs.items():
        if name == "overlay":
            write_picture(path, analysis.overlay())
        elif name in _SHAPES:
            write_shapes(path, analysis)
        elif name == "mask":
            mask = analysis.full_mask()
            rgb_mask = mask[:, :, None].repeat(3, axis=2)
            write_picture(path, rgb_mask.view("uint8") * 255)
        elif name == "plot":
            from vehanchor.pictures.plot import write_plot

            write_plot(path, analysis.plot())
    metric = {}
    for name in _METRIC:
        if name in outputs:
            metric[name] = outputs[name]
    if not metric:
        return list(outputs.values()), None
    why_refused = why_not_resampled(analysis.estimate)
    if why_refused is None:
        _write_metric(analysis, metric)
        return list(outputs.values()), None
    written = [path for name, path in outputs.items() if name not in _METRIC]
    return written, why_refused


def _write_metric(analysis: ScaleAnalysis, outputs: Mapping[str, Path]) -> None:
    """Write the photograph with a scale bar, and in full size with the size of its pixels."""
    from vehanchor.export.geotiff import write_metric_copy
    from vehanchor.imagery.sources.opening import open_raster
    from vehanchor.pictures.scale import draw_scale_bar, fit_for_eyes, read_reduced, write_picture

    gsd = analysis.estimate.gsd_m_per_px
    assert gsd is not None
    assert analysis.image is not None
    with open_raster(analysis.image, analysis.reading) as raster:
        if "scale_bar" in outputs:
            picture = fit_for_eyes(read_reduced(raster))
            picture_gsd = gsd * raster.width_px / picture.shape[1]
            draw_scale_bar(picture, picture_gsd)
            write_picture(outputs["scale_bar"], picture)
        if "geotiff" in outputs:
            write_metric_copy(outputs["geotiff"], raster, gsd)
