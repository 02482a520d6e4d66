"""The documentation builds without a warning and is complete."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import vehanchor
from tests.conftest import ROOT
from tests.needs import needed_module

pytestmark = [pytest.mark.packaging, pytest.mark.timeout(600)]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    needed_module("mkdocs", "pip install -e '.[docs]'")
    folder = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    built = subprocess.run(build, cwd=ROOT, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    return folder


def test_everything_public_is_in_the_reference(site: Path) -> None:
    page = (site / "reference/index.html").read_text(encoding="utf-8")
    # These are documented as methods of an engine.
    names = {"estimate_gsd": "Engine.estimate", "estimate_flight": "Engine.flight"}
    public = {names.get(name, name) for name in vehanchor.__all__} - {"__version__"}
    missing = {name for name in public if not re.search(rf'id="vehanchor\.[\w.]*\b{name}"', page)}
    assert not missing


def test_fields_are_explained_by_the_records_own_descriptions(site: Path) -> None:
    page = (site / "reference/index.html").read_text(encoding="utf-8")
    assert "Chance that the scale is right within 20 %" in page


def test_every_bundled_model_has_its_card(site: Path) -> None:
    page = (site / "models/index.html").read_text(encoding="utf-8")
    cards = list((ROOT / "skill/vehanchor/models/bundled").glob("*.md"))
    assert cards
    for card in cards:
        heading = card.read_text(encoding="utf-8").splitlines()[0]
        title = heading.removeprefix("# Model card: ").strip("`")
        assert title in page


def test_the_site_fetches_nothing_from_elsewhere(site: Path) -> None:
    page = (site / "index.html").read_text(encoding="utf-8")
    assert 'src="http' not in page
    assert 'rel="stylesheet" href="http' not in page
