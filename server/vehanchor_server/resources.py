"""Resources: the settings, models and image sources that the work of a call uses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from vehanchor_server.images.fetch import Fetcher
from vehanchor_server.images.path_access import PathAccess
from vehanchor_server.images.source import ImageSources
from vehanchor_server.models import Models

if TYPE_CHECKING:
    from pathlib import Path

    from vehanchor_server.settings import Settings


@dataclass(frozen=True)
class Resources:
    """Settings, models and image sources; the server and each of its workers have their own.

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
        uses_accelerator = bool(providers - {"cpu"})
        if self.settings.isolation != "confined" or uses_accelerator:
            return None
        return (*self.settings.roots, *self.models.files())


def create_resources(settings: Settings) -> Resources:
    """Create the resources of a server or a worker without loading a model."""
    sources = ImageSources(
        paths=PathAccess(settings.roots, settings.spelled_roots),
        fetcher=Fetcher(settings.image_hosts, settings.image_limits.max_bytes),
    )
    return Resources(settings, Models(settings), sources=sources)
