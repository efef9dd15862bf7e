"""`unitouch-gen convert unitouch`, `convert touch-llm` and `distill`: models from checkpoints and pipelines."""

from pathlib import Path
from typing import Annotated

from typer import Option, Typer, echo

from unitouch_gen.cli.loading import folder_of
from unitouch_gen.cli.options import FILE
from unitouch_gen.errors import check_dtype
from unitouch_gen.files import read_settings

app = Typer(no_args_is_help=True, help="Published checkpoints as folders of safetensors.")


@app.command()
def unitouch(
    output: Annotated[Path, Option("--output", "-o", help="Folder for the model, without one yet.")],
    touch: Annotated[Path | None, Option(**FILE, help="UniTouch's last_new.ckpt, for touch.")] = None,
    imagebind: Annotated[Path | None, Option(**FILE, help="ImageBind's imagebind_huge.pth, for the others.")] = None,
    tokenizer: Annotated[Path | None, Option(exists=True, help="Folder `tokenizer` of SD 2.1 unCLIP.")] = None,
    dtype: Annotated[str | None, Option(help="float32, float16 or bfloat16; as published if left out.")] = None,
    config: Annotated[Path | None, Option(**FILE, help="config.json of encoders of another size.")] = None,
) -> None:
    """Converts the checkpoints of UniTouch and ImageBind.

    Example: unitouch-gen convert unitouch --touch last_new.ckpt --imagebind imagebind_huge.pth -o unitouch
    """
    from unitouch_gen.convert import convert_published
    from unitouch_gen.models import UniTouchConfig

    missing = convert_published(
        output,
        touch=touch,
        imagebind=imagebind,
        tokenizer=tokenizer,
        config=None if config is None else UniTouchConfig.from_dict(read_settings("--config", config)),
        dtype=None if dtype is None else check_dtype("--dtype", dtype),
    )
    if missing:
        echo(f"The files lack {', '.join(missing)}")
    echo("Licence: CC-BY-NC-4.0, as the checkpoints'; not for commercial use")
    echo(f"The model is in {output.resolve()}")


@app.command()
def touch_llm(
    bridge: Annotated[Path, Option(**FILE, help="Touch-LLM's checkpoint.")],
    llama: Annotated[str, Option(help="Folder or repository id of the LLaMA it was trained on.")],
    output: Annotated[Path, Option("--output", "-o", help="Folder for the pipeline.")],
    unitouch: Annotated[str | None, Option(help="Folder that `convert unitouch` wrote.")] = None,
    dtype: Annotated[str, Option(help="float32, float16 or bfloat16.")] = "float16",
) -> None:
    """Converts Touch-LLM's checkpoint: its bridge, and the LLaMA with its fine-tuned weights.

    Example: unitouch-gen convert touch-llm --bridge checkpoint.pth --llama llama-7b --unitouch unitouch -o touch-llm
    """
    from unitouch_gen.convert_llm import read_touch_llm
    from unitouch_gen.pipelines import TouchToTextPipeline
    from unitouch_gen.pipelines.published import read_joint

    weights_dtype = check_dtype("--dtype", dtype)
    components = read_touch_llm(bridge, llama, dtype=weights_dtype)
    if unitouch is not None:
        components["unitouch"], components["processor"] = read_joint(unitouch, weights_dtype)
    TouchToTextPipeline(**components).save_pretrained(output)
    echo("Licence: CC-BY-NC-4.0, as UniTouch's, and LLaMA's own; not for commercial use")
    echo(f"The pipeline is in {output.resolve()}")


def distill(
    model: Annotated[str, Option(help="Folder or repository id of a saved pipeline.")],
    output: Annotated[Path, Option("--output", "-o", help="Folder for the LoRA weights and checkpoints.")],
    recipe: Annotated[str | None, Option(help="A YAML file, or the name of a recipe of the package.")] = None,
    overrides: Annotated[
        list[str] | None, Option("--set", metavar="SECTION.KEY=VALUE", help="A value of the recipe to replace.")
    ] = None,
    cache: Annotated[Path, Option(help="Folder for rendered or decoded training data.")] = Path("runs/cache"),
    resume: Annotated[bool, Option("--resume", metavar="", help="Go on from the last checkpoint.")] = False,
    init: Annotated[Path | None, Option(exists=True, help="Folder of LoRA weights to start from.")] = None,
) -> None:
    """Trains LoRA weights with which a pipeline draws in four evaluations without guidance (DMD2).

    Example: unitouch-gen distill --model my-pipeline -o runs/turbo
    """
    folder = folder_of(model)
    from unitouch_gen.training.stages import run_stage

    run_stage(
        "distill",
        model=folder,
        output=output,
        recipe=recipe,
        overrides=overrides,
        cache=cache,
        resume=resume,
        init=init,
    )
    echo(f"The weights are in {(output / 'model').resolve()}; pipe.load_lora_weights(...) reads them, for LCMScheduler")
