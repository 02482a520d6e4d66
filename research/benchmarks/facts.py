"""Measure how far a measured line that is wrong is believed against the cars.

``python -m research.benchmarks.facts [--images N]``. Prints Markdown; ``--record`` keeps it.

Each val image of known scale is searched once. A line across it is then given as measured: with its
right length, and 1.5 times too long or too short. A lie must not make an answer that is ``ok`` and
more than 20 % off; a truth must lead.
"""

from __future__ import annotations

import argparse
import random
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from research.results.record import add_record_option, recording
from vehanchor.analysis.pipeline import analyse_view, search_raster
from vehanchor.detection.detector import Detector
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import resolve_model
from vehanchor.options import KnownLength, ScaleOptions
from vehanchor_evaluation.table import survey_table

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from vehanchor.records import GsdEstimate
    from vehanchor.rulers.ruler import View

DATA = Path(__file__).resolve().parents[2].parent / "shared/data"
_TABLES = ("table.csv", "upright.csv")
# Factors on the right length of the line.
_LIES = (1.5, 1 / 1.5)
_TRUTH = 1.0
_LARGEST_ERROR = 0.2
_LEADING_ERROR = 0.03
# Fewest and most cars of a row of the table.
_GROUPS = {"1 to 4": (1, 4), "5 and more": (5, 10_000)}
_SEED = 3


class Outcome(NamedTuple):
    """Answers about one image.

    Attributes:
        alone: without a line.
        lies: with each line that is wrong.
        truth: with the right line.
        true_gsd: the true scale.
    """

    alone: GsdEstimate
    lies: tuple[GsdEstimate, ...]
    truth: GsdEstimate
    true_gsd: float


def measure_images(data: Path, n_images: int) -> Iterable[Outcome]:
    """Search val images, and measure each with and without lines."""
    detector = Detector(resolve_model(None), runtime=Runtime(threads=1))
    items = []
    for table in _TABLES:
        images = survey_table(data / "gsd" / table).images
        items += [item for item in images if item.split == "val"]
    random.Random(_SEED).shuffle(items)
    options = ScaleOptions()
    for item in items[:n_images]:
        with open_raster(item.path, options.reading) as raster:
            view = search_raster(raster, detector, options)
            alone = analyse_view(view).estimate
            lies = [_with_line(view, item.gsd_m_per_px * factor) for factor in _LIES]
            truth = _with_line(view, item.gsd_m_per_px * _TRUTH)
        yield Outcome(alone, tuple(lies), truth, item.gsd_m_per_px)


def _with_line(view: View, gsd_m_per_px: float) -> GsdEstimate:
    """Measure a view with a measured line across it that has this scale."""
    width_px = view.image.width_px
    y_px = 0.5 * view.image.height_px
    x1_px = 0.2 * width_px
    x2_px = 0.8 * width_px
    metres = (x2_px - x1_px) * gsd_m_per_px
    line = KnownLength(x1_px, y_px, x2_px, y_px, metres, "measured")
    rulers = replace(view.options.rulers, known_lengths=(line,))
    options = replace(view.options, rulers=rulers)
    return analyse_view(replace(view, options=options)).estimate


def _is_ok_within(estimate: GsdEstimate, true_gsd: float, largest_error: float) -> bool:
    """Test whether a scale is ``ok`` and has at most this relative error."""
    if estimate.status != "ok" or estimate.gsd_m_per_px is None:
        return False
    return abs(estimate.gsd_m_per_px / true_gsd - 1) <= largest_error


def row(name: str, outcomes: Sequence[Outcome]) -> str:
    """Format a row of the table."""
    n_lies = 0
    n_wrong = 0
    n_wrong_against_sure = 0
    n_right = 0
    for outcome in outcomes:
        for lie in outcome.lies:
            n_lies += 1
            is_right = _is_ok_within(lie, outcome.true_gsd, _LARGEST_ERROR)
            is_wrong = lie.status == "ok" and not is_right
            n_right += is_right
            n_wrong += is_wrong
            n_wrong_against_sure += is_wrong and outcome.alone.status == "ok"
    leads = [_is_ok_within(outcome.truth, outcome.true_gsd, _LEADING_ERROR) for outcome in outcomes]
    cells = [name, n_lies, n_wrong, n_wrong_against_sure, n_right, len(outcomes), sum(leads)]
    return f"| {' | '.join(map(str, cells))} |"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--images", type=int, default=120)
    options = add_record_option(parser).parse_args()
    outcomes = list(measure_images(options.data, options.images))
    with recording("rulers", ["facts"], options.record):
        print(
            "| cars | lies | ok and wrong | of these, cars alone are ok | ok and right | truths "
            "| lead |"
        )
        print("|---|---|---|---|---|---|---|")
        for name, (fewest, most) in _GROUPS.items():
            group = [
                outcome for outcome in outcomes if fewest <= (outcome.alone.n_vehicles or 0) <= most
            ]
            print(row(name, group))


if __name__ == "__main__":
    main()
