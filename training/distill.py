"""A pipeline in four evaluations: LCM-LoRA (Luo et al., 2023), by latent consistency distillation.

    python -m unitouch_gen.training.distill --model my-pipeline --output runs/distill

The student is the network with LoRA layers. It learns to predict, at the noise levels of diffusers' `LCMScheduler` in
a few steps, the latents that guided sampling ends at: its prediction at one level is trained to match the one at the
next level, where guided DDIM leads. The result is a LoRA file. Pipelines use it with that scheduler and a
`guidance_scale` of 1, since guidance is learnt, too.
"""

import warnings
from typing import Annotated, Any

import torch
from diffusers import DDPMScheduler, LCMScheduler, UNet2DConditionModel
from diffusers.loaders import StableDiffusionLoraLoaderMixin
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer
from pydantic import Field, PositiveFloat, PositiveInt
from torch import Tensor, nn
from transformers import CLIPTextModel

from unitouch_gen.errors import InvalidInputError, check_choice, needed
from unitouch_gen.files import class_name, read_settings, reading
from unitouch_gen.models.autoencoders import read_autoencoder
from unitouch_gen.models.processing import read_tokenizer
from unitouch_gen.schedule import NoiseSchedule, alpha, to_denoised
from unitouch_gen.training import touch_ldm, unclip
from unitouch_gen.training.batches import ArrayDataset, Batch
from unitouch_gen.training.data import DrawnContacts
from unitouch_gen.training.losses import predict
from unitouch_gen.training.recipe import Arguments, Settings, Share, build, read, read_recipe
from unitouch_gen.training.stages import Recipe, Stage, run
from unitouch_gen.training.trainer import Decay

STUDENT, TARGET = "student", "target"
"""Names of the two sets of LoRA layers: the trained ones and their moving average."""

SIGMA_DATA, TIMESTEP_SCALING = 0.5, 10.0
"""Of the boundary condition, as in diffusers' `LCMScheduler`."""

Conditioned = unclip.UnclipObjective | touch_ldm.TouchDiffusionObjective


class DistillSettings(Settings):
    """How the student is taught."""

    guidance_spread: Share  # guidance is uniform around the pipeline's default, within this share of it
    levels: Annotated[int, Field(ge=1, le=50)]  # steps of `LCMScheduler`, whose noise levels are learnt
    solver_steps: PositiveInt  # of DDIM from one level to the next
    target_decay: Decay  # of the moving average of the LoRA layers
    huber: PositiveFloat  # c of the pseudo-Huber loss


class DistillRecipe(Recipe):
    lora: Arguments
    objective: DistillSettings


class DistillObjective(nn.Module):
    """Consistency of states a level apart on the trajectories of guided DDIM (Luo et al., 2023, "Latent", Algorithm 1).

    One network is all three: without LoRA layers the teacher, with those of `STUDENT` the student, with those of
    `TARGET` the target. `conditioned` is the objective that trained the network; it makes the conditions.
    """

    def __init__(
        self, unet: UNet2DConditionModel, scheduler: DDPMScheduler, conditioned: Conditioned,
        settings: DistillSettings, guidance_scale: float,
    ):  # fmt: skip
        super().__init__()
        self.trained, self.settings, self.guidance_scale = unet, settings, guidance_scale
        self.frozen = (conditioned,)  # in a tuple, so that it is no module of this one
        self.prediction_type = scheduler.config.prediction_type
        self.schedule, lcm = NoiseSchedule.of(scheduler), LCMScheduler.from_config(scheduler.config)
        lcm.set_timesteps(settings.levels)
        self.timesteps = torch.cat([torch.zeros(1), lcm.timesteps.flip(0)])  # from data to noise
        self.follow(1.0)  # both begin alike

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        self.follow(1.0 - self.settings.target_decay)
        latents, settings = batch["latents"].float(), self.settings
        count, device = len(latents), latents.device
        level = torch.randint(1, len(self.timesteps), (count,))
        first, last = self.timesteps[level], self.timesteps[level - 1]
        t, sigma = self._levels(first, device)
        every = torch.ones(count, dtype=torch.bool, device=device)
        conditions = self.frozen[0].conditions(batch, every)
        unconditional = self.frozen[0].conditions(batch, ~every)
        both = {name: torch.cat([unconditional[name], given]) for name, given in conditions.items()}
        spread = settings.guidance_spread * (2.0 * torch.rand(count, 1, 1, 1, device=device) - 1.0)
        z = alpha(sigma) * (latents + sigma * torch.randn_like(latents))
        with torch.no_grad():
            self.trained.disable_adapters()
            z_next = self._guided_ddim(z, first, last, both, self.guidance_scale * (1.0 + spread))
            self.trained.enable_adapters()
            self.trained.set_adapter(TARGET)
            aim = self._consistency(z_next, *self._levels(last, device), conditions)
        self.trained.set_adapter(STUDENT)
        error = self._consistency(z, t, sigma, conditions) - aim
        loss = ((error.square() + settings.huber**2).sqrt() - settings.huber).mean()
        return {"loss": loss, "mse": error.square().mean().detach()}

    @torch.no_grad()
    def follow(self, share: float) -> None:
        """Moves the target's layers towards the student's, by a share of the way."""
        for name, parameter in self.trained.named_parameters():
            if f".{TARGET}." in name:
                student = self.trained.get_parameter(name.replace(f".{TARGET}.", f".{STUDENT}."))
                parameter.lerp_(student, share)

    def _levels(self, timesteps: Tensor, device: torch.device) -> tuple[Tensor, Tensor]:
        """Timesteps (B,) and their noise levels (B, 1, 1, 1)."""
        sigmas = self.schedule.sigma(timesteps).float()
        return timesteps.to(device), sigmas.to(device)[:, None, None, None]

    def _guided_ddim(
        self, z: Tensor, first: Tensor, last: Tensor, both: dict[str, Tensor], guidance_scale: Tensor
    ) -> Tensor:
        """States (B, C, h, w) at timesteps `last` (B,), from those at `first`; unconditional `both` come first."""
        t, sigma = self._levels(first, z.device)
        for step in range(1, self.settings.solver_steps + 1):
            without, given = predict(self.trained, torch.cat([z, z]), torch.cat([t, t]), **both).chunk(2)
            guided = without + guidance_scale * (given - without)
            ahead = first + (step / self.settings.solver_steps) * (last - first)
            t, sigma_next = self._levels(ahead.round(), z.device)
            z = ddim_step(to_denoised(guided, z, sigma, self.prediction_type), z, sigma, sigma_next)
            sigma = sigma_next
        return z

    def _consistency(self, z: Tensor, t: Tensor, sigma: Tensor, conditions: dict[str, Tensor]) -> Tensor:
        """f(z, t) = c_skip z + c_out x_0(z, t) (B, C, h, w), which is z at t = 0."""
        denoised = to_denoised(predict(self.trained, z, t, **conditions), z, sigma, self.prediction_type)
        scaled = TIMESTEP_SCALING * t[:, None, None, None]
        c_skip, c_out = SIGMA_DATA**2 / (scaled**2 + SIGMA_DATA**2), scaled / (scaled**2 + SIGMA_DATA**2) ** 0.5
        return c_skip * z + c_out * denoised


