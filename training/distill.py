"""A pipeline in four evaluations: distribution matching distillation (Yin et al., 2024, "DMD2") of LoRA layers.

The student is the network with LoRA layers. It draws as diffusers' `LCMScheduler` does, and learns to draw what guided
sampling draws: noised, its latents are shown to the network and to a critic, which are other LoRA layers that learn to
denoise what the student draws, and moved where the network's guided prediction differs from the critic's. The result is
a LoRA file. Pipelines use it with that scheduler, the same timesteps, and a `guidance_scale` of 1, since guidance is
learnt; `defaults.json` beside it says so.
"""

import json
import warnings
from pathlib import Path
from typing import Annotated, Any

import torch
from diffusers import DDPMScheduler, LCMScheduler, UNet2DConditionModel
from diffusers.loaders import StableDiffusionLoraLoaderMixin
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer
from pydantic import Field, NonNegativeInt, PositiveInt
from torch import Tensor, nn
from transformers import CLIPTextModel

from unitouch_gen.errors import InvalidInputError, check_choice, first_line, needed
from unitouch_gen.files import class_name, read_network, read_settings, reading
from unitouch_gen.models import UniTouchModel
from unitouch_gen.models.autoencoders import Autoencoder, read_autoencoder
from unitouch_gen.models.processing import read_tokenizer
from unitouch_gen.schedule import NoiseSchedule, to_denoised
from unitouch_gen.training import touch_ldm, unclip
from unitouch_gen.training.batches import ArrayDataset, Batch
from unitouch_gen.training.losses import denoising_loss, predict
from unitouch_gen.training.recipe import Arguments, Settings, build, read, read_recipe
from unitouch_gen.training.stages import Recipe, Stage

STUDENT = "student"
CRITIC = "critic"
"""Names of the two sets of LoRA layers."""

Conditioned = unclip.UnclipObjective | touch_ldm.TouchDiffusionObjective


class DistillSettings(Settings):
    """How the student is taught."""

    timesteps: Annotated[list[NonNegativeInt], Field(min_length=1)]  # at which the student draws, falling
    margin: Annotated[float, Field(ge=0.0, lt=0.5)]  # share of the timesteps at either end that nothing is noised to
    critic_rank: PositiveInt  # of the critic's LoRA layers, which are not kept


class DistillRecipe(Recipe):
    lora: Arguments
    objective: DistillSettings


