"""Vision-language models behind the Anthropic Messages API and the OpenAI Chat Completions API.

The providers' clients (extra ``examples``) send the requests. They retry on 408, 409, 429, 5xx,
timeouts and lost connections, and respect ``Retry-After``. This module adds a store of replies and
limits on cost. Keys come only from the environment; they are never stored, hashed or printed.
"""

from __future__ import annotations

import hashlib
import json
import os
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias
from urllib.parse import urlsplit

from vehanchor.errors import InvalidParameterError, MissingExtraError
from vehanchor.storage.journal import Journal, Key

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from research.paper.tools import ToolCaller

Provider: TypeAlias = Literal["anthropic", "openai", "openai-compatible"]
_KEY_VARIABLES = {
    "anthropic": "ANTHROPIC_API_KEY",
    "openai": "OPENAI_API_KEY",
    "openai-compatible": "OPENAI_API_KEY",
}
# The client requires a key, also for compatible servers without keys.
_NO_KEY = "none"
# The key or the model is wrong, so other requests would fail, too.
_REFUSALS = (401, 403, 404)
_JPEG = "image/jpeg"
Messages: TypeAlias = list[dict[str, Any]]


class RequestFailedError(Exception):
    """A request failed after all attempts."""


class ApiRefusedError(Exception):
    """The service refuses the key or lacks the model."""


class BudgetSpentError(Exception):
    """A limit on cost is reached."""


class ToolCall(NamedTuple):
    """Tool call that a model requests."""

    id: str
    name: str
    arguments: dict[str, Any]


class ToolResult(NamedTuple):
    """Result of a tool call for the model."""

    text: str
    is_error: bool


@dataclass(frozen=True)
class Reply:
    """Reply of a model.

    Attributes:
        text: all text of the reply.
        refused: whether the service marks it as a refusal.
        tool_calls: tool calls that the model requests before it continues.
        input_tokens: tokens of the request.
        output_tokens: tokens of the reply.
        message: the reply as the conversation's next message.
    """

    text: str
    refused: bool
    tool_calls: tuple[ToolCall, ...]
    input_tokens: int
    output_tokens: int
    message: dict[str, Any]


@dataclass
class Budget:
    """Limits on the cost of a run; stored replies are free.

    Attributes:
        max_requests: maximum number of requests; None for no limit.
        max_tokens: maximum number of input and output tokens.
        requests: number of requests so far.
        tokens: number of tokens so far.
    """

    max_requests: int | None = None
    max_tokens: int | None = None
    requests: int = 0
    tokens: int = 0

    def begin(self) -> None:
        """Take one request from the budget.

        Raises:
            BudgetSpentError: the budget is spent.
        """
        if self.max_requests is not None and self.requests >= self.max_requests:
            raise BudgetSpentError(f"{self.requests} requests made, the limit of --max-requests")
        if self.max_tokens is not None and self.tokens >= self.max_tokens:
            raise BudgetSpentError(
                f"{self.tokens} tokens used, the limit of --max-tokens is {self.max_tokens}"
            )
        self.requests += 1


def reply_journal(folder: Path | None) -> Journal[dict[str, Any]]:
    """Open the stored responses of a folder, which are never requested again; None: in memory.

    Raises:
        InvalidParameterError: the file in the folder is not a journal.
        OutputError: the file cannot be read or written.
    """
    path = None if folder is None else folder / "replies.sqlite"
    return Journal(path, {"responses": "as the service gave them"}, dump=dict, load=dict)


def _request_key(provider: str, base_url: str, payload: dict[str, Any]) -> Key:
    """Hash everything that a response depends on (SHA-256); the service's key is not included."""
    text = json.dumps([provider, base_url, payload], sort_keys=True, ensure_ascii=True)
    return (hashlib.sha256(text.encode()).hexdigest(),)


