"""The program `fingerjax`, and `python -m fingerjax`."""

from __future__ import annotations

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA warns at length of every program that it reads from its own cache
# Threads of XLA's own. jaxlib's dense solves wait on these for one another, and on two cores two of them could wait for ever.
os.environ.setdefault("NPROC", "16")
# Small dense matrices, factorised by the hundred: on a busy machine two threads wait for one another longer than they work.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import typer

from fingerjax.commands.design import design
from fingerjax.commands.diagnose import diagnose
from fingerjax.commands.effects import effects
from fingerjax.commands.grid import grid
from fingerjax.commands.mesh import mesh
from fingerjax.commands.run import run
from fingerjax.commands.studies import studies
from fingerjax.commands.verify import verify

app = typer.Typer(
    name="fingerjax",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    help=(
        "What is this fingertip made of, how sure can one be, and what does the model miss?\n\n"
        "Start with:  fingerjax run experiments.yaml\n\n"
        "Then open results/experiments/report.html."
    ),
)
app.command()(run)
app.command()(diagnose)
app.command()(effects)
app.command()(mesh)
app.command()(studies)
app.command()(verify)
app.command()(design)
app.command()(grid)


def main() -> None:
    """Entry point of the console script."""
    app()


if __name__ == "__main__":
    main()
