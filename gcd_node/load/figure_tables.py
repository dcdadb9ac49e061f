"""Tables of figures, drawn alike in a terminal and on a page."""

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, slots=True)
class FigureTable:
    """rows: each as long as columns. names: how many cells, from the left, say what the others are figures of."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    names: int = 1

    def markdown(self) -> str:
        """As a Markdown table under its title, figures to the right."""
        ruler = ["---"] * self.names + ["---:"] * (len(self.columns) - self.names)
        return "\n".join([f"**{self.title}**", "", *(_line(row) for row in (self.columns, ruler, *self.rows))])


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def figure(value: float | None, digits: int = 3) -> str:
    """A number to so many digits, without an exponent between a ten-thousandth and a million; empty for none."""
    if value is None:
        return ""
    if value != 0 and not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    whole = len(str(int(abs(value))))
    decimals = max(0, digits - whole) if abs(value) >= 1 else _decimals_below_one(value, digits)
    return f"{value:.{decimals}f}"


def _decimals_below_one(value: float, digits: int) -> int:
    return digits if value == 0 else int(f"{abs(value):e}".partition("e-")[2] or 0) + digits - 1
