"""LoRA layers (Hu et al., 2022): two sets of them in a network, and what of one set is worth its bytes in a file."""

import warnings
from collections import Counter
from collections.abc import Mapping
from itertools import accumulate

import torch
from diffusers import UNet2DConditionModel
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, needed
from unitouch_gen.training.recipe import Arguments, build

STUDENT, TARGET = "student", "target"
"""Names of the two sets: the trained layers and their moving average."""


def add_layers(unet: UNet2DConditionModel, lora: Arguments) -> None:
    """Adds the layers of student and target to a network; only the student's are trained."""
    config = build("lora", needed("peft").LoraConfig, lora, lora_alpha=lora.get("r"))
    unet.requires_grad_(False)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Already found a `peft_config`")  # of a second set of layers
        try:
            unet.add_adapter(config, TARGET)
            unet.add_adapter(config, STUDENT)
        except ValueError as error:  # no such modules
            raise InvalidInputError(f"`lora` does not fit the network: {error}") from error
    unet.set_adapter(STUDENT)


def cut_to_size(layers: Mapping[str, Tensor], megabytes: float) -> dict[str, Tensor]:
    """Layers in half precision, cut to at most so many MB by SVD: each to a rank of its own, or left out at rank 0.

    A singular value of B A is kept for its square, by which it changes the network, over the bytes that it takes.
    """
    split, values = {}, []
    for name in [name for name in layers if ".lora_A." in name]:
        down, up = layers[name].float(), layers[name.replace(".lora_A.", ".lora_B.")].float()
        u, s, v = torch.linalg.svd(up.flatten(1) @ down.flatten(1), full_matrices=False)
        split[name] = (u * s.sqrt(), s.sqrt()[:, None] * v, up.shape[2:], down.shape[1:])
        size = 2e-6 * (len(u) + v.shape[1])
        values += [(value**2 / size, size, name) for value in s[: len(down)].tolist()]
    values.sort(reverse=True)
    sizes = accumulate(size for _, size, _ in values)
    ranks = Counter(name for (_, _, name), total in zip(values, sizes, strict=True) if total <= megabytes)
    cut = {}
    for name, rank in ranks.items():
        u, v, above, below = split[name]
        cut[name] = v[:rank].reshape(rank, *below).half().contiguous()
        cut[name.replace(".lora_A.", ".lora_B.")] = u[:, :rank].reshape(len(u), rank, *above).half().contiguous()
    return cut
