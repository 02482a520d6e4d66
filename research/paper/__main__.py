"""Run a baseline of the paper: ``python -m research.paper rs-gsd | vlm | questions | ...``."""

from __future__ import annotations

import typer

from research.paper.planner_commands import agents, questions
from research.paper.rs_gsd_command import rs_gsd
from research.paper.transcript import transcript
from research.paper.vlm_command import vlm

app = typer.Typer(
    help="The paper's baselines: areas and answers of language models, with and without "
    "VehAnchor's tools.",
    no_args_is_help=True,
)
app.command("rs-gsd")(rs_gsd)
app.command("vlm")(vlm)
app.command("questions")(questions)
app.command("agents")(agents)
app.command("transcript")(transcript)

if __name__ == "__main__":
    app(prog_name="python -m research.paper")
