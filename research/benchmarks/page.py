"""Measure the page of ``vehanchor view`` in Chromium: ``python -m research.benchmarks.page``.

Prints Markdown; ``--record`` keeps it. A rendered photograph of two megapixels is shifted into
several, so that no result is known before. The first warms the program. Of each other one, three
times are measured from the click on its name: until the photograph is on screen, until its answer
is, and, in a second round, until a measured photograph is shown again. ``--other`` names a checkout
of another commit, whose page takes turns with this one. Needs the extra ``browser``.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

from research.benchmarks.starts import commit_of, environment
from research.results.record import add_record_option, header, recording, spread
from research.scenes import render_scene

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

_ROOT = Path(__file__).parents[2]
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
def viewer(folder: Path, checkout: Path = _ROOT) -> Iterator[str]:
    """Run ``vehanchor view`` of a checkout on a folder, and yield the address of its page."""
    command = [sys.executable, "-m", "vehanchor", "view", str(folder), "--no-browser"]
    variables = environment(checkout)
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=variables) as program:
        assert program.stderr is not None
        try:
            yield program.stderr.readline().split()[1]
        finally:
            program.terminate()


def measure_pages(browser: Any, urls: Sequence[str], names: Sequence[str]) -> list[list[Times]]:
    """Measure all photographs but the first, which is measured when a page opens.

    Args:
        browser: a browser of Playwright.
        urls: addresses of pages, which take turns.
        names: names of their photographs.

    Returns:
        The times of each page.
    """
    pages = [_opened(browser, url) for url in urls]
    # Each photograph is new in the first turn, and measured in the second.
    turns = [
        [[page.evaluate(_CHOOSE, name) for page in pages] for name in names[1:]] for _ in range(2)
    ]
    for page in pages:
        page.close()
    times: list[list[Times]] = [[] for _ in pages]
    for fresh, again in zip(*turns, strict=True):
        for measured, first, second in zip(times, fresh, again, strict=True):
            milliseconds = (first["photograph"], first["answer"], second["photograph"])
            measured.append(Times(*[value / 1000 for value in milliseconds]))
    return times


def _opened(browser: Any, url: str) -> Any:
    """Open a page, and wait for the answer on its first photograph."""
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.goto(url)
    page.locator(".sheet").wait_for()
    return page


def table(times: Sequence[Sequence[Times]]) -> str:
    """Make a table of least, median and largest seconds; of a second page only the medians."""
    columns = ["seconds until", "least", "median", "most", "aim"]
    if len(times) > 1:
        columns += ["other commit: median", "over the other commit's"]
    lines = [header(*columns)]
    for name, aim in _AIMS_S.items():
        own, *others = [[getattr(each, name) for each in of_page] for of_page in times]
        cells = [name, *spread(own), f"{aim:.2f}"]
        for other in others:
            ratios = [mine / theirs for mine, theirs in zip(own, other, strict=True)]
            cells += [f"{statistics.median(other):.2f}", f"{statistics.median(ratios):.2f}"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Command line."""
    from playwright.sync_api import sync_playwright  # extra browser

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photographs", type=int, default=9)
    parser.add_argument("--other", type=Path, help="checkout of another commit")
    options = add_record_option(parser).parse_args()
    checkouts = [_ROOT]
    facts: dict[str, Any] = {"title": "The page: a photograph of two megapixels in Chromium"}
    if options.other is not None:
        checkouts.append(options.other.resolve())
        facts["other_commit"] = commit_of(options.other)
    chromium = os.environ.get("CHROMIUM") or shutil.which("chromium")
    with (
        recording("speed", ["page"], options.record, **facts),
        tempfile.TemporaryDirectory() as name,
        sync_playwright() as playwright,
    ):
        folder = Path(name)
        names = write_photographs(folder, options.photographs + 1)
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        with ExitStack() as running:
            urls = [running.enter_context(viewer(folder, each)) for each in checkouts]
            times = measure_pages(browser, urls, names)
        browser.close()
        print(table(times))


if __name__ == "__main__":
    main()
