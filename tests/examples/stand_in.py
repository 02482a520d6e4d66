"""A model that follows a script, behind the wire formats of three real APIs.

``POST /v1/messages`` (Anthropic), ``POST /v1/responses`` (OpenAI) and ``POST
.../models/<model>:generateContent`` (Gemini) on a port of the loopback interface. The model asks
for one tool call after the other and then answers with what the last tool said. What was said
before it sees in each request, or keeps where Anthropic's SDK asks for a thread. A request that the
real APIs would refuse is refused: no key, a tool call without its result.
"""

from __future__ import annotations

import json
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from tests.json_server import Answered, json_server

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from typing import Self

KEY = "key-of-the-stand-in"


class _RefusedError(Exception):
    pass


@dataclass(frozen=True)
class ToolCall:
    """What the model asks for at its turn."""

    name: str
    arguments: dict[str, Any]


@dataclass
class StandIn:
    """The server; ``listening`` starts it.

    Attributes:
        calls: the script.
        answer: what the model says at the end; ``{result}`` is what the last tool said.
        requests: bodies received so far, threads written out.
        threads: what was said up to a message, by its id.
        url: where it listens, without a path.
    """

    calls: Sequence[ToolCall]
    answer: str = "The tool says: {result}"
    requests: list[dict[str, Any]] = field(default_factory=list)
    threads: dict[str, dict[str, Any]] = field(default_factory=dict)
    url: str = ""

    def tool_names(self) -> set[str]:
        """Tools that the last request offered."""
        return {name for name, _ in _offered(self.requests[-1].get("tools", []))}

    def n_pictures(self) -> int:
        """Pictures that the model has been shown, as pictures, up to its last turn."""
        return _count_pictures(self.requests[-1])

    @contextmanager
    def listening(self) -> Iterator[Self]:
        """Listen at ``url``."""
        with json_server(self._answered) as self.url:
            yield self

    def _answered(self, path: str, headers: dict[str, str], body: dict[str, Any]) -> Answered:
        try:
            body = self._with_thread(body)
            self.requests.append(body)
            return 200, self._reply(path.partition("?")[0], headers, body), {}
        except _RefusedError as reason:
            error = {
                "type": "invalid_request_error",
                "message": str(reason),
                "code": 400,
                "status": "INVALID",
            }
            return 400, {"type": "error", "error": error}, {}

    def _reply(self, path: str, sent: dict[str, str], body: dict[str, Any]) -> dict[str, Any]:
        _require(bool(body.get("model")) or ":generateContent" in path, "model: field required")
        if path == "/v1/messages":
            # SDKs differ
            keys = sent.get("x-api-key"), sent.get("authorization", "").removeprefix("Bearer ")
            _require(KEY in keys, "x-api-key header is required")
            _require("anthropic-version" in sent, "anthropic-version header is required")
            return self._anthropic(body)
        if path == "/v1/responses":
            _require(sent.get("authorization") == f"Bearer {KEY}", "you did not provide an API key")
            return self._openai(body)
        if path.endswith(":generateContent"):
            _require(sent.get("x-goog-api-key") == KEY, "API key not valid")
            return self._gemini(body)
        raise _RefusedError(f"no such endpoint: {path}")

    def _next(self, body: dict[str, Any], results: list[str]) -> ToolCall | str:
        tools = dict(_offered(body.get("tools", [])))
        if len(results) == len(self.calls):
            return self.answer.format(result=results[-1])
        call = self.calls[len(results)]
        _require(call.name in tools, f"the script calls {call.name}, offered are {sorted(tools)}")
        return call

    def _with_thread(self, body: dict[str, Any]) -> dict[str, Any]:
        thread = body.pop("thread", None) or {}
        if thread.get("type") != "continue":
            return body
        _require(
            thread["previous_message_id"] in self.threads, "previous_message_id: no such message"
        )
        before = self.threads[thread["previous_message_id"]]
        return {**before, **body, "messages": [*before["messages"], *body["messages"]]}

    def _anthropic(self, body: dict[str, Any]) -> dict[str, Any]:
        _require(isinstance(body.get("max_tokens"), int), "max_tokens: field required")
        blocks = [block for message in body["messages"] for block in _blocks(message["content"])]
        asked = [block["id"] for block in blocks if block["type"] == "tool_use"]
        given = [block for block in blocks if block["type"] == "tool_result"]
        _require(
            asked == [block["tool_use_id"] for block in given],
            "tool_use ids without tool_result blocks",
        )
        step = self._next(body, [_text(block["content"]) for block in given])
        if isinstance(step, str):
            content: list[dict[str, Any]] = [{"type": "text", "text": step}]
        else:
            content = [
                {
                    "type": "tool_use",
                    "id": f"toolu_{len(given)}",
                    "name": step.name,
                    "input": step.arguments,
                }
            ]
        message_id = f"msg_{len(self.requests)}"
        reply = {"role": "assistant", "content": content}
        self.threads[message_id] = {**body, "messages": [*body["messages"], reply]}
        return {
            "id": message_id,
            "type": "message",
            "role": "assistant",
            "model": body["model"],
            "content": content,
            "stop_reason": "end_turn" if isinstance(step, str) else "tool_use",
            "stop_sequence": None,
            "usage": {"input_tokens": 1, "output_tokens": 1},
        }

    def _openai(self, body: dict[str, Any]) -> dict[str, Any]:
        items = (
            [item for item in body["input"] if isinstance(item, dict)]
            if isinstance(body["input"], list)
            else []
        )
        asked = [item["call_id"] for item in items if item.get("type") == "function_call"]
        given = [item for item in items if item.get("type") == "function_call_output"]
        _require(
            asked == [item["call_id"] for item in given], "No tool output found for function call"
        )
        step = self._next(body, [_text(item["output"]) for item in given])
        number = len(given)
        if isinstance(step, str):
            content = [{"type": "output_text", "text": step, "annotations": []}]
            output = {
                "type": "message",
                "id": f"msg_{number}",
                "role": "assistant",
                "content": content,
            }
        else:
            output = {
                "type": "function_call",
                "id": f"fc_{number}",
                "call_id": f"call_{number}",
                "name": step.name,
                "arguments": json.dumps(step.arguments),
            }
        return {
            "id": f"resp_{number}",
            "object": "response",
            "created_at": 1_700_000_000,
            "status": "completed",
            "error": None,
            "incomplete_details": None,
            "instructions": None,
            "metadata": {},
            "model": body["model"],
            "output": [output | {"status": "completed"}],
            "parallel_tool_calls": True,
            "temperature": 1.0,
            "tool_choice": "auto",
            "tools": [],
            "top_p": 1.0,
            "usage": {
                "input_tokens": 1,
                "input_tokens_details": {"cached_tokens": 0},
                "output_tokens": 1,
                "output_tokens_details": {"reasoning_tokens": 0},
                "total_tokens": 2,
            },
        }

    def _gemini(self, body: dict[str, Any]) -> dict[str, Any]:
        parts = [part for content in body["contents"] for part in content["parts"]]
        asked = [part["functionCall"]["name"] for part in parts if "functionCall" in part]
        given = [part["functionResponse"] for part in parts if "functionResponse" in part]
        _require(
            asked == [part["name"] for part in given],
            "function responses must follow function calls",
        )
        step = self._next(
            body, [_text(part["response"].get("content", part["response"])) for part in given]
        )
        part: dict[str, Any] = (
            {"text": step}
            if isinstance(step, str)
            else {
                "functionCall": {
                    "name": step.name,
                    "args": step.arguments,
                    "id": f"call_{len(given)}",
                }
            }
        )
        return {
            "candidates": [
                {"content": {"role": "model", "parts": [part]}, "finishReason": "STOP", "index": 0}
            ],
            "usageMetadata": {
                "promptTokenCount": 1,
                "candidatesTokenCount": 1,
                "totalTokenCount": 2,
            },
            "modelVersion": "stand-in",
        }


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise _RefusedError(message)


