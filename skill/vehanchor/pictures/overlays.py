"""Pictures of many photographs in a folder."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from vehanchor.errors import OutputError
from vehanchor.pictures.scale import write_picture

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True)
class Overlays:
    """Where the pictures of a run lie: as their photographs, in folders of the same names.

    Attributes:
        folder: folder of the pictures.
        root: folder that all photographs share.
    """

    folder: Path
    root: str

    @classmethod
    def of(cls, folder: str | os.PathLike[str], photographs: Iterable[str]) -> Overlays:
        """Place the pictures of photographs, which are named by absolute paths."""
        parents = [Path(photograph).parent for photograph in photographs]
        return cls(Path(folder).absolute(), os.path.commonpath(parents))

    def path(self, photograph: str) -> Path:
        """Return the path of the picture of a photograph."""
        name = os.path.relpath(photograph, self.root)
        return self.folder / f"{name}.overlay.png"

    def write(self, photograph: str, picture: NDArray[np.uint8]) -> None:
        """Write the picture ``[h, w, 3]`` RGB of a photograph.

        Raises:
            OutputError: the picture cannot be written.
        """
        path = self.path(photograph)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"cannot make the folder {str(path.parent)!r}: {error}") from None
        write_picture(path, picture)
