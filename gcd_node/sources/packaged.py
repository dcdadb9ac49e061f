"""Files that ship with the package."""

from importlib.resources import files
from pathlib import Path

from gcd_node.errors import SourceError

PREFIX = "package:"


def resolve_path(name: str) -> Path:
    """The path a launch file means: `package:drive.mp4` is a file of this package, anything else is itself.

    Raises:
        SourceError: the package has no such file.
    """
    if not name.startswith(PREFIX):
        return Path(name).expanduser()
    assets = Path(str(files("gcd_node").joinpath("assets")))
    path = assets / name.removeprefix(PREFIX)
    if path.parent != assets or not path.is_file():
        known = ", ".join(sorted(PREFIX + entry.name for entry in assets.glob("*.mp4")))
        raise SourceError(f"the package has no file {name}; it has {known or 'none, install it again'}")
    return path
