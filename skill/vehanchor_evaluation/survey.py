"""Images of known scale from one source: a split of DOTA, a table, or georeferenced files."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.errors import InvalidParameterError
from vehanchor_evaluation.dota import survey_dota
from vehanchor_evaluation.geotiff import survey_geotiffs
from vehanchor_evaluation.table import survey_table

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from vehanchor_evaluation.known_scale import KnownScaleImage, KnownScaleSet


def survey_known_scale(
    *,
    dota: Path | None = None,
    table: Path | None = None,
    geotiff: Sequence[Path] = (),
    labels: Path | None = None,
    set_name: str | None = None,
    split: str | None = None,
    limit: int | None = None,
) -> KnownScaleSet:
    """Find images of known scale.

    Args:
        dota: folder of a split of DOTA.
        table: CSV with the columns ``file`` and ``gsd_m_per_px``.
        geotiff: georeferenced files, or folders of them.
        labels: folder of DOTA's labels; None for the latest.
        set_name: only this set of the table.
        split: only this split of the table.
        limit: only the first images, up to this number.

    Returns:
        The images of known scale, possibly none; the issues give the reasons.

    Raises:
        InvalidParameterError: there is not exactly one source, the source is invalid, or the set
            and split have no image.
    """
    is_given = [dota is not None, table is not None, bool(geotiff)]
    if is_given.count(True) != 1:
        raise InvalidParameterError(
            "give the images with one of --dota DIR, --table FILE and --geotiff FILES"
        )
    if dota is not None:
        data = survey_dota(dota, labels)
    elif table is not None:
        data = survey_table(table)
    else:
        data = survey_geotiffs(geotiff)
    selection = data.select(set_name=set_name, split=split, limit=limit)
    if data.images and not selection.images:
        sets = {_set_text(image) for image in data.images}
        available = ", ".join(sorted(sets))
        raise InvalidParameterError(
            f"no image of set {set_name!r} and split {split!r}; the table has {available}"
        )
    return selection


def _set_text(image: KnownScaleImage) -> str:
    set_name = image.set or "-"
    split = image.split or "-"
    return f"{set_name} ({split})"
