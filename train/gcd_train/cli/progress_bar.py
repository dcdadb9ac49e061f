"""The one progress bar of `gcd-train`."""

from collections.abc import Callable, Generator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


@contextmanager
def progress_bar(what: str, total: int, *, keep: bool = False) -> Generator[Callable[[int], None]]:
    """A bar on stderr; call what this gives with the number done so far. keep: leave the bar there at the end."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=not keep) as bar:
        task = bar.add_task(what, total=total)
        yield lambda done: bar.update(task, completed=done)
