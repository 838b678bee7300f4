"""One bar over all steps of all studies, with the time left; a line now and then where there is no terminal to draw a bar on."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeElapsedColumn
from rich.text import Text

APART = 10.0  # seconds between lines that stand in for a bar


class TimeLeft(ProgressColumn):
    """What the share done so far says about the rest; steps are too unequal for a speed."""

    def render(self, task: Task) -> Text:
        left = remaining(task.elapsed or 0.0, task.percentage / 100.0)
        return Text("" if left is None else f"{clock(left)} left", style="progress.remaining")


def remaining(elapsed: float, share: float) -> float | None:
    """Seconds left where `share` of the work took `elapsed` seconds; None before that can be said."""
    return None if share < 0.02 else elapsed * (1.0 - share) / share


def clock(seconds: float) -> str:
    """75 s as 1:15."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"


class Board:
    """The bar of a run. A study counts as much as it took last time, or as the others do.

    **Arguments:** names of the studies in order, the seconds that they took before (of some of them), where
    to draw.
    """

    def __init__(self, names: Sequence[str], before: Mapping[str, float], console: Console):
        known = [before[name] for name in names if before.get(name, 0.0) > 0]
        usual = sum(known) / len(known) if known else 1.0
        weights = [before.get(name, 0.0) or usual for name in names]
        total = sum(weights) or 1.0
        self.share = {name: weight / total for name, weight in zip(names, weights, strict=True)}
        self.start = {name: sum(list(self.share.values())[:k]) for k, name in enumerate(names)}
        self.console = console
        self.began = time.perf_counter()
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"))
        self.progress = Progress(*columns, TimeElapsedColumn(), TimeLeft(), console=console, transient=True)
        self.task = self.progress.add_task("starting", total=1.0)
        self._said = self.began, ""

    def __enter__(self) -> Board:
        if self.console.is_terminal:
            self.progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.progress.stop()

    def teller(self, name: str) -> Callable[[float, str], None]:
        """The `tell` of a study's context."""

        def tell(share: float, doing: str) -> None:
            done = self.start[name] + self.share[name] * share
            self.progress.update(self.task, completed=done, description=f"{name}: {doing}"[:70])
            if not self.console.is_terminal:
                self._say(done, f"{name}: {doing}")

        return tell

    def _say(self, done: float, text: str) -> None:
        """What a bar would show, if it is news and the last line is not too fresh."""
        now, (when, before) = time.perf_counter(), self._said
        if text != before and now - when >= APART:
            self._said = now, text
            self.line(f"{clock(now - self.began)}  {100 * done:3.0f} %  {text}")

    def line(self, text: str) -> None:
        """A line that stays above the bar."""
        self.console.print(text, highlight=False, markup=False, soft_wrap=True)
