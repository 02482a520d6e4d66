"""Ask the scripted planner the forty questions of ``vehanchor_evaluation.question_set``, with and without facts.

    python -m research.benchmarks.question_set /data /tmp/rendered

The first folder holds the photographs, the second receives the rendered scenes.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

from vehanchor_evaluation.agent_tools import open_agent_tools
from vehanchor_evaluation.question_set import ask_set, question_set


def main() -> None:
    """Print each answer, and the counts of both planners."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("rendered", type=Path)
    folders = parser.parse_args()
    folders.rendered.mkdir(parents=True, exist_ok=True)
    with open_agent_tools([folders.data.resolve(), folders.rendered.resolve()]) as tools:
        for catalogue in (True, False):
            answers = ask_set(question_set(), tools, folders.data, folders.rendered, catalogue=catalogue)
            name = "with the catalogue" if catalogue else "without it"
            for each in answers:
                ratio = "" if each.ratio is None else f"{each.ratio:.3f}"
                print(f"{name:20} {each.deed:22} {each.status:16} {ratio:6} {each.question.file} ({each.question.why})")
            print(name, dict(Counter(each.deed for each in answers)), flush=True)


if __name__ == "__main__":
    main()