def _offered(tools: Iterable[dict[str, Any]]) -> list[tuple[str, dict[str, Any]]]:
    """Names and schemas of the tools of a request, in the form of any of the APIs."""
    found = []
    for tool in tools:
        for entry in tool.get("functionDeclarations", [tool]):
            keys = ("input_schema", "parameters", "parametersJsonSchema", "parameters_json_schema")
            schema = next((entry[key] for key in keys if key in entry), None)
            _require(isinstance(schema, dict), f"tool {entry.get('name')!r} has no schema")
            _require(str(schema["type"]).lower() == "object", "a tool's schema is an object's")  # type: ignore[index]
            found.append((entry["name"], schema or {}))
    return found


def _count_pictures(value: Any) -> int:
    """Blocks that one of the three APIs shows its models as pictures."""
    if isinstance(value, list):
        return sum(map(_count_pictures, value))
    if not isinstance(value, dict):
        return 0
    if value.get("type") in ("image", "input_image") or "inlineData" in value:
        return 1
    return sum(map(_count_pictures, value.values()))


def _blocks(content: Any) -> list[dict[str, Any]]:
    return [{"type": "text", "text": content}] if isinstance(content, str) else list(content)


def _text(content: Any) -> str:
    """The words of a tool's result, in any of the forms that the SDKs give it."""
    if isinstance(content, list):
        return " ".join(str(part.get("text", "")) for part in content)
    return content if isinstance(content, str) else json.dumps(content)
