"""Ask an OpenAI model about an aerial image, with VehAnchor's tools.

    pip install -r examples/requirements.txt
    export OPENAI_API_KEY=... OPENAI_MODEL=...               # and OPENAI_BASE_URL for a gateway
    python examples/openai_tool_use.py examples/car_park.jpg "How wide is the car park, in metres?"

With ``--way agents``, the OpenAI Agents SDK gets the tools from the server and calls them. With
``--way responses``, this script calls them in a loop of its own over the Responses API; the strict
definitions of the tools are in ``schemas/openai.json``.
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
    import openai
    from agents import Agent, Runner, ToolCallItem, ToolCallOutputItem, set_tracing_disabled
    from agents.mcp import MCPServerStdio
    from mcp import Client, StdioServerParameters
except ModuleNotFoundError as missing:
    sys.exit(
        f"this example needs the package {missing.name!r}: pip install -r examples/requirements.txt"
    )

MAX_TURNS = 8
SCHEMAS = Path(__file__).parent.parent / "schemas" / "openai.json"
SYSTEM = (
    "You answer questions about aerial images. Every distance, length and area comes from a "
    "tool, never from your own eyes. If a tool's status is not ok, say that the image allows no "
    "answer, and name another source of scale."
)


async def by_agents(model: str, root: Path, question: str) -> str:
    """Answer with the Agents SDK, which launches the server and calls its tools."""
    set_tracing_disabled(True)
    command: Any = {"command": "vehanchor", "args": ["serve", "--root", str(root)]}
    async with MCPServerStdio(
        params=command, client_session_timeout_seconds=60, cache_tools_list=True
    ) as server:
        agent = Agent(name="surveyor", instructions=SYSTEM, model=model, mcp_servers=[server])
        result = await Runner.run(agent, question, max_turns=MAX_TURNS)
    for item in result.new_items:
        if isinstance(item, ToolCallItem):
            name = getattr(item.raw_item, "name", "")
            arguments = getattr(item.raw_item, "arguments", "")
            print(f"calls {name} {arguments}")
        elif isinstance(item, ToolCallOutputItem):
            print("tool ", *texts_of(item.output))
    return str(result.final_output)


def texts_of(output: Any) -> list[str]:
    """Return the texts of a tool's output, which is a list if there is a picture."""
    parts = output if isinstance(output, list) else [output]
    return [part.get("text", "") if isinstance(part, dict) else part for part in parts]


async def by_responses(model: str, root: Path, question: str) -> str:
    """Answer with a loop of our own over the Responses API and the definitions on disk."""
    definitions = json.loads(SCHEMAS.read_text(encoding="utf-8"))
    server = StdioServerParameters(command="vehanchor", args=["serve", "--root", str(root)])
    items: list[Any] = [{"role": "user", "content": question}]
    async with openai.AsyncOpenAI() as client, Client(server) as tools:
        for _ in range(MAX_TURNS):
            response = await client.responses.create(
                model=model, instructions=SYSTEM, input=items, tools=definitions
            )
            calls = [item for item in response.output if item.type == "function_call"]
            if not calls:
                return response.output_text
            items += response.output
            for call in calls:
                items.append(await call_tool(tools, call))
    return "no answer: too many turns"


async def call_tool(tools: Client, call: Any) -> dict[str, Any]:
    """Call a tool of the server; return its record and its pictures for the model."""
    print(f"calls {call.name} {call.arguments}")
    result = await tools.call_tool(call.name, json.loads(call.arguments))
    record = " ".join(getattr(part, "text", "") for part in result.content)
    print(f"tool  {record}")
    if result.structured_content:
        record = json.dumps(result.structured_content)
    return {
        "type": "function_call_output",
        "call_id": call.call_id,
        "output": [{"type": "input_text", "text": record}, *pictures(result.content)],
    }


def pictures(content: list[Any]) -> list[dict[str, Any]]:
    """Convert a tool's pictures for the model."""
    return [
        {
            "type": "input_image",
            "image_url": f"data:{part.mime_type};base64,{part.data}",
            "detail": "auto",
        }
        for part in content
        if part.type == "image"
    ]


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
    parser = argparse.ArgumentParser(description="Ask an OpenAI model about an aerial image.")
    parser.add_argument("image", type=Path)
    parser.add_argument("question")
    parser.add_argument("--way", choices=("agents", "responses"), default="agents")
    options = parser.parse_args()
    image = options.image.resolve()
    read_environment("OPENAI_API_KEY", "your key, from platform.openai.com")
    model = read_environment("OPENAI_MODEL", "a model's name")
    ask = by_agents if options.way == "agents" else by_responses
    question = f"{options.question}\nThe image is the file {image}."
    print(f"asked {question}")
    failed = None
    try:
        answer = await ask(model, image.parent, question)
        print(f"says  {answer}")
    except* openai.APIError as errors:
        failed = errors
    # Leaving inside "except*" would wrap the exit in a group, too.
    if failed is not None:
        exit_with_first(failed, "OPENAI_BASE_URL")


if __name__ == "__main__":
    asyncio.run(main())
