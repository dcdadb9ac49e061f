"""CURVE keys as files, and what a key's owner may do.

A key pair is a folder with `public.key` and `secret.key`, 40 characters (Z85) each; the secret one is readable by its
owner alone. Standard library only, Python 3.10 syntax: planners import this.
"""

import hashlib
import os
import re
import stat
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeAlias

from gcd_node.errors import ConfigError, OutputError

Role: TypeAlias = Literal["viewer", "operator"]
"""What a client may do: look, or also command. A viewer's verbs change nothing."""

PUBLIC_FILE = "public.key"
SECRET_FILE = "secret.key"  # noqa: S105  the file's name

_Z85 = re.compile(r"[0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")


@dataclass(frozen=True, kw_only=True, slots=True)
class KeyPair:
    """Both halves of a CURVE key, 40 characters (Z85) each. The secret one shows in no repr.

    Raises:
        ConfigError: a half is no key.
    """

    public: str
    secret: str = field(repr=False)

    def __post_init__(self) -> None:
        check_key(self.public, "the public key")
        if not is_key(self.secret):  # never shown, not even in an error
            raise ConfigError(f"the secret key must be 40 Z85 characters, got {len(self.secret)} characters")


@dataclass(frozen=True, kw_only=True, slots=True)
class ClientKeys:
    """What a client needs to reach a node that asks for keys: its own pair, and the node's public key.

    Raises:
        ConfigError: the node's key is none.
    """

    own: KeyPair
    server: str

    def __post_init__(self) -> None:
        check_key(self.server, "the node's public key")


@dataclass(frozen=True, kw_only=True, slots=True)
class Client:
    """Whose key it is, and what it may do."""

    name: str
    role: Role


def is_key(text: str) -> bool:
    """Whether the text is a CURVE key in Z85."""
    return _Z85.fullmatch(text) is not None


def check_key(text: str, what: str) -> None:
    """Raises ConfigError, naming `what`, unless the text is a key."""
    if not is_key(text):
        raise ConfigError(f"{what} must be 40 Z85 characters as `gcd-node keys show` prints, got {ascii(text)[:48]}")


def fingerprint(public: str) -> str:
    """A public key's name in logs: the first 16 hex digits of the SHA-256 of its Z85 text."""
    return hashlib.sha256(public.encode()).hexdigest()[:16]


def write_key_pair(folder: Path, pair: KeyPair) -> None:
    """Write a new key folder, mode 0700, with its secret file of mode 0600.

    Raises:
        OutputError: there are keys already, which are never overwritten, or the folder cannot be written.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        _write_new(folder / SECRET_FILE, pair.secret, 0o600)
        _write_new(folder / PUBLIC_FILE, pair.public, 0o644)
    except FileExistsError as error:
        raise OutputError(f"{folder} holds keys already; choose another folder, or move the old keys away") from error
    except OSError as error:
        raise OutputError(f"cannot write keys to {folder}: {error.strerror}; choose another folder") from error


def read_key_pair(folder: Path) -> KeyPair:
    """Read a key folder.

    Raises:
        ConfigError: a file is missing or no key, or others than its owner may read the secret.
    """
    secret = folder / SECRET_FILE
    text = _read(secret)
    mode = stat.S_IMODE(secret.stat().st_mode)
    if mode & 0o077:
        raise ConfigError(f"{secret} must be readable by its owner alone, its mode is {mode:04o}; run chmod 600 on it")
    return KeyPair(public=_read(folder / PUBLIC_FILE), secret=text)


def read_public_key(text: str) -> str:
    """A public key given as itself, as its file, or as a key folder.

    Raises:
        ConfigError: it is none of these.
    """
    if is_key(text):
        return text
    path = Path(text)
    key = _read(path / PUBLIC_FILE if path.is_dir() else path)
    check_key(key, f"the key in {path}")
    return key


def _write_new(path: Path, text: str, mode: int) -> None:
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "w") as file:
        file.write(text + "\n")


def _read(path: Path) -> str:
    try:
        with path.open(encoding="ascii") as file:
            return file.read(256).strip()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file"
        raise ConfigError(f"cannot read the key {path}: {reason}; make keys with `gcd-node keys new FOLDER`") from error
