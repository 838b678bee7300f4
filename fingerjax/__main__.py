"""The program `fingerjax`, and `python -m fingerjax`."""

from __future__ import annotations

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA warns at length of every program that it reads from its own cache
# Programs that hold batches of small dense solves have been seen to wait for ever on XLA's own two threads. The heavy linear algebra
# is the factorisation's, which has threads of its own.
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")

import typer

from fingerjax.commands.mesh import mesh
from fingerjax.commands.run import run
from fingerjax.commands.studies import studies

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
app.command()(mesh)
app.command()(studies)


def main() -> None:
    """Entry point of the console script."""
    app()


if __name__ == "__main__":
    main()
