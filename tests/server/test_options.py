"""Options are declared once: keywords, command line, tools and settings agree on each."""

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
    if "tuple" in str(annotation):
        return None
    for part in typing.get_args(annotation):
        limits = part if isinstance(part, Limits) else _limits(part)
        if limits is not None and limits != Limits():
            return limits
    return None


def _limited_options() -> dict[str, Limits]:
    """Options with limits, by keyword."""
    options = {}
    for keyword, declared in DECLARED.items():
        limits = _limits(declared.annotation)
        if limits is not None:
            options[keyword] = limits
    return options


LIMITED = _limited_options()


def _beyond(limits: Limits) -> list[Any]:
    """Numbers that the limits refuse."""
    numbers = []
    if limits.above is not None:
        numbers.append(limits.above)
    if limits.least is not None:
        numbers.append(limits.least - 1)
    if limits.most is not None:
        numbers.append(limits.most + 1)
    return numbers


def _within(limits: Limits) -> list[Any]:
    """The outermost numbers that the limits take."""
    numbers = [limit for limit in (limits.least, limits.most) if limit is not None]
    return numbers or [(limits.above or 0) + 1]


@pytest.mark.parametrize("keyword", LIMITED)
def test_the_library_takes_the_limits_of_an_option(keyword: str) -> None:
    for value in _within(LIMITED[keyword]):
        if keyword != "gsd_tolerance" or value < 1:
            ScaleOptions.of({keyword: value, **NEEDED.get(keyword, {})})


@pytest.mark.parametrize("keyword", LIMITED)
def test_the_library_refuses_numbers_beyond_the_limits(keyword: str) -> None:
    for value in _beyond(LIMITED[keyword]):
        with pytest.raises(InvalidParameterError, match=keyword):
            ScaleOptions.of({keyword: value, **NEEDED.get(keyword, {})})


def test_numbers_are_read_from_texts_with_units() -> None:
    options = ScaleOptions.of(
        {"min_score": " 0.2", "height_m": "30 feet", "focal_35mm": "24 mm", "alpha": "none"}
    )
    assert options.search.min_score == 0.2
    assert options.rulers.height_m == pytest.approx(9.144)
    assert options.rulers.focal_35mm == 24
    assert options.lengths.alpha is None


@pytest.mark.parametrize("text", ["30 kg", "3.0.1", "nan", ""])
def test_a_text_that_is_not_a_length_is_refused(text: str) -> None:
    with pytest.raises(InvalidParameterError, match="height_m"):
        ScaleOptions.of({"height_m": text})


def _command(*, chosen: ParsedOptions) -> None:
    raise NotImplementedError


SHOWN = {keyword: declared.option for keyword, declared in DECLARED.items() if declared.option.cli}


def test_the_command_line_has_all_options_but_seven() -> None:
    assert set(DECLARED) - set(SHOWN) == {
        "limits",
        "file_scale",
        "bgr",
        "verify",
        "gsd_m_per_px",
        "gsd_basis",
        "gsd_tolerance",
    }


@pytest.mark.parametrize("keyword", SHOWN)
def test_the_command_line_has_an_option_as_declared(keyword: str) -> None:
    parameter = inspect.signature(scale_command()(_command)).parameters[keyword]
    option = SHOWN[keyword]
    _, info = typing.get_args(parameter.annotation)
    assert isinstance(info, typer.models.OptionInfo)
    assert info.help == (rulers_help() if keyword == "rulers" else option.help)
    assert info.hidden is not option.first
    assert parameter.default is None


FILE_NAMES = {"effort", "height_m", "known_lengths", "threads"}


@pytest.fixture
def options_file(tmp_path: Path) -> Path:
    file = tmp_path / "options.toml"
    file.write_text('effort = "full"\nheight_m = 40\nknown_lengths = ["0 0 30 0 5"]\nthreads = 1\n')
    return file


def test_a_file_has_options_by_keyword(options_file: Path) -> None:
    parsed = ParsedOptions({}, options_file, FILE_NAMES)
    assert parsed.options().search.effort == "full"
    assert parsed.options().rulers.known_lengths[0].metres == 5
    assert parsed.runtime().threads == 1


def test_the_command_line_overrides_a_file(options_file: Path) -> None:
    parsed = ParsedOptions({"height_m": "50"}, options_file, FILE_NAMES)
    assert parsed.options().rulers.height_m == 50


def test_a_file_has_only_options_of_the_command(options_file: Path) -> None:
    parsed = ParsedOptions({}, options_file, FILE_NAMES - {"effort"})
    with pytest.raises(
        InvalidParameterError, match="has 'effort': the options of this command are height_m"
    ):
        parsed.options()


def test_a_file_that_is_not_toml_is_refused(options_file: Path) -> None:
    options_file.write_text("effort: full")
    with pytest.raises(InvalidParameterError, match=r"--options .* cannot be read"):
        ParsedOptions({}, options_file, FILE_NAMES).options()


MEASURING_TOOLS = {
    tool.name: tool
    for tool in create_tools(create_services(Settings()))
    if tool.name != "view_image"
}


def _arguments(tool: str) -> dict[str, Any]:
    arguments: dict[str, Any] = MEASURING_TOOLS[tool].full_parameters["properties"]
    return arguments


def _options_of(tool: str) -> dict[str, Any]:
    """The declared options that a tool takes as arguments."""
    kind = "estimate" if tool == "estimate_gsd" else "measure"
    return {
        keyword: declared
        for keyword, declared in DECLARED.items()
        if declared.option.tools in ("all", kind)
    }


@pytest.mark.parametrize("tool", MEASURING_TOOLS)
def test_the_tools_have_the_help_of_the_options(tool: str) -> None:
    for name, declared in _options_of(tool).items():
        assert _arguments(tool)[name]["description"] == declared.option.help
    if tool != "estimate_gsd":
        assert _arguments(tool)["object_height_m"]["description"] == OBJECT_HEIGHT.help


@pytest.mark.parametrize("tool", MEASURING_TOOLS)
def test_the_tools_have_the_limits_of_the_options(tool: str) -> None:
    for name in _options_of(tool).keys() & LIMITED.keys():
        variants = _arguments(tool)[name]["anyOf"]
        (number,) = [part for part in variants if part["type"] in ("number", "integer")]
        limits = {key: value for key, value in number.items() if key != "type"}
        assert limits == LIMITED[name].schema
