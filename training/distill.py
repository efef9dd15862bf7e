"""A pipeline in four evaluations: distribution matching distillation (Yin et al., 2024, "DMD2") of LoRA layers.

The student is the network with LoRA layers. It draws as diffusers' `LCMScheduler` does, and learns to draw what guided
sampling draws. The critic is the network with other LoRA layers, which learn to denoise what the student draws. The
student's latents are noised and denoised by both, and move along the difference of the network's guided prediction and
the critic's. The result is a LoRA file. Pipelines use it with that scheduler, the same timesteps, and a
`guidance_scale` of 1, since guidance is learnt. `defaults.json` beside it holds these settings.
"""

import json
import warnings
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import torch
from diffusers import DDPMScheduler, LCMScheduler, UNet2DConditionModel
from diffusers.loaders import StableDiffusionLoraLoaderMixin
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer
from pydantic import Field, NonNegativeInt, PositiveInt
from torch import Tensor, nn
from transformers import CLIPTextModel

from unitouch_gen.errors import InvalidInputError, check_choice, first_line, import_optional
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
    """Settings of the distillation."""

    timesteps: Annotated[list[NonNegativeInt], Field(min_length=1)]  # of the student's steps, descending
    margin: Annotated[
        float, Field(ge=0.0, lt=0.5)
    ]  # share of the timesteps at either end that are not used for noising
    critic_rank: PositiveInt  # rank of the critic's LoRA layers, which are not kept


class DistillRecipe(Recipe):
    lora: Arguments
    objective: DistillSettings


class DistillObjective(nn.Module):
    """The student's loss, whose gradient is Equation 3 of DMD (Yin et al., 2024), and the critic's.

    One network plays all three parts: without LoRA layers it is the teacher, with those of `STUDENT` the student, with
    those of `CRITIC` the critic. `conditioned` is the objective that trained the network; it makes the conditions.
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
        latents = batch["latents"]
        kept = torch.ones(len(latents), dtype=torch.bool, device=latents.device)
        conditions = self.frozen[0].conditions(batch, kept)
        unconditional = self.frozen[0].conditions(batch, ~kept)
        drawn = self.drawn(torch.randn(latents.shape, device=latents.device), conditions)
        target = self.moved(drawn.detach(), conditions, unconditional)
        self._use_layers(CRITIC)
        critic = denoising_loss(self.trained, self.scheduler, drawn.detach(), step_power=1.0, **conditions)
        student = 0.5 * (drawn - target).square().mean()
        return {"loss": student + critic, "student": student.detach(), "critic": critic.detach()}

    def drawn(self, z: Tensor, conditions: dict[str, Tensor]) -> Tensor:
        """Latents (B, C, h, w) that the student predicts in one of its steps, from noise (B, C, h, w)."""
        self._use_layers(STUDENT)
        last = int(torch.randint(len(self.timesteps), ()))
        timesteps = [torch.full((len(z),), timestep, device=z.device) for timestep in self.timesteps[: last + 1]]
        with torch.no_grad():
            for t, next_t in pairwise(timesteps):
                z = self._noised(self._denoised(z, t, conditions), next_t)
        return self._denoised(z, timesteps[-1], conditions)

    @torch.no_grad()
    def moved(self, drawn: Tensor, conditions: dict[str, Tensor], unconditional: dict[str, Tensor]) -> Tensor:
        """Drawn latents (B, C, h, w), moved from the critic's prediction towards the guided teacher's."""
        count = self.scheduler.config.num_train_timesteps
        margin = round(self.settings.margin * count)
        t = torch.randint(margin, count - margin, (len(drawn),), device=drawn.device)
        z = self._noised(drawn, t)
        self._use_layers(CRITIC)
        fake = self._denoised(z, t, conditions)
        self.trained.disable_adapters()
        without_condition = self._denoised(z, t, unconditional)
        with_condition = self._denoised(z, t, conditions)
        self.trained.enable_adapters()
        real = without_condition + self.guidance_scale * (with_condition - without_condition)
        size = (drawn - real).abs().mean(dim=(1, 2, 3), keepdim=True).clamp_min(1e-3)
        return drawn + (real - fake) / size

    def _use_layers(self, name: str) -> None:
        """Activates the student's layers or the critic's; both keep their gradients."""
        self.trained.set_adapter(name)
        train_layers(self.trained)

    def _denoised(self, z: Tensor, t: Tensor, conditions: dict[str, Tensor]) -> Tensor:
        """The network's prediction of clean latents, (B, C, h, w)."""
        prediction = predict(self.trained, z, t, **conditions)
        sigma = self.schedule.sigma(t.cpu()).float().to(t.device)[:, None, None, None]
        return to_denoised(prediction, z, sigma, self.scheduler.config.prediction_type)

    def _noised(self, latents: Tensor, t: Tensor) -> Tensor:
        """The variance-preserving state (B, C, h, w) of latents at timesteps (B,)."""
        return self.scheduler.add_noise(latents, torch.randn_like(latents), t)


