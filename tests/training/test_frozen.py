"""What each stage trains, and what it must not touch: two real steps of each, weights compared bit by bit."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import AutoencoderDC, DDPMScheduler, UNet2DConditionModel, VQModel
from torch import nn
from transformers import ResNetConfig

from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.classifier import ContactClassifier
from unitouch_gen.training.audio import AudioObjective
from unitouch_gen.training.batches import ArrayDataset, ShuffledSampler
from unitouch_gen.training.data import image_embeddings
from unitouch_gen.training.image_text import ImageTextObjective
from unitouch_gen.training.image_vae import AutoencoderLoss, AutoencoderObjective, cached_latents
from unitouch_gen.training.picture_classifier import ClassifierAugmentation, ClassifierObjective
from unitouch_gen.training.touch import TouchAugmentation, TouchObjective
from unitouch_gen.training.touch_ldm import TouchDiffusionObjective, TouchDiffusionSettings
from unitouch_gen.training.trainer import Trainer, TrainerConfig
from unitouch_gen.training.unclip import UnclipObjective, UnclipSettings, fit_normalizer

COUNT = 12
CONFIG = TrainerConfig(steps=2, batch_size=6, learning_rate=1e-2, warmup=0, weight_decay=0.1, save_every=10)


@pytest.fixture
def columns(processor: UniTouchProcessor) -> dict[str, np.ndarray | torch.Tensor]:
    """Everything any objective reads, of twelve samples."""
    rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)
    return {
        "image": rng.integers(0, 256, (COUNT, 3, 32, 32), dtype=np.uint8),
        "touch": rng.integers(0, 256, (COUNT, 3, 32, 32), dtype=np.uint8),
        "pixels": rng.integers(0, 256, (COUNT, 3, 32, 32), dtype=np.uint8),
        "audio": rng.standard_normal((COUNT, 1, 16, 24)).astype(np.float16),
        "material": rng.integers(0, 4, COUNT),
        "sensor": rng.integers(0, 2, COUNT),
        "image_embeds": torch.randn(COUNT, 16, generator=generator),
        "latents": torch.randn(COUNT, 4, 8, 8, generator=generator),
        "index": torch.arange(COUNT),
        "shown": np.ones(COUNT, dtype=np.float32),
        "input_ids": processor.text(["rough brick", "slick glass"] * (COUNT // 2))["input_ids"][:, None],
    }


def train(objective: nn.Module, columns: dict, output: Path) -> None:
    torch.manual_seed(0)
    dataset = ArrayDataset(**columns)
    Trainer(objective, dataset, ShuffledSampler(COUNT, CONFIG.batch_size), CONFIG, output).fit()


def parameters(*modules: nn.Module) -> dict[str, torch.Tensor]:
    states = [(f"{number}.{key}", value) for number, m in enumerate(modules) for key, value in m.state_dict().items()]
    return {key: value.detach().clone() for key, value in states}


def unet(**conditions: object) -> UNet2DConditionModel:
    return UNet2DConditionModel(
        sample_size=8,
        block_out_channels=(8, 16),
        layers_per_block=1,
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"),
        up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
        cross_attention_dim=16,
        attention_head_dim=2,
        norm_num_groups=4,
        **conditions,
    )


def unclip(model: UniTouchModel, processor: UniTouchProcessor, columns: dict) -> UnclipObjective:
    scheduler = DDPMScheduler(prediction_type="v_prediction", clip_sample=False)
    network = unet(class_embed_type="projection", projection_class_embeddings_input_dim=32)
    return UnclipObjective(
        network, model.text_model.text_model, processor, ["brick"] * COUNT, fit_normalizer(columns["image_embeds"]),
        DDPMScheduler(beta_schedule="squaredcos_cap_v2"), scheduler,
        UnclipSettings(
            condition_dropout=0.2, caption_share=0.5, empty_share=0.1, clean_share=0.3, gain=0.7, snr_gamma=5.0
        ),
    )  # fmt: skip


def touch_ldm(model: UniTouchModel, processor: UniTouchProcessor, columns: dict) -> TouchDiffusionObjective:
    scheduler = DDPMScheduler(prediction_type="v_prediction", clip_sample=False)
    settings = TouchDiffusionSettings(condition_dropout=0.2, noisy_share=0.5, condition_noise=1.0, snr_gamma=5.0)
    return TouchDiffusionObjective(unet(num_class_embeds=2), scheduler, 14.0, settings)


def vq() -> VQModel:
    kinds = {"down_block_types": ("DownEncoderBlock2D",) * 2, "up_block_types": ("UpDecoderBlock2D",) * 2}
    return VQModel(**kinds, block_out_channels=(8, 8), norm_num_groups=4, latent_channels=3, num_vq_embeddings=16)


LOSS = AutoencoderLoss(gradient_weight=0.5, latent_noise=0.1, latent_weight=1e-4)
AUGMENT = TouchAugmentation(turn=0.5, permute=0.5, blur=0.5)


def autoencoder() -> AutoencoderDC:
    return AutoencoderDC(
        latent_channels=4, encoder_block_types="ResBlock", decoder_block_types="ResBlock",
        encoder_block_out_channels=(8, 8), decoder_block_out_channels=(8, 8), encoder_layers_per_block=(1, 1),
        decoder_layers_per_block=(1, 1), encoder_qkv_multiscales=((), ()), decoder_qkv_multiscales=((), ()),
    )  # fmt: skip


def classifier() -> ContactClassifier:
    return ContactClassifier(
        ResNetConfig(embedding_size=8, hidden_sizes=[8], depths=[1], layer_type="basic", num_labels=4)
    )


# What is frozen stays -------------------------------------------------------------------------------------------------


def test_audio_leaves_the_other_modalities_alone(model: UniTouchModel, columns: dict, tmp_path: Path) -> None:
    others = [model.vision_model, model.text_model, model.touch_model, model.sensor_bank]
    before = parameters(*others)
    train(AudioObjective(model), columns, tmp_path)
    assert_unchanged(before, others)


def test_touch_leaves_the_other_modalities_alone(model: UniTouchModel, columns: dict, tmp_path: Path) -> None:
    others = [model.vision_model, model.text_model, model.audio_model]
    before = parameters(*others)
    train(TouchObjective(model, AUGMENT), columns, tmp_path)
    assert_unchanged(before, others)


def test_touch_leaves_the_prototypes_alone(model: UniTouchModel, columns: dict, tmp_path: Path) -> None:
    model.sensor_bank.set_prototype("digit", torch.rand(3, 32, 32))
    before = model.sensor_bank.prototypes.clone()
    train(TouchObjective(model, AUGMENT), columns, tmp_path)
    assert torch.equal(model.sensor_bank.prototypes, before)


def test_unclip_leaves_the_joint_space_and_the_normaliser_alone(
    model: UniTouchModel, processor: UniTouchProcessor, columns: dict, tmp_path: Path
) -> None:
    objective = unclip(model, processor, columns)
    frozen = [model, objective.frozen.normalizer]
    before = parameters(*frozen)
    train(objective, columns, tmp_path)
    assert_unchanged(before, frozen)


def test_touch_diffusion_leaves_the_condition_encoder_and_the_autoencoder_alone(
    model: UniTouchModel, processor: UniTouchProcessor, columns: dict, tmp_path: Path
) -> None:
    vae = autoencoder().eval()
    before = parameters(model, vae)
    columns["image_embeds"] = image_embeddings(model, [columns["image"]], "image", tmp_path)
    columns["latents"] = cached_latents(vae, [columns["touch"]], "touch", tmp_path)
    train(touch_ldm(model, processor, columns), columns, tmp_path)
    assert_unchanged(before, [model, vae])


def test_unclip_encodes_prompts_as_in_evaluation(
    model: UniTouchModel, processor: UniTouchProcessor, columns: dict
) -> None:
    objective = unclip(model.train(), processor, columns).train()
    assert objective.training and not objective.frozen.text_encoder.training


def test_what_is_frozen_is_not_in_the_checkpoint(
    model: UniTouchModel, processor: UniTouchProcessor, columns: dict
) -> None:
    made = [make(model, processor, columns) for make in (unclip, touch_ldm)]
    for objective in (AudioObjective(model), *made):
        assert all(key.startswith("trained.") for key in objective.state_dict())


def assert_unchanged(before: dict[str, torch.Tensor], modules: list[nn.Module]) -> None:
    after = parameters(*modules)
    assert [key for key in before if not torch.equal(before[key], after[key])] == []
    assert [name for module in modules for name, p in module.named_parameters() if p.grad is not None] == []


# What is trained changes ----------------------------------------------------------------------------------------------

OBJECTIVES: dict[str, Callable[[UniTouchModel, UniTouchProcessor, dict], nn.Module]] = {
    "image_text": lambda model, processor, columns: ImageTextObjective(pair(model), 0.07),
    "audio": lambda model, processor, columns: AudioObjective(model),
    "touch": lambda model, processor, columns: TouchObjective(model, AUGMENT),
    "image_vae": lambda model, processor, columns: AutoencoderObjective(autoencoder(), LOSS),
    "touch_vae": lambda model, processor, columns: AutoencoderObjective(vq(), LOSS),
    "unclip": unclip,
    "classifier": lambda model, processor, columns: ClassifierObjective(
        classifier(), ClassifierAugmentation(mirror=0.5, blur=0.4, noise=0.05)
    ),
    "touch_ldm": touch_ldm,
}


def pair(model: UniTouchModel) -> UniTouchModel:
    """With image and text alone, as the first stage has it."""
    for name in ("audio_model", "touch_model", "sensor_bank"):
        delattr(model, name)
    return model


@pytest.mark.parametrize("name", OBJECTIVES)
def test_every_weight_that_is_trained_changes(
    name: str, model: UniTouchModel, processor: UniTouchProcessor, columns: dict, tmp_path: Path
) -> None:
    objective = OBJECTIVES[name](model, processor, columns)
    before = {key: value.detach().clone() for key, value in objective.trained.named_parameters()}
    train(objective, columns, tmp_path)
    same = {key for key, value in objective.trained.named_parameters() if torch.equal(before[key], value)}
    # Cross-attention over one token is that token's value: what asks for it has no say.
    idle = ("norm2.", "attn2.to_q.", "attn2.to_k.") if name == "touch_ldm" else ()
    assert {key for key in same if not any(word in key for word in idle)} == set()


@pytest.mark.parametrize("name", OBJECTIVES)
def test_losses_are_scalars_that_can_be_logged(
    name: str, model: UniTouchModel, processor: UniTouchProcessor, columns: dict
) -> None:
    losses = OBJECTIVES[name](model, processor, columns)(ArrayDataset(**columns)[range(6)])
    assert "loss" in losses and losses["loss"].requires_grad
    assert all(value.ndim == 0 and bool(torch.isfinite(value)) for value in losses.values())
    assert [key for key, value in losses.items() if value.requires_grad] == ["loss"]


def test_sensor_tokens_of_a_sensor_learn_from_its_own_images(model: UniTouchModel, columns: dict) -> None:
    objective = TouchObjective(model, TouchAugmentation(turn=0.0, permute=0.0, blur=0.0))
    batch = ArrayDataset(**columns)[range(6)]
    batch["sensor"] = torch.ones(6, dtype=torch.int64)
    objective(batch)["loss"].backward()
    gradient = model.sensor_bank.tokens.grad
    assert gradient[1].abs().max() > 0 and gradient[0].abs().max() == 0