def ddim_step(denoised: Tensor, z: Tensor, sigma: Tensor, sigma_next: Tensor) -> Tensor:
    """The variance-preserving state at the next noise level (Song et al., 2021, "DDIM", Equation 12, eta 0)."""
    noise = (z / alpha(sigma) - denoised) / sigma
    return alpha(sigma_next) * (denoised + sigma_next * noise)


def add_layers(unet: UNet2DConditionModel, lora: Arguments) -> None:
    """Adds the LoRA layers of student and target to a network; only the student's are trained."""
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


def conditioned_touches(
    stage: Stage, settings: Arguments, unet: Any, scheduler: Any
) -> tuple[Conditioned, ArrayDataset]:
    """The objective that trains a network of touches, and its data."""
    sensors, with_gels = settings["sensors"], unet.config.in_channels != unet.config.out_channels
    for source in stage.sources:
        if with_gels and not isinstance(source, DrawnContacts):
            raise InvalidInputError("`data.sets` have no untouched gels, which `model` learns from; leave them out.")
        if sensors and (source.sensor is not None or not with_gels):
            check_choice("data: sensor", source.sensor, sensors)
    with reading("model", stage.folders["model"]):
        joint, vae = stage.joint_space("image"), read_autoencoder(stage.folders["model"] / "vae")
    dataset, gels = touch_ldm.inputs(stage, joint, vae, sensors, with_gels)
    how = read(touch_ldm.TouchDiffusionSettings, read_recipe("touch_ldm")["objective"])
    return touch_ldm.TouchDiffusionObjective(unet, scheduler, joint.config.embedding_norm, how, gels), dataset


def conditioned_pictures(
    stage: Stage, settings: Arguments, unet: Any, scheduler: Any
) -> tuple[Conditioned, ArrayDataset]:
    """The objective that trains a network of pictures, and its data."""
    folder = stage.folders["model"]
    with reading("model", folder):
        joint, vae, processor = stage.joint_space("image"), read_autoencoder(folder / "vae"), stage.processor
        normalizer = StableUnCLIPImageNormalizer.from_pretrained(folder / "image_normalizer", use_safetensors=True)
        noising = DDPMScheduler.from_pretrained(folder / "image_noising_scheduler")
        text_encoder = CLIPTextModel.from_pretrained(folder / "text_encoder", use_safetensors=True)
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


def main(stage: Stage) -> None:
    recipe, folder = stage.recipe, stage.folders["model"]
    settings = read_settings("model", folder / "model_index.json")
    conditioned_by = CONDITIONED[check_choice("model: _class_name", class_name(settings), CONDITIONED)]
    with reading("model", folder):
        unet = UNet2DConditionModel.from_pretrained(folder / "unet", use_safetensors=True)
        scheduler = DDPMScheduler.from_pretrained(folder / "scheduler")
    add_layers(unet, recipe.lora)
    conditioned, dataset = conditioned_by(stage, settings, unet, scheduler)
    guidance_scale = settings["default_guidance_scale"]
    stage.fit(DistillObjective(unet, scheduler, conditioned, recipe.objective, guidance_scale), dataset)
    layers = needed("peft").get_peft_model_state_dict(unet, adapter_name=TARGET)
    with stage.saving() as place:
        halves = {name: tensor.half() for name, tensor in layers.items()}
        StableDiffusionLoraLoaderMixin.save_lora_weights(place, unet_lora_layers=halves)


if __name__ == "__main__":
    run("distill", DistillRecipe, main)
