"""`gcd-train lora`: adapters and their bases."""

from pathlib import Path
from typing import Annotated, Literal

from rich.console import Console
from typer import Argument, Option, Typer

from gcd_train.cli.errors import errors_shown

app = Typer(no_args_is_help=True, help="Adapters that a run with model.train = lora writes, and their bases.")


@app.callback()
def about() -> None:
    """Keep `lora` a command with sub-commands, however many there are."""


@app.command()
def merge(
    base: Annotated[Path, Argument(metavar="BASE", help="The weight file the adapter was trained from, any layout.")],
    adapter: Annotated[Path, Argument(metavar="ADAPTER", help="NAME-adapter.safetensors of a run.")],
    out: Annotated[Path, Argument(metavar="OUT", help="The file to write: .safetensors, or .ckpt.")],
    layout: Annotated[
        Literal["gcd-node", "gcd-ckpt"], Option(help="Our .safetensors, or the .ckpt of the released code.")
    ] = "gcd-node",
    dtype: Annotated[str | None, Option(help="float32, bfloat16 or float16; else as the base is stored.")] = None,
    overwrite: Annotated[bool, Option("--overwrite", help="Replace OUT if it is there.")] = False,
) -> None:
    """Join an adapter with its base to plain weights. OUT appears whole or not at all."""
    with errors_shown():
        from gcd_model.weights.card import Card, precision
        from gcd_model.weights.load import load_adapted, load_weights, read_adapter, save_weights
        from gcd_model.weights.save import write_published

        wanted = None if dtype is None else precision(dtype)
        start = load_weights(base, ask_family=False)
        joined = load_adapted(start, read_adapter(adapter))
        networks = joined.diffusion if wanted is None else joined.diffusion.to(wanted)
        family = None if joined.family is None else joined.family.name
        card = Card(name=joined.name, config=networks.config, family=family, move_time=joined.move_time)
        if layout == "gcd-ckpt":
            write_published(out, networks.state_dict(), card, carried=start.carried, overwrite=overwrite)
        else:
            save_weights(networks, out, card, overwrite=overwrite)
    Console(markup=False).print(f"wrote {out}", soft_wrap=True)
