"""``vehanchor models list | info | --sizes | --check``: models, things of known size, a check of the installation."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vehanchor.cli.cli_options import read_classes
from vehanchor.cli.terminal import (
    FAILED,
    exit_on_error,
    facts_table,
    failures_as_json,
    print_failure,
    print_json,
    print_table,
    printable,
)
from vehanchor.errors import ModelError

if TYPE_CHECKING:
    from vehanchor.engine import Engine
    from vehanchor.rulers.standards import Standard, Variant

_SHORT_SHA = 12

models = typer.Typer(no_args_is_help=True, add_completion=False)


@models.callback(invoke_without_command=True)
def _show(
    sizes: Annotated[
        bool, typer.Option("--sizes", help="List the things of known size for --known-length, then exit.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="With --sizes: one JSON object per thing and line.")] = False,
    check: Annotated[
        bool, typer.Option("--check", help="List installed versions, and measure a bundled picture of known scale.")
    ] = False,
    provider: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Where --check runs models, as for `estimate`; repeatable. Default: cpu."),
    ] = None,
) -> None:
    """Show bundled models, your own model files and the things of known size, and check the installation."""
    if sizes:
        with exit_on_error():
            _print_sizes(as_json=as_json)
        raise typer.Exit
    if check:
        with exit_on_error():
            _check_installation(provider)
        raise typer.Exit


def _print_sizes(*, as_json: bool) -> None:
    """Print the things of known size for --known-length X1 Y1 X2 Y2 NAME."""
    from vehanchor.rulers.standards import standards

    for each in standards().values():
        if as_json:
            print_json({**each._asdict(), "variants": [variant._asdict() for variant in each.variants]})
        else:
            print_table(facts_table(each.name, _size_facts(each)))


def _size_facts(standard: Standard) -> list[tuple[str, str]]:
    return [
        ("between", standard.between),
        *(("length", _size_text(each)) for each in standard.variants),
        ("chance of another thing", f"{100 * standard.chance_wrong:.0f} %"),
        ("source", standard.source),
    ]


def _size_text(variant: Variant) -> str:
    countries = f": {', '.join(variant.countries)}" if variant.countries else ""
    return f"{variant.metres:g} m +- {100 * variant.log_sd:.2g} %{countries}"


def _check_installation(providers: list[str] | None) -> None:
    """List installed versions, and measure the bundled picture."""
    from vehanchor.cli.installation import check_picture, installed
    from vehanchor.engine import Engine
    from vehanchor.models.runtime import DEFAULT_PROVIDERS, Runtime

    print_table(facts_table("installed", installed()))
    found = check_picture(Engine(runtime=Runtime(providers=providers or DEFAULT_PROVIDERS)))
    print_table(facts_table("a picture of known scale", found.facts()))
    if not found.passed:
        raise typer.Exit(FAILED)


@models.command("list")
def list_models(
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object per model and line.")] = False,
) -> None:
    """List the bundled detectors and the segmenter."""
    with exit_on_error():
        from vehanchor.engine import Engine
        from vehanchor.models.zoo import DEFAULT_DETECTOR, SEGMENTER, bundled_models

        for name, path in bundled_models().items():
            default = name == DEFAULT_DETECTOR
            engine = Engine(path)
            try:
                card = engine.detector.card
            except ModelError as error:
                if as_json:
                    print_failure(str(path), error)
                else:
                    print(printable(f"{name}: {path}") + "\n" + printable(f"  not a detector: {error}"))
                continue
            if as_json:
                print_json({"kind": "detector", "file": str(path), "default": default, **card.model_dump(mode="json")})
            else:
                facts = [("file", str(path)), *_card_facts(engine, sha_digits=_SHORT_SHA)]
                print_table(facts_table(f"{name} (default)" if default else name, facts))
        _list_segmenter(*SEGMENTER, as_json=as_json)


def _list_segmenter(encoder: Path, decoder: Path, *, as_json: bool) -> None:
    from vehanchor.engine import Engine

    card = Engine(segmenter=(encoder, decoder)).segmenter.card
    if as_json:
        print_json({"kind": "segmenter", "encoder": str(encoder), "decoder": str(decoder), **asdict(card)})
        return
    facts = [
        ("encoder", str(encoder)),
        ("decoder", str(decoder)),
        ("sha256", card.sha256[:_SHORT_SHA]),
        ("input", f"{card.input_px} px a side, {card.contract} contract"),
        ("minimum score", f"{card.min_score:g}"),
        ("licence", card.licence or "not stated"),
    ]
    print_table(facts_table(f"{card.name} (segmenter of measure)", facts))


@models.command("info")
def show_model(
    file: Annotated[str, typer.Argument(metavar="FILE", help="An ONNX file, or the name of a bundled model.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")] = False,
    classes: Annotated[
        list[str] | None,
        typer.Option("--class", metavar="NAME", help="Class that counts as a vehicle, if the model does not name one."),
    ] = None,
) -> None:
    """Show the metadata of a detector's file; missing values are the paper's."""
    with exit_on_error():
        with failures_as_json([file], as_json):
            from vehanchor.engine import Engine

            engine = Engine(file, classes=read_classes(classes or ()))
            model = engine.detector
        if as_json:
            print_json(
                {"file": str(model.path), "fixed_size_px": model.fixed_size, **model.card.model_dump(mode="json")}
            )
            return
        card = model.card
        size = "any" if model.fixed_size is None else f"{model.fixed_size[1]} x {model.fixed_size[0]} px"
        regions = ", ".join(
            f"{name} {length:.4g} m" for name, length in sorted((card.bodies or card).region_lengths_m.items())
        )
        facts = [
            ("file", str(model.path)),
            ("input", size),
            ("classes", ", ".join(card.class_names.values()) or "not named"),
            *_card_facts(engine, sha_digits=len(card.sha256)),
            ("regions", regions),
        ]
        print_table(facts_table(card.name, facts))


def _card_facts(engine: Engine, *, sha_digits: int) -> list[tuple[str, str]]:
    card = engine.detector.card
    shortest, longest = card.length_range_px
    length_m, sd_m = (card.bodies or card).reference_length_m, (card.bodies or card).reference_length_sd_m
    unbiased = f"; measured without bias from {card.min_length_px:g} px" if card.min_length_px else ""
    return [
        ("sha256", card.sha256[:sha_digits]),
        (
            "reference length",
            f"{length_m:.4g} m, sd {sd_m:.2g} m between regions",
        ),
        ("vehicle lengths", f"{shortest:g} to {longest:g} px{unbiased}"),
        ("minimum score", f"{card.min_score:g}"),
        ("licence", card.licence or "not stated"),
    ]
