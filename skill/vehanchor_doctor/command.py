"""Command ``vehanchor doctor``: installed versions, a self-test, and a trial on a user's images."""

from __future__ import annotations

import random
import sys
from typing import TYPE_CHECKING, Annotated

import typer

from vehanchor.cli.terminal import FAILED, exit_on_error, facts_table, print_table, seldom

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.engine import Engine
    from vehanchor_doctor.checks import FolderCheck


def doctor(
    inputs: Annotated[
        list[str] | None,
        typer.Argument(metavar="[IMAGES]", help="Images to try: files, folders, patterns.", show_default=False),
    ] = None,
    sample: Annotated[int, typer.Option(metavar="N", min=1, help="Try N of the images, chosen at random.")] = 20,
    max_megapixels: Annotated[
        float | None,
        typer.Option(metavar="MP", help="Decode images up to this size whole. Default: 100."),
    ] = None,
    provider: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Where models run, as for `estimate`; repeatable. Default: cpu."),
    ] = None,
    test: Annotated[bool, typer.Option("--test/--no-test", help="Measure a scene of known scale.")] = True,
) -> None:
    """List installed versions, measure a scene of known scale, and try VehAnchor on your images."""
    with exit_on_error():
        from vehanchor.engine import Engine
        from vehanchor.imagery.sources.files import find_images
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
            measured = "no scale" if found.gsd_m_per_px is None else f"{found.gsd_m_per_px:.4g} m/px"
            facts = [
                ("self-test", "passed" if passed else "FAILED: reinstall, or report this"),
                ("measured", f"{measured} ({found.status}); true: {found.true_gsd_m_per_px:g} m/px"),
                ("seconds", f"{found.seconds:.1f}"),
            ]
            print_table(facts_table("a rendered scene", facts))
        if images:
            chosen = sorted(random.Random(0).sample(images, min(sample, len(images))))
            print_table(
                facts_table(f"{len(chosen)} of {len(images)} images", _advice(_check(chosen, engine, max_megapixels)))
            )
        if not passed:
            raise typer.Exit(FAILED)


def _check(images: Sequence[str], engine: Engine, max_megapixels: float | None) -> FolderCheck:
    from vehanchor_doctor.checks import check_images

    report = seldom(lambda n, total: f"{n} of {total} images", sys.stderr)
    return check_images(images, engine, report, max_megapixels)


def _advice(check: FolderCheck) -> list[tuple[str, str]]:
    """Count images with a usable scale; give the reason and a remedy for the others."""
    from vehanchor.records.advice import ADVICE

    facts = [("usable", f"{check.n_ok} of {check.n} ({100 * check.n_ok / max(1, check.n):.0f} %)")]
    for reason, count in check.reasons.most_common():
        known = {str(name): advice for name, advice in ADVICE.items()}.get(reason)
        facts.append((f"{count} x {reason}", "an error" if known is None else f"{known.why}; {known.helps}"))
    return facts
