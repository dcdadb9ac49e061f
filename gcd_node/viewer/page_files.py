"""The files of the page, as they ship with the package."""

from dataclasses import dataclass
from importlib.resources import files

from gcd_node.errors import NodeError

_TYPES = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
}


@dataclass(frozen=True, kw_only=True, slots=True)
class PageFile:
    """content_type: for HTTP."""

    content_type: str
    body: bytes


def load_page() -> dict[str, PageFile]:
    """Every file by its path, "/" for the page itself.

    Raises:
        NodeError: the package lacks it.
    """
    found = {
        "/" if entry.name == "index.html" else f"/{entry.name}": PageFile(
            content_type=_TYPES[entry.name.rpartition(".")[2]], body=entry.read_bytes()
        )
        for entry in files("gcd_node").joinpath("viewer", "page").iterdir()
        if entry.is_file() and entry.name.rpartition(".")[2] in _TYPES
    }
    if "/" not in found:
        raise NodeError("the package lacks the viewer's page; install gcd-node again")
    return found
