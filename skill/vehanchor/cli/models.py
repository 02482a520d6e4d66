"""``vehanchor models list | info | --sizes | --check``: models, things of known size, a check of the installation."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from vehanchor.cli.cli_options import read_classes
from vehanchor.cli.terminal import FAILED, exit_on_error, failures_as_json, print_facts, print_json
from vehanchor.records.text import scale_text

if TYPE_CHECKING:
    from vehanchor.engine import Engine

_TOLERANCE = 0.15  # of the scale that --check measures, relative

models = typer.Typer(no_args_is_help=True, add_completion=False)


@models.callback(invoke_without_command=True)
def _show(
    sizes: Annotated[
        bool,
        typer.Option(
            "--sizes", help="List the things of known size for --known-length, then exit."
        ),
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="With --sizes: one JSON object per thing and line.")
    ] = False,
    check: Annotated[
        bool,
        typer.Option(
            "--check", help="List installed versions, and measure a bundled picture of known scale."
        ),
    ] = False,
    provider: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Where --check runs models, as for `estimate`; repeatable. Default: cpu.",
        ),
    ] = None,
) -> None:
    """Show bundled models, your own model files and the things of known size, and check the installation."""
    if sizes or check:
        with exit_on_error():
            _print_sizes(as_json=as_json) if sizes else _check_installation(provider)
        raise typer.Exit


def _print_sizes(*, as_json: bool) -> None:
    """Print the things of known size for --known-length X1 Y1 X2 Y2 NAME."""
    from vehanchor.rulers.standards import standards

    for each in standards().values():
        if as_json:
            print_json(
                {**each._asdict(), "variants": [variant._asdict() for variant in each.variants]}
            )
            continue
        facts = [("between", each.between)]
        for variant in each.variants:
            countries = f": {', '.join(variant.countries)}" if variant.countries else ""
            facts.append(
                ("length", f"{variant.metres:g} m +- {100 * variant.log_sd:.2g} %{countries}")
            )
        mistaken = f"{100 * each.chance_wrong:.0f} %"
        print_facts(
            each.name, [*facts, ("chance of another thing", mistaken), ("source", each.source)]
        )


def _check_installation(providers: list[str] | None) -> None:
    """List installed versions, and measure the bundled picture."""
    from vehanchor.cli import installation
    from vehanchor.engine import Engine
    from vehanchor.models.runtime import DEFAULT_PROVIDERS, Runtime

    print_facts("installed", installation.installed())
    record = installation.check_picture(
        Engine(runtime=Runtime(providers=providers or DEFAULT_PROVIDERS))
    )
    gsd = record.gsd_m_per_px or 0.0
    true = installation.GSD_M_PER_PX
    passed = record.status == "ok" and abs(gsd / true - 1) <= _TOLERANCE
    facts = [
        ("check", "passed" if passed else "FAILED: reinstall, or report this"),
        ("measured", f"{scale_text(record)}, {record.status}; true: {true:g} m/px"),
    ]
    print_facts("a picture of known scale", facts)
    if not passed:
        raise typer.Exit(FAILED)


@models.command("list")
def list_models(
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object per model and line.")
    ] = False,
) -> None:
    """List the bundled detectors and the segmenter."""
    with exit_on_error():
        from vehanchor.engine import Engine
        from vehanchor.models.zoo import DEFAULT_DETECTOR, bundled_models

        for name, path in bundled_models().items():
            default = name == DEFAULT_DETECTOR
            title = f"{name} (default)" if default else name
            _print_detector(
                Engine(path), title, {"kind": "detector", "default": default}, as_json=as_json
            )
        _print_segmenter(Engine(), as_json=as_json)


def _print_segmenter(engine: Engine, *, as_json: bool) -> None:
    segmenter = engine.segmenter
    card = engine.segmenter.card
    files = {"encoder": str(segmenter.encoder_path), "decoder": str(segmenter.decoder_path)}
    if as_json:
        print_json({"kind": "segmenter", **files, **asdict(card)})
        return
    facts = [
        *files.items(),
        ("sha256", card.sha256),
        ("input", f"{card.input_px} px a side, {card.contract} contract"),
        ("minimum score", f"{card.min_score:g}"),
        ("licence", card.licence or "not stated"),
    ]
    print_facts(f"{card.name} (segmenter of measure)", facts)


@models.command("info")
def show_model(
    file: Annotated[
        str, typer.Argument(metavar="FILE", help="An ONNX file, or the name of a bundled model.")
    ],
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object and nothing else.")
    ] = False,
    classes: Annotated[
        list[str] | None,
        typer.Option(
            "--class",
            metavar="NAME",
            help="Class that counts as a vehicle, if the model does not name one.",
        ),
    ] = None,
) -> None:
    """Show the metadata of a detector's file; missing values are the paper's."""
    with exit_on_error():
        with failures_as_json([file], as_json):
            from vehanchor.engine import Engine

            engine = Engine(file, classes=read_classes(classes or ()))
            title = engine.detector.card.name
        _print_detector(engine, title, {}, as_json=as_json)


def _print_detector(engine: Engine, title: str, about: dict[str, object], *, as_json: bool) -> None:
    """Print the metadata of a detector's file; ``about`` has further members of the JSON object."""
    model = engine.detector
    card = engine.detector.card
    if as_json:
        file = {"file": str(model.path), "fixed_size_px": model.fixed_size}
        print_json({**about, **file, **card.model_dump(mode="json")})
        return
    (shortest, longest) = card.length_range_px
    of_lengths = card.bodies or card
    unbiased = (
        f"; measured without bias from {card.min_length_px:g} px" if card.min_length_px else ""
    )
    regions = (
        f"{name} {length:.4g} m" for name, length in sorted(of_lengths.region_lengths_m.items())
    )
    mean = of_lengths.reference_length_m
    sd = of_lengths.reference_length_sd_m
    facts = [
        ("file", str(model.path)),
        (
            "input",
            "any"
            if model.fixed_size is None
            else f"{model.fixed_size[1]} x {model.fixed_size[0]} px",
        ),
        ("classes", ", ".join(card.class_names.values()) or "not named"),
        ("sha256", card.sha256),
        ("reference length", f"{mean:.4g} m, sd {sd:.2g} m between regions"),
        ("vehicle lengths", f"{shortest:g} to {longest:g} px{unbiased}"),
        ("minimum score", f"{card.min_score:g}"),
        ("licence", card.licence or "not stated"),
        ("regions", ", ".join(regions)),
    ]
    print_facts(title, facts)