class DistillObjective(nn.Module):
    """The student's loss, whose gradient is Equation 3 of DMD (Yin et al., 2024), and the critic's.

    One network is all three: without LoRA layers the teacher, with those of `STUDENT` the student, with those of
    `CRITIC` the critic. `conditioned` is the objective that trained the network; it makes the conditions.
    """

    def __init__(
        self,
        unet: UNet2DConditionModel,
        scheduler: DDPMScheduler,
        conditioned: Conditioned,
        settings: DistillSettings,
        guidance_scale: float,
    ):
        super().__init__()
        self.trained = unet
        self.scheduler = scheduler
        self.settings = settings
        self.guidance_scale = guidance_scale
        self.frozen = (conditioned,)  # in a tuple, so that it is no module of this one
        self.schedule = NoiseSchedule.of(scheduler)
        lcm = LCMScheduler.from_config(scheduler.config)
        try:
            lcm.set_timesteps(timesteps=settings.timesteps)
        except ValueError as error:
            raise InvalidInputError(f"`objective.timesteps` is {settings.timesteps}: {first_line(error)}") from error
        self.timesteps = settings.timesteps

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        shape = batch["latents"].shape
        device = batch["latents"].device
        every = torch.ones(len(batch["latents"]), dtype=torch.bool, device=device)
        conditions = self.frozen[0].conditions(batch, every)
        unconditional = self.frozen[0].conditions(batch, ~every)
        drawn = self.drawn(torch.randn(shape, device=device), conditions)
        aim = self.moved(drawn.detach(), conditions, unconditional)
        self._take(CRITIC)
        critic = denoising_loss(self.trained, self.scheduler, drawn.detach(), step_power=1.0, **conditions)
        student = 0.5 * (drawn - aim).square().mean()
        return {"loss": student + critic, "student": student.detach(), "critic": critic.detach()}

    def drawn(self, z: Tensor, conditions: dict[str, Tensor]) -> Tensor:
        """Latents (B, C, h, w) that the student predicts in one of its steps, from noise (B, C, h, w)."""
        self._take(STUDENT)
        last = int(torch.randint(len(self.timesteps), ()))
        with torch.no_grad():
            for timestep, following in zip(self.timesteps[:last], self.timesteps[1:], strict=False):
                denoised = self._denoised(z, torch.full((len(z),), timestep, device=z.device), conditions)
                z = self._noised(denoised, torch.full((len(z),), following, device=z.device))
        return self._denoised(z, torch.full((len(z),), self.timesteps[last], device=z.device), conditions)

    @torch.no_grad()
    def moved(self, drawn: Tensor, conditions: dict[str, Tensor], unconditional: dict[str, Tensor]) -> Tensor:
        """Drawn latents (B, C, h, w), moved to where the guided teacher expects them rather than the critic."""
        margin = self.settings.margin
        count = self.scheduler.config.num_train_timesteps
        t = torch.randint(round(margin * count), count - round(margin * count), (len(drawn),), device=drawn.device)
        z = self._noised(drawn, t)
        self._take(CRITIC)
        known = self._denoised(z, t, conditions)
        self.trained.disable_adapters()
        without, given = (self._denoised(z, t, one) for one in (unconditional, conditions))
        self.trained.enable_adapters()
        real = without + self.guidance_scale * (given - without)
        size = (drawn - real).abs().mean(dim=(1, 2, 3), keepdim=True).clamp_min(1e-3)
        return drawn + (real - known) / size

    def _take(self, layers: str) -> None:
        """Computes with the student's layers or the critic's; both stay trained."""
        self.trained.set_adapter(layers)
        train_layers(self.trained)

    def _denoised(self, z: Tensor, t: Tensor, conditions: dict[str, Tensor]) -> Tensor:
        """What the network predicts of the data, (B, C, h, w)."""
        prediction = predict(self.trained, z, t, **conditions)
        sigma = self.schedule.sigma(t.cpu()).float().to(t.device)[:, None, None, None]
        return to_denoised(prediction, z, sigma, self.scheduler.config.prediction_type)

    def _noised(self, latents: Tensor, t: Tensor) -> Tensor:
        """The variance-preserving state (B, C, h, w) of latents at timesteps (B,)."""
        return self.scheduler.add_noise(latents, torch.randn_like(latents), t)


def train_layers(unet: UNet2DConditionModel) -> None:
    """Asks for gradients of all LoRA layers, since peft asks for those of the last ones taken alone."""
    for name, parameter in unet.named_parameters():
        if "lora_" in name:
            parameter.requires_grad_(True)


def add_layers(unet: UNet2DConditionModel, lora: Arguments, critic_rank: int, init: Path | None = None) -> None:
    """Adds the LoRA layers of student and critic to a network; only these are trained.

    The student's begin as those stored in the folder `init`, if there is one.
    """
    ranks = {CRITIC: critic_rank, STUDENT: lora.get("r", 8)}  # 8 is peft's own
    kind = needed("peft").LoraConfig
    configs = {name: build("lora", kind, {**lora, "r": rank}, lora_alpha=rank) for name, rank in ranks.items()}
    unet.requires_grad_(False)
    if init is not None:
        with reading("init", init):
            unet.load_lora_adapter(init, prefix="unet", adapter_name=STUDENT, use_safetensors=True)
        held = getattr(unet, "peft_config", {}).get(STUDENT)
        if held is None or held.r != ranks[STUDENT]:
            holds = "no LoRA weights of a UNet" if held is None else f"layers of rank {held.r}; set `lora.r` to that"
            raise InvalidInputError(f"`init` is {str(init)!r}, which holds {holds}.")
        del configs[STUDENT]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Already found a `peft_config`")  # of a second set of layers
        try:
            for name, config in configs.items():
                unet.add_adapter(config, name)
        except ValueError as error:  # no such modules
            raise InvalidInputError(f"`lora` does not fit the network: {error}") from error
    train_layers(unet)