def train_layers(unet: UNet2DConditionModel) -> None:
    """Asks for gradients of all LoRA layers; peft's `set_adapter` asks only for those of the active ones."""
    for name, parameter in unet.named_parameters():
        if "lora_" in name:
            parameter.requires_grad_(True)


def add_layers(unet: UNet2DConditionModel, lora: Arguments, critic_rank: int, init: Path | None = None) -> None:
    """Adds the LoRA layers of student and critic to a network. Only these are trained.

    With a folder `init`, the student's layers are read from there.
    """
    ranks = {CRITIC: critic_rank, STUDENT: lora.get("r", 8)}  # 8 is peft's default
    lora_config = import_optional("peft").LoraConfig
    configs = {name: build("lora", lora_config, {**lora, "r": rank}, lora_alpha=rank) for name, rank in ranks.items()}
    unet.requires_grad_(False)
    if init is not None:
        with reading("init", init):
            unet.load_lora_adapter(init, prefix="unet", adapter_name=STUDENT, use_safetensors=True)
        stored = getattr(unet, "peft_config", {}).get(STUDENT)
        if stored is None:
            raise InvalidInputError(f"`init` is {str(init)!r}, which holds no LoRA weights of a UNet.")
        if stored.r != ranks[STUDENT]:
            raise InvalidInputError(
                f"`init` is {str(init)!r}, which holds layers of rank {stored.r}; set `lora.r` to that."
            )
        del configs[STUDENT]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Already found a `peft_config`")  # raised for a second set of layers
        try:
            for name, config in configs.items():
                unet.add_adapter(config, name)
        except ValueError as error:  # the network has no such modules
            raise InvalidInputError(f"`lora` does not fit the network: {error}") from error
    train_layers(unet)


def teacher_objective(folder: Path, name: str) -> dict[str, Any]:
    """The section `objective` of the recipe that a saved pipeline's network was trained by.

    It is read from the pipeline's `record.json`. A pipeline without one, such as a published one, is taken to be
    trained by the package's own recipe of stage `name`.
    """
    file = folder / "record.json"
    if not file.is_file():
        return read_recipe(name)["objective"]
    record = read_settings("model", file)
    check_choice("model: record.json: stage", record.get("stage"), [name])
    return dict(record["recipe"]["objective"])


def conditioned_touches(
    stage: Stage, settings: Arguments, unet: Any, scheduler: Any, joint: UniTouchModel, vae: Autoencoder
) -> tuple[Conditioned, ArrayDataset]:
    """The objective that trained a network of touches, and its data."""
    sensors = settings["sensors"]
    with_gels = unet.config.in_channels != unet.config.out_channels
    if with_gels and stage.data.drawn is None:
        raise InvalidInputError("`data.sets` have no untouched gels, which `model` learns from; leave them out.")
    for source in stage.sources:
        if sensors and (source.sensor is not None or not with_gels):
            check_choice("data: sensor", source.sensor, sensors)
    dataset, gels = touch_ldm.inputs(stage, joint, vae, sensors, with_gels)
    section = teacher_objective(stage.folders["model"], "touch_ldm")
    objective = touch_ldm.TouchDiffusionObjective(
        unet,
        scheduler,
        joint.config.embedding_norm,
        settings=read(touch_ldm.TouchDiffusionSettings, section),
        backgrounds=gels,
    )
    return objective, dataset


def conditioned_pictures(
    stage: Stage, settings: Arguments, unet: Any, scheduler: Any, joint: UniTouchModel, vae: Autoencoder
) -> tuple[Conditioned, ArrayDataset]:
    """The objective that trained a network of pictures, and its data."""
    folder = stage.folders["model"]
    processor = stage.processor
    with reading("model", folder):
        normalizer = read_network(StableUnCLIPImageNormalizer, folder / "image_normalizer")
        noising = DDPMScheduler.from_pretrained(folder / "image_noising_scheduler")
        text_encoder = read_network(CLIPTextModel, folder / "text_encoder")
        processor.tokenizer = read_tokenizer("model", folder / "tokenizer")
    dataset, captions = unclip.inputs(stage, joint, vae)
    section = teacher_objective(folder, "unclip") | {"gain": min(settings["default_strength"], 1.0)}
    objective = unclip.UnclipObjective(
        unet,
        scheduler,
        settings=read(unclip.UnclipSettings, section),
        normalizer=normalizer,
        noising=noising,
        captions=captions,
        processor=processor,
        text_encoder=text_encoder,
        level=settings["default_noise_level"],
    )
    return objective, dataset


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
    layers = import_optional("peft").get_peft_model_state_dict(unet, adapter_name=STUDENT)
    with stage.saving() as output:
        half_precision = {name: tensor.half() for name, tensor in layers.items()}
        StableDiffusionLoraLoaderMixin.save_lora_weights(output, unet_lora_layers=half_precision)
        timesteps = recipe.objective.timesteps
        defaults = {
            "default_num_inference_steps": len(timesteps),
            "default_timesteps": timesteps,
            "default_guidance_scale": 1.0,
        }
        (output / "defaults.json").write_text(json.dumps(defaults, indent=2) + "\n")
