"""`unitouch-gen convert unitouch`: published checkpoints as folders of safetensors."""

from pathlib import Path
from typing import Annotated

from typer import Option, Typer, echo

from unitouch_gen.cli.options import FILE

app = Typer(no_args_is_help=True, help="Published checkpoints as folders of safetensors.")


@app.command()
def unitouch(
    output: Annotated[Path, Option("--output", "-o", help="A folder; one with other modalities is added to.")],
    touch: Annotated[Path | None, Option(**FILE, help="UniTouch's last_new.ckpt, for touch.")] = None,
    imagebind: Annotated[Path | None, Option(**FILE, help="ImageBind's imagebind_huge.pth, for the others.")] = None,
    tokenizer: Annotated[Path | None, Option(exists=True, help="Folder `tokenizer` of SD 2.1 unCLIP.")] = None,
    dtype: Annotated[str | None, Option(help="float32, float16 or bfloat16; as published if left out.")] = None,
    config: Annotated[Path | None, Option(**FILE, help="config.json of encoders of another size.")] = None,
) -> None:  # fmt: skip
    """Converts the checkpoints of UniTouch and ImageBind.

    Example: unitouch-gen convert unitouch --touch last_new.ckpt --imagebind imagebind_huge.pth -o unitouch
    """
    from unitouch_gen.convert import convert_published, read_config
    from unitouch_gen.errors import InvalidInputError, check_dtype

    if touch is None and imagebind is None:
        raise InvalidInputError("Nothing to convert came; pass `--touch`, `--imagebind` or both.")
    sizes = None if config is None else read_config("--config", config)
    kind = None if dtype is None else check_dtype("--dtype", dtype)
    convert_published(
        output, touch=touch, imagebind=imagebind, tokenizer=tokenizer, config=sizes, dtype=kind, log_fn=echo
    )
    echo("Licence: CC-BY-NC-4.0, as the checkpoints'; not for commercial use")
    echo(f"The model is in {output.resolve()}")
