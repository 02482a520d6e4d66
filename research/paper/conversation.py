"""Conversation with a model about one picture, with or without tools."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from research.paper.vlm_api import Reply, ToolResult

if TYPE_CHECKING:
    from research.paper.tools import ToolCaller
    from research.paper.vlm_api import ModelApi


class Conversation(NamedTuple):
    """What a model said in the end, and what it cost.

    Attributes:
        last: its last reply; one with tool calls is unfinished.
        turns: number of replies.
        called: names of the called tools, in order.
        input_tokens: of all requests.
        output_tokens: of all replies.
    """

    last: Reply
    turns: int
    called: tuple[str, ...]
    input_tokens: int
    output_tokens: int

    @property
    def text(self) -> str:
        """Text of the last reply; empty if it is unfinished."""
        return "" if self.last.tool_calls else self.last.text

    @property
    def tokens(self) -> int:
        """Tokens in both directions."""
        return self.input_tokens + self.output_tokens


def converse(
    api: ModelApi,
    system: str,
    text: str,
    jpeg_base64: str,
    tools: ToolCaller | None = None,
    *,
    max_turns: int = 8,
) -> Conversation:
    """Ask a model about a picture and run its tool calls, until it answers or its turns are spent.

    Args:
        api: the model.
        system: its role.
        text: the question.
        jpeg_base64: the picture.
        tools: tools that it may call; None for none.
        max_turns: maximum number of replies.

    Raises:
        Exception: as ``ModelApi.ask``.
    """
    messages = api.first_messages(system, text, jpeg_base64)
    replies: list[Reply] = []
    called: list[str] = []
    while True:
        reply = api.ask(system, messages, tools)
        replies.append(reply)
        if tools is None or not reply.tool_calls or len(replies) >= max_turns:
            break
        results = [ToolResult(*tools.call(call.name, call.arguments)) for call in reply.tool_calls]
        called += [call.name for call in reply.tool_calls]
        messages = api.next_messages(messages, reply, results)
    costs = sum(each.input_tokens for each in replies), sum(each.output_tokens for each in replies)
    return Conversation(reply, len(replies), tuple(called), *costs)
