"""Pydantic AI agent with VehAnchor's tools.

Run python pydantic_ai_agent.py IMAGE QUESTION with OPENAI_API_KEY and OPENAI_MODEL set and
`vehanchor` on the PATH.
"""

import asyncio
import os
import sys
from pathlib import Path

try:
    from fastmcp.client.transports import StdioTransport
    from pydantic_ai import Agent
    from pydantic_ai.mcp import MCPToolset
except ModuleNotFoundError as missing:
    sys.exit(
        f"this example needs the package {missing.name!r}: "
        "pip install -r pydantic_ai_agent.requirements.txt"
    )

SYSTEM = (
    "Every distance and area comes from a tool. If a tool's status is not ok, say that the image "
    "allows no answer."
)


async def main(image: Path, question: str) -> None:
    """Ask the agent a question about an image."""
    server = StdioTransport("vehanchor", ["serve", "--root", str(image.parent)])
    tools = MCPToolset(server, init_timeout=60)
    model = f"openai-responses:{os.environ['OPENAI_MODEL']}"
    agent = Agent(model, instructions=SYSTEM, toolsets=[tools])
    async with agent:
        result = await agent.run(f"{question}\nThe image is the file {image}.")
    print(result.output)


if __name__ == "__main__":
    asyncio.run(main(Path(sys.argv[1]).resolve(), sys.argv[2]))
