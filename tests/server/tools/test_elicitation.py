from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import anyio
import mcp.types
import pytest
from mcp import Client
from mcp.client import ClientRequestContext
from mcp.server import MCPServer
from mcp.types import CallToolResult, ElicitRequestFormParams, ElicitRequestParams, ElicitResult

from tests.server.conversation import by_path, error_of, text_of
from vehanchor_server.app import create_server
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings

pytestmark = pytest.mark.anyio


class Person:
    """A client's user, who answers every form alike; it keeps the forms."""

    def __init__(self, action: Any, **content: Any) -> None:
        self.answer = ElicitResult(action=action, content=content if action == "accept" else None)
        self.forms: list[ElicitRequestFormParams] = []

    async def __call__(
        self, context: ClientRequestContext, params: ElicitRequestParams
    ) -> ElicitResult:
        assert isinstance(params, ElicitRequestFormParams)
        self.forms.append(params)
        return self.answer


def at(server: MCPServer[object], person: Person, mode: str = "auto") -> Client:
    return Client(server, mode=mode, elicitation_callback=person)


class Conversation(NamedTuple):
    """A call about two vehicles, whose user answers the form.

    Attributes:
        form: the form that the user got.
        result: the result after the answer.
        as_arguments: the result of a call with the same values as arguments.
        without_answer: the result without an answer.
    """

    form: ElicitRequestFormParams
    result: CallToolResult
    as_arguments: CallToolResult
    without_answer: CallToolResult


@pytest.fixture(scope="module")
def conversation(server: MCPServer[object], images: Path) -> Conversation:
    arguments = by_path(images / "two.png")
    person = Person("accept", known_length="100, 50, 300, 50, 28 measured", region="europe")
    line = {"x1": 100, "y1": 50, "x2": 300, "y2": 50, "metres": 28, "basis": "measured"}
    answers = {"region": "europe", "known_lengths": [line]}

    async def talk() -> tuple[CallToolResult, CallToolResult, CallToolResult]:
        async with at(server, person) as client:
            result = await client.call_tool("estimate_gsd", arguments)
        async with Client(server) as client:
            as_arguments = await client.call_tool("estimate_gsd", {**arguments, **answers})
            without_answer = await client.call_tool("estimate_gsd", arguments)
        return result, as_arguments, without_answer

    results = anyio.run(talk)
    (form,) = person.forms
    return Conversation(form, *results)


def test_an_answer_counts_as_an_argument(conversation: Conversation) -> None:
    content = conversation.as_arguments.structured_content
    assert conversation.result.structured_content == content
    assert content is not None
    assert content["status"] == "ok"


def test_the_form_begins_with_the_result(conversation: Conversation) -> None:
    assert conversation.form.message.startswith(text_of(conversation.without_answer))


def test_the_form_has_optional_fields_for_the_missing_values(conversation: Conversation) -> None:
    schema = conversation.form.requested_schema
    fields = list(schema["properties"])
    assert fields == ["region", "height_m", "height_basis", "focal_35mm", "known_length"]
    assert not schema.get("required")


def test_the_form_names_the_callers_coordinates(conversation: Conversation) -> None:
    field = conversation.form.requested_schema["properties"]["known_length"]
    assert "pixels of the image of 640 x 512 px" in field["description"]


@pytest.mark.parametrize(
    "answered", [Person("decline"), Person("cancel"), Person("accept"), Person("accept", region="")]
)
async def test_without_an_answer_the_low_result_stands(
    server: MCPServer[object], images: Path, answered: Person
) -> None:
    async with at(server, answered) as client:
        result = await client.call_tool("estimate_gsd", by_path(images / "two.png"))
    async with Client(server) as client:
        untold = await client.call_tool("estimate_gsd", by_path(images / "two.png"))
    assert result.structured_content == untold.structured_content
    assert text_of(result) == text_of(untold)
    assert len(answered.forms) == 1


async def test_what_is_known_or_would_not_help_is_not_asked(
    server: MCPServer[object], images: Path
) -> None:
    person = Person("decline")
    copy = {"frame": {"width_px": 320, "height_px": 256}}
    line = {"x1": 100, "y1": 50, "x2": 300, "y2": 50, "metres": 28}
    async with at(server, person) as client:
        await client.call_tool("estimate_gsd", by_path(images / "cars.png"))  # good enough
        await client.call_tool("estimate_gsd", {**by_path(images / "empty.png"), **copy})
        await client.call_tool(
            "estimate_gsd", {**by_path(images / "two.png"), "region": "europe", "height_m": 30}
        )
        await client.call_tool(
            "estimate_gsd", {**by_path(images / "two.png"), "known_lengths": [line]}
        )
    fields = [list(form.requested_schema["properties"]) for form in person.forms]
    assert fields == [["height_m", "height_basis", "focal_35mm", "known_length"], ["known_length"]]
    assert (
        "320 x 256" in person.forms[0].requested_schema["properties"]["known_length"]["description"]
    )


async def test_clients_without_forms_get_the_low_result_at_once(
    server: MCPServer[object], settings: Settings, images: Path
) -> None:
    person = Person("accept", height_m=30, focal_35mm=24)
    never = create_server(create_services(replace(settings, never_ask=True)))
    results = []
    for client in (at(server, person, "legacy"), at(never, person), Client(server)):
        async with client:
            results.append(await client.call_tool("estimate_gsd", by_path(images / "two.png")))
    assert not person.forms
    assert (
        results[0].structured_content
        == results[1].structured_content
        == results[2].structured_content
    )
    assert results[0].structured_content is not None
    assert results[0].structured_content["status"] == "low_confidence"


async def test_any_server_can_answer_the_second_call(settings: Settings, images: Path) -> None:
    here = create_server(create_services(settings))
    elsewhere = create_server(create_services(settings))
    arguments = by_path(images / "empty.png")
    async with at(here, Person("cancel")) as client:
        first = await client.session.call_tool("estimate_gsd", arguments, allow_input_required=True)
    assert isinstance(first, mcp.types.InputRequiredResult)
    assert first.request_state is None
    assert first.input_requests is not None
    answers: Any = {
        key: ElicitResult(action="accept", content={"height_m": 30, "focal_35mm": 24})
        for key in first.input_requests
    }
    async with Client(elsewhere) as client:
        result = await client.session.call_tool("estimate_gsd", arguments, input_responses=answers)
    assert isinstance(result, mcp.types.CallToolResult)
    assert result.structured_content is not None
    assert result.structured_content["leading_ruler"] == "height"


@pytest.mark.parametrize(
    ("answer", "complaint"),
    [
        (
            {"known_length": "from the door to the gate"},
            "known_length: the known length is 'from the",
        ),
        ({"known_length": "0 0 100 0 -5"}, "metres is '-5': use a finite number > 0"),
        ({"height_m": -3}, "height_m: use a finite number > 0"),
        ({"region": "atlantis"}, "region"),
        ({"colour": "red"}, "colour"),
    ],
)
async def test_an_answer_without_meaning_is_told(
    server: MCPServer[object], images: Path, answer: dict[str, Any], complaint: str
) -> None:
    async with at(server, Person("accept", **answer)) as client:
        result = await client.call_tool("estimate_gsd", by_path(images / "two.png"))
    assert error_of(result) == "invalid_answer"
    assert complaint in text_of(result)
