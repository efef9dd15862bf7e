"""What every pipeline on an unCLIP model shares: its components, its prompts and how it is conditioned."""

import os
from collections.abc import Callable, Mapping
from typing import Any, Self

import torch
from diffusers import AutoencoderDC, AutoencoderKL, DiffusionPipeline, UNet2DConditionModel
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer
from diffusers.schedulers.scheduling_utils import KarrasDiffusionSchedulers
from diffusers.utils.torch_utils import randn_tensor
from torch import Tensor
from transformers import CLIPTextModel, CLIPTokenizer

from unitouch_gen.conditioning import QUALITY_PROMPT, apply_strength, noise_embeddings
from unitouch_gen.errors import InvalidInputError, check_integer, check_number
from unitouch_gen.models.images import ImageInput
from unitouch_gen.models.joint import UniTouchModel
from unitouch_gen.models.processing import UniTouchProcessor
from unitouch_gen.models.sensors import SensorMatch
from unitouch_gen.pipelines.base import JointSpacePipeline, SensorNames
from unitouch_gen.pipelines.call import Call
from unitouch_gen.pipelines.checks import (
    MAX_GAIN,
    Generators,
    check_prompt_lengths,
    check_prompts,
)
from unitouch_gen.pipelines.pipeline_output import UniTouchPipelineOutput
from unitouch_gen.pipelines.published import Wanted, unclip_pipeline
from unitouch_gen.plan import Plan, guidance_of
from unitouch_gen.report import RunReport

DEFAULTS = ("default_strength", "default_guidance_scale", "default_num_inference_steps", "default_noise_level",
            "calibration")  # fmt: skip


