"""Give the scripted planner the tasks of ``vehanchor_evaluation.question_set``, with and without facts.

    python -m research.benchmarks.question_set /data /tmp/rendered

The first folder holds the photographs, the second receives the rendered scenes.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

from vehanchor_evaluation.agent_tools import open_agent_tools
from vehanchor_evaluation.question_set import TASKS, SetQuestion, ask_set, question_set, task_of
from vehanchor_scenes import render_scene


def picture_of(question: SetQuestion, data: Path, rendered: Path) -> Path:
    """Name the photograph of a question, or render its scene."""
    if question.scene is None:
        return data / question.file
    path = rendered / question.file
    if not path.is_file():
        told = question.scene
        scene = render_scene(
            told.gsd_m_per_px, width_px=told.width_px, height_px=told.height_px, seed=told.seed, layout=told.layout
        )
        scene.write(path)
    return path


def main() -> None:
    """Print each answer, and the counts of both planners."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("rendered", type=Path)
    folders = parser.parse_args()
    folders.rendered.mkdir(parents=True, exist_ok=True)
    pictures = [(each, picture_of(each, folders.data, folders.rendered)) for each in question_set()]
    asked = [(task_of(each, kind), path) for each, path in pictures for kind in TASKS]
    with open_agent_tools([folders.data.resolve(), folders.rendered.resolve()]) as tools:
        for catalogue in (True, False):
            answers = ask_set(asked, tools, catalogue=catalogue)
            name = "with the catalogue" if catalogue else "without it"
            for each in answers:
                ratio = "" if each.ratio is None else f"{each.ratio:.3f}"
                seen = each.task.question
                print(
                    f"{name:20} {each.task.kind:10} {each.deed:22} {each.status:16} {ratio:6} {seen.file} ({seen.why})"
                )
            for kind in TASKS:
                print(name, kind, dict(Counter(each.deed for each in answers if each.task.kind == kind)), flush=True)


if __name__ == "__main__":
    main()
