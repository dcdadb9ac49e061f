"""Files of a scene while it is written, each with its checksum."""

import hashlib
from pathlib import Path


class SceneFiles:
    """Writes into one scene folder and remembers the SHA-256 of everything."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.checksums: dict[str, str] = {}
        self.size = 0
        self._made: set[Path] = set()

    def write(self, path: Path, data: bytes) -> None:
        """One file; its folder is made when needed. Raises OSError, which names it, for one if the disk is full."""
        if path.parent not in self._made:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._made.add(path.parent)
        try:
            path.write_bytes(data)
        except OSError as error:  # a full disk does not say for which file
            raise OSError(error.errno, error.strerror, str(path)) from error
        self.checksums[path.relative_to(self.folder).as_posix()] = hashlib.sha256(data).hexdigest()
        self.size += len(data)
