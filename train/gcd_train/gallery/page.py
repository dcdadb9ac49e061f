"""The page that shows all windows: `index.html`, with nothing but pictures and links beside it."""

from collections.abc import Sequence
from html import escape
from pathlib import Path

from gcd_train.evaluation.keeping import write_whole
from gcd_train.gallery.viewed import Viewed

_STYLE = (
    "body{font:15px/1.45 sans-serif;margin:2em auto;max-width:1080px;padding:0 1em;color:#222}"
    "img{max-width:100%;border:1px solid #ddd}h2{margin-top:2em}.note{color:#666}.fault{color:#a02020}"
)


def write_page(viewed: Sequence[Viewed], faults: Sequence[str], facts: Sequence[tuple[str, str]], out: Path) -> None:
    """Write the page.

    Args:
        viewed: windows in order, whose files lie beside the page. faults: what could not be shown, a line each. facts:
            name and value of what holds for all: the command, the weights, the options.
    Raises:
        RunError: it cannot be written.
    """
    rows = "".join(f"<tr><th align=left>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in facts)
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8><title>Views of real videos</title>",
        f"<style>{_STYLE}</style><h1>Views of real videos</h1>",
        "<p>Every pixel of a view is generated. Nobody knows what was really there: a view that looks right is no "
        f"evidence that it is.</p><table>{rows}</table>",
        *(f"<p class=fault>{escape(fault)}</p>" for fault in faults),
        *map(_section, viewed),
    ]
    write_whole(out, ("\n".join(parts) + "</html>\n").encode())


def _section(viewed: Viewed) -> str:
    name = escape(viewed.window.name, quote=True)
    notes = escape("; ".join(viewed.notes))
    return (
        f"<h2>{escape(viewed.window.video)}, window {viewed.window.number + 1}</h2><p class=note>{notes}; "
        f'<a href="{name}.mp4">video</a></p><a href="{name}.png"><img src="{name}.png" alt="{name}"></a>'
    )
