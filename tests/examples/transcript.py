"""Write ``docs/transcripts/``: the output of the examples with language models.

    python -m tests.examples.transcript

The stand-in is their model, and the transcripts state it. Every answer of a tool is measured.
"""

from __future__ import annotations

from tests.conftest import ROOT
from tests.examples.stand_in import StandIn
from tests.examples.test_agents import CALLS, EXAMPLES, QUESTION, STRICT, run_example, variables
from tests.needs import environment

_ANSWER = "(the scripted model repeats what the tool said) {result}"
_HEAD = (
    "Made by `python -m tests.examples.transcript`: the example really ran, its tools really "
    "measured; the model was a stand-in\nthat follows a script behind the real API's wire format, "
    "so what it says is not a language model's.\n\n"
)


def main() -> None:
    """Run and write."""
    folder = ROOT / "docs" / "transcripts"
    folder.mkdir(parents=True, exist_ok=True)
    python = environment(EXAMPLES / "requirements.txt")
    for script, way, calls in (
        ("claude_tool_use.py", "mcp", CALLS),
        ("openai_tool_use.py", "agents", STRICT),
    ):
        with StandIn(calls, _ANSWER).listening() as stand_in:
            done = run_example(python, script, "--way", way, **variables(script, stand_in))
        done.check_returncode()
        printed = done.stdout.replace(str(ROOT), "/path/to/vehanchor")
        command = f'$ python examples/{script} examples/scenes/safe.jpg "{QUESTION}" --way {way}\n'
        path = folder / f"{script.removesuffix('.py')}.txt"
        path.write_text(_HEAD + command + printed, encoding="utf-8")
        print(path)


if __name__ == "__main__":
    main()
