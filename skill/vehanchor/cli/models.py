"""``vehanchor models``: models, things of known size, and a check of the installation."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from vehanchor.cli.cli_options import read_classes
from vehanchor.cli.terminal import (
    FAILED,
    AsJson,
    exit_on_error,
    failures_as_json,
    print_facts,
    print_json,
)
from vehanchor.records.text import scale_text

if TYPE_CHECKING:
    from vehanchor.engine import Engine

_MAX_CHECK_ERROR = 0.15  # relative error of the scale that --check measures

models = typer.Typer(no_args_is_help=True, add_completion=False)


@models.callback(invoke_without_command=True)
def _show(
    sizes: Annotated[
        bool,
        typer.Option(
            "--sizes", help="List the things of known size for --known-length, then exit."
        ),
    ] = False,
    rulers: Annotated[
        bool, typer.Option("--rulers", help="List the rulers and what each needs, then exit.")
    ] = False,
    as_json: Annotated[
        bool,
        typer.Option("--json", help="With --sizes or --rulers: one JSON object per line."),
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
            help="Where --check runs models, as in `estimate`; repeatable. Default: cpu.",
        ),
    ] = None,
) -> None:
    """Show models, things of known size and rulers; check the installation."""
    if not sizes and not rulers and not check:
        return
    with exit_on_error():
        if sizes:
            _print_sizes(as_json=as_json)
        elif rulers:
            _print_rulers(as_json=as_json)
        else:
            _check_installation(provider)
    raise typer.Exit


def _print_sizes(*, as_json: bool) -> None:
    """Print the things of known size for --known-length X1 Y1 X2 Y2 NAME."""
    from vehanchor.rulers.standards import describe_lengths, standards

    for standard in standards().values():
        if as_json:
            variants = [variant._asdict() for variant in standard.variants]
            print_json({**standard._asdict(), "variants": variants})
            continue
        facts = [("between", standard.between)]
        facts += [("length", length) for length in describe_lengths(standard)]
        facts.append(("chance of misidentification", f"{100 * standard.chance_wrong:.0f} %"))
        facts.append(("source", standard.source))
        print_facts(standard.name, facts)


def _print_rulers(*, as_json: bool) -> None:
    """Print the registered rulers, those of other packages among them, and what each needs."""
    from vehanchor.records.ruler_registry import RULERS
    from vehanchor.rulers.active import ruler_class

    rulers = [ruler_class(kind) for kind in RULERS]
    if as_json:
        for ruler in rulers:
            print_json(
                {
                    "kind": ruler.kind,
                    "needs": ruler.help,
                    "sets_scale": ruler.sets_scale,
                }
            )
        return
    facts = [(ruler.kind, ruler.help) for ruler in rulers]
    print_facts("rulers, and what each needs", facts)


def _check_installation(providers: list[str] | None) -> None:
    """List installed versions, and measure the bundled picture."""
    from vehanchor.cli import installation
    from vehanchor.engine import Engine
    from vehanchor.models.runtime import DEFAULT_PROVIDERS, Runtime

    print_facts("installed", installation.installed())
    runtime = Runtime(providers=providers or DEFAULT_PROVIDERS)
    record = installation.check_picture(Engine(runtime=runtime))
    gsd = record.gsd_m_per_px or 0.0
    true_gsd = installation.GSD_M_PER_PX
    relative_error = abs(gsd / true_gsd - 1)
    passed = record.status == "ok" and relative_error <= _MAX_CHECK_ERROR
    facts = [
        ("check", "passed" if passed else "FAILED: reinstall, or report this"),
        ("measured", f"{scale_text(record)}, {record.status}; true: {true_gsd:g} m/px"),
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
            is_default = name == DEFAULT_DETECTOR
            title = f"{name} (default)" if is_default else name
            about = {"kind": "detector", "default": is_default}
            _print_detector(Engine(path), title, about, as_json=as_json)
        _print_segmenter(Engine(), as_json=as_json)


def _print_segmenter(engine: Engine, *, as_json: bool) -> None:
    """Print the metadata of the segmenter's files."""
    segmenter = engine.segmenter
    card = segmenter.card
    files = {
        "encoder": str(segmenter.encoder_path),
        "decoder": str(segmenter.decoder_path),
    }
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
    as_json: AsJson = False,
    classes: Annotated[
        list[str] | None,
        typer.Option(
            "--class",
            metavar="NAME",
            help="Class that counts as a vehicle, if the model does not name one.",
        ),
    ] = None,
) -> None:
    """Show the metadata of a detector's file, with the paper's values for missing ones."""
    with exit_on_error():
        with failures_as_json([file], as_json):
            from vehanchor.engine import Engine

            engine = Engine(file, classes=read_classes(classes or ()))
            title = engine.detector.card.name
        _print_detector(engine, title, {}, as_json=as_json)


def _print_detector(engine: Engine, title: str, about: dict[str, object], *, as_json: bool) -> None:
    """Print the metadata of a detector's file.

    Args:
        engine: engine with the detector.
        title: title of the facts.
        about: further members of the JSON object.
        as_json: print one JSON object and nothing else.
    """
    from vehanchor.models.zoo import errors_file

    detector = engine.detector
    card = detector.card
    errors_path = errors_file(detector.path)
    if as_json:
        file = {
            "file": str(detector.path),
            "errors_file": None if errors_path is None else str(errors_path),
            "fixed_size_px": detector.fixed_size,
        }
        fields = card.model_dump(mode="json")
        print_json({**about, **file, **fields})
        return

    input_size = "any"
    if detector.fixed_size is not None:
        height, width = detector.fixed_size
        input_size = f"{width} x {height} px"
    shortest, longest = card.length_range_px
    vehicle_lengths = f"{shortest:g} to {longest:g} px"
    if card.min_length_px:
        vehicle_lengths += f"; measured without bias from {card.min_length_px:g} px"
    # A model that measures bodies has other reference lengths for them.
    lengths = card.bodies or card
    mean = lengths.reference_length_m
    sd = lengths.reference_length_sd_m
    lengths_by_region = sorted(lengths.region_lengths_m.items())
    regions = [f"{name} {length:.4g} m" for name, length in lengths_by_region]
    errors_source = "defaults"
    if errors_path is not None:
        errors_source = errors_path.name
    errors = f"{errors_source}; one car's box {100 * card.errors.boxes.log_sd:.3g} %"
    if detector.chips is not None:
        errors += f", a fleet by appearance {100 * card.errors.appearance.log_sd:.3g} %"
    facts = [
        ("file", str(detector.path)),
        ("input", input_size),
        ("classes", ", ".join(card.class_names.values()) or "not named"),
        ("sha256", card.sha256),
        ("reference length", f"{mean:.4g} m, sd {sd:.2g} m between regions"),
        ("vehicle lengths", vehicle_lengths),
        ("minimum score", f"{card.min_score:g}"),
        ("errors", errors),
        ("licence", card.licence or "not stated"),
        ("regions", ", ".join(regions)),
    ]
    print_facts(title, facts)
