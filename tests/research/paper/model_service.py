"""Local service with the Anthropic Messages and OpenAI Chat Completions APIs, for tests.

What the model says is a function of what it is shown: the picture as pixels, the text, and results
of tools.
"""

from __future__ import annotations

import base64
import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.json_server import Answered, json_server


@dataclass(frozen=True)
class ModelRequest:
    """What the model is shown."""

    system: str
    text: str
    picture: NDArray[np.uint8]
    tools: list[dict[str, Any]]
    tool_results: list[str]


@dataclass(frozen=True)
class UseTool:
    """A reply that calls a tool."""

    name: str
    arguments: dict[str, Any]


@dataclass(frozen=True)
class Refusal:
    """A reply that the service marks as a refusal."""

    text: str = "I cannot help with that."


Answer = str | UseTool | Refusal


@dataclass
class ModelService:
    """What the service does, and what it was asked.

    Attributes:
        answer: the model.
        failures: what the next requests get instead of an answer: status and headers, or None to
            hang up.
        defects: what the model itself raised; shown where the service stops.
        requests: every request so far: path, headers (lower case) and payload.
    """

    answer: Callable[[ModelRequest], Answer] = lambda _: "AREA=100"
    failures: list[tuple[int, dict[str, str]] | None] = field(default_factory=list)
    requests: list[tuple[str, dict[str, str], dict[str, Any]]] = field(default_factory=list)
    defects: list[BaseException] = field(default_factory=list)
    url: str = ""


@contextmanager
def model_service(service: ModelService) -> Iterator[ModelService]:
    """Run the service on a free port; ``service.url`` says where."""
    lock = threading.Lock()

    def answered(path: str, headers: dict[str, str], payload: dict[str, Any]) -> Answered | None:
        with lock:
            service.requests.append((path, headers, payload))
            number = len(service.requests)
            failure = service.failures.pop(0) if service.failures else (0, {})
        if failure is None:
            return None
        status, more = failure
        if status:
            return status, {"error": {"type": "test", "message": "scripted"}}, more
        try:
            if path == "/v1/messages":
                return (
                    200,
                    _anthropic_response(service.answer(_asked_anthropic(payload)), number),
                    {},
                )
            if path == "/v1/chat/completions":
                return 200, _openai_response(service.answer(_asked_openai(payload)), number), {}
            raise ValueError(f"no such API: {path}")
        except Exception as defect:
            service.defects.append(defect)
            return 400, {"error": {"message": repr(defect)}}, {}

    with json_server(answered) as service.url:
        yield service
    assert not service.defects, service.defects


def red_rectangle(picture: NDArray[np.uint8]) -> tuple[int, int, int, int]:
    """Find the inside of the red rectangle: x1, y1, x2, y2.

    These are the first pixel, and the first one beyond, that is not red.
    """
    red = (picture[:, :, 0] > 170) & (picture[:, :, 1] < 90) & (picture[:, :, 2] < 90)
    ys, xs = np.nonzero(red)
    x1 = xs.min()
    x2 = xs.max()
    y1 = ys.min()
    y2 = ys.max()
    middle_x = (x1 + x2) // 2
    middle_y = (y1 + y2) // 2
    while red[middle_y, x1]:
        x1 += 1
    while red[middle_y, x2]:
        x2 -= 1
    while red[y1, middle_x]:
        y1 += 1
    while red[y2, middle_x]:
        y2 -= 1
    return int(x1), int(y1), int(x2) + 1, int(y2) + 1


def _decoded(data: str) -> NDArray[np.uint8]:
    bgr = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    assert bgr is not None
    return np.ascontiguousarray(bgr[:, :, ::-1]).astype(np.uint8)


def _asked_anthropic(payload: dict[str, Any]) -> ModelRequest:
    image, text = payload["messages"][0]["content"]
    assert image["source"]["media_type"] == "image/jpeg"
    results = []
    calls: set[str] = set()
    for message in payload["messages"][1:]:
        blocks = message["content"]
        if message["role"] == "assistant":
            calls |= {block["id"] for block in blocks if block["type"] == "tool_use"}
        else:
            assert {block["tool_use_id"] for block in blocks} <= calls
            results += [block["content"] for block in blocks]
    tools = [
        {"name": tool["name"], "schema": tool["input_schema"]} for tool in payload.get("tools", [])
    ]
    return ModelRequest(
        payload["system"],
        text["text"],
        picture=_decoded(image["source"]["data"]),
        tools=tools,
        tool_results=results,
    )


def _asked_openai(payload: dict[str, Any]) -> ModelRequest:
    system, user, *rest = payload["messages"]
    image, text = user["content"]
    head, _, data = image["image_url"]["url"].partition(",")
    assert head == "data:image/jpeg;base64"
    results = []
    calls: set[str] = set()
    for message in rest:
        if message["role"] == "assistant":
            calls |= {call["id"] for call in message["tool_calls"]}
        else:
            assert message["tool_call_id"] in calls
            results.append(message["content"])
    tools = [
        {"name": tool["function"]["name"], "schema": tool["function"]["parameters"]}
        for tool in payload.get("tools", [])
    ]
    return ModelRequest(
        system["content"], text["text"], picture=_decoded(data), tools=tools, tool_results=results
    )


def _anthropic_response(answer: Answer, number: int) -> dict[str, Any]:
    stop = {UseTool: "tool_use", Refusal: "refusal"}.get(type(answer), "end_turn")
    if isinstance(answer, UseTool):
        content: list[dict[str, Any]] = [
            {"type": "text", "text": "I will measure."},
            {
                "type": "tool_use",
                "id": f"call_{number}",
                "name": answer.name,
                "input": answer.arguments,
            },
        ]
    else:
        content = [{"type": "text", "text": answer.text if isinstance(answer, Refusal) else answer}]
    return {
        "id": f"msg_{number}",
        "type": "message",
        "role": "assistant",
        "model": "test",
        "content": content,
        "stop_reason": stop,
        "stop_sequence": None,
        "usage": {"input_tokens": 1000, "output_tokens": 50},
    }


def _openai_response(answer: Answer, number: int) -> dict[str, Any]:
    message: dict[str, Any] = {"role": "assistant", "content": None}
    if isinstance(answer, UseTool):
        function = {"name": answer.name, "arguments": json.dumps(answer.arguments)}
        message["tool_calls"] = [{"id": f"call_{number}", "type": "function", "function": function}]
    elif isinstance(answer, Refusal):
        message["refusal"] = answer.text
    else:
        message["content"] = answer
    return {
        "id": f"chat_{number}",
        "object": "chat.completion",
        "created": 0,
        "model": "test",
        "choices": [
            {
                "index": 0,
                "message": message,
                "finish_reason": "tool_calls" if isinstance(answer, UseTool) else "stop",
                "logprobs": None,
            }
        ],
        "usage": {"prompt_tokens": 1000, "completion_tokens": 50, "total_tokens": 1050},
    }