class ModelApi(ABC):
    """Model of a provider.

    Attributes:
        provider: provider of the model.
        model: the provider's name of the model.
        base_url: address of the service.
        budget: limits on cost.
    """

    def __init__(
        self,
        provider: str,
        model: str,
        client: Any,
        api_error: type[Exception],
        replies: Journal[dict[str, Any]],
        budget: Budget,
    ) -> None:
        self.provider = provider
        self.model = model
        self.budget = budget
        self.base_url = str(client.base_url)
        self._client = client
        self._api_error = api_error
        self._replies = replies

    def ask(self, system: str, messages: Messages, tools: ToolCaller | None = None) -> Reply:
        """Ask the model, or read the stored reply.

        Raises:
            RequestFailedError: the request failed after all attempts.
            ApiRefusedError: the key or the model is refused.
            BudgetSpentError: a limit on cost is reached.
            OutputError: the reply cannot be stored.
        """
        payload = self._payload(system, messages, tools)
        key = _request_key(self.provider, self.base_url, payload)
        response = self._replies.get(key)
        if response is None:
            self.budget.begin()
            response = self._send(payload)
            reply = self._parse(response)
            self.budget.tokens += reply.input_tokens + reply.output_tokens
            self._replies.add(key, response)
            return reply
        return self._parse(response)

    def _send(self, payload: dict[str, Any]) -> dict[str, Any]:
        try:
            response = self._create(payload).to_dict(mode="json", exclude_none=True, warnings=False)
        except self._api_error as error:
            status = getattr(error, "status_code", None)
            if status in (401, 403):  # the service's message may quote the key
                raise ApiRefusedError(f"{self.base_url} refuses the key ({status})") from None
            if status in _REFUSALS:
                raise ApiRefusedError(
                    f"{self.base_url} lacks the model {self.model!r} or this API ({status})"
                ) from None
            reason = f"status {status}" if status else type(error).__name__
            message = str(error).replace(self._client.api_key, "***")
            raise RequestFailedError(f"{reason}: {message[:300]}") from None
        return dict(response)

    def _parse(self, response: dict[str, Any]) -> Reply:
        try:
            return self._read(response)
        except (KeyError, TypeError, IndexError, ValueError) as error:
            raise RequestFailedError(
                f"the reply has an unexpected form: {type(error).__name__}: {error}"
            ) from None

    @abstractmethod
    def first_messages(self, system: str, text: str, jpeg_base64: str) -> Messages:
        """Start a conversation with an image and a question."""

    @abstractmethod
    def next_messages(
        self, messages: Messages, reply: Reply, results: Sequence[ToolResult]
    ) -> Messages:
        """Continue a conversation with a reply and the results of its tool calls."""

    @abstractmethod
    def _payload(
        self, system: str, messages: Messages, tools: ToolCaller | None
    ) -> dict[str, Any]: ...

    @abstractmethod
    def _create(self, payload: dict[str, Any]) -> Any: ...

    @abstractmethod
    def _read(self, response: dict[str, Any]) -> Reply: ...


class AnthropicApi(ModelApi):
    """Anthropic's Messages API."""

    def __init__(self, *args: Any, max_output_tokens: int) -> None:
        super().__init__(*args)
        self._max_output_tokens = max_output_tokens

    def first_messages(self, system: str, text: str, jpeg_base64: str) -> Messages:
        """See ``ModelApi``; this API has a separate field for the system prompt."""
        del system
        source = {"type": "base64", "media_type": _JPEG, "data": jpeg_base64}
        return [
            {
                "role": "user",
                "content": [{"type": "image", "source": source}, {"type": "text", "text": text}],
            }
        ]

    def next_messages(
        self, messages: Messages, reply: Reply, results: Sequence[ToolResult]
    ) -> Messages:
        """See ``ModelApi``."""
        content = [
            {
                "type": "tool_result",
                "tool_use_id": call.id,
                "content": result.text,
                "is_error": result.is_error,
            }
            for call, result in zip(reply.tool_calls, results, strict=True)
        ]
        return [*messages, reply.message, {"role": "user", "content": content}]

    def _payload(self, system: str, messages: Messages, tools: ToolCaller | None) -> dict[str, Any]:
        payload: dict[str, Any] = {
            "model": self.model,
            "max_tokens": self._max_output_tokens,
            "system": system,
            "messages": messages,
        }
        return payload if tools is None else {**payload, "tools": tools.anthropic_tools}

    def _create(self, payload: dict[str, Any]) -> Any:
        return self._client.messages.create(**payload)

    def _read(self, response: dict[str, Any]) -> Reply:
        blocks = response["content"]
        usage = response["usage"]
        cached = usage.get("cache_creation_input_tokens", 0) + usage.get(
            "cache_read_input_tokens", 0
        )
        return Reply(
            text="\n".join(block["text"] for block in blocks if block["type"] == "text"),
            refused=response.get("stop_reason") == "refusal",
            tool_calls=tuple(
                ToolCall(block["id"], block["name"], dict(block["input"]))
                for block in blocks
                if block["type"] == "tool_use"
            ),
            input_tokens=usage["input_tokens"] + cached,
            output_tokens=usage["output_tokens"],
            message={"role": "assistant", "content": blocks},
        )


