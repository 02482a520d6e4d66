"""The ruler of docs/how-to/add-a-ruler.md as an installed package: other processes register it, too."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from tests.conftest import ROOT
from tests.docs.documents import blocks
from tests.models import blank_image, paint_vehicles, write_detector

SHAPE = 92.52 / 176.91
LENGTH_PX = 200.0


def track_code() -> str:
    """The module of the how-to."""
    (text,) = (block.text for block in blocks(ROOT / "docs/how-to/add-a-ruler.md") if "class Track" in block.text)
    return text


def install_track(folder: Path) -> dict[str, str]:
    """Install the package in a folder; the environment of a process that finds it there."""
    (entry,) = (
        block.text for block in blocks(ROOT / "docs/how-to/add-a-ruler.md") if '"vehanchor.rulers"' in block.text
    )
    assert entry.splitlines() == ['[project.entry-points."vehanchor.rulers"]', 'track = "tracks:Track"']
    facts = folder / "tracks-1.0.dist-info"
    facts.mkdir(parents=True)
    (folder / "tracks.py").write_text(track_code(), encoding="utf-8")
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: tracks\nVersion: 1.0\n", encoding="utf-8")
    (facts / "entry_points.txt").write_text("[vehanchor.rulers]\ntrack = tracks:Track\n", encoding="utf-8")
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *filter(None, sys.path)])}


def write_track_detector(path: Path) -> Path:
    """A detector that knows running tracks."""
    return write_detector(path, names={0: "small-vehicle", 1: "ground-track-field"})


def write_track(path: Path) -> Path:
    """A photograph of a running track, 200 px long, and of no car."""
    image = blank_image(400, 400)
    paint_vehicles(image, np.array([[200, 200, LENGTH_PX, LENGTH_PX * SHAPE, 0.0]]), classes=[1])
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)
    return path
