"""`TouchToImagePipeline`: a picture of what a touch feels like (Section 4.4 of the paper)."""

import os
from collections.abc import Sequence
from typing import Any, Self

import torch
from diffusers import (
    AutoencoderKL,
    AutoencoderTiny,
    DiffusionPipeline,
    StableUnCLIPImg2ImgPipeline,
    UNet2DConditionModel,
)
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer
from diffusers.schedulers.scheduling_utils import KarrasDiffusionSchedulers
from diffusers.utils import USE_PEFT_BACKEND, scale_lora_layers, unscale_lora_layers
from diffusers.utils.torch_utils import randn_tensor
from torch import Tensor
from transformers import CLIPImageProcessor, CLIPTextModel, CLIPTokenizer

from unitouch_gen.arguments import MAX_SCALE, SamplingArguments
from unitouch_gen.conditioning import QUALITY_PROMPT, EmbeddingBank, noise_embeddings
from unitouch_gen.errors import (
    InvalidInputError,
    check_count,
    check_dtype,
    check_equal,
    check_integer,
    check_kind,
    check_number,
    check_passed,
    check_tensor,
    check_texts,
    check_unused,
    one_each,
)
from unitouch_gen.models.images import ImageInput
from unitouch_gen.models.joint import UniTouchModel
from unitouch_gen.models.processing import UniTouchProcessor, tokenize
from unitouch_gen.pipelines.base import (
    Generators,
    SensorNames,
    StepEndCallback,
    Touches,
    UniTouchPipeline,
)
from unitouch_gen.pipelines.output import UniTouchPipelineOutput
from unitouch_gen.pipelines.published import read_joint, read_unclip
from unitouch_gen.sampling import Denoiser, Guidance, RunReport, prepare_steps


