"""`gcd-node ctl` and `gcd-node keys`: commands for a running node, and the keys to reach it from elsewhere."""

import contextlib
from pathlib import Path
from typing import Annotated, TypeAlias

import msgspec
import typer
from typer import Argument, Option

from gcd_client.control import ControlClient, ControlError
from gcd_client.endpoints import ClientKeys, fingerprint, read_key_pair, read_public_key
from gcd_node.auth import new_key_pair, write_key_pair
from gcd_node.errors import UsageError
from gcd_node.verbs import VERBS, text_arguments

keys = typer.Typer(no_args_is_help=True, help="CURVE keys, for nodes that are reached over a network.")

KeyFolder: TypeAlias = Annotated[Path | None, Option("--keys", help="Our key folder, as `gcd-node keys new` makes it.")]
NodeKey: TypeAlias = Annotated[str | None, Option(help="The node's public key, or its file.")]


def ctl(
    verb: Annotated[str, Argument(metavar="VERB", help=f"One of {', '.join(VERBS)}.")],
    settings: Annotated[list[str] | None, Argument(metavar="[KEY=VALUE]...", help="The verb's arguments.")] = None,
    endpoint: Annotated[str, Option(help="The node's control endpoint: ipc, ipc://PATH or tcp://HOST:PORT.")] = "ipc",
    json: Annotated[bool, Option("--json", help="Print the whole reply as one line of JSON.")] = False,
    dry_run: Annotated[bool, Option("--dry-run", help="Check everything, change nothing.")] = False,
    if_view_rev: Annotated[int | None, Option(min=0, help="Only if the view still has this revision.")] = None,
    key_folder: KeyFolder = None,
    node_key: NodeKey = None,
    timeout: Annotated[float, Option(min=0.1, help="Seconds to wait for a reply.")] = 2.0,
) -> None:
    """Send one request to a running node: `gcd-node ctl set_view view=top azimuth_deg=30`."""
    arguments = parse_settings(verb, settings or [])
    own = client_keys(key_folder, node_key)
    with ControlClient(endpoint, keys=own, timeout_s=timeout) as node:
        reply = node.request(verb, arguments, dry_run=dry_run, if_view_rev=if_view_rev)
    if json:
        typer.echo(msgspec.json.encode(reply).decode())
    elif reply.ok:
        message = f": {reply.message}" if reply.message else ""
        typer.echo(f"{reply.code}{message} (the node is {reply.state})")
        if reply.result:
            typer.echo(msgspec.json.format(msgspec.json.encode(reply.result)).decode())
    if not reply.ok:
        allowed = "" if reply.result is None else f" ({msgspec.json.encode(reply.result).decode()})"
        raise ControlError(f"{verb}: {reply.code}: {reply.message}{allowed}", reply.code)


@keys.command("new")
def new_keys(
    folder: Annotated[Path, Argument(metavar="FOLDER", help="Where the keys go; must hold none yet.")],
) -> None:
    """Make a key pair, for a node or for a client."""
    write_key_pair(folder, new_key_pair())
    _describe(folder)


@keys.command("show")
def show_keys(folder: Annotated[Path, Argument(metavar="FOLDER", help="A key folder.")]) -> None:
    """Show the public half of a key pair, and how to allow it."""
    _describe(folder)


def parse_settings(verb: str, settings: list[str]) -> dict[str, object]:
    """KEY=VALUE as arguments: text where the verb wants text, else JSON if it is any, else text.

    Raises:
        UsageError: no `=`, or a key twice.
    """
    texts = text_arguments(verb)
    found: dict[str, object] = {}
    for each in settings:
        key, equals, value = each.partition("=")
        if not equals or not key or key in found:
            raise UsageError(f"an argument is KEY=VALUE, each key once, got {each!r}")
        found[key] = value
        if key not in texts:
            with contextlib.suppress(msgspec.DecodeError, RecursionError, UnicodeError):  # then it is text
                found[key] = msgspec.json.decode(value.encode())
    return found


def client_keys(folder: Path | None, node_key: str | None) -> ClientKeys | None:
    """The keys that options name; None if they name none.

    Raises:
        UsageError: one without the other. SetupError: they cannot be read.
    """
    if folder is None and node_key is None:
        return None
    if folder is None or node_key is None:
        raise UsageError("give both --keys, our own key folder, and --node-key, the node's public key, or neither")
    return ClientKeys(own=read_key_pair(folder), server=read_public_key(node_key))


def _describe(folder: Path) -> None:
    pair = read_key_pair(folder)
    typer.echo(f"public key   {pair.public}")
    typer.echo(f"fingerprint  {fingerprint(pair.public)}")
    typer.echo("\nTo allow it, write into the node's list of clients ([security] allow):\n")
    typer.echo(f'[client.NAME]\nkey = "{pair.public}"\nrole = "viewer"  # or "operator"')
