"""Count answers on photographs that are not one view: ``python -m research.benchmarks.views``.

Photographs of known scale (``../shared/data/gsd``) get an inset, are stretched by 1.25 to 1.6 in
one direction, or give a car that is pasted nine times (``research.scenes.composed``). An answer is
mistaken if it is ``ok`` and the scale of a part, or along one axis, is more than 20 % off; a pasted
car, if it is ``ok`` with more than four vehicles. The row ``as they are`` has the photographs
without a change, whose usable scales the doubts may cost.

``--images`` limits the photographs, ``--part`` chooses. Prints Markdown; ``--record`` keeps it.
"""

from __future__ import annotations

import argparse
import random
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from research.results.record import add_record_option, header, recording
from research.scenes.composed import pasted, stretched, with_inset
from vehanchor.analysis.pipeline import analyse_raster
from vehanchor.detection.detector import Detector
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import resolve_model
from vehanchor.options import ScaleOptions
from vehanchor_evaluation.table import survey_table

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.analysis.scale_analysis import ScaleAnalysis

DATA = Path(__file__).resolve().parents[2].parent / "shared/data"
_TABLES = ("table.csv", "upright.csv")
_PARTS = ("as they are", "inset", "stretched", "pasted")
_LARGEST_ERROR = 0.2
_MOST_OF_PASTED = 4
_SEED = 64
# Longest side of what is used of a photograph.
_SIDE_PX = 1600


class Case(NamedTuple):
    """Image with the scales that are true in it.

    Attributes:
        kind: row of the table.
        image: ``[h, w, 3]`` RGB.
        scales: metres per pixel in its parts or along its axes.
    """

    kind: str
    image: NDArray[np.uint8]
    scales: tuple[float, ...]


class Count(NamedTuple):
    """Answers of one row: images, usable ones, mistaken ones of these."""

    n: int = 0
    ok: int = 0
    mistaken: int = 0


class Views:
    """Answers on changed photographs."""

    def __init__(self, data: Path, n_images: int) -> None:
        """Load the detector, and choose photographs of the split val.

        Args:
            data: folder of the shared data.
            n_images: most photographs.
        """
        self._detector = Detector(resolve_model(None), runtime=Runtime(threads=1))
        options = ScaleOptions()
        # The truth of some photographs follows from their metadata.
        self._options = replace(options, rulers=replace(options.rulers, metadata=False))
        items = []
        for table in _TABLES:
            images = survey_table(data / "gsd" / table).images
            items += [item for item in images if item.split == "val"]
        random.Random(_SEED).shuffle(items)
        self._items = items[:n_images]

    def counts(self, parts: Sequence[str]) -> dict[str, Count]:
        """Answer the images of some parts, by rows."""
        counts: dict[str, Count] = {}
        for number in range(len(self._items)):
            for part in parts:
                for case in self._cases(part, number):
                    before = counts.get(case.kind, Count())
                    counts[case.kind] = self._plus(before, case)
        return counts

    def _pixels(self, number: int) -> NDArray[np.uint8]:
        with open_raster(self._items[number].path) as raster:
            return raster.read()[:_SIDE_PX, :_SIDE_PX].copy()

    def _analysed(self, image: NDArray[np.uint8]) -> ScaleAnalysis:
        with open_raster(image) as raster:
            return analyse_raster(self._detector, raster, self._options)

    def _cases(self, part: str, number: int) -> Iterator[Case]:
        """Change a photograph; a photograph without a clear car gives none to paste."""
        photograph = self._pixels(number)
        gsd = self._items[number].gsd_m_per_px
        rng = random.Random(f"{_SEED} {part} {number}")
        if part == "as they are":
            yield Case(part, photograph, (gsd,))
        elif part == "inset":
            other = rng.randrange(len(self._items))
            composed = with_inset(photograph, self._pixels(other), rng)
            kind = "inset with a frame" if composed.frame_px else "inset without a frame"
            inset_gsd = self._items[other].gsd_m_per_px / composed.reduction
            yield Case(kind, composed.image, (gsd, inset_gsd))
        elif part == "stretched":
            changed = stretched(photograph, rng)
            yield Case(part, changed.image, (gsd / changed.across, gsd / changed.down))
        else:
            vehicles = self._analysed(photograph).vehicles
            if vehicles is None or not vehicles.n:
                return
            image = pasted(photograph, vehicles.fleet.detections.boxes[0], rng)
            if image is not None:
                yield Case(part, image, ())

    def _plus(self, count: Count, case: Case) -> Count:
        """Answer one image, and count it."""
        estimate = self._analysed(case.image).estimate
        is_ok = estimate.status == "ok"
        is_wrong = not case.scales and (estimate.n_vehicles or 0) > _MOST_OF_PASTED
        for scale in case.scales:
            gsd = estimate.gsd_m_per_px
            is_wrong |= gsd is not None and abs(gsd / scale - 1) > _LARGEST_ERROR
        return Count(count.n + 1, count.ok + is_ok, count.mistaken + (is_ok and is_wrong))


def report(counts: dict[str, Count]) -> list[str]:
    """Tabulate the answers."""
    lines = [header("photographs", "n", "ok", "of these mistaken")]
    for kind in sorted(counts):
        lines.append(f"| {kind} | {' | '.join(map(str, counts[kind]))} |")
    return lines


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--images", type=int, default=120)
    parser.add_argument("--part", choices=_PARTS, action="append")
    options = add_record_option(parser).parse_args()
    views = Views(DATA, options.images)
    with recording("detection", ["views"], options.record):
        print("\n".join(report(views.counts(options.part or _PARTS))) + "\n", flush=True)


if __name__ == "__main__":
    main()
