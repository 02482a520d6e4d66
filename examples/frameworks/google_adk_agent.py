"""Google ADK agent with VehAnchor's tools.

Run python google_adk_agent.py IMAGE QUESTION with GEMINI_API_KEY and GEMINI_MODEL set and
`vehanchor` on the PATH.
"""

import asyncio
import os
import sys
from pathlib import Path

try:
    from google.adk.agents import LlmAgent
    from google.adk.runners import InMemoryRunner
    from google.adk.tools.mcp_tool.mcp_session_manager import StdioConnectionParams
    from google.adk.tools.mcp_tool.mcp_toolset import McpToolset
    from mcp import StdioServerParameters
except ModuleNotFoundError as missing:
    sys.exit(
        f"this example needs the package {missing.name!r}: "
        "pip install -r google_adk_agent.requirements.txt"
    )

SYSTEM = (
    "Every distance and area comes from a tool. If a tool's status is not ok, say that the image "
    "allows no answer."
)


async def main(image: Path, question: str) -> None:
    """Ask the agent a question about an image."""
    server = StdioServerParameters(command="vehanchor", args=["serve", "--root", str(image.parent)])
    tools = McpToolset(connection_params=StdioConnectionParams(server_params=server, timeout=60))
    agent = LlmAgent(
        name="surveyor", model=os.environ["GEMINI_MODEL"], instruction=SYSTEM, tools=[tools]
    )
    async with InMemoryRunner(agent, app_name="vehanchor") as runner:
        events = await runner.run_debug(f"{question}\nThe image is the file {image}.", quiet=True)
        answer = events[-1].content.parts
        print("".join(part.text or "" for part in answer))


if __name__ == "__main__":
    asyncio.run(main(Path(sys.argv[1]).resolve(), sys.argv[2]))