class OpenAiApi(ModelApi):
    """Chat Completions API of OpenAI or a compatible service (vLLM, DashScope, ...)."""

    def __init__(self, *args: Any, max_output_tokens: int) -> None:
        super().__init__(*args)
        # OpenAI's newer models refuse the older name; most compatible servers accept only that one
        name = "max_completion_tokens" if self.provider == "openai" else "max_tokens"
        self._limits = {name: max_output_tokens}

    def first_messages(self, system: str, text: str, jpeg_base64: str) -> Messages:
        """See ``ModelApi``."""
        picture = {
            "type": "image_url",
            "image_url": {"url": f"data:{_JPEG};base64,{jpeg_base64}", "detail": "high"},
        }
        return [
            {"role": "system", "content": system},
            {"role": "user", "content": [picture, {"type": "text", "text": text}]},
        ]

    def next_messages(
        self, messages: Messages, reply: Reply, results: Sequence[ToolResult]
    ) -> Messages:
        """See ``ModelApi``."""
        answers = [
            {"role": "tool", "tool_call_id": call.id, "content": result.text}
            for call, result in zip(reply.tool_calls, results, strict=True)
        ]
        return [*messages, reply.message, *answers]

    def _payload(self, system: str, messages: Messages, tools: ToolCaller | None) -> dict[str, Any]:
        del system  # the first message
        payload: dict[str, Any] = {"model": self.model, "messages": messages, **self._limits}
        return payload if tools is None else {**payload, "tools": tools.openai_tools}

    def _create(self, payload: dict[str, Any]) -> Any:
        return self._client.chat.completions.create(**payload)

    def _read(self, response: dict[str, Any]) -> Reply:
        choice = response["choices"][0]
        message = choice["message"]
        usage = response.get("usage") or {}
        calls = message.get("tool_calls") or []
        sent = {
            "role": "assistant",
            "content": message.get("content") or message.get("refusal") or "",
        }
        return Reply(
            text=message.get("content") or message.get("refusal") or "",
            refused=bool(message.get("refusal")) or choice.get("finish_reason") == "content_filter",
            tool_calls=tuple(
                ToolCall(
                    call["id"], call["function"]["name"], _arguments(call["function"]["arguments"])
                )
                for call in calls
            ),
            input_tokens=usage.get("prompt_tokens", 0),
            output_tokens=usage.get("completion_tokens", 0),
            message={**sent, "tool_calls": calls} if calls else sent,
        )


def _arguments(text: str) -> dict[str, Any]:
    """Parse a model's JSON; invalid JSON becomes arguments that the tool refuses with an error."""
    try:
        arguments = json.loads(text or "{}")
    except ValueError:
        arguments = None
    return arguments if isinstance(arguments, dict) else {"arguments_are_not_a_json_object": text}


def open_api(
    provider: Provider,
    model: str,
    replies: Journal[dict[str, Any]],
    budget: Budget,
    *,
    base_url: str | None = None,
    max_output_tokens: int = 4096,
    timeout_s: float = 120.0,
    max_retries: int = 6,
) -> ModelApi:
    """Connect to a model.

    Args:
        provider: ``anthropic``, ``openai`` or ``openai-compatible``.
        model: the provider's name of the model.
        replies: stored replies, see ``reply_journal``.
        budget: limits on cost.
        base_url: address of the service; None for the provider's own, required for a compatible
            one.
        max_output_tokens: maximum number of tokens of one reply.
        timeout_s: time limit of one attempt.
        max_retries: attempts after the first.

    Raises:
        MissingExtraError: the provider's client is not installed.
        InvalidParameterError: the environment has no key, or the address of a compatible service is
            missing.
    """
    _check_address(provider, base_url)
    key = _key(provider)
    options = {
        "api_key": key,
        "base_url": base_url,
        "timeout": timeout_s,
        "max_retries": max_retries,
    }
    kind: type[AnthropicApi | OpenAiApi] = AnthropicApi if provider == "anthropic" else OpenAiApi
    client, api_error = _client(provider, options)
    return kind(
        provider, model, client, api_error, replies, budget, max_output_tokens=max_output_tokens
    )


def _check_address(provider: Provider, base_url: str | None) -> None:
    if provider == "openai-compatible" and base_url is None:
        raise InvalidParameterError(
            "a compatible service needs an address: --base-url http://host:8000/v1"
        )
    address = urlsplit(base_url or "")
    if base_url is not None and (
        not address.scheme.startswith("http") or address.username or address.query
    ):
        raise InvalidParameterError(
            "--base-url must be http(s)://host/path without user, password or key: keys come "
            "from the environment"
        )


def _key(provider: Provider) -> str:
    """Read the user's key from the environment."""
    variable = _KEY_VARIABLES[provider]
    key = os.environ.get(variable) or (_NO_KEY if provider == "openai-compatible" else "")
    if not key:
        raise InvalidParameterError(
            f"no key in the environment: set {variable} to your key for {provider}"
        )
    return key


def _client(provider: Provider, options: dict[str, Any]) -> tuple[Any, type[Exception]]:
    """Create the provider's client, and get the base of its errors."""
    try:
        if provider == "anthropic":
            import anthropic

            return anthropic.Anthropic(**options), anthropic.APIError
        import openai

        return openai.OpenAI(**options), openai.APIError
    except ImportError as error:
        raise MissingExtraError(
            f"{error.name} is not installed: pip install '.[examples]'"
        ) from error
