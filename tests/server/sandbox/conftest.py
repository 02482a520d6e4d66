"""A server whose worker is confined."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.server.calls.working import TESTS, ready
from vehanchor_server.services import Services, create_services
from vehanchor_server.settings import Settings


@pytest.fixture(scope="module")
def running(detector_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Services]:
    root = tmp_path_factory.mktemp("root")
    settings = Settings(roots=(root, TESTS), detector=str(detector_path), threads=1, max_concurrency=1)
    services = ready(create_services(settings))
    yield services
    services.close()
