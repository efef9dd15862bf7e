"""What every pipeline on an unCLIP model shares: its components, its conditions, its denoising and its decoding."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from diffusers import AutoencoderDC, AutoencoderKL, DiffusionPipeline, UNet2DConditionModel
from diffusers.image_processor import VaeImageProcessor
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer
from diffusers.schedulers.scheduling_utils import KarrasDiffusionSchedulers, SchedulerMixin
from diffusers.utils.torch_utils import randn_tensor
from torch import Tensor
from transformers import CLIPTextModel, CLIPTokenizer

from unitouch_gen.diffusion.conditioning import apply_strength, match_norm, noise_embeddings
from unitouch_gen.diffusion.latents import decode, scale_factor
from unitouch_gen.diffusion.report import ReturnCode, RunReport
from unitouch_gen.diffusion.sampling import Guidance, sample
from unitouch_gen.encoders.model import UniTouchModel
from unitouch_gen.encoders.pixels import ImageInput
from unitouch_gen.encoders.processing import UniTouchProcessor
from unitouch_gen.encoders.sensors import SensorMatch
from unitouch_gen.errors import InvalidInputError, NonFiniteError, check_number, describe
from unitouch_gen.pipelines.checks import MAX_GAIN, Generators, check_sensor

DEFAULTS = ("default_strength", "default_guidance_scale", "default_num_inference_steps", "default_noise_level")

SensorNames = str | Sequence[str | None] | None
StepEndCallback = Callable[[Any, int, Tensor, dict[str, Tensor]], dict[str, Tensor] | None]


class UnclipPipeline(DiffusionPipeline):
    """An unCLIP model that takes embeddings of the joint space in place of image embeddings.

    Args:
        image_normalizer: Mean and standard deviation of the embeddings that the UNet was trained on.
        image_noising_scheduler: Schedule of the noise on the embedding.
        unet: Conditioned on hidden states of the prompt and, as class labels, on the noised embedding.
        scheduler: The pipeline's own solver, used when `solver` is `None`.
        vae: Decodes latents.
        unitouch: The joint space; only its touch encoder is used. May be `None` if embeddings are passed.
        processor: Prepares touch images for it.
        tokenizer, text_encoder: For the prompt. May be `None` if `prompt_embeds` are passed.
        default_strength, default_guidance_scale, default_num_inference_steps, default_noise_level: What a call uses
            where it says nothing. The paper's values; a checkpoint may store its own.
    """

    model_cpu_offload_seq = "unitouch->text_encoder->unet->vae"
    _optional_components = ["unitouch", "processor", "tokenizer", "text_encoder"]
    # Sequential offloading leaves `unitouch` on its device: it would take the prototypes away from the sensor bank.
    _exclude_from_cpu_offload = ["image_normalizer", "unitouch"]
    _callback_tensor_inputs = ["latents", "prompt_embeds"]

    def __init__(
        self,
        image_normalizer: StableUnCLIPImageNormalizer,
        image_noising_scheduler: KarrasDiffusionSchedulers,
        unet: UNet2DConditionModel,
        scheduler: KarrasDiffusionSchedulers,
        vae: AutoencoderKL | AutoencoderDC,
        unitouch: UniTouchModel | None = None,
        processor: UniTouchProcessor | None = None,
        tokenizer: CLIPTokenizer | None = None,
        text_encoder: CLIPTextModel | None = None,
        default_strength: float = 0.75,
        default_guidance_scale: float = 9.0,
        default_num_inference_steps: int = 50,
        default_noise_level: int = 0,
    ):
        super().__init__()
        self.register_modules(
            unitouch=unitouch,
            processor=processor,
            image_normalizer=image_normalizer,
            image_noising_scheduler=image_noising_scheduler,
            tokenizer=tokenizer,
            text_encoder=text_encoder,
            unet=unet,
            scheduler=scheduler,
            vae=vae,
        )
        self.register_to_config(
            default_strength=default_strength,
            default_guidance_scale=default_guidance_scale,
            default_num_inference_steps=default_num_inference_steps,
            default_noise_level=default_noise_level,
        )
        self.vae_scale_factor = scale_factor(vae)
        self.image_processor = VaeImageProcessor(vae_scale_factor=self.vae_scale_factor)
        self._check_widths()

    def _check_widths(self) -> None:
        """The embedding of the joint space has to fit the unCLIP's."""
        width = self.embedding_dim
        labels = self.unet.config.projection_class_embeddings_input_dim
        if labels != 2 * width:
            raise InvalidInputError(
                f"`unet` takes class labels of width {labels}, but `image_normalizer` has {width}; an unCLIP UNet "
                "takes twice the embedding's width."
            )
        if self.unitouch is not None and self.unitouch.config.projection_dim != width:
            raise InvalidInputError(
                f"`unitouch` has embeddings of width {self.unitouch.config.projection_dim}, the unCLIP model of width "
                f"{width}; use models of one width."
            )

    @property
    def embedding_dim(self) -> int:
        """D of the embeddings that condition the UNet."""
        return self.image_normalizer.config.embedding_dim

    @classmethod
    def from_pipe(cls, pipeline: DiffusionPipeline, **kwargs: Any) -> "UnclipPipeline":
        """Builds on any diffusers unCLIP pipeline, sharing its components as they are.

        Args:
            pipeline: `StableUnCLIPImg2ImgPipeline` or another one with its components.
            kwargs: `unitouch=` the joint space; `processor=`, made for `unitouch` when left out; and whatever else
                should differ. `dtype=` or `torch_dtype=` moves all networks to one dtype.

        Raises:
            InvalidInputError: On an argument that this pipeline does not take, or components that do not fit.
        """
        dtype = kwargs.pop("dtype", kwargs.pop("torch_dtype", None))
        required, optional = cls._get_signature_keys(cls)
        accepted = {*required, *optional}
        unknown = sorted(set(kwargs) - accepted)
        if unknown:
            raise InvalidInputError(f"`from_pipe` got {unknown}; it takes {sorted(accepted)}.")
        inherited = {key: value for key, value in pipeline.components.items() if key in accepted}
        defaults = {key: pipeline.config[key] for key in DEFAULTS if key in pipeline.config}
        parts = {**inherited, **defaults, **kwargs}
        if parts.get("unitouch") is not None and parts.get("processor") is None:
            parts["processor"] = UniTouchProcessor(image_size=parts["unitouch"].config.touch_config.image_height)
        missing = sorted(set(required) - set(parts))
        if missing:
            raise InvalidInputError(f"`pipeline` has no {missing}; pass an unCLIP pipeline, or these by name.")
        made = cls(**parts)
        return made if dtype is None else made.to(dtype)

    # Conditions -------------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def encode_touch(
        self,
        touch: ImageInput,
        sensor: SensorNames = None,
        strength: float | None = None,
        background: ImageInput = None,
    ) -> Tensor:
        """Touch embeddings as the network will see them before noise: norm-matched and with strength, (B, D).

        Args:
            touch: Touch images; see `unitouch_gen.encoders.pixels.load_images`.
            sensor: Its name, one name for each image, or `None` to retrieve it by prototype.
            strength: Gain on the embedding, >= 0; the pipeline's default when `None`.
            background: What the sensor sees untouched or on average; the touches are then re-centred on the prototype
                of the sensor retrieved for it.

        Raises:
            InvalidInputError: On unreadable images, unknown sensors or a negative strength.
            NonFiniteError: If an embedding leaves the range of the encoder's dtype.
        """
        strength = check_number("strength", self._default("strength", strength), 0.0, MAX_GAIN)
        return self._touch_embeds(*self._prepare_touch(touch, sensor, background), strength)

    def _default(self, name: str, value: Any) -> Any:
        """What the call said, or else the checkpoint's default."""
        return self.config[f"default_{name}"] if value is None else value

    def _default_size(self, name: str, value: Any) -> Any:
        """`height` or `width` as the call said, or else as the UNet was trained, pixels."""
        if value is not None:
            return value
        size = self.unet.config.sample_size  # of latents: one side or (height, width)
        side = size[("height", "width").index(name)] if isinstance(size, list | tuple) else size
        if side is None:
            raise InvalidInputError(f"`{name}` has to be passed: this pipeline's UNet does not say its own size.")
        return side * self.vae_scale_factor

    def _prepare_touch(
        self, touch: ImageInput, sensor: SensorNames, background: ImageInput
    ) -> tuple[Tensor, list[SensorMatch]]:
        """Pixel values (B, 3, S, S) and the sensor of each touch; no network runs."""
        if self.unitouch is None or self.processor is None:
            raise InvalidInputError(
                "`touch` came, but this pipeline has no `unitouch` and `processor`; pass `touch_embeds` instead."
            )
        check_sensor(sensor)
        pixels = self.processor.touch(touch)
        if background is None:
            return pixels, self.unitouch.match_sensors(pixels, sensor)
        behind = self.processor.images(background, name="background")
        if len(behind) not in (1, len(pixels)):
            raise InvalidInputError(
                f"`background` holds {len(behind)} images for {len(pixels)} touches; pass one, or one each."
            )
        behind = behind.expand_as(pixels)
        matches = self.unitouch.match_sensors(behind, sensor)
        if matches[0].name is None:
            raise InvalidInputError(
                "`background` came, but this model has no sensor prototypes to re-centre on; leave it out."
            )
        return self.unitouch.recentre(pixels, behind, matches), matches

    def _touch_embeds(self, pixels: Tensor, matches: list[SensorMatch], strength: float, throw: bool = True) -> Tensor:
        """(B, D) float32; without `throw`, an embedding that is not finite stays so, and its sample breaks."""
        features = self.unitouch.get_touch_features(pixels, self.unitouch.sensor_ids(matches)).float()
        broken = ~torch.isfinite(features.norm(dim=1))
        if throw and bool(broken.any()):
            raise NonFiniteError(
                f"The embedding of touch {int(broken.nonzero()[0])} is not finite; run `unitouch` in float32."
            )
        embeds = match_norm(features, self.unitouch.config.embedding_norm)
        return apply_strength(embeds, strength).masked_fill(broken[:, None], float("nan"))

    def encode_prompt(self, prompt: list[str]) -> Tensor:
        """Hidden states of prompts, (B, T, C), T the tokenizer's full length; longer prompts are cut.

        Raises:
            InvalidInputError: If this pipeline has no text encoder.
        """
        if self.text_encoder is None or self.tokenizer is None:
            raise InvalidInputError("`prompt` came, but this pipeline has no text encoder; pass `prompt_embeds`.")
        length = self.tokenizer.model_max_length
        ids = self.tokenizer(prompt, padding="max_length", max_length=length, truncation=True, return_tensors="pt")
        use_mask = getattr(self.text_encoder.config, "use_attention_mask", False)
        device = self._execution_device
        mask = ids.attention_mask.to(device) if use_mask else None
        return self.text_encoder(ids.input_ids.to(device), attention_mask=mask)[0]

    def _prompt_states(self, prompts: list[str] | None, embeds: Tensor | None, batch_size: int, repeats: int) -> Tensor:
        """(B n, T, C), each distinct prompt encoded once."""
        if embeds is None:
            assert prompts is not None
            unique = list(dict.fromkeys(prompts))
            embeds = self.encode_prompt(unique)[[unique.index(prompt) for prompt in prompts]]
        embeds = embeds.to(self._execution_device)  # given ones may lie elsewhere
        return embeds.expand(batch_size, -1, -1).repeat_interleave(repeats, dim=0)

    def _class_labels(self, embeds: Tensor, noise_level: int, generator: Generators, repeats: int) -> Tensor:
        """(B n, 2 D); one generator noises each embedding once, as diffusers does, a list every image's own."""
        if isinstance(generator, list):
            embeds, repeats = embeds.repeat_interleave(repeats, dim=0), 1
        noise = randn_tensor(embeds.shape, generator=generator, device=embeds.device, dtype=embeds.dtype)
        level = torch.full((len(embeds),), noise_level, device=embeds.device)
        labels = noise_embeddings(embeds, level, noise, self.image_normalizer, self.image_noising_scheduler)
        return labels.repeat_interleave(repeats, dim=0)

    # Denoising and decoding -------------------------------------------------------------------------------------------

    @property
    def guidance_scale(self) -> float:
        """Of the call that runs; `callback_on_step_end` may set `_guidance_scale`, as with diffusers' pipelines."""
        return self._guidance_scale

    @property
    def do_classifier_free_guidance(self) -> bool:
        return Guidance(self._guidance_scale).active

    @property
    def num_timesteps(self) -> int:
        return self._num_timesteps

    @property
    def interrupt(self) -> bool:
        return self._interrupt

    def _denoise(
        self,
        latents: Tensor,
        hidden: Tensor,
        labels: Tensor,
        scheduler: SchedulerMixin,
        timesteps: Tensor,
        report: RunReport,
        *,
        callback: StepEndCallback | None,
        callback_inputs: Sequence[str],
        **options: Any,
    ) -> Tensor:
        """Unit-variance noise -> latents; see `diffusion.sampling.sample`.

        Hidden states and labels hold the conditional branch, and before it the unconditional one where guidance is on.
        """
        dtype, batch_size = self.unet.dtype, len(latents)
        hidden, labels = hidden.to(latents.device, dtype), labels.to(latents.device, dtype)
        self._num_timesteps, self._interrupt = len(timesteps), False

        def guidance() -> Guidance:
            now = Guidance(self._guidance_scale)
            if now.active and not len(hidden) == len(labels) == 2 * batch_size:
                raise InvalidInputError(
                    f"`callback_on_step_end` set `_guidance_scale` to {now.scale:g}, but there is no unconditional "
                    "branch; start with a `guidance_scale` above 1, and keep both halves of `prompt_embeds`."
                )
            return now

        def denoise(state: Tensor, timestep: Tensor) -> Tensor:
            rows = len(state)  # as many as there are samples, or twice that
            states = hidden.expand(rows, -1, -1) if len(hidden) == 1 else hidden[-rows:]
            conditions = {"encoder_hidden_states": states, "class_labels": labels[-rows:]}
            return self.unet(state.to(dtype), timestep, **conditions, return_dict=False)[0]

        def on_step(step: int, timestep: Tensor, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
            nonlocal hidden
            assert callback is not None
            tensors = {**tensors, "prompt_embeds": hidden}
            changed = callback(self, step, timestep, {key: tensors[key] for key in callback_inputs}) or {}
            if "prompt_embeds" in changed:
                hidden = changed["prompt_embeds"].to(hidden)
            if len(hidden) not in (1, batch_size, 2 * batch_size):
                raise InvalidInputError(
                    f"`callback_on_step_end` returned `prompt_embeds` that are {describe(hidden)}, for {batch_size} "
                    "pictures; return one for each, one for all, or both halves."
                )
            return changed

        with self.progress_bar(total=len(timesteps)) as bar:
            return sample(
                denoise,
                scheduler,
                latents,
                guidance,
                report,
                timesteps=timesteps,
                on_step=None if callback is None else on_step,
                progress=bar.update,
                interrupted=lambda: self._interrupt,
                **options,
            )

    def _decode(self, latents: Tensor, output_type: str, report: RunReport, throw: bool) -> Any:
        """Latents (B, C, h, w) -> pictures, of the output type, of the samples that ended well."""
        rows = [row for row, code in enumerate(report.codes) if code is ReturnCode.SUCCESS]
        if output_type == "latent":
            report.left_out.append("VAE")
            return latents[rows]
        pixels = latents.new_zeros(0, 3, *(self.vae_scale_factor * side for side in latents.shape[-2:]))
        if rows:
            pixels = decode(self.vae, latents[rows])
            finite = torch.isfinite(pixels.flatten(1)).all(dim=1)
            broken = [row for row, fine in zip(rows, finite.tolist(), strict=True) if not fine]
            if broken and throw:
                raise NonFiniteError(f"Sample {broken[0]} is not finite after decoding; run the VAE in float32.")
            for row in broken:
                report.codes[row], report.failed_at[row] = ReturnCode.NON_FINITE, report.steps
            pixels = pixels[finite]
        return self.image_processor.postprocess(pixels, output_type=output_type)
