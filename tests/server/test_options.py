"""One declaration of an option: keywords, command line, tools and settings agree in type, limits, default and help."""

from __future__ import annotations

import inspect
import typing
from typing import Any

import pytest
import typer

from vehanchor.cli.cli_options import ParsedOptions, scale_command
from vehanchor.errors import InvalidParameterError
from vehanchor.measure.resolved_scale import given_scale
from vehanchor.options import ScaleOptions, declared_options
from vehanchor.options.frame import FRAME, FRAME_SIDE
from vehanchor.options.given_scale import GSD, GSD_M_PER_PX, OBJECT_HEIGHT
from vehanchor.options.option import Limits, Option, Words
from vehanchor.options.rulers import LINE_LENGTH_M
from vehanchor.rulers.registry import rulers_help
from vehanchor.scale.calibration import Calibration
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings
from vehanchor_server.tools.registry import create_tools

DECLARED = {each.keyword: each for each in declared_options()}
BESIDE: dict[str, Option] = {"object_height_m": OBJECT_HEIGHT}  # an option of measurements alone
STATED = {"stated_scale"}  # three arguments of the measuring tools
LIMITED = {
    keyword: each.declared.takes
    for keyword, each in DECLARED.items()
    if each.declared is not None and isinstance(each.declared.takes, Limits)
}
NEEDED = {
    "focal_35mm": {"height_m": 50},
    "height_tolerance_m": {"height_m": 50},
    "frame_width_px": {"frame_height_px": 1},
    "frame_height_px": {"frame_width_px": 1},
}
JSON_NAMES = {"ge": "minimum", "le": "maximum", "gt": "exclusiveMinimum"}


def _beyond(limits: Limits) -> list[Any]:
    """Numbers that the limits refuse."""
    found = [limits.above] if limits.above is not None else []
    found += [limits.least - 1] if limits.least is not None else []
    return found + ([limits.most + 1] if limits.most is not None else [])


def _within(limits: Limits) -> list[Any]:
    """The outermost numbers that the limits take."""
    return [each for each in (limits.least, limits.most) if each is not None] or [(limits.above or 0) + 1]


def _hints(group: type[Any]) -> dict[str, Any]:
    return typing.get_type_hints(group, localns={"Calibration": Calibration})


@pytest.mark.parametrize("keyword", LIMITED)
def test_the_library_takes_what_an_option_declares_and_nothing_beyond(keyword: str) -> None:
    more = NEEDED.get(keyword, {})
    for value in _within(LIMITED[keyword]):
        ScaleOptions.of({keyword: value, **more})
    for value in _beyond(LIMITED[keyword]):
        with pytest.raises(InvalidParameterError, match=keyword):
            ScaleOptions.of({keyword: value, **more})


def test_a_measurement_takes_a_scale_within_its_limits() -> None:
    assert isinstance(GSD.takes, Limits)
    for value in _within(GSD.takes):
        assert given_scale(value, None, ScaleOptions()) == value
    for value in _beyond(GSD.takes):
        with pytest.raises(InvalidParameterError, match="gsd_m_per_px"):
            given_scale(value, None, ScaleOptions())


def test_the_command_line_has_every_option_with_its_help_and_default() -> None:
    def command(*, chosen: ParsedOptions) -> None:
        raise NotImplementedError

    parameters = inspect.signature(scale_command()(command)).parameters
    shown = {keyword: each for keyword, each in DECLARED.items() if each.declared is not None and each.declared.cli}
    beside = {"frame_width_px", "frame_height_px", "limits", "bgr", "verify"}
    assert set(DECLARED) - set(shown) == beside | STATED
    for keyword, each in shown.items():
        assert each.declared is not None
        parameter = parameters[keyword]
        kind, option = typing.get_args(parameter.annotation)
        assert isinstance(option, typer.models.OptionInfo)
        assert option.help == (rulers_help() if keyword == "rulers" else each.declared.help)
        default = None if each.field.default in ((), None) else each.field.default
        assert parameter.default == (str(default) if keyword == "alpha" else default), keyword
        if isinstance(each.declared.takes, Words):
            first = typing.get_args(kind)[0]
            words = typing.get_args(kind) if isinstance(first, str) else [word.value for word in first]
            assert set(each.declared.takes.words) == set(words)
    assert typing.get_args(parameters["frame"].annotation)[1].help == FRAME.help


def test_the_tools_have_the_limits_and_the_help_of_the_options() -> None:
    seen = set()
    for tool in create_tools(create_services(Settings())):
        for name, schema in tool.full_parameters["properties"].items():
            declared = BESIDE.get(name) or (DECLARED[name].declared if name in DECLARED else None)
            if declared is None:
                continue
            seen.add(name)
            assert schema["description"] == declared.help, (tool.name, name)
            if isinstance(declared.takes, Limits):
                (number,) = (each for each in schema["anyOf"] if each["type"] in ("number", "integer"))
                expected = {JSON_NAMES[limit]: value for limit, value in declared.takes.schema.items()}
                assert {key: value for key, value in number.items() if key != "type"} == expected, (tool.name, name)
                assert number["type"] == ("integer" if declared.takes.whole else "number")
            if isinstance(declared.takes, Words):
                words = next(each["enum"] for each in (schema, *schema.get("anyOf", ())) if "enum" in each)
                assert words == list(declared.takes.words)
    assert {"region", "reference_length_m", "known_lengths", "height_m", "focal_35mm"} < seen
    assert {"object_height_m", "effort", "max_tiles", "max_seconds", "coordinates"} < seen


def test_the_parts_of_a_tools_arguments_have_the_limits_of_the_library() -> None:
    tools = {each.name: each.full_parameters["properties"] for each in create_tools(create_services(Settings()))}
    properties = tools["estimate_gsd"]
    (frame,) = (each for each in properties["frame"]["anyOf"] if each["type"] == "object")
    (lines,) = (each for each in properties["known_lengths"]["anyOf"] if each["type"] == "array")
    for schema, limits in (
        (frame["properties"]["width_px"], FRAME_SIDE),
        (frame["properties"]["height_px"], FRAME_SIDE),
        (lines["items"]["properties"]["metres"]["anyOf"][0], LINE_LENGTH_M),
        *((tools["measure_area"][name]["anyOf"][0], GSD_M_PER_PX) for name in ("gsd_m_per_px", "gsd_tolerance")),
    ):
        expected = {JSON_NAMES[limit]: value for limit, value in limits.schema.items()}
        assert {key: value for key, value in schema.items() if "imum" in key.lower()} == expected
