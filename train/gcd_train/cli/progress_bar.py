"""What `gcd-train` says while it works: the one progress bar, and lines on stderr."""

import signal
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


def say(line: str) -> None:
    """A line on stderr, as it is."""
    Console(stderr=True, highlight=False).print(line, markup=False, soft_wrap=True)


def stop_as_by_ctrl_c() -> None:
    """From now on SIGTERM ends this process as Ctrl-C does, so that no worker is left behind."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