class UnclipPipeline(JointSpacePipeline):
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
        calibration: What error indicators stand for; see `Calibration.find`.
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
        calibration: Mapping[str, Any] | None = None,
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
            calibration=dict(calibration or {}),
        )
        self._prepare_images()
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
        if isinstance(pipeline, JointSpacePipeline):
            pipeline._read_again(pipeline._readers)
        inherited = {key: value for key, value in pipeline.components.items() if key in accepted}
        defaults = {key: pipeline.config[key] for key in DEFAULTS if key in pipeline.config}
        parts = {**inherited, **defaults, **kwargs}
        if parts.get("unitouch") is not None and parts.get("processor") is None:
            parts["processor"] = UniTouchProcessor.for_config(parts["unitouch"].config)
        missing = sorted(set(required) - set(parts))
        if missing:
            raise InvalidInputError(f"`pipeline` has no {missing}; pass an unCLIP pipeline, or these by name.")
        made = cls(**parts)
        return made if dtype is None else made.to(dtype)

    @classmethod
    def from_published(
        cls,
        unclip: str | os.PathLike,
        unitouch: str | os.PathLike | UniTouchModel,
        *,
        embedding_norm: float | None = None,
        images: ImageInput = None,
        plan: Plan | None = None,
        low_memory: bool = False,
        dtype: torch.dtype = torch.float32,
        device: str | torch.device | None = None,
        variant: str | None = None,
        offload: str | None = None,
        **hub: Any,
    ) -> Self:
        """Builds on published weights: an unCLIP model as its authors shared it, and a converted joint space.

        The unCLIP's image encoder is read only where it is needed: to measure the norm on pictures, or as the encoder
        of images where the joint space has none of its own. Otherwise the two have to be the same one (ImageBind kept
        OpenCLIP's), and a warning tells where they are not.

        Args:
            unclip: Folder or repository id of a diffusers unCLIP pipeline, such as Stable Diffusion 2.1 unCLIP.
            unitouch: Folder that `unitouch-gen convert unitouch` wrote, repository id of one, or the model itself.
            embedding_norm: Of image embeddings, which touches are brought to; it becomes the joint space's. When left
                out it is that of the unCLIP's own normaliser, or of `images` under its image encoder.
            images: Some pictures to measure it on, in place of `embedding_norm`.
            plan: Read no more than it needs; see `plan`.
            low_memory: Free encoders when they have done their work; the next call reads them again.
            dtype: Of the networks.
            device: They are moved to.
            variant: Of the unCLIP's files, such as "fp16".
            offload: "model" or "sequential": see diffusers' `enable_model_cpu_offload` and its like.
            hub: Options of a fetch: `cache_dir`, `token`, `local_files_only`, and `revision`, which is of `unclip`.

        Raises:
            InvalidInputError: If one of them is no such model, or their embeddings differ in width.

        Example:
            >>> pipe = TouchToImagePipeline.from_published("sd21-unclip", "unitouch")  # doctest: +SKIP
        """
        wanted = Wanted(dtype, device, variant, offload, plan, low_memory, hub)
        return unclip_pipeline(cls, unclip, unitouch, embedding_norm, images, wanted)

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
            touch: Touch images; see `unitouch_gen.models.images.load_images`.
            sensor: Its name, one name for each image, or `None` to retrieve it by prototype.
            strength: Gain on the embedding, >= 0; the pipeline's default when `None`.
            background: What the sensor sees untouched or on average; the touches are then re-centred on the prototype
                of the sensor retrieved for it.

        Raises:
            InvalidInputError: On unreadable images, unknown sensors or a negative strength.
            NonFiniteError: If an embedding leaves the range of the encoder's dtype.
        """
        strength = check_number("strength", self._default("strength", strength), 0.0, MAX_GAIN)
        pixels, matches = self._prepare_touch(touch, sensor, background)
        return self._touch_embeds(pixels, matches, strength)

    def _touch_embeds(self, pixels: Tensor, matches: list[SensorMatch], strength: float, throw: bool = True) -> Tensor:
        """(B, D) float32, norm-matched and with strength."""
        return apply_strength(self._matched(self._touch_features(pixels, matches), "touch", throw), strength)

    def encode_prompt(self, prompt: list[str]) -> Tensor:
        """Hidden states of prompts, (B, T, C), T the tokenizer's full length; longer prompts are cut.

        Raises:
            InvalidInputError: If this pipeline has no text encoder.
        """
        self._read_again(("text_encoder",))
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

    # One call ---------------------------------------------------------------------------------------------------------

    @staticmethod
    def _prompt_plan(request: Mapping[str, Any]) -> dict[str, Any]:
        """`Plan.text_encoder`, `Plan.noise` and `Plan.guidance` of a call."""
        guidance = guidance_of(request["guidance_scale"], request["guidance_interval"])
        needed = [request["prompt_embeds"], *([] if guidance is None else [request["negative_prompt_embeds"]])]
        return {"text_encoder": any(embeds is None for embeds in needed), "noise": True, "guidance": guidance}

    def _check_prompts(
        self, call: Call, batch_size: int, prompt: Any, prompt_embeds: Any, negative: Any, negative_embeds: Any
    ) -> Callable[[], Tensor]:
        """Refuses prompts that cannot be used; what it returns encodes those that can, of both branches."""
        prompts = check_prompts("prompt", prompt, prompt_embeds, batch_size, QUALITY_PROMPT, self)
        used = call.guidance.active
        negatives = check_prompts("negative_prompt", negative, negative_embeds, batch_size, "", self, used=used)
        if used:
            check_prompt_lengths(prompt_embeds, negative_embeds, self.tokenizer)

        def encode() -> Tensor:
            hidden = self._prompt_states(prompts, prompt_embeds, batch_size, call.repeats)
            if not used:
                return hidden
            return torch.cat([self._prompt_states(negatives, negative_embeds, batch_size, call.repeats), hidden])

        return encode

    def _check_noise_level(self, noise_level: int | None) -> int:
        """The noise level of the embedding, the checkpoint's default where none came."""
        top = self.image_noising_scheduler.config.num_train_timesteps - 1
        return check_integer("noise_level", self._default("noise_level", noise_level), 0, top)

    def _generate(
        self,
        call: Call,
        embeds: Tensor,
        noise_level: int,
        prompts: Callable[[], Tensor],
        report: RunReport,
        return_dict: bool,
        **init: Any,
    ) -> UniTouchPipelineOutput | tuple:
        """From embeddings (B, D), as the network will see them before noise, to pictures."""
        embeds = embeds.to(self._execution_device)

        # Prompts
        with report.stage("prompt"):
            hidden = prompts()
        self._free("text_encoder")

        # Noised embedding, then latents: the order in which diffusers draws
        labels = self._class_labels(embeds, noise_level, call.generator, call.repeats)
        if call.guidance.active:
            labels = torch.cat([torch.zeros_like(labels), labels])

        with report.stage("denoising"):
            latents = self._denoise(call, hidden, labels, report, **init)

        # Pictures, of the samples that ended well
        with report.stage("decoding"):
            images = self._images(call, latents, report)

        self._end(report)
        return UniTouchPipelineOutput(images=images, report=report, embeds=embeds) if return_dict else (images, report)
