"""Ask Claude about an aerial image, with VehAnchor's tools.

    pip install -r examples/requirements.txt
    export ANTHROPIC_API_KEY=... ANTHROPIC_MODEL=...        # and ANTHROPIC_BASE_URL for a gateway
    python examples/claude_tool_use.py examples/car_park.jpg "How wide is the car park, in metres?"

With ``--way mcp``, the SDK gets the tools from the server and calls them. With ``--way schemas``,
this script calls them in a loop of its own, for programs without MCP; the definitions of the tools
are in ``schemas/anthropic.json``.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import sys
from pathlib import Path
from typing import Any

try:
    import anthropic
    from anthropic.lib.tools.mcp import async_mcp_tool
    from mcp import Client, StdioServerParameters
except ModuleNotFoundError as missing:
    sys.exit(
        f"this example needs the package {missing.name!r}: pip install -r examples/requirements.txt"
    )

MAX_TOKENS = 2048
MAX_TURNS = 8
SCHEMAS = Path(__file__).parent.parent / "schemas" / "anthropic.json"
SYSTEM = (
    "You answer questions about aerial images. Every distance, length and area comes from a "
    "tool, never from your own eyes. If a tool's status is not ok, say that the image allows no "
    "answer, and name another source of scale."
)


async def by_mcp(claude: anthropic.AsyncAnthropic, model: str, tools: Client, question: str) -> str:
    """Answer with the SDK's tool runner, which calls the server's tools."""
    listed = await tools.list_tools()
    runner = claude.beta.messages.tool_runner(
        model=model,
        max_tokens=MAX_TOKENS,
        max_iterations=MAX_TURNS,
        system=SYSTEM,
        tools=[async_mcp_tool(tool, tools) for tool in listed.tools],
        messages=[{"role": "user", "content": question}],
    )
    answer = ""
    async for message in runner:
        answer = print_calls(message)
        # The runner calls the tools; their results are its next message.
        results = await runner.generate_tool_call_response()
        if results:
            for block in results["content"]:
                print_result(text_of_block(block))
    return answer


async def by_schemas(
    claude: anthropic.AsyncAnthropic, model: str, tools: Client, question: str
) -> str:
    """Answer with a loop of our own and the definitions on disk."""
    definitions = json.loads(SCHEMAS.read_text(encoding="utf-8"))
    messages: list[Any] = [{"role": "user", "content": question}]
    for _ in range(MAX_TURNS):
        message = await claude.messages.create(
            model=model,
            max_tokens=MAX_TOKENS,
            system=SYSTEM,
            tools=definitions,
            messages=messages,
        )
        answer = print_calls(message)
        if message.stop_reason != "tool_use":
            return answer
        calls = [block for block in message.content if block.type == "tool_use"]
        results = [await call_tool(tools, call) for call in calls]
        messages.append({"role": "assistant", "content": message.content})
        messages.append({"role": "user", "content": results})
    return "no answer: too many turns"


async def call_tool(tools: Client, call: Any) -> dict[str, Any]:
    """Call a tool of the server; return its record and its pictures for Claude."""
    result = await tools.call_tool(call.name, call.input)
    record = " ".join(getattr(part, "text", "") for part in result.content)
    print_result(record)
    if result.structured_content:
        record = json.dumps(result.structured_content)
    return {
        "type": "tool_result",
        "tool_use_id": call.id,
        "content": [{"type": "text", "text": record}, *pictures(result.content)],
        "is_error": result.is_error,
    }


def pictures(content: list[Any]) -> list[dict[str, Any]]:
    """Convert a tool's pictures for Claude."""
    return [
        {
            "type": "image",
            "source": {"type": "base64", "media_type": part.mime_type, "data": part.data},
        }
        for part in content
        if part.type == "image"
    ]


def print_calls(message: Any) -> str:
    """Print Claude's tool calls; return its text."""
    for block in message.content:
        if block.type == "tool_use":
            print(f"calls {block.name} {json.dumps(block.input)}")
    return "".join(block.text for block in message.content if block.type == "text")


def text_of_block(block: Any) -> str:
    """Return the text of a tool's result, which is a string or a list of parts."""
    content = block["content"]
    if isinstance(content, str):
        return content
    return " ".join(part.get("text", "") for part in content)


def print_result(text: str) -> None:
    """Print a tool's answer."""
    print(f"tool  {text}")


def read_environment(name: str, described: str) -> str:
    """Read a required environment variable."""
    value = os.environ.get(name)
    if not value:
        sys.exit(f"{name} is not set: export {name}=<{described}> first")
    return value


def exit_with_first(errors: BaseExceptionGroup[Any], base_url: str) -> None:
    """End with the first error of the API in one sentence."""
    error: BaseException = errors
    # Task groups wrap errors in groups.
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    sys.exit(f"the API gives no answer: {error} Check the network, the key and {base_url}.")


async def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Ask Claude about an aerial image.")
    parser.add_argument("image", type=Path)
    parser.add_argument("question")
    parser.add_argument("--way", choices=("mcp", "schemas"), default="mcp")
    options = parser.parse_args()
    image = options.image.resolve()
    key = read_environment("ANTHROPIC_API_KEY", "your key, from console.anthropic.com")
    model = read_environment("ANTHROPIC_MODEL", "a Claude model's name")
    server = StdioServerParameters(command="vehanchor", args=["serve", "--root", str(image.parent)])
    ask = by_mcp if options.way == "mcp" else by_schemas
    question = f"{options.question}\nThe image is the file {image}."
    print(f"asked {question}")
    failed = None
    try:
        async with anthropic.AsyncAnthropic(api_key=key) as claude, Client(server) as tools:
            answer = await ask(claude, model, tools, question)
            print(f"says  {answer}")
    except* anthropic.APIError as errors:
        failed = errors
    # Leaving inside "except*" would wrap the exit in a group, too.
    if failed is not None:
        exit_with_first(failed, "ANTHROPIC_BASE_URL")


if __name__ == "__main__":
    asyncio.run(main())
