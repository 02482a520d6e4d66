"""Shared parts of one server: its options, models, images and places for calls."""

from __future__ import annotations

import os
from dataclasses import dataclass

from vehanchor_server.calls.capacity import Capacity
from vehanchor_server.images.fetch import Fetcher
from vehanchor_server.images.sandbox import Sandbox
from vehanchor_server.images.source import ImageSources
from vehanchor_server.models import Models
from vehanchor_server.settings import Settings

__all__ = ["Services", "create_services"]


@dataclass(frozen=True)
class Services:
    """Everything that tools work with; one for each server.

    Attributes:
        settings: the operator's options.
        models: the operator's models.
        sources: where images come from.
        capacity: how much runs at once.
    """

    settings: Settings
    models: Models
    sources: ImageSources
    capacity: Capacity


def create_services(settings: Settings) -> Services:
    """Make the parts of a server; nothing is loaded yet."""
    max_bytes = settings.image_limits.max_bytes
    return Services(
        settings=settings,
        models=Models(settings),
        sources=ImageSources(
            sandbox=Sandbox(settings.roots, settings.spelled_roots),
            fetcher=Fetcher(settings.image_hosts, max_bytes, settings.fetch_timeout_s),
            max_bytes=max_bytes,
        ),
        capacity=Capacity(settings.max_concurrency or _default_concurrency(), settings.deadline_s),
    )


def _default_concurrency() -> int:
    """One call for each CPU, and two at least."""
    return max(2, os.cpu_count() or 1)
