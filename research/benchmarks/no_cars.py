"""Count answers on rendered pictures without whole cars: ``python -m research.benchmarks.no_cars``.

``--set`` chooses:

* ``look-alikes``: rows and scatters of equal things that are not cars, such as graves, boats and
  carts (``research.scenes.look_alikes``). Every ``ok`` is a mistake, even if its value is near the
  truth by chance;
* ``small-vehicles``: the same of karts, scooters and other small vehicles, which are the hardest
  (``research.scenes.small_vehicles``);
* ``covered``: cars that the edge of a canopy, of a bridge or of a shadow cuts, half of the scenes
  with further cars in the open (``research.scenes.covered``).

Prints Markdown; ``--record`` keeps it.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, NamedTuple

from research.results.record import add_record_option, header, recording
from research.scenes.covered import covered
from research.scenes.look_alikes import look_alikes
from research.scenes.small_vehicles import SMALL_VEHICLES
from vehanchor import analyse_scale
from vehanchor.detection.detector import Detector
from vehanchor.models.zoo import resolve_model

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import numpy as np
    from numpy.typing import NDArray

    from research.scenes.look_alikes import LookAlikes

_HIGH_ERROR = 0.2


class Picture(NamedTuple):
    """Picture without cars.

    Attributes:
        name: its name.
        kind: row of the table that counts it.
        image: ``[h, w, 3]`` uint8 RGB.
        gsd_m_per_px: its scale; None for a picture that has none.
    """

    name: str
    kind: str
    image: NDArray[np.uint8]
    gsd_m_per_px: float | None


def pictures_of_look_alikes() -> Iterator[Picture]:
    """Render the recorded scenes of look-alikes."""
    yield from _pictures(look_alikes())


def pictures_of_small_vehicles() -> Iterator[Picture]:
    """Render the recorded scenes of small vehicles."""
    yield from _pictures(look_alikes(SMALL_VEHICLES))


def _pictures(scenes: Iterator[LookAlikes]) -> Iterator[Picture]:
    """Take the pictures of scenes."""
    for rendered in scenes:
        scene = rendered.scene
        yield Picture(rendered.name, rendered.kind, scene.image, gsd_m_per_px=scene.gsd_m_per_px)


def pictures_of_covered_cars() -> Iterator[Picture]:
    """Render the recorded scenes of cars that an edge cuts."""
    for rendered in covered():
        scene = rendered.scene
        yield Picture(rendered.name, rendered.cover, scene.image, gsd_m_per_px=scene.gsd_m_per_px)


SETS: dict[str, Callable[[], Iterator[Picture]]] = {
    "look-alikes": pictures_of_look_alikes,
    "small-vehicles": pictures_of_small_vehicles,
    "covered": pictures_of_covered_cars,
}


class Count(NamedTuple):
    """Answers on the pictures of one kind.

    Attributes:
        n: number of pictures.
        with_vehicles: pictures in which something was taken for a vehicle.
        ok: usable answers.
        wrong: usable answers that are more than 20 % off, or whose picture has no scale.
    """

    n: int = 0
    with_vehicles: int = 0
    ok: int = 0
    wrong: int = 0

    def plus(self, other: Count) -> Count:
        """Add the counts of another kind."""
        sums = [mine + others for mine, others in zip(self, other, strict=True)]
        return Count(*sums)


def count_of(picture: Picture, detector: Detector) -> Count:
    """Answer one picture."""
    estimate = analyse_scale(picture.image, detector=detector).estimate
    is_ok = estimate.status == "ok"
    is_wrong = is_ok and _is_wrong(estimate.gsd_m_per_px, picture.gsd_m_per_px)
    return Count(
        n=1, with_vehicles=int(bool(estimate.n_vehicles)), ok=int(is_ok), wrong=int(is_wrong)
    )


def _is_wrong(gsd_m_per_px: float | None, truth: float | None) -> bool:
    if truth is None or gsd_m_per_px is None:
        return True
    return abs(gsd_m_per_px / truth - 1) > _HIGH_ERROR


def report(pictures: Iterator[Picture], detector: Detector) -> list[str]:
    """Tabulate the answers by kind."""
    counts: dict[str, Count] = {}
    for picture in pictures:
        before = counts.get(picture.kind, Count())
        counts[picture.kind] = before.plus(count_of(picture, detector))
    total = Count()
    for count in counts.values():
        total = total.plus(count)
    lines = [header("pictures", "n", "with vehicles", "ok", "of these mistaken")]
    for kind, count in (*counts.items(), ("all", total)):
        cells = [kind, *map(str, count)]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--set", choices=sorted(SETS), action="append")
    parser.add_argument("--detector")
    options = add_record_option(parser).parse_args()
    detector = Detector(resolve_model(options.detector))
    for name in options.set or sorted(SETS):
        key = name.replace("-", "_")
        model = {detector.card.name: detector.card.sha256}
        with recording("detection", [key], options.record, model=model):
            print("\n".join(report(SETS[name](), detector)) + "\n", flush=True)


if __name__ == "__main__":
    main()
