"""`unitouch-gen convert ldm`."""

from pathlib import Path
from typing import Annotated

import typer

from unitouch_gen.cli.writing import bytes_written


def convert_ldm(
    ldm: Annotated[Path, typer.Option(help="Checkpoint in CompVis' layout; a pickle is read without running it.")],
    config: Annotated[Path, typer.Option(help="The YAML file that it was trained with.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="A folder; its unet, vae and scheduler are replaced.")],
    ema: Annotated[bool, typer.Option(help="Take the moving averages of the UNet's weights.")] = False,
) -> None:
    """Converts a latent diffusion model of touch, as its training left it, to a folder of diffusers."""
    from unitouch_gen.convert import ldm as compvis

    with bytes_written() as written:
        compvis.convert_ldm(ldm, config, output, ema, told=typer.echo, written=written)
    typer.echo(f"The model is in {output.resolve()}")
