"""The file that ``vehanchor calibrate`` writes; the library only reads it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from vehanchor.storage.atomic import whole_file

if TYPE_CHECKING:
    import os

    from vehanchor.scale.calibration import Calibration


def save_calibration(path: str | os.PathLike[str], calibration: Calibration) -> None:
    """Write a calibration as JSON.

    Raises:
        OutputError: the file cannot be written.
    """
    with whole_file(Path(path)) as partial:
        partial.write_text(calibration.model_dump_json(indent=2) + "\n", encoding="utf-8")
