"""Ask an OpenAI model about an aerial image, with VehAnchor's tools.

    pip install -r examples/requirements.txt
    export OPENAI_API_KEY=... OPENAI_MODEL=...               # and OPENAI_BASE_URL for a gateway
    python examples/openai_tool_use.py examples/car_park.jpg "How wide is the car park, in metres?"

``--way agents`` passes the server to the OpenAI Agents SDK. ``--way responses`` uses the strict
definitions in ``schemas/openai.json`` with its own loop over the Responses API.
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
    "tool, never from your own "
    "eyes. If a tool's status is not ok, say that the image allows no answer, and name another "
    "source of scale."
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
            print(
                f"calls {getattr(item.raw_item, 'name', '')} "
                f"{getattr(item.raw_item, 'arguments', '')}"
            )
        elif isinstance(item, ToolCallOutputItem):
            # a list if there is a picture
            parts = item.output if isinstance(item.output, list) else [item.output]
            print(
                "tool ",
                *(part.get("text", "") if isinstance(part, dict) else part for part in parts),
            )
    return str(result.final_output)


async def by_responses(model: str, root: Path, question: str) -> str:
    """Answer with a loop of our own over the Responses API and the definitions on disk."""
    server = StdioServerParameters(command="vehanchor", args=["serve", "--root", str(root)])
    items: list[Any] = [{"role": "user", "content": question}]
    async with openai.AsyncOpenAI() as client, Client(server) as tools:
        for _ in range(MAX_TURNS):
            response = await client.responses.create(
                model=model,
                instructions=SYSTEM,
                input=items,
                tools=json.loads(SCHEMAS.read_text(encoding="utf-8")),
            )
            calls = [item for item in response.output if item.type == "function_call"]
            if not calls:
                return response.output_text
            items += response.output
            for call in calls:
                print(f"calls {call.name} {call.arguments}")
                result = await tools.call_tool(call.name, json.loads(call.arguments))
                text = " ".join(getattr(part, "text", "") for part in result.content)
                print(f"tool  {text}")
                record = (
                    json.dumps(result.structured_content) if result.structured_content else text
                )
                shown = [
                    {
                        "type": "input_image",
                        "image_url": f"data:{part.mime_type};base64,{part.data}",
                        "detail": "auto",
                    }
                    for part in result.content
                    if part.type == "image"
                ]
                output = [{"type": "input_text", "text": record}, *shown]
                items.append(
                    {"type": "function_call_output", "call_id": call.call_id, "output": output}
                )
    return "no answer: too many turns"


def from_environment(name: str, what: str) -> str:
    """Read a required environment variable."""
    value = os.environ.get(name)
    if not value:
        sys.exit(f"{name} is not set: export {name}=<{what}> first")
    return value


def leave(errors: BaseExceptionGroup[Any], base_url: str) -> None:
    """End with the first error of the API in one sentence."""
    error: BaseException = errors
    while isinstance(error, BaseExceptionGroup):  # task groups wrap errors
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
    from_environment("OPENAI_API_KEY", "your key, from platform.openai.com")
    model = from_environment("OPENAI_MODEL", "a model's name")
    ask = by_agents if options.way == "agents" else by_responses
    question = f"{options.question}\nThe image is the file {image}."
    print(f"asked {question}")
    failed = None
    try:
        print(f"says  {await ask(model, image.parent, question)}")
    except* openai.APIError as errors:
        failed = errors
    if failed is not None:
        leave(failed, "OPENAI_BASE_URL")


if __name__ == "__main__":
    asyncio.run(main())
