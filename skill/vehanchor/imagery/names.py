"""Images' names as people read them."""

from __future__ import annotations

import os
from pathlib import PurePath
from typing import TYPE_CHECKING

from vehanchor.imagery.sources.addresses import is_address

if TYPE_CHECKING:
    from collections.abc import Sequence


def under_one_folder(names: Sequence[str]) -> tuple[str, list[str]]:
    """Shorten images' names for people: the folder that all of them lie in, and each name below it.

    Args:
        names: as records have them.

    Returns:
        The folder, empty where there is none but the current or where one is an address, and the names.
    """
    if any(map(is_address, names)):
        return "", list(names)
    try:
        folder = os.path.commonpath([PurePath(name).parent for name in names])
    except ValueError:  # some are absolute and some not
        folder = ""
    folder = "" if folder == "." else folder
    return folder, [os.path.relpath(name, folder) if folder else name for name in names]
