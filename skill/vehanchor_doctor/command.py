"""``vehanchor doctor``: what is installed, whether it works, and whether it will work on somebody's images."""

from __future__ import annotations

import random
import sys
from typing import TYPE_CHECKING, Annotated

import typer

from vehanchor.cli.terminal import FAILED_TEST, exit_on_error, facts_table, print_table, seldom

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.engine import Engine
    from vehanchor_doctor.checks import FolderCheck


def doctor(
    inputs: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[IMAGES]", help="Will it work on my images: files, folders, patterns.", show_default=False
        ),
    ] = None,
    sample: Annotated[int, typer.Option(metavar="N", min=1, help="Look at so many of them, taken by chance.")] = 20,
    max_megapixels: Annotated[
        float | None,
        typer.Option(metavar="MP", help="Decode images of up to so many megapixels whole. Default: 100."),
    ] = None,
    provider: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Where models run, as of `estimate`; may be repeated. Default: cpu."),
    ] = None,
    test: Annotated[bool, typer.Option("--test/--no-test", help="Measure a scene of known scale.")] = True,
) -> None:
    """Tell what is installed, test it on a scene of known scale, and say whether it will work on your images."""
    with exit_on_error():
        from vehanchor.batch.files import find_images
        from vehanchor.engine import Engine
        from vehanchor.models.runtime import DEFAULT_PROVIDERS, Runtime
        from vehanchor_doctor.checks import installed, self_test

        images = find_images(inputs) if inputs else []
        print_table(facts_table("installed", installed()))
        engine = Engine(runtime=Runtime(providers=provider or DEFAULT_PROVIDERS))
        engine.load()
        passed = True
        if test:
            found = self_test(engine)
            passed = found.passed
            measured = "nothing" if found.gsd_m_per_px is None else f"{found.gsd_m_per_px:.4g} m/px"
            facts = [
                ("self-test", "passed" if passed else "FAILED: reinstall, or report it"),
                ("measured", f"{measured} ({found.status}) where {found.true_gsd_m_per_px:g} is right"),
                ("seconds", f"{found.seconds:.1f} a megapixel, about" if found.seconds else "0"),
            ]
            print_table(facts_table("a rendered scene", facts))
        if images:
            chosen = sorted(random.Random(0).sample(images, min(sample, len(images))))
            print_table(
                facts_table(f"{len(chosen)} of {len(images)} images", _advice(_counted(chosen, engine, max_megapixels)))
            )
        if not passed:
            raise typer.Exit(FAILED_TEST)


def _counted(images: Sequence[str], engine: Engine, max_megapixels: float | None) -> FolderCheck:
    from vehanchor_doctor.checks import check_images

    tell = seldom(lambda n, total: f"{n} of {total} images", sys.stderr)
    return check_images(images, engine, tell, max_megapixels)


def _advice(check: FolderCheck) -> list[tuple[str, str]]:
    """How many have a usable scale, and for the others why not and what would help."""
    from vehanchor.records.advice import ADVICE

    facts = [("usable", f"{check.n_ok} of {check.n} ({100 * check.n_ok / max(1, check.n):.0f} %)")]
    for reason, count in check.reasons.most_common():
        known = {str(name): advice for name, advice in ADVICE.items()}.get(reason)
        facts.append((f"{count} x {reason}", "an error" if known is None else f"{known.why}; {known.helps}"))
    return facts