def conditioned_touches(
    stage: Stage, settings: Arguments, unet: Any, scheduler: Any, joint: UniTouchModel, vae: Autoencoder
) -> tuple[Conditioned, ArrayDataset]:
    """The objective that trains a network of touches, and its data."""
    sensors = settings["sensors"]
    with_gels = unet.config.in_channels != unet.config.out_channels
    if with_gels and stage.data.drawn is None:
        raise InvalidInputError("`data.sets` have no untouched gels, which `model` learns from; leave them out.")
    for source in stage.sources:
        if sensors and (source.sensor is not None or not with_gels):
            check_choice("data: sensor", source.sensor, sensors)
    dataset, gels = touch_ldm.inputs(stage, joint, vae, sensors, with_gels)
    how = read(touch_ldm.TouchDiffusionSettings, read_recipe("touch_ldm")["objective"])
    return touch_ldm.TouchDiffusionObjective(unet, scheduler, joint.config.embedding_norm, how, gels), dataset


def conditioned_pictures(
    stage: Stage, settings: Arguments, unet: Any, scheduler: Any, joint: UniTouchModel, vae: Autoencoder
) -> tuple[Conditioned, ArrayDataset]:
    """The objective that trains a network of pictures, and its data."""
    folder = stage.folders["model"]
    processor = stage.processor
    with reading("model", folder):
        normalizer = read_network(StableUnCLIPImageNormalizer, folder / "image_normalizer")
        noising = DDPMScheduler.from_pretrained(folder / "image_noising_scheduler")
        text_encoder = read_network(CLIPTextModel, folder / "text_encoder")
        processor.tokenizer = read_tokenizer("model", folder / "tokenizer")
    dataset, captions = unclip.inputs(stage, joint, vae)
    how = read_recipe("unclip")["objective"] | {"gain": min(settings["default_strength"], 1.0)}
    parts = (read(unclip.UnclipSettings, how), normalizer, noising, captions, processor, text_encoder)
    return unclip.UnclipObjective(unet, scheduler, *parts, settings["default_noise_level"]), dataset


CONDITIONED = {
    "TouchToImagePipeline": conditioned_pictures,
    "TactileStylizationPipeline": conditioned_pictures,
    "XToTouchPipeline": conditioned_touches,
}


def main(stage: Stage, recipe: DistillRecipe) -> None:
    folder = stage.folders["model"]
    settings = read_settings("model", folder / "model_index.json")
    conditioned_by = CONDITIONED[check_choice("model: _class_name", class_name(settings), CONDITIONED)]
    with reading("model", folder):
        unet = read_network(UNet2DConditionModel, folder / "unet")
        scheduler = DDPMScheduler.from_pretrained(folder / "scheduler")
        joint = stage.joint_space("image")
        vae = read_autoencoder(folder / "vae")
    add_layers(unet, recipe.lora, recipe.objective.critic_rank, stage.folders.get("init"))
    conditioned, dataset = conditioned_by(stage, settings, unet, scheduler, joint, vae)
    guidance_scale = settings["default_guidance_scale"]
    stage.fit(DistillObjective(unet, scheduler, conditioned, recipe.objective, guidance_scale), dataset)
    layers = needed("peft").get_peft_model_state_dict(unet, adapter_name=STUDENT)
    with stage.saving() as place:
        halves = {name: tensor.half() for name, tensor in layers.items()}
        StableDiffusionLoraLoaderMixin.save_lora_weights(place, unet_lora_layers=halves)
        steps = recipe.objective.timesteps
        drawn = {"default_num_inference_steps": len(steps), "default_timesteps": steps, "default_guidance_scale": 1.0}
        (place / "defaults.json").write_text(json.dumps(drawn, indent=2) + "\n")
