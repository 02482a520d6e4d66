"""A model that follows a script, behind the wire formats of three real APIs.

The server answers ``POST /v1/messages`` (Anthropic), ``POST /v1/responses`` (OpenAI) and ``POST
.../models/<model>:generateContent`` (Gemini) on a port of the loopback interface.

The model asks for one tool call after the other, and then answers with the result of the last one.
Each request contains the conversation so far; the server keeps it only if Anthropic's SDK asks for
a thread. Requests that the real APIs would refuse are refused: those without a key, and those with
a tool call but without its result.
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
    """Request that the real API would refuse."""


@dataclass(frozen=True)
class ToolCall:
    """Call of a tool that the model asks for."""

    name: str
    arguments: dict[str, Any]


@dataclass
class StandIn:
    """Server of a scripted model; ``listening`` starts it.

    Attributes:
        calls: the script.
        answer: the model's text at the end; ``{result}`` stands for the last tool's text.
        requests: bodies received so far, with their threads written out.
        threads: conversation up to a message, by the message's id.
        url: address of the server, without a path.
    """

    calls: Sequence[ToolCall]
    answer: str = "The tool says: {result}"
    requests: list[dict[str, Any]] = field(default_factory=list)
    threads: dict[str, dict[str, Any]] = field(default_factory=dict)
    url: str = ""

    def tool_names(self) -> set[str]:
        """Return the tools that the last request offered."""
        return set(_offered(self.requests[-1].get("tools", [])))

    def n_pictures(self) -> int:
        """Count the pictures that the model has been shown as pictures, up to its last turn."""
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
            # Some SDKs send the key in one header, some in the other.
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

    def _next_step(self, body: dict[str, Any], results: list[str]) -> ToolCall | str:
        """Return the next call of the script, or the answer after the last one."""
        if len(results) == len(self.calls):
            return self.answer.format(result=results[-1])
        call = self.calls[len(results)]
        tools = _offered(body.get("tools", []))
        _require(call.name in tools, f"the script calls {call.name}, offered are {sorted(tools)}")
        return call

    def _with_thread(self, body: dict[str, Any]) -> dict[str, Any]:
        """Put the conversation of a continued thread before a request's messages."""
        thread = body.pop("thread", None) or {}
        if thread.get("type") != "continue":
            return body
        previous_id = thread["previous_message_id"]
        _require(previous_id in self.threads, "previous_message_id: no such message")
        before = self.threads[previous_id]
        return {**before, **body, "messages": [*before["messages"], *body["messages"]]}

    def _anthropic(self, body: dict[str, Any]) -> dict[str, Any]:
        _require(isinstance(body.get("max_tokens"), int), "max_tokens: field required")
        blocks = [block for message in body["messages"] for block in _blocks(message["content"])]
        call_ids = [block["id"] for block in blocks if block["type"] == "tool_use"]
        results = [block for block in blocks if block["type"] == "tool_result"]
        result_ids = [block["tool_use_id"] for block in results]
        _require(call_ids == result_ids, "tool_use ids without tool_result blocks")
        step = self._next_step(body, [_text(block["content"]) for block in results])
        if isinstance(step, str):
            stop_reason = "end_turn"
            block: dict[str, Any] = {"type": "text", "text": step}
        else:
            stop_reason = "tool_use"
            block = {
                "type": "tool_use",
                "id": f"toolu_{len(results)}",
                "name": step.name,
                "input": step.arguments,
            }
        message_id = f"msg_{len(self.requests)}"
        reply = {"role": "assistant", "content": [block]}
        self.threads[message_id] = {**body, "messages": [*body["messages"], reply]}
        return {
            "id": message_id,
            "type": "message",
            "role": "assistant",
            "model": body["model"],
            "content": [block],
            "stop_reason": stop_reason,
            "stop_sequence": None,
            "usage": {"input_tokens": 1, "output_tokens": 1},
        }

    def _openai(self, body: dict[str, Any]) -> dict[str, Any]:
        items: list[dict[str, Any]] = []
        if isinstance(body["input"], list):
            items = [item for item in body["input"] if isinstance(item, dict)]
        call_ids = [item["call_id"] for item in items if item.get("type") == "function_call"]
        results = [item for item in items if item.get("type") == "function_call_output"]
        result_ids = [item["call_id"] for item in results]
        _require(call_ids == result_ids, "No tool output found for function call")
        step = self._next_step(body, [_text(item["output"]) for item in results])
        number = len(results)
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
        call_names = [part["functionCall"]["name"] for part in parts if "functionCall" in part]
        results = [part["functionResponse"] for part in parts if "functionResponse" in part]
        result_names = [result["name"] for result in results]
        _require(call_names == result_names, "function responses must follow function calls")
        responses = [result["response"] for result in results]
        texts = [_text(response.get("content", response)) for response in responses]
        step = self._next_step(body, texts)
        if isinstance(step, str):
            reply: dict[str, Any] = {"text": step}
        else:
            call_id = f"call_{len(results)}"
            reply = {"functionCall": {"name": step.name, "args": step.arguments, "id": call_id}}
        candidate = {
            "content": {"role": "model", "parts": [reply]},
            "finishReason": "STOP",
            "index": 0,
        }
        return {
            "candidates": [candidate],
            "usageMetadata": {
                "promptTokenCount": 1,
                "candidatesTokenCount": 1,
                "totalTokenCount": 2,
            },
            "modelVersion": "stand-in",
        }


# Names of a tool's schema in the three APIs and their SDKs.
_SCHEMA_KEYS = ("input_schema", "parameters", "parametersJsonSchema", "parameters_json_schema")


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise _RefusedError(message)


def _offered(tools: Iterable[dict[str, Any]]) -> list[str]:
    """Return the names of a request's tools, in the form of any of the APIs."""
    names = []
    for tool in tools:
        for entry in tool.get("functionDeclarations", [tool]):
            schema = next((entry[key] for key in _SCHEMA_KEYS if key in entry), None)
            if not isinstance(schema, dict):
                raise _RefusedError(f"tool {entry.get('name')!r} has no schema")
            _require(str(schema["type"]).lower() == "object", "a tool's schema is an object's")
            names.append(entry["name"])
    return names


def _count_pictures(value: Any) -> int:
    """Count the blocks that one of the three APIs shows its models as pictures."""
    if isinstance(value, list):
        return sum(_count_pictures(part) for part in value)
    if not isinstance(value, dict):
        return 0
    if value.get("type") in ("image", "input_image") or "inlineData" in value:
        return 1
    return sum(_count_pictures(part) for part in value.values())


def _blocks(content: Any) -> list[dict[str, Any]]:
    if isinstance(content, str):
        return [{"type": "text", "text": content}]
    return list(content)


def _text(content: Any) -> str:
    """Return the text of a tool's result, in any of the forms that SDKs send."""
    if isinstance(content, str):
        return content
    if isinstance(content, list):
        return " ".join(str(part.get("text", "")) for part in content)
    return json.dumps(content)
