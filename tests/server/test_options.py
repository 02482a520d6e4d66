"""One declaration of an option: keywords, command line, tools and settings agree in type, limits, default and help."""

from __future__ import annotations

import inspect
import typing
from pathlib import Path
from typing import Any

import pytest
import typer

from vehanchor.cli.cli_options import ParsedOptions, scale_command
from vehanchor.errors import InvalidParameterError
from vehanchor.options import ScaleOptions, declared_options
from vehanchor.options.option import Limits
from vehanchor.options.rulers import OBJECT_HEIGHT
from vehanchor.rulers.active import rulers_help
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings
from vehanchor_server.tools.registry import create_tools

DECLARED = declared_options()
NEEDED: dict[str, dict[str, Any]] = {
    "focal_35mm": {"height_m": 50},
    "height_tolerance_m": {"height_m": 50},
    "gsd_tolerance": {"gsd_m_per_px": 999.9},
}


def _limits(annotation: Any) -> Limits | None:
    """Limits of the numbers of an option."""
    for part in typing.get_args(annotation):
        found = part if isinstance(part, Limits) else _limits(part)
        if found is not None and found != Limits() and "tuple" not in str(annotation):
            return found
    return None


LIMITED = {
    keyword: limits
    for keyword, each in DECLARED.items()
    if (limits := _limits(each.annotation)) is not None
}


def _beyond(limits: Limits) -> list[Any]:
    """Numbers that the limits refuse."""
    found = [limits.above] if limits.above is not None else []
    found += [limits.least - 1] if limits.least is not None else []
    return found + ([limits.most + 1] if limits.most is not None else [])


def _within(limits: Limits) -> list[Any]:
    """The outermost numbers that the limits take."""
    return [each for each in (limits.least, limits.most) if each is not None] or [
        (limits.above or 0) + 1
    ]


@pytest.mark.parametrize("keyword", LIMITED)
def test_the_library_takes_what_an_option_declares_and_nothing_beyond(keyword: str) -> None:
    more = NEEDED.get(keyword, {})
    for value in _within(LIMITED[keyword]):
        if keyword != "gsd_tolerance" or value < 1:
            ScaleOptions.of({keyword: value, **more})
    for value in _beyond(LIMITED[keyword]):
        with pytest.raises(InvalidParameterError, match=keyword):
            ScaleOptions.of({keyword: value, **more})


def test_numbers_are_read_from_texts_and_lengths_with_their_units() -> None:
    options = ScaleOptions.of(
        {"min_score": " 0.2", "height_m": "30 feet", "focal_35mm": "24 mm", "alpha": "none"}
    )
    assert options.search.min_score == 0.2
    assert options.rulers.height_m == pytest.approx(9.144)
    assert options.rulers.focal_35mm == 24
    assert options.lengths.alpha is None
    for wrong in ("30 kg", "3.0.1", "nan", ""):
        with pytest.raises(InvalidParameterError, match="height_m"):
            ScaleOptions.of({"height_m": wrong})


def _command(*, chosen: ParsedOptions) -> None:
    raise NotImplementedError


def test_the_command_line_has_every_option_with_its_help_and_shows_the_first() -> None:
    parameters = inspect.signature(scale_command()(_command)).parameters
    shown = {keyword: each.option for keyword, each in DECLARED.items() if each.option.cli}
    assert set(DECLARED) - set(shown) == {
        "limits",
        "bgr",
        "verify",
        "gsd_m_per_px",
        "gsd_basis",
        "gsd_tolerance",
    }
    for keyword, option in shown.items():
        _, info = typing.get_args(parameters[keyword].annotation)
        assert isinstance(info, typer.models.OptionInfo)
        assert info.help == (rulers_help() if keyword == "rulers" else option.help)
        assert info.hidden is not option.first
        assert parameters[keyword].default is None


def test_a_file_has_options_by_keyword_and_the_command_line_overrides_it(tmp_path: Path) -> None:
    file = tmp_path / "options.toml"
    file.write_text('effort = "full"\nheight_m = 40\nknown_lengths = ["0 0 30 0 5"]\nthreads = 1\n')
    names = {"effort", "height_m", "known_lengths", "threads"}
    chosen = ParsedOptions({"height_m": "50"}, file, names)
    assert chosen.options().search.effort == "full"
    assert chosen.options().rulers.height_m == 50
    assert chosen.options().rulers.known_lengths[0].metres == 5
    assert chosen.runtime().threads == 1
    with pytest.raises(
        InvalidParameterError, match="has 'effort': the options of this command are height_m"
    ):
        ParsedOptions({}, file, names - {"effort"}).options()
    file.write_text("effort: full")
    with pytest.raises(InvalidParameterError, match=r"--options .* cannot be read"):
        ParsedOptions({}, file, names).options()


def test_the_tools_have_the_limits_and_the_help_of_the_options() -> None:
    for tool in create_tools(create_services(Settings())):
        if tool.name == "view_image":
            continue
        arguments = tool.full_parameters["properties"]
        kind = "estimate" if tool.name == "estimate_gsd" else "measure"
        expected = {
            keyword: each
            for keyword, each in DECLARED.items()
            if each.option.tools in ("all", kind)
        }
        assert set(expected) <= set(arguments)
        for name, each in expected.items():
            assert arguments[name]["description"] == each.option.help
            if name in LIMITED:
                (number,) = (
                    part
                    for part in arguments[name]["anyOf"]
                    if part["type"] in ("number", "integer")
                )
                assert {key: value for key, value in number.items() if key != "type"} == LIMITED[
                    name
                ].schema
        if kind == "measure":
            assert arguments["object_height_m"]["description"] == OBJECT_HEIGHT.help