class TouchToImagePipeline(UniTouchPipeline):
    """Touch to image: an unCLIP model conditioned on a touch embedding in place of an image embedding.

    Args:
        image_normalizer: Mean and standard deviation of the embeddings that the UNet was trained on.
        image_noising_scheduler: Noise schedule of the embedding.
        unet: Conditioned on the prompt's hidden states and, as class labels, the noised embedding.
        scheduler: Used when a call names no `solver`.
        vae: Decodes latents to pictures.
        unitouch: The joint space. May be `None` if embeddings are passed.
        processor: Preprocesses touch images for `unitouch`.
        tokenizer, text_encoder: For the prompt. May be `None` if `prompt_embeds` are passed.
        embedding_bank: Image embeddings of the bridge; `None` for no bridge.
        default_strength, default_guidance_scale, default_num_inference_steps, default_noise_level, default_timesteps:
            Defaults of a call; here the paper's values.
    """

    model_cpu_offload_seq = "unitouch->text_encoder->unet->vae"
    _optional_components = ["unitouch", "processor", "tokenizer", "text_encoder", "embedding_bank"]
    # `unitouch` stays on its device: sequential offloading would take the prototypes from the sensor bank.
    _exclude_from_cpu_offload = ["image_normalizer", "unitouch", "embedding_bank"]
    _callback_tensor_inputs = ["latents", "prompt_embeds"]
    _example_call = 'pipe(example("brick"))'

    def __init__(
        self,
        image_normalizer: StableUnCLIPImageNormalizer,
        image_noising_scheduler: KarrasDiffusionSchedulers,
        unet: UNet2DConditionModel,
        scheduler: KarrasDiffusionSchedulers,
        vae: AutoencoderKL | AutoencoderTiny,
        unitouch: UniTouchModel | None = None,
        processor: UniTouchProcessor | None = None,
        tokenizer: CLIPTokenizer | None = None,
        text_encoder: CLIPTextModel | None = None,
        embedding_bank: EmbeddingBank | None = None,
        default_strength: float = 0.75,
        default_guidance_scale: float = 9.0,
        default_num_inference_steps: int = 50,
        default_noise_level: int = 0,
        default_timesteps: list[int] | None = None,
    ):
        super().__init__()
        self.register_modules(
            unitouch=unitouch,
            processor=processor,
            image_normalizer=image_normalizer,
            image_noising_scheduler=image_noising_scheduler,
            tokenizer=tokenizer,
            text_encoder=text_encoder,
            embedding_bank=embedding_bank,
            unet=unet,
            scheduler=scheduler,
            vae=vae,
        )
        width = self.embedding_dim
        labels = unet.config.projection_class_embeddings_input_dim
        check_equal("unet", "class labels of width", labels, 2 * width, "twice the width of the embeddings")
        self._finish_init(
            "the unCLIP model",
            default_strength=default_strength,
            default_guidance_scale=default_guidance_scale,
            default_num_inference_steps=default_num_inference_steps,
            default_noise_level=default_noise_level,
            default_timesteps=default_timesteps,
        )

    @property
    def embedding_dim(self) -> int:
        """D, width of the embeddings that condition the UNet."""
        return self.image_normalizer.config.embedding_dim

    # One call ---------------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def __call__(
        self,
        touch: ImageInput = None,
        prompt: str | list[str] | None = None,
        height: int | None = None,
        width: int | None = None,
        num_inference_steps: int | None = None,
        timesteps: Sequence[int] | None = None,
        guidance_scale: float | None = None,
        strength: float | None = None,
        negative_prompt: str | list[str] | None = None,
        num_images_per_prompt: int = 1,
        noise_level: int | None = None,
        sensor: SensorNames = None,
        background: ImageInput = None,
        bridge: bool | None = None,
        solver: str | None = None,
        tolerance: float | None = None,
        max_evaluations: int | None = None,
        eta: float = 0.0,
        generator: Generators = None,
        latents: Tensor | None = None,
        touch_embeds: Tensor | None = None,
        prompt_embeds: Tensor | None = None,
        negative_prompt_embeds: Tensor | None = None,
        output_type: str = "pil",
        return_dict: bool = True,
        cross_attention_kwargs: dict[str, Any] | None = None,
        callback_on_step_end: StepEndCallback | None = None,
        callback_on_step_end_tensor_inputs: Sequence[str] = ("latents",),
        throw: bool = True,
    ) -> UniTouchPipelineOutput | tuple:
        """Generates pictures from touches.

        Args:
            touch: One touch image or several: paths, PIL images, arrays (H, W, 3), tensors (3, H, W), or a list.
            prompt: One prompt, or one for each touch; default "high quality".
            height, width: Picture size in pixels; multiples of the VAE's scale factor.
            num_inference_steps: Number of solver steps.
            timesteps: Descending timesteps of the pipeline's own scheduler, in place of their number.
            guidance_scale: s of classifier-free guidance, >= 0; active above 1.
            strength: Factor on the touch embedding, >= 0 (paper: 0.75).
            negative_prompt: Prompt of the unconditional branch; default empty.
            num_images_per_prompt: Pictures for each touch.
            noise_level: Noise level of the embedding, 0-999. More noise gives more variety.
            sensor: Sensor that took the touch: a name, one for each touch, or `None` to retrieve it.
            background: Image of the untouched sensor, to recentre touches of an unknown sensor.
            bridge: Move touch embeddings to the nearest stored image embeddings (the UNet saw only image embeddings).
                Default: if a bank is present.
            solver: A name in `unitouch_gen.sampling.SOLVERS`; `None` uses the pipeline's own scheduler.
            tolerance: Relative RMS error of the latents, from 1e-5 to 1; the steps are adaptive.
            max_evaluations: Maximum network evaluations, default 1000; applies only with `tolerance`.
            eta: DDIM eta, from 0 to 1; other schedulers ignore it, and other named solvers refuse it.
            generator: One, or one for each picture.
            latents: Unit-variance noise (B, C, h, w); the scheduler's `init_noise_sigma` is applied to it here.
            touch_embeds: Embeddings (B, D) in place of `touch`, used unchanged; see `encode_touch`.
            prompt_embeds, negative_prompt_embeds: Hidden states (B or 1, T, C) in place of the prompts.
            output_type: "pil", "np", "pt" or "latent".
            return_dict: Whether to return an output object rather than the tuple (images, report).
            cross_attention_kwargs: As in diffusers; "scale" multiplies LoRA weights, also of the text encoder.
            callback_on_step_end: Called as `callback(pipe, step, timestep, tensors)` after every step; may return new
                tensors, and set `pipe._guidance_scale` for the steps that follow, or `pipe._interrupt`. Or, without a
                `tolerance`, one of `diffusers.callbacks`.
            callback_on_step_end_tensor_inputs: Tensors passed to it: "latents" (B n, C, h, w) in float32,
                "prompt_embeds", the hidden states of both branches, the unconditional one first.
            throw: Raise on a non-finite or failed sample; otherwise drop non-finite ones and record codes.

        Examples:
            >>> import unitouch_gen

            >>> pipe = unitouch_gen.tiny("touch-to-image")
            >>> output = pipe(unitouch_gen.example("brick"))
            >>> output.images[0].save("brick.png")
            >>> print(output.report)

        Returns:
            [`UniTouchPipelineOutput`] or `tuple`.

        Raises:
            InvalidInputError, InvalidTypeError: On unusable input, before any network runs.
            NonFiniteError: If an embedding or a sample is not finite and `throw` is set.
            NotConvergedError: If a tolerance is not reached and `throw` is set.

        Warns:
            UnfamiliarInputWarning: On touches out of distribution, and on untouched gels.
        """
        # 1. Check inputs, before any network runs
        check_passed({"touch": touch, "touch_embeds": touch_embeds}, only_one=True)
        arguments = self._check_arguments(
            height=height,
            width=width,
            num_inference_steps=num_inference_steps,
            timesteps=timesteps,
            guidance_scale=self.config.default_guidance_scale if guidance_scale is None else guidance_scale,
            strength=self.config.default_strength if strength is None else strength,
            num_images_per_prompt=num_images_per_prompt,
            noise_level=self.config.default_noise_level if noise_level is None else noise_level,
            bridge=bridge,
            solver=solver,
            tolerance=tolerance,
            max_evaluations=max_evaluations,
            eta=eta,
            output_type=output_type,
            throw=throw,
        )
        if touch_embeds is not None:
            check_tensor("touch_embeds", touch_embeds, "B", self.embedding_dim)
            others = {"strength": strength, "sensor": sensor, "background": background, "bridge": bridge or None}
            check_unused("with `touch_embeds`", **others)
        touches = None if touch is None else self._read_touches(touch, sensor, background)
        batch_size = len(touch_embeds if touches is None else touches.pixels)  # type: ignore[arg-type]
        shape = self._latents_shape(batch_size, arguments)
        guidance = Guidance(arguments.guidance_scale)
        self.check_inputs(
            shape,
            arguments,
            generator=generator,
            latents=latents,
            cross_attention_kwargs=cross_attention_kwargs,
            callback_on_step_end=callback_on_step_end,
            callback_on_step_end_tensor_inputs=callback_on_step_end_tensor_inputs,
        )
        prompts = self._check_prompts(
            batch_size,
            guidance,
            prompt=prompt,
            prompt_embeds=prompt_embeds,
            negative_prompt=negative_prompt,
            negative_prompt_embeds=negative_prompt_embeds,
        )
        steps, schedule = prepare_steps(self.scheduler, arguments, self._execution_device)
        report = RunReport()

        with self._threads(shape, guidance):
            # 2. Encode the touch and the prompts
            embeds: Any = touch_embeds
            if touches is None:
                report.left_out.append("touch encoder")
            else:
                with report.stage("touch"):
                    embeds = self._encode(touches, arguments, report)
            if self.embedding_bank is not None and (touches is None or not arguments.bridge):
                report.left_out.append("embedding bank")
            conditions = {
                "encoder_hidden_states": self._encode_prompts(prompts, shape[0], cross_attention_kwargs, report),
                "class_labels": self._class_labels(embeds, arguments, guidance, generator),
                "cross_attention_kwargs": cross_attention_kwargs,
            }

            # 3. Denoise
            noise = self.prepare_latents(shape, steps, generator, latents)
            latents = self._denoise(
                Denoiser(self.unet, schedule, conditions, guidance),
                noise,
                steps,
                arguments,
                report,
                generator=generator,
                callback=callback_on_step_end,
                callback_inputs=callback_on_step_end_tensor_inputs,
            )

            # 4. Decode the finite samples
            images = self._decode(latents, arguments, report)
        self.maybe_free_model_hooks()
        if not return_dict:
            return images, report
        return UniTouchPipelineOutput(images=images, report=report, embeds=embeds)

    # Checks -----------------------------------------------------------------------------------------------------------

    def _check_arguments(self, **given: Any) -> SamplingArguments:
        arguments = super()._check_arguments(**given)
        top = self.image_noising_scheduler.config.num_train_timesteps - 1
        check_integer("noise_level", arguments.noise_level, 0, top)
        return arguments

    def _check_prompts(
        self,
        batch_size: int,
        guidance: Guidance,
        *,
        prompt: str | list[str] | None,
        prompt_embeds: Tensor | None,
        negative_prompt: str | list[str] | None,
        negative_prompt_embeds: Tensor | None,
    ) -> list[list[str] | Tensor]:
        """The prompts of each branch that runs, unconditional first: B texts, or hidden states (1 or B, T, C)."""
        prompts = [self._check_prompt("prompt", prompt, prompt_embeds, QUALITY_PROMPT, batch_size)]
        if guidance.active:
            negative = self._check_prompt("negative_prompt", negative_prompt, negative_prompt_embeds, "", batch_size)
            prompts.insert(0, negative)
        lengths = {one.shape[1] if isinstance(one, Tensor) else self.tokenizer.model_max_length for one in prompts}
        if len(lengths) > 1:
            raise InvalidInputError(
                f"`prompt_embeds` and `negative_prompt_embeds` have {sorted(lengths)} tokens; pass both, of one length."
            )
        return prompts

    def _check_prompt(
        self, name: str, prompt: Any, embeds: Tensor | None, default: str, batch_size: int
    ) -> list[str] | Tensor:
        """The prompts of a branch, `default` if there is none; or the hidden states in their place."""
        if embeds is not None:
            check_unused(f"with `{name}_embeds`", **{name: prompt})
            check_tensor(f"{name}_embeds", embeds, "B", "T", self.unet.config.cross_attention_dim)
            check_count(f"{name}_embeds", len(embeds), batch_size)
            return embeds
        self._require(name, "text_encoder", "tokenizer")
        return one_each(name, check_texts(name, default if prompt is None else prompt), batch_size)

    # Encoding ---------------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def encode_touch(
        self,
        touch: ImageInput,
        sensor: SensorNames = None,
        strength: float | None = None,
        background: ImageInput = None,
        bridge: bool | None = None,
    ) -> Tensor:
        """Un-noised embeddings (B, D) that condition the network; for arguments and errors see `__call__`."""
        strength = self.config.default_strength if strength is None else strength
        arguments = self._check_arguments(strength=strength, bridge=bridge)
        touches = self._read_touches(touch, sensor, background)
        with self._threads(self._latents_shape(len(touches.pixels), arguments), Guidance(1.0)):
            return self._encode(touches, arguments, RunReport())

    def _encode(self, touches: Touches, arguments: SamplingArguments, report: RunReport) -> Tensor:
        """Embeddings (B, D) of touches, with bridge and strength."""
        embeds = self._touch_embeds(touches, report, arguments.throw)
        if arguments.bridge:
            embeds = self.embedding_bank.bridge(embeds)
        return arguments.strength * embeds

    @torch.no_grad()
    def encode_prompt(self, prompt: str | list[str], lora_scale: float = 1.0) -> Tensor:
        """Hidden states of prompts, (B, T, C), T the tokenizer's full length; longer prompts are cut.

        Equal prompts are encoded once. `lora_scale` multiplies the text encoder's LoRA weights.
        """
        self._require("prompt", "text_encoder", "tokenizer")
        check_number("lora_scale", lora_scale, -MAX_SCALE, MAX_SCALE)
        return self._encode_prompt(check_texts("prompt", prompt), lora_scale)

    def _encode_prompt(self, prompts: list[str], lora_scale: float) -> Tensor:
        device = self._execution_device
        scaled = lora_scale != 1.0 and USE_PEFT_BACKEND  # without peft there are no LoRA weights
        unique = list(dict.fromkeys(prompts))
        ids = tokenize(self.tokenizer, unique)
        use_mask = getattr(self.text_encoder.config, "use_attention_mask", False)
        mask = ids.attention_mask.to(device) if use_mask else None
        try:
            if scaled:
                scale_lora_layers(self.text_encoder, lora_scale)
            hidden = self.text_encoder(ids.input_ids.to(device), attention_mask=mask)[0]
        finally:
            if scaled:
                unscale_lora_layers(self.text_encoder, lora_scale)
        return hidden[[unique.index(prompt) for prompt in prompts]]

    def _encode_prompts(
        self,
        prompts: list[list[str] | Tensor],
        num_images: int,
        cross_attention_kwargs: dict[str, Any] | None,
        report: RunReport,
    ) -> Tensor:
        """Hidden states of the prompts of `_check_prompts`, with one row for each image and branch."""
        lora_scale = (cross_attention_kwargs or {}).get("scale", 1.0)
        device = self._execution_device
        branches = []
        with report.stage("prompt"):
            for prompt in prompts:
                states = prompt if isinstance(prompt, Tensor) else self._encode_prompt(prompt, lora_scale)
                states = states.to(device, self.unet.dtype)
                branches.append(states.repeat_interleave(num_images // len(states), dim=0))
        if all(isinstance(prompt, Tensor) for prompt in prompts):
            report.left_out.append("prompt encoder")
        return torch.cat(branches)

    def _class_labels(
        self, embeds: Tensor, arguments: SamplingArguments, guidance: Guidance, generator: Generators
    ) -> Tensor:
        """Class labels of each image and branch: noised embeddings, drawn before latents as in diffusers, or zeros."""
        embeds = embeds.to(self._execution_device, torch.float32)  # the noise must not depend on the dtype
        repeats = arguments.num_images_per_prompt
        if isinstance(generator, list):  # which draws noise for each image; a single one, for each embedding
            embeds = embeds.repeat_interleave(repeats, dim=0)
            repeats = 1
        noise = randn_tensor(embeds.shape, generator=generator, device=embeds.device, dtype=embeds.dtype)
        level = torch.full((len(embeds),), arguments.noise_level, device=embeds.device)
        labels = noise_embeddings(embeds, level, noise, self.image_normalizer, self.image_noising_scheduler)
        labels = labels.repeat_interleave(repeats, dim=0)
        if guidance.active:
            labels = torch.cat([torch.zeros_like(labels), labels])
        return labels.to(self.unet.dtype)

    # Building on other pipelines --------------------------------------------------------------------------------------

    @classmethod
    def from_pipe(cls, pipeline: DiffusionPipeline, **kwargs: Any) -> Self:
        """Builds on any diffusers unCLIP pipeline and shares its components.

        Args:
            pipeline: `StableUnCLIPImg2ImgPipeline`, or another one with its components.
            kwargs: Components and defaults to replace, and `torch_dtype`; a missing `processor` is made for `unitouch`.
        """
        check_kind("pipeline", pipeline, DiffusionPipeline)
        modules, settings = cls._get_signature_keys(cls)
        dtype = kwargs.pop("torch_dtype", None)
        available = {**pipeline.config, **pipeline.components}
        parts = {name: available[name] for name in (*modules, *settings) if name in available} | kwargs
        if parts.get("unitouch") is not None and parts.get("processor") is None:
            parts["processor"] = UniTouchProcessor.for_config(parts["unitouch"].config)
        return cls(**parts) if dtype is None else cls(**parts).to(check_dtype("torch_dtype", dtype))

    def to_diffusers(self) -> StableUnCLIPImg2ImgPipeline:
        """diffusers' own unCLIP pipeline of the same components, with the joint space's image encoder.

        Its `image_embeds` may be touch embeddings. `from_pipe(..., unitouch=..., embedding_bank=...)` is the inverse.
        """
        self._require("to_diffusers", "unitouch", "tokenizer", "text_encoder", instead="call this one")
        ours = ("unitouch", "processor", "embedding_bank")
        shared = {name: part for name, part in self.components.items() if name not in ours}
        encoder = self.unitouch.load("image")[0]
        size = encoder.config.image_size
        processor = CLIPImageProcessor(size={"shortest_edge": size}, crop_size=size)
        return StableUnCLIPImg2ImgPipeline(feature_extractor=processor, image_encoder=encoder, **shared)

    @classmethod
    def from_published(
        cls,
        unclip: str | os.PathLike,
        unitouch: str | os.PathLike | UniTouchModel,
        *,
        dtype: torch.dtype = torch.float32,
        variant: str | None = None,
        revision: str | None = None,
        cache_dir: str | os.PathLike | None = None,
        token: str | bool | None = None,
        local_files_only: bool = False,
    ) -> Self:
        """Builds on published weights: an unCLIP model and a converted joint space.

        Touches are rescaled to the norm of image embeddings, which follows from the mean and standard deviation in the
        unCLIP's normaliser.

        Args:
            unclip: Folder or repository id of a diffusers unCLIP pipeline, such as Stable Diffusion 2.1 unCLIP. Its
                image encoder has to be the joint space's: ImageBind kept OpenCLIP's.
            unitouch: Folder that `unitouch-gen convert unitouch` wrote, repository id of one, or the model itself.
            dtype: dtype of the networks.
            variant, revision: Variant, such as "fp16", and revision of the unCLIP's files.
            cache_dir, token, local_files_only: Options of downloads, as in `from_pretrained`.

        Raises:
            InvalidInputError: If a model cannot be read, or their embeddings differ in width.

        Example:
            >>> pipe = TouchToImagePipeline.from_published("sd21-unclip", "unitouch")  # doctest: +SKIP
        """
        hub: Any = {"cache_dir": cache_dir, "token": token, "local_files_only": local_files_only}
        model, processor = read_joint(unitouch, dtype, **hub)
        source = read_unclip(unclip, model, dtype, variant, revision=revision, **hub)
        if processor.tokenizer is None and isinstance(source.tokenizer, CLIPTokenizer):
            processor.tokenizer = source.tokenizer
        mean = source.image_normalizer.mean.double()
        std = source.image_normalizer.std.double()
        model.config.embedding_norm = (mean.square() + std.square()).sum().sqrt().item()  # RMS norm of embeddings
        return cls.from_pipe(source, unitouch=model, processor=processor)
