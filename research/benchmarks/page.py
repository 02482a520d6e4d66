"""Measure the page of ``vehanchor view`` in Chromium: ``python -m research.benchmarks.page``.

Prints Markdown; ``--record`` keeps it. A rendered photograph of two megapixels is shifted into
several, so that no result is known before. The first warms the program. Of each other one, three
times are measured from the click on its name: until the photograph is on screen, until its answer
is, and, in a second round, until a measured photograph is shown again. Needs the extra ``browser``.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

from research.results.record import add_record_option, header, recording
from research.scenes import render_scene

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

_SIZE_PX = (1632, 1224)
_GSD_M_PER_PX = 0.1
# Seconds that we aim for, on two quiet cores.
_AIMS_S = {"photograph": 0.5, "answer": 1.5, "switch": 0.1}
_SHIFT_PX = 37

# Choose a photograph; milliseconds until something of it, and until its answer, is painted.
_CHOOSE = """async (name) => {
  const painted = () => new Promise((done) => requestAnimationFrame(() => setTimeout(done)));
  const began = performance.now();
  const until = async (holds) => {
    do await painted(); while (!holds());
    return performance.now() - began;
  };
  const listed = [...document.querySelectorAll("#photographs button")];
  listed.find((button) => button.textContent === name).click();
  const images = () => [...document.querySelectorAll("main .preview, main .sheet > img")];
  const photograph = await until(() => images().some((image) => image.naturalWidth));
  const panel = document.getElementById("panel");
  const answer = await until(() => panel.getAttribute("aria-busy") === "false");
  return { photograph, answer };
}"""


class Times(NamedTuple):
    """Seconds from a click on a photograph's name.

    Attributes:
        photograph: until it is on screen.
        answer: until its answer is.
        switch: until it is shown again, once it is measured.
    """

    photograph: float
    answer: float
    switch: float


def write_photographs(folder: Path, count: int) -> list[str]:
    """Write photographs of two megapixels, and return their names."""
    width_px, height_px = _SIZE_PX
    scene = render_scene(_GSD_M_PER_PX, width_px=width_px, height_px=height_px, seed=3)
    names = []
    for number in range(count):
        name = f"{number:02}.jpg"
        shifted = np.roll(scene.image, number * _SHIFT_PX, axis=1)
        cv2.imwrite(str(folder / name), shifted[:, :, ::-1])
        names.append(name)
    return names


@contextmanager
def viewer(folder: Path) -> Iterator[str]:
    """Run ``vehanchor view`` on a folder, and yield the address of its page."""
    command = [sys.executable, "-m", "vehanchor", "view", str(folder), "--no-browser"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as program:
        assert program.stderr is not None
        try:
            yield program.stderr.readline().split()[1]
        finally:
            program.terminate()


def measure_page(browser: Any, url: str, names: Sequence[str]) -> list[Times]:
    """Measure all photographs but the first, which is measured when the page opens.

    Args:
        browser: a browser of Playwright.
        url: address of the page.
        names: names of its photographs.
    """
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.goto(url)
    page.locator(".sheet").wait_for()
    fresh = [page.evaluate(_CHOOSE, name) for name in names[1:]]
    again = [page.evaluate(_CHOOSE, name) for name in names[1:]]
    page.close()
    times = []
    for first, second in zip(fresh, again, strict=True):
        seconds = [first["photograph"], first["answer"], second["photograph"]]
        times.append(Times(*[value / 1000 for value in seconds]))
    return times


def table(times: Sequence[Times]) -> str:
    """Make a table of least, median and largest seconds."""
    lines = [header("seconds until", "least", "median", "most", "aim")]
    for name, aim in _AIMS_S.items():
        values = [getattr(each, name) for each in times]
        cells = [min(values), statistics.median(values), max(values), aim]
        lines.append(f"| {name} | {' | '.join(f'{value:.2f}' for value in cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Command line."""
    from playwright.sync_api import sync_playwright  # extra browser

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photographs", type=int, default=9)
    options = add_record_option(parser).parse_args()
    chromium = os.environ.get("CHROMIUM") or shutil.which("chromium")
    title = "The page: a photograph of two megapixels in Chromium"
    with (
        recording("speed", ["page"], options.record, title=title),
        tempfile.TemporaryDirectory() as name,
        sync_playwright() as playwright,
    ):
        folder = Path(name)
        names = write_photographs(folder, options.photographs + 1)
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        with viewer(folder) as url:
            times = measure_page(browser, url, names)
        browser.close()
        print(table(times))


if __name__ == "__main__":
    main()
