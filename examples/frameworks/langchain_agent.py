"""LangGraph agent of LangChain with VehAnchor's tools.

LangChain's adapters need mcp < 2, and the server needs mcp 2: this example has an environment of
its own. Beside `vehanchor`, it would replace the server's mcp by an older one. In the environment
of `vehanchor`, with OPENAI_API_KEY and OPENAI_MODEL set:

    python -m venv langchain_env
    langchain_env/bin/pip install -r langchain_agent.requirements.txt
    langchain_env/bin/python langchain_agent.py IMAGE QUESTION

The server is `vehanchor` on the PATH, or a running `vehanchor serve --http` at VEHANCHOR_URL.
"""

import asyncio
import os
import sys
from pathlib import Path

try:
    from langchain.agents import create_agent
    from langchain_mcp_adapters.client import MultiServerMCPClient
    from langchain_openai import ChatOpenAI
except ModuleNotFoundError as missing:
    sys.exit(
        f"this example needs the package {missing.name!r}: "
        "pip install -r langchain_agent.requirements.txt, in an environment of its own"
    )

SYSTEM = (
    "Every distance and area comes from a tool. If a tool's status is not ok, say that the image "
    "allows no answer."
)


async def main(image: Path, question: str) -> None:
    """Ask the agent a question about an image."""
    url = os.environ.get("VEHANCHOR_URL")
    if url:
        connection = {"transport": "streamable_http", "url": url}
    else:
        connection = {
            "transport": "stdio",
            "command": "vehanchor",
            "args": ["serve", "--root", str(image.parent)],
        }
    tools = await MultiServerMCPClient({"vehanchor": connection}).get_tools()
    model = ChatOpenAI(model=os.environ["OPENAI_MODEL"], use_responses_api=True)
    agent = create_agent(model, tools, system_prompt=SYSTEM)
    message = ("user", f"{question}\nThe image is the file {image}.")
    state = await agent.ainvoke({"messages": [message]})
    print(state["messages"][-1].text)


if __name__ == "__main__":
    asyncio.run(main(Path(sys.argv[1]).resolve(), sys.argv[2]))
