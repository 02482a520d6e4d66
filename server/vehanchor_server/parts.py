"""Parts that the work of a call needs, in a worker or in this process."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from vehanchor_server.images.source import ImageSources
    from vehanchor_server.models import Models
    from vehanchor_server.settings import Settings


@dataclass(frozen=True)
class Parts:
    """Parts that the work of a call needs.

    Attributes:
        settings: the operator's options.
        models: the operator's models.
        sources: image sources.
    """

    settings: Settings
    models: Models
    sources: ImageSources

    @property
    def readable(self) -> tuple[Path, ...] | None:
        """Files and folders that workers may read; None for no confinement.

        Workers with accelerators are unconfined, because drivers need devices, sockets and caches.
        """
        providers = {
            name.strip().lower().removesuffix("executionprovider")
            for name in self.settings.providers
        }
        if self.settings.isolation != "confined" or providers - {"cpu"}:
            return None
        return (*self.settings.roots, *self.models.files())
