"""Which layers of a `UNet2DConditionModel` get a stand-in of `eliminate_layers`.

Only layers whose class and settings are the plain ones, and into which nobody looks, do. So what is not known to be
exact is left as it is.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from diffusers.models.attention import BasicTransformerBlock
from diffusers.models.attention_processor import Attention, AttnProcessor, AttnProcessor2_0, SlicedAttnProcessor
from diffusers.models.resnet import ResnetBlock2D
from diffusers.models.transformers.transformer_2d import Transformer2DModel
from diffusers.models.unets import unet_2d_blocks as blocks
from torch import nn

from unitouch_gen.eliminate_layers import (
    AttendToOne,
    Evaluation,
    Halved,
    Kept,
    OneTime,
    SplitConvolution,
    StandIn,
    Unread,
)
from unitouch_gen.models.casting import casts

PLAIN_PROCESSORS = (AttnProcessor, AttnProcessor2_0, SlicedAttnProcessor)
"""Those that see each row of the batch alone, and keep nothing between calls."""

ACTIVATIONS = (nn.SiLU, nn.ReLU, nn.GELU, nn.Mish)
"""Those that see each value alone."""

CONDITION_FREE_BLOCKS = (blocks.DownBlock2D, blocks.AttnDownBlock2D, blocks.ResnetDownsampleBlock2D)
CROSS_ATTENTION_BLOCKS = (blocks.CrossAttnDownBlock2D, blocks.UNetMidBlock2DCrossAttn, blocks.CrossAttnUpBlock2D)
JOINING_BLOCKS = (blocks.UpBlock2D, blocks.CrossAttnUpBlock2D)
"""Those that join what comes up and what was skipped, in this order, along the channels."""

Shared = tuple[str, ...]
"""Values of `Evaluation.shared` under which a layer has the same input in both halves of the batch."""

STEM: Shared = ("stem", "prefix")
PREFIX: Shared = ("prefix",)


@dataclass
class Plan:
    """The stand-ins for layers of a UNet, and what they are good for.

    Attributes:
        stand_ins: Of each module that has one.
        cross_attentions: How many have one.
        other_cross_attentions: How many have not.
        labels, projection, time: Whether the embedding of the class labels, the projection of the condition, and the
            features of the timestep have one.
        halved: Number of layers that can run on half of the batch, for each value of `Evaluation.shared`.
        split: Number of convolutions that can for the skips which they read out of such layers.
    """

    stand_ins: dict[nn.Module, StandIn] = field(default_factory=dict)
    cross_attentions: int = 0
    other_cross_attentions: int = 0
    labels: bool = False
    projection: bool = False
    time: bool = False
    halved: dict[str, int] = field(default_factory=lambda: {"nothing": 0, "stem": 0, "prefix": 0})
    split: dict[str, int] = field(default_factory=lambda: {"nothing": 0, "stem": 0, "prefix": 0})


def plan_of(unet: Any, evaluation: Evaluation) -> Plan:
    """The plan for a `UNet2DConditionModel`, whose stand-ins do what `evaluation` says."""
    plan, config = Plan(), unet.config
    attentions = [module for module in unet.modules() if isinstance(module, Attention) and module.is_cross_attention]
    plan.other_cross_attentions = len(attentions)
    if not bare(unet) or any(module.training for module in unet.modules()):
        return plan
    labels_are_times = config.class_embed_type == "timestep"
    if unet.class_embedding is not None and not labels_are_times and untouched(unet.class_embedding):
        plan.labels = True
        plan.stand_ins[unet.class_embedding] = Kept(unet.class_embedding.forward, evaluation)
    broadcasts = not config.class_embeddings_concat and all(
        type(part).__module__ == blocks.__name__
        for part in (*unet.down_blocks, unet.mid_block, *unet.up_blocks)
        if part is not None
    )
    if broadcasts and not labels_are_times and untouched(unet.time_proj):
        plan.time = True
        plan.stand_ins[unet.time_proj] = OneTime(unet.time_proj.forward, evaluation)
    if config.encoder_hid_dim_type in (None, "text_proj"):  # others change the number of tokens
        _add_conditions(plan, unet, evaluation)
    if config.addition_embed_type != "image_hint":  # which joins the latents
        _add_skips(plan, unet, evaluation, _add_halves(plan, unet, evaluation))
    return plan


# What is plain --------------------------------------------------------------------------------------------------------


def bare(module: Any) -> bool:
    """Whether what a module does is what its class says.

    Hooks of accelerate are allowed, which only move tensors, and those of `casting`, which only cast weights.
    """
    hooked = module._forward_hooks or module._forward_pre_hooks
    return not hooked and ("forward" not in module.__dict__ or hasattr(module, "_hf_hook") or casts(module))


def untouched(module: Any) -> bool:
    """Whether this holds for all of its parts, and their attention sees each row of the batch alone."""
    return all(
        bare(part) and (not isinstance(part, Attention) or type(part.processor) in PLAIN_PROCESSORS)
        for part in module.modules()
    )


def _plain_attention(attention: Any) -> bool:
    """Whether it is an output layer after softmax(Q K) V, and nothing besides."""
    absent = ("group_norm", "spatial_norm", "norm_cross", "norm_q", "norm_k", "added_kv_proj_dim")
    return (
        type(attention) is Attention
        and untouched(attention)
        and all(getattr(attention, name) is None for name in absent)
        and not attention.residual_connection
        and not attention.fused_projections
        and attention.rescale_output_factor == 1.0
        and attention.inner_dim == attention.inner_kv_dim
        and attention.to_out is not None
        and [type(layer) for layer in attention.to_out] == [nn.Linear, nn.Dropout]
        and all(type(layer) is nn.Linear for layer in (attention.to_q, attention.to_k, attention.to_v))
    )


def _plain_transformer(transformer: Any) -> bool:
    return type(transformer) is Transformer2DModel and transformer.is_input_continuous and bare(transformer)


def _plain_block(block: Any) -> bool:
    """Whether it is norm and attention, again norm and attention, and a feed-forward layer."""
    return (
        type(block) is BasicTransformerBlock
        and bare(block)
        and block.norm_type == "layer_norm"
        and block.pos_embed is None
        and not block.double_self_attention
        and not hasattr(block, "fuser")
    )


def _plain_resnet(resnet: Any) -> bool:
    """Whether nothing but a norm and an activation comes before its first convolution."""
    return (
        type(resnet) is ResnetBlock2D
        and untouched(resnet)
        and resnet.upsample is None
        and resnet.downsample is None
        and type(resnet.nonlinearity) in ACTIVATIONS
    )


def _plain_convolution(convolution: Any) -> bool:
    """Whether its weight can be read here and now, and split by input channels."""
    return (
        type(convolution) is nn.Conv2d
        and convolution.groups == 1
        and convolution.padding_mode == "zeros"
        and ("forward" not in convolution.__dict__ or casts(convolution))
    )


# What attends to the condition ----------------------------------------------------------------------------------------


def _add_conditions(plan: Plan, unet: Any, evaluation: Evaluation) -> None:
    projection = unet.encoder_hid_proj
    if projection is not None:
        if not untouched(projection):
            return
        plan.projection = True
        plan.stand_ins[projection] = Kept(projection.forward, evaluation)
    for block in _transformer_blocks(unet):
        for norm, attention in ((block.norm1, block.attn1), (block.norm2, block.attn2)):
            if attention is None or not attention.is_cross_attention or not _plain_attention(attention):
                continue
            plan.cross_attentions += 1
            plan.other_cross_attentions -= 1
            plan.stand_ins[attention.to_k] = Kept(attention.to_k.forward, evaluation)
            plan.stand_ins[attention.to_v] = Kept(attention.to_v.forward, evaluation)
            plan.stand_ins[attention] = AttendToOne(attention, evaluation)
            if type(norm) is nn.LayerNorm and untouched(norm):
                plan.stand_ins[norm] = Unread(norm.forward, evaluation)


def _transformer_blocks(unet: Any) -> Iterator[Any]:
    """Those that get the condition as the UNet has it."""
    for part in (*unet.down_blocks, unet.mid_block, *unet.up_blocks):
        if type(part) in CROSS_ATTENTION_BLOCKS and bare(part):
            for transformer in filter(_plain_transformer, part.attentions):
                yield from filter(_plain_block, transformer.transformer_blocks)


# What both halves of the batch have in common -------------------------------------------------------------------------


def _add_halves(plan: Plan, unet: Any, evaluation: Evaluation) -> list[tuple[int, Shared]]:
    """Adds the layers before the first that attends to the condition.

    Returns:
        Of the skips that come out of them, in their order, the number of channels and when both halves are the same.
    """

    def halve(module: nn.Module, shared: Shared, take: bool = True, give: bool = True) -> None:
        plan.stand_ins[module] = Halved(module.forward, evaluation, shared, take, give)
        for case in shared:
            plan.halved[case] += 1

    if not untouched(unet.conv_in):
        return []
    halve(unet.conv_in, STEM)
    skips: list[tuple[int, Shared]] = [(unet.conv_in.out_channels, STEM)]
    for index, block in enumerate((*unet.down_blocks, unet.mid_block)):
        if type(block) not in CONDITION_FREE_BLOCKS + CROSS_ATTENTION_BLOCKS or not bare(block):
            break
        first = block.resnets[0]
        if index == 0 and _plain_resnet(first):  # the time comes in after its first convolution
            halve(first.norm1, ("stem",), give=False)
            halve(first.conv1, ("stem",), take=False)
            if first.conv_shortcut is not None:
                halve(first.conv_shortcut, ("stem",))
        if type(block) in CROSS_ATTENTION_BLOCKS:
            if untouched(first):
                halve(first, PREFIX)
                _halve_transformer(block.attentions[0], halve)
            break
        if not untouched(block):
            break
        halve(block, PREFIX)
        outputs = len(block.resnets) + len(block.downsamplers or ())
        skips += [(first.out_channels, PREFIX)] * outputs
    return skips


def _halve_transformer(transformer: Any, halve: Callable[..., None]) -> None:
    """Adds what a transformer does before it attends to the condition."""
    if not _plain_transformer(transformer) or not untouched(transformer.norm) or not untouched(transformer.proj_in):
        return
    # Between the two come as many rows as the norm gives for a linear projection, as many as it took for a convolution.
    linear = transformer.use_linear_projection
    halve(transformer.norm, PREFIX, give=linear)
    halve(transformer.proj_in, PREFIX, take=linear)
    block = transformer.transformer_blocks[0]
    if _plain_block(block) and untouched(block.norm1) and _plain_attention(block.attn1):
        if block.attn1.is_cross_attention:
            return
        halve(block.norm1, PREFIX, give=False)
        halve(block.attn1, PREFIX, take=False)


def _add_skips(plan: Plan, unet: Any, evaluation: Evaluation, skips: list[tuple[int, Shared]]) -> None:
    """Adds the convolutions that read the skips out of those layers: going up, the last ones."""
    readers = [(block, resnet) for block in unet.up_blocks for resnet in block.resnets]
    for (block, resnet), (channels, shared) in zip(reversed(readers), skips, strict=False):
        if type(block) not in JOINING_BLOCKS or not bare(block) or not _plain_resnet(resnet):
            continue
        own = resnet.in_channels - channels
        group = resnet.in_channels // resnet.norm1.num_groups
        normed = -(-own // group) * group  # a group of the norm that holds both kinds of channels differs as a whole
        for convolution, split in ((resnet.conv1, normed), (resnet.conv_shortcut, own)):
            if split < resnet.in_channels and _plain_convolution(convolution):
                plan.stand_ins[convolution] = SplitConvolution(convolution, evaluation, shared, split)
                for case in shared:
                    plan.split[case] += 1
