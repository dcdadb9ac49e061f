"""What the tests of `map_items` give to workers; imports little, so that these start quickly."""

import os
import signal
import time
from pathlib import Path

from gcd_train.data.files import FileFault


def killed_once(place: tuple[str, int]) -> int:
    """Kills its own process the first time it meets an item; the second time gives its square."""
    folder, number = place
    with Path(folder, f"{number}-attempts").open("a") as file:
        file.write(f"{os.getpid()}\n")
    if number in (3, 4) and len(Path(folder, f"{number}-attempts").read_text().split()) == 1:
        os.kill(os.getpid(), signal.SIGKILL if number == 3 else signal.SIGTERM)
    return number * number


def always_killed(number: int) -> int:
    """Kills its process at every 2."""
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def square(number: int) -> int:
    """Fails in three ways: an error of ours, one of the disk, and a bug."""
    if number == 1:
        raise FileFault(Path("one.png"), "is refused")
    if number == 2:
        raise OSError(28, "No space left on device")
    if number == 4:
        return number // 0
    return number * number


def unsendable(number: int) -> object:
    """Gives something that pickle refuses."""
    return lambda: number


def wait_for_ever(folder: str) -> None:
    """Leaves a file when it begins, and another when it is stopped in an orderly way."""
    Path(folder, f"begun-{os.getpid()}").touch()
    try:
        time.sleep(600)
    finally:
        Path(folder, f"cleaned-{os.getpid()}").touch()


def mark_and_square(place: tuple[str, int]) -> int:
    """Takes half a second, and leaves a file of its own each time."""
    folder, number = place
    time.sleep(0.5)
    Path(folder, f"{number}-{os.getpid()}-{time.time_ns()}").touch()
    return number * number


def seat_after_a_death(place: tuple[str, int]) -> str:
    """What the environment says, once two have said it; kills its process the first time it meets item 0."""
    folder, number = place
    first = Path(folder, "first")
    if number == 0 and not first.exists():
        first.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    seat, deadline = os.environ["SEAT"], time.monotonic() + 60
    Path(folder, f"seat-{seat}").touch()
    while len(list(Path(folder).glob("seat-*"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    return seat
