"""Give the scripted planner the tasks of ``vehanchor_evaluation.question_set``, with and without facts.

    python -m research.benchmarks.question_set /data /tmp/rendered

The first folder holds the photographs, the second receives the rendered scenes. ``--record`` keeps the table.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path
from typing import get_args

from research.results.record import add_record_option, header, recording
from vehanchor_evaluation.agent_tools import open_agent_tools
from vehanchor_evaluation.question_set import TASKS, Deed, SetQuestion, ask_set, question_set, task_of
from vehanchor_scenes import render_scene


def picture_of(question: SetQuestion, data: Path, rendered: Path) -> Path:
    """Name the photograph of a question, or render its scene."""
    if question.scene is None:
        return data / question.file
    path = rendered / question.file
    if not path.is_file():
        render_scene(**question.scene.model_dump()).write(path)
    return path


def main() -> None:
    """Print each answer, and the counts of both planners."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("rendered", type=Path)
    folders = add_record_option(parser).parse_args()
    folders.rendered.mkdir(parents=True, exist_ok=True)
    pictures = [(each, picture_of(each, folders.data, folders.rendered)) for each in question_set()]
    asked = [(task_of(each, kind), path) for each, path in pictures for kind in TASKS]
    deeds: tuple[Deed, ...] = get_args(Deed)
    rows = []
    with open_agent_tools([folders.data.resolve(), folders.rendered.resolve()]) as tools:
        for catalogue in (True, False):
            answers = ask_set(asked, tools, catalogue=catalogue)
            name = "with what it recognises" if catalogue else "without"
            for each in answers:
                ratio = "" if each.ratio is None else f"{each.ratio:.3f}"
                seen = each.task.question
                print(
                    f"{name:24} {each.task.kind:10} {each.deed:22} {each.status:16} {ratio:6} {seen.file} ({seen.why})"
                )
            for kind in TASKS:
                counts = Counter(each.deed for each in answers if each.task.kind == kind)
                rows.append(f"| {name} | {kind} | {' | '.join(str(counts[deed]) for deed in deeds)} |")
    with recording("agents", ["question_set"], folders.record):
        print(header("planner", "task", *deeds), *rows, sep="\n")


if __name__ == "__main__":
    main()
