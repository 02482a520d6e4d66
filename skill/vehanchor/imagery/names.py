"""Short image names for people."""

from __future__ import annotations

import os
from pathlib import PurePath
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence


def under_one_folder(names: Sequence[str]) -> tuple[str, list[str]]:
    """Split image names into their common folder and the names relative to it.

    Returns:
        The folder and the names; the folder is empty if the images share none.
    """
    try:
        folder = os.path.commonpath([PurePath(name).parent for name in names])
    except ValueError:  # some are absolute and some not
        folder = ""
    folder = "" if folder == "." else folder
    return folder, [os.path.relpath(name, folder) if folder else name for name in names]
