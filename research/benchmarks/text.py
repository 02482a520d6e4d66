"""Ask for the scale of lettering: ``python -m research.benchmarks.text``.

Two kinds of pictures, from the generators ``research.scenes.pages`` and
``research.scenes.captions``:

* pages, charts, slides, maps, windows, plans and icons, which are no photographs: none has a scale;
* captions, labels, displays, marks and markers over photographs: the scale of the bare photograph
  stays, and where that has none, lettering gives none. The mirrored photograph shows how far the
  scale of equal content moves.

``--record`` keeps the tables, ``--seed`` draws others. The photographs are those of
``VEHANCHOR_DATA``, half of the unlabelled ones and the val split; without the folder, rendered
scenes stand in. Fonts are those of this machine; ``--fonts held-out`` takes those that training
left out.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import zlib
from collections.abc import Iterator
from itertools import cycle, islice
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from research.results.record import add_record_option, header, recording
from research.scenes.captions import CAPTIONS
from research.scenes.lettering import Picture, is_held_out, own_fonts, system_fonts
from research.scenes.pages import PAGES, Fonts
from vehanchor import GsdEstimate, estimate_gsd

DATA = Path(os.environ.get("VEHANCHOR_DATA", "../shared/data"))
_SEED = 7_000
# Largest difference of the scale with a caption from that without.
_SAME_SCALE = 0.02


class Lettering(NamedTuple):
    """Picture with lettering.

    Attributes:
        name: its number.
        kind: layout of the lettering.
        image: the picture.
        bare: the photograph without lettering; None for a picture that is no photograph.
    """

    name: str
    kind: str
    image: Picture
    bare: Picture | None = None


class Answered(NamedTuple):
    """Answers to a picture with lettering.

    Attributes:
        lettering: the picture.
        estimate: its answer.
        bare: answer to the photograph without lettering; None for a picture without a photograph.
        mirrored: answer to the bare photograph, left and right exchanged; None if the bare one is
            not usable.
    """

    lettering: Lettering
    estimate: GsdEstimate
    bare: GsdEstimate | None
    mirrored: GsdEstimate | None


def pages(count: int, fonts: Fonts, seed: int = _SEED) -> Iterator[Lettering]:
    """Draw pictures that are no photographs, kinds in turn."""
    for number, (kind, draw) in enumerate(islice(cycle(PAGES.items()), count)):
        rng = np.random.default_rng([seed, number])
        yield Lettering(f"{kind} {number}", kind, draw(rng, fonts))


def captions(
    count: int, fonts: Fonts, photographs: list[Path], seed: int = _SEED
) -> Iterator[Lettering]:
    """Draw over photographs, kinds in turn."""
    for number, (kind, draw) in enumerate(islice(cycle(CAPTIONS.items()), count)):
        rng = np.random.default_rng([seed, number])
        path = photographs[number % len(photographs)]
        bare = np.asarray(cv2.imread(str(path), cv2.IMREAD_COLOR), np.uint8)
        rgb = np.ascontiguousarray(bare[:, :, ::-1])
        yield Lettering(f"{kind} {number} {path.name}", kind, draw(rgb, rng, fonts), rgb)


def photographs_to_draw_on(data: Path) -> list[Path]:
    """List photographs of known places in a random order; training draws on others."""
    files = [path for path in (data / "unlabelled").rglob("*.jpg") if not _is_for_training(path)]
    with (data / "gsd" / "table.csv").open(newline="") as handle:
        rows = [row for row in csv.DictReader(handle) if row["split"] == "val"]
    files += [(data / "gsd" / row["file"]).resolve() for row in rows]
    return sorted(files, key=_checksum)


def _checksum(path: Path) -> int:
    return zlib.crc32(path.name.encode())


def _is_for_training(path: Path) -> bool:
    return _checksum(path) % 2 == 0


def answers(pictures: Iterator[Lettering]) -> Iterator[Answered]:
    """Ask for the scale of each picture, and of the photograph below."""
    for picture in pictures:
        bare = None
        mirrored = None
        if picture.bare is not None:
            bare = estimate_gsd(picture.bare)
            if bare.status == "ok":
                mirrored = estimate_gsd(np.ascontiguousarray(picture.bare[:, ::-1]))
        yield Answered(picture, estimate_gsd(picture.image), bare, mirrored)


def page_report(answered: list[Answered]) -> list[str]:
    """Count the pictures without a photograph by status."""
    lines = [header("picture", "n", "ok", "low confidence", "no scale", "stated as no photograph")]
    kinds = list(dict.fromkeys(answer.lettering.kind for answer in answered))
    for kind in [*kinds, "all"]:
        of_kind = [a.estimate for a in answered if kind in (a.lettering.kind, "all")]
        counts = [sum(e.status == s for e in of_kind) for s in ("ok", "low_confidence", "no_scale")]
        stated = sum(e.reason == "no_photograph" for e in of_kind)
        lines.append(f"| {kind} | {len(of_kind)} | {' | '.join(map(str, counts))} | {stated} |")
    return lines


def caption_report(answered: list[Answered]) -> list[str]:
    """Compare photographs with and without lettering."""
    columns = ("lettering", "n", "bare ok", "ok of these", "within 2 % of these")
    lines = [header(*columns, "within 2 % if only mirrored", "ok of the others")]
    kinds = list(dict.fromkeys(answer.lettering.kind for answer in answered))
    for kind in [*kinds, "all"]:
        of_kind = [a for a in answered if kind in (a.lettering.kind, "all")]
        usable = [a for a in of_kind if a.bare and a.bare.status == "ok"]
        both = [a for a in usable if a.estimate.status == "ok"]
        same = [a for a in both if _difference(a.estimate, a.bare) <= _SAME_SCALE]
        steady = [a for a in usable if _difference(a.mirrored, a.bare) <= _SAME_SCALE]
        false = [a for a in of_kind if a not in usable and a.estimate.status == "ok"]
        counts = [len(part) for part in (of_kind, usable, both, same, steady, false)]
        lines.append(f"| {kind} | {' | '.join(map(str, counts))} |")
    return lines


def _difference(estimate: GsdEstimate | None, bare: GsdEstimate | None) -> float:
    """Compute the relative difference of a usable scale from that of the bare photograph."""
    if estimate is None or estimate.status != "ok" or estimate.gsd_m_per_px is None:
        return 1.0
    if bare is None or bare.gsd_m_per_px is None:
        return 1.0
    return abs(estimate.gsd_m_per_px / bare.gsd_m_per_px - 1)


def _fonts(choice: str) -> Fonts:
    """Choose fonts: ``own`` is on every machine, ``held-out`` was not in training."""
    if choice == "own":
        return own_fonts()
    if choice == "held-out":
        return [font for font in system_fonts() if is_held_out(font)]
    return system_fonts()


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fonts", choices=("all", "own", "held-out"), default="all")
    parser.add_argument("--seed", type=int, default=_SEED)
    parser.add_argument("--part", choices=("pages", "captions"))
    parser.add_argument("--pages", type=int, default=154)
    parser.add_argument("--captions", type=int, default=154)
    parser.add_argument("--keep", type=Path, help="folder for pictures whose answer is wrong")
    options = add_record_option(parser).parse_args()
    fonts = _fonts(options.fonts)
    parts = (
        ("text_pages", pages(options.pages, fonts, options.seed), page_report),
        (
            "text_captions",
            captions(options.captions, fonts, photographs_to_draw_on(DATA), options.seed),
            caption_report,
        ),
    )
    for key, pictures, report in parts:
        if options.part and key != f"text_{options.part}":
            continue
        answered = []
        for answer in answers(pictures):
            answered.append(answer)
            if options.keep:
                _keep(answer, options.keep)
        with recording("detection", [key], options.record):
            print("\n".join(report(answered)) + "\n", flush=True)


def _keep(answer: Answered, folder: Path) -> None:
    """Write a picture and a line about its answers."""
    folder.mkdir(parents=True, exist_ok=True)
    name = answer.lettering.name.replace(" ", "_").removesuffix(".jpg")
    row = {"name": name, "kind": answer.lettering.kind}
    for prefix, estimate in (("", answer.estimate), ("bare_", answer.bare)):
        if estimate is not None:
            row[f"{prefix}status"] = estimate.status
            row[f"{prefix}gsd"] = str(estimate.gsd_m_per_px)
            row[f"{prefix}confidence"] = str(estimate.confidence)
            row[f"{prefix}n"] = str(estimate.n_vehicles)
    with (folder / "answers.jsonl").open("a") as handle:
        handle.write(f"{json.dumps(row)}\n")
    cv2.imwrite(str(folder / f"{name}.png"), answer.lettering.image[:, :, ::-1])


if __name__ == "__main__":
    main()
