"""`TouchToImagePipeline`: a picture of what a touch feels like (Section 4.4 of the paper)."""

import os
from collections.abc import Mapping, Sequence
from typing import Any, Self

import torch
from diffusers import (
    AutoencoderDC,
    AutoencoderKL,
    AutoencoderTiny,
    DiffusionPipeline,
    StableUnCLIPImg2ImgPipeline,
    UNet2DConditionModel,
)
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer
from diffusers.schedulers.scheduling_utils import KarrasDiffusionSchedulers
from diffusers.utils import USE_PEFT_BACKEND, replace_example_docstring, scale_lora_layers, unscale_lora_layers
from diffusers.utils.torch_utils import randn_tensor
from torch import Tensor
from transformers import CLIPImageProcessor, CLIPTextModel, CLIPTokenizer

from unitouch_gen.conditioning import QUALITY_PROMPT, EmbeddingBank, apply_strength, noise_embeddings
from unitouch_gen.errors import (
    InvalidInputError,
    check_arguments,
    check_device,
    check_dtype,
    check_integer,
    check_kind,
    check_number,
    check_tensor,
    check_texts,
    describe,
)
from unitouch_gen.files import LOADING
from unitouch_gen.models.images import ImageInput
from unitouch_gen.models.joint import UniTouchModel
from unitouch_gen.models.out_of_distribution import warn_of_unknown
from unitouch_gen.models.processing import UniTouchProcessor, tokenize
from unitouch_gen.pipelines.common import (
    MAX_GAIN,
    MOST_IMAGES,
    UNCONDITIONAL,
    Generators,
    Plan,
    SamplingSettings,
    SensorNames,
    StepEndCallback,
    Touches,
    UniTouchPipeline,
    guided,
)
from unitouch_gen.pipelines.output import UniTouchPipelineOutput
from unitouch_gen.pipelines.published import Wanted, unclip_pipeline
from unitouch_gen.sampling import RunReport

DEFAULTS = ("default_strength", "default_guidance_scale", "default_num_inference_steps", "default_noise_level")

EXAMPLE_DOC_STRING = """
    Examples:
        ```py
        >>> import unitouch_gen

        >>> pipe = unitouch_gen.tiny("touch-to-image")
        >>> output = pipe(unitouch_gen.example("brick"))
        >>> output.images[0].save("brick.png")
        >>> print(output.report)
        ```
"""


class TouchToImagePipeline(UniTouchPipeline):
    """Touch to image: an unCLIP model that gets a touch embedding in place of an image embedding.

    Args:
        image_normalizer: Mean and standard deviation of the embeddings that the UNet was trained on.
        image_noising_scheduler: Schedule of the noise on the embedding.
        unet: Conditioned on hidden states of the prompt and, as class labels, on the noised embedding.
        scheduler: The pipeline's own solver, used when `solver` is `None`.
        vae: Decodes latents.
        unitouch: The joint space; only its touch encoder is used here. May be `None` if embeddings are passed.
        processor: Prepares touch images for it.
        tokenizer, text_encoder: For the prompt. May be `None` if `prompt_embeds` are passed.
        embedding_bank: Image embeddings that those of touches are moved towards; `None` to leave these as they are.
        default_strength, default_guidance_scale, default_num_inference_steps, default_noise_level: What a call uses
            where it says nothing. The paper's values; a checkpoint may store its own.
    """

    model_cpu_offload_seq = "unitouch->text_encoder->unet->vae"
    _optional_components = ["unitouch", "processor", "tokenizer", "text_encoder", "embedding_bank"]
    # Sequential offloading leaves `unitouch` on its device: it would take the prototypes away from the sensor bank.
    _exclude_from_cpu_offload = ["image_normalizer", "unitouch", "embedding_bank"]
    _embeds_name: str | None = "touch_embeds"
    _callback_tensor_inputs = ["latents", "prompt_embeds"]
    _example_call = 'pipe(example("brick"))'

    def __init__(
        self,
        image_normalizer: StableUnCLIPImageNormalizer,
        image_noising_scheduler: KarrasDiffusionSchedulers,
        unet: UNet2DConditionModel,
        scheduler: KarrasDiffusionSchedulers,
        vae: AutoencoderKL | AutoencoderTiny | AutoencoderDC,
        unitouch: UniTouchModel | None = None,
        processor: UniTouchProcessor | None = None,
        tokenizer: CLIPTokenizer | None = None,
        text_encoder: CLIPTextModel | None = None,
        embedding_bank: EmbeddingBank | None = None,
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
            embedding_bank=embedding_bank,
            unet=unet,
            scheduler=scheduler,
            vae=vae,
        )
        self._keep_defaults(
            default_strength=default_strength,
            default_guidance_scale=default_guidance_scale,
            default_num_inference_steps=default_num_inference_steps,
            default_noise_level=default_noise_level,
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
        self._check_embeddings(f"the unCLIP model is of width {width}")

    @property
    def embedding_dim(self) -> int:
        """D of the embeddings that condition the UNet."""
        return self.image_normalizer.config.embedding_dim

    @classmethod
    def from_pipe(cls, pipeline: DiffusionPipeline, **kwargs: Any) -> Self:
        """Builds on any diffusers unCLIP pipeline, sharing its components as they are.

        Args:
            pipeline: `StableUnCLIPImg2ImgPipeline` or another one with its components.
            kwargs: `unitouch=` the joint space; `processor=`, made for `unitouch` when left out; and whatever else
                should differ. `dtype=` or `torch_dtype=` moves all networks to one dtype.

        Raises:
            InvalidInputError: On an argument that this pipeline does not take, or components that do not fit.
        """
        dtype = kwargs.pop("dtype", kwargs.pop("torch_dtype", None))
        dtype = None if dtype is None else check_dtype("dtype", dtype)
        required, optional = cls._get_signature_keys(cls)
        accepted = {*required, *optional}
        check_arguments("from_pipe", kwargs, accepted)
        if isinstance(check_kind("pipeline", pipeline, DiffusionPipeline), UniTouchPipeline):
            for name in pipeline._readers:
                pipeline._component(name)
        inherited = {key: value for key, value in pipeline.components.items() if key in accepted}
        defaults = {key: pipeline.config[key] for key in DEFAULTS if key in pipeline.config}
        parts = {"embedding_bank": None, **inherited, **defaults, **kwargs}
        if parts.get("unitouch") is not None and parts.get("processor") is None:
            parts["processor"] = UniTouchProcessor.for_config(parts["unitouch"].config)
        missing = sorted(set(required) - set(parts))
        if missing:
            raise InvalidInputError(f"`pipeline` has no {missing}; pass an unCLIP pipeline, or these by name.")
        made = cls(**parts)
        return made if dtype is None else made.to(dtype)

    def to_diffusers(self) -> StableUnCLIPImg2ImgPipeline:
        """diffusers' own unCLIP pipeline of the same parts, for images; its `image_embeds` may be touches' as well.

        `from_pipe(..., unitouch=..., embedding_bank=...)` is the way back: diffusers' has no place for these. The joint
        space's image encoder becomes the pipeline's.

        Raises:
            InvalidInputError: If a part is missing that it needs, or the autoencoder is none that it takes.
        """
        parts = {name: self._component(name) for name in ("unitouch", "tokenizer", "text_encoder", "vae")}
        for name, part in parts.items():
            if part is None:
                raise InvalidInputError(f"`to_diffusers` needs `{name}`, and this pipeline has none.")
        if "block_out_channels" not in parts["vae"].config:
            raise InvalidInputError(
                f"`vae` is {type(parts['vae']).__name__}, which diffusers' unCLIP pipeline does not take; it takes "
                "AutoencoderKL and AutoencoderTiny."
            )
        (image_encoder,) = parts.pop("unitouch").load("image")
        size = image_encoder.config.image_size
        return StableUnCLIPImg2ImgPipeline(
            feature_extractor=CLIPImageProcessor(size={"shortest_edge": size}, crop_size=size),
            image_encoder=image_encoder,
            image_normalizer=self.image_normalizer,
            image_noising_scheduler=self.image_noising_scheduler,
            unet=self.unet,
            scheduler=self.scheduler,
            **parts,
        )

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
        with LOADING:
            return unclip_pipeline(cls, unclip, unitouch, embedding_norm, images, wanted)

    # Conditions -------------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def encode_touch(
        self,
        touch: ImageInput,
        sensor: SensorNames = None,
        strength: float | None = None,
        background: ImageInput = None,
        bridge: bool | None = None,
    ) -> Tensor:
        """Touch embeddings as the network will see them before noise: norm-matched, with strength, bridged, (B, D).

        Args:
            touch: Touch images; see `unitouch_gen.models.images.load_images`.
            sensor: Its name, one name for each image, or `None` to retrieve it by prototype.
            strength: Gain on the embedding, >= 0; the pipeline's default when `None`.
            background: What the sensor sees untouched or on average; the touches are then re-centred on the prototype
                of the sensor retrieved for it.
            bridge: Whether they are moved towards embeddings of pictures; see `__call__`.

        Raises:
            InvalidInputError: On unreadable images, unknown sensors or a negative strength.
            NonFiniteError: If an embedding leaves the range of the encoder's dtype.
        """
        strength = check_number("strength", self._default("strength", strength), 0.0, MAX_GAIN)
        bridge, unknown = self._check_bridge(bridge), dict[str, list[str | None]]()
        embeds = self._touch_embeds(self._prepare_touch(touch, sensor, background), strength, unknown)
        warn_of_unknown(unknown)
        return self._towards_pictures(embeds, bridge)

    def _touch_embeds(
        self, touches: Touches, strength: float, unknown: dict[str, list[str | None]], throw: bool = True
    ) -> Tensor:
        """(B, D) float32, norm-matched and with strength."""
        return apply_strength(self._matched(self._touch_features(touches, unknown), "touch", throw), strength)

    def encode_prompt(
        self, prompt: list[str], device: torch.device | None = None, lora_scale: float | None = None
    ) -> Tensor:
        """Hidden states of prompts, (B, T, C), T the tokenizer's full length; longer prompts are cut.

        Args:
            prompt: The prompts.
            device: Where the text encoder runs; the pipeline's own when left out.
            lora_scale: What LoRA weights of the text encoder are multiplied by, from -1e6 to 1e6; 1 when left out.

        Raises:
            InvalidInputError, InvalidTypeError: If they are no strings, the scale is no such number, or this pipeline
                has no text encoder.
        """
        text_encoder = self._component("text_encoder")
        if text_encoder is None or self.tokenizer is None:
            raise InvalidInputError("`prompt` came, but this pipeline has no text encoder; pass `prompt_embeds`.")
        ids = tokenize(self.tokenizer, check_texts("prompt", prompt))
        use_mask = getattr(text_encoder.config, "use_attention_mask", False)
        device = self._execution_device if device is None else check_device("device", device)
        mask = ids.attention_mask.to(device) if use_mask else None
        scale = 1.0 if lora_scale is None else check_number("lora_scale", lora_scale, -MAX_GAIN, MAX_GAIN)
        scaled = scale != 1.0 and USE_PEFT_BACKEND  # without peft there are no LoRA weights
        if scaled:
            scale_lora_layers(text_encoder, scale)
        try:
            return text_encoder(ids.input_ids.to(device), attention_mask=mask)[0]
        finally:
            if scaled:
                unscale_lora_layers(text_encoder, scale)

    def _prompt_states(self, prompt: list[str] | Tensor, batch_size: int, settings: SamplingSettings) -> Tensor:
        """Hidden states of one branch, (B n, T, C), each distinct prompt encoded once."""
        if not isinstance(prompt, Tensor):
            unique = list(dict.fromkeys(prompt))
            scale = (settings.cross_attention_kwargs or {}).get("scale")
            states = self.encode_prompt(unique, settings.device, scale)
            prompt = states[[unique.index(item) for item in prompt]]
        prompt = prompt.to(settings.device)  # given ones may lie elsewhere
        return prompt.expand(batch_size, -1, -1).repeat_interleave(settings.repeats, dim=0)

    def _class_labels(self, embeds: Tensor, noise_level: int, settings: SamplingSettings) -> Tensor:
        """(B n, 2 D); one generator noises each embedding once, as diffusers does, a list every image's own."""
        generator, repeats = settings.generator, settings.repeats
        if isinstance(generator, list):
            embeds, repeats = embeds.repeat_interleave(repeats, dim=0), 1
        noise = randn_tensor(embeds.shape, generator=generator, device=embeds.device, dtype=embeds.dtype)
        level = torch.full((len(embeds),), noise_level, device=embeds.device)
        labels = noise_embeddings(embeds, level, noise, self.image_normalizer, self.image_noising_scheduler)
        return labels.repeat_interleave(repeats, dim=0)

    # One call ---------------------------------------------------------------------------------------------------------

    @torch.no_grad()
    @replace_example_docstring(EXAMPLE_DOC_STRING)
    def __call__(
        self,
        touch: ImageInput = None,
        prompt: str | list[str] | None = None,
        height: int | None = None,
        width: int | None = None,
        num_inference_steps: int | None = None,
        timesteps: Sequence[int] | None = None,
        sigmas: Sequence[float] | None = None,
        guidance_scale: float | None = None,
        guidance_interval: Sequence[float] | None = None,
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
            prompt: What else the picture should be; "high quality" when left out. One, or one for each touch.
            height, width: Of the pictures, pixels; multiples of the VAE's scale factor.
            num_inference_steps: Solver steps.
            timesteps, sigmas: The steps themselves, in place of their number, for solvers that take them: falling
                timesteps from 0 to 999, or falling noise levels that end in 0.
            guidance_scale: s of classifier-free guidance, >= 0; on above 1.
            guidance_interval: Where guidance is on, (low, high) shares of the training timesteps, from 0 (the least
                noise) to 1 (noise alone); everywhere when left out. Outside, the unconditional branch is left out,
                which saves half of an evaluation and is no longer the same picture.
            strength: Gain on the touch embedding, >= 0 (paper: 0.75).
            negative_prompt: What guidance leads away from; empty when left out.
            num_images_per_prompt: Pictures for each touch.
            noise_level: Of the noise on the embedding, from 0 to 999; more noise, more variety.
            sensor: Which sensor took the touch: a name, one for each touch, or `None` to retrieve it.
            background: What the sensor sees untouched, to re-centre touches of a sensor the model does not know.
            bridge: Whether embeddings of touches are moved towards the nearest of those of pictures that the checkpoint
                has, as it was trained on such; where it has any, if left out.
            solver: A name in `unitouch_gen.schedulers.SOLVERS`; `None` uses the pipeline's own scheduler.
            tolerance: Relative RMS error of the latents, from 1e-5 to 1: chooses the steps as it goes, in place of
                `num_inference_steps` and `solver`.
            max_evaluations: Of the network, at most, to a tolerance; 1,000 when left out.
            eta: Of DDIM, from 0 to 1; other solvers ignore it.
            generator: One, or one for each picture.
            latents: Unit-variance noise (B, C, h, w); the scheduler's `init_noise_sigma` is applied to it here.
            touch_embeds: Embeddings (B, D) in place of `touch`, used as they are. What is about touches (`strength`,
                `sensor`, `background`, `bridge`) goes to `encode_touch`, which makes embeddings.
            prompt_embeds, negative_prompt_embeds: Hidden states (B or 1, T, C) in place of the prompts.
            output_type: "pil", "np", "pt" or "latent".
            return_dict: Whether to return an output object rather than the tuple (images, report).
            cross_attention_kwargs: By name, what the UNet passes to its attention processors in every evaluation, as in
                diffusers; "scale", from -1e6 to 1e6, multiplies LoRA weights, those of the text encoder, too. Meanwhile
                no other call should run on the same networks.
            callback_on_step_end: Called as `callback(pipe, step, timestep, tensors)` after every evaluation, or to a
                `tolerance` every accepted step; may return new tensors, and set `pipe._guidance_scale` for the
                evaluations that follow. Or, without a `tolerance`, one of `diffusers.callbacks`.
            callback_on_step_end_tensor_inputs: Which tensors it gets: "latents" (B n, C, h, w) in float32,
                "prompt_embeds" with the hidden states of both branches, the unconditional one first.
            throw: Raise where a sample breaks. Otherwise the others are returned, and its code is in the report, as
                are, in either case, those of samples that are there, but diverged or interrupted.

        Examples:

        Returns:
            [`UniTouchPipelineOutput`] or `tuple`.

        Raises:
            InvalidInputError, InvalidTypeError: On input that cannot be used, before any network runs.
            NonFiniteError: If an embedding or a sample leaves the range of floating-point numbers and `throw` is set.
            NotConvergedError: If a tolerance is not reached or latents grow to a hundred times a picture's, and `throw`
                is set.

        Warns:
            UnfamiliarInputWarning: Of inputs that are unlike any the model knows, and of touches of nothing.
        """
        # 1. Check everything, before any network runs
        request = dict(locals())  # the arguments as they came, by name
        plan = self._begin(request)
        self._check_source(request)
        strength = check_number("strength", self._default("strength", strength), 0.0, MAX_GAIN)
        noise_level = self._check_noise_level(noise_level)
        touches = None
        if touch is not None:
            bridge = self._check_bridge(bridge)
            touches = self._prepare_touch(touch, sensor, background)
            batch_size = len(touches.pixels)
        else:
            batch_size = len(check_tensor("touch_embeds", touch_embeds, "B", self.embedding_dim))
        repeats = check_integer("num_images_per_prompt", num_images_per_prompt, 1, MOST_IMAGES)
        settings = self._check_sampling(request, batch_size, repeats)
        prompts = self._check_prompts(request, batch_size, settings)
        report = self._report(settings, plan, touches.matches if touches else ())

        # 2. Encode the touch
        encoded = None
        if touches is not None:
            with report.stage("touch"):
                encoded = self._touch_embeds(touches, strength, report.unknown, throw)
                touch_embeds = self._towards_pictures(encoded, bool(bridge))
            self._free("touch")
            warn_of_unknown(report.unknown)
        assert touch_embeds is not None

        # 3. Generate from its embedding
        return self._generate(settings, touch_embeds, noise_level, prompts, report, return_dict, encoded)

    def _generate(
        self,
        settings: SamplingSettings,
        embeds: Tensor,
        noise_level: int,
        prompts: dict[str, list[str] | Tensor],
        report: RunReport,
        return_dict: bool,
        encoded: Tensor | None = None,
        **init: Any,
    ) -> UniTouchPipelineOutput | tuple:
        """From embeddings (B, D), as the network will see them before noise, to pictures.

        Args:
            prompts: Of each branch that runs, the unconditional one first: prompts, or hidden states (B or 1, T, C).
            encoded: Embeddings before the bridge, for the output.
            init: Latents to start from, and how much of them to replace.
        """
        # 1. Encode the prompts
        with report.stage("prompt"):
            hidden = torch.cat([self._prompt_states(prompt, len(embeds), settings) for prompt in prompts.values()])
        self._free("text_encoder")

        # 2. Noise the embedding, and then draw latents: the order in which diffusers draws
        embeds = embeds.to(settings.device, torch.float32)  # or their noise would be another one in each dtype
        labels = self._class_labels(embeds, noise_level, settings)
        if settings.guidance.active:
            labels = torch.cat([torch.zeros_like(labels), labels])

        # 3. Denoise
        with report.stage("denoising"):
            latents = self._denoise(settings, hidden, labels, report, **init)

        # 4. Decode the samples that ended well
        with report.stage("decoding"):
            images = self._images(settings, latents, report)

        self.maybe_free_model_hooks()
        output = UniTouchPipelineOutput(images=images, report=report, embeds=embeds, encoded=encoded)
        return output if return_dict else (images, report)

    # Checks -----------------------------------------------------------------------------------------------------------

    @classmethod
    def _plan(cls, request: Mapping[str, Any]) -> Plan:
        _check_one_came(request)
        return Plan(
            {
                "touch encoder": request["touch"] is not None,
                "bank of image embeddings": request["touch"] is not None and request["bridge"] is not False,
                **cls._prompt_parts(request),
                "VAE": request["output_type"] != "latent",
            }
        )

    @staticmethod
    def _prompt_parts(request: Mapping[str, Any]) -> dict[str, bool]:
        """The parts of a plan that any unCLIP model has."""
        both = guided(request["guidance_scale"])
        embeds = [request["prompt_embeds"], *([request["negative_prompt_embeds"]] if both else [])]
        # An unCLIP model always adds noise: at level 0, too, diffusers' schedules add a little.
        return {
            "prompt encoder": any(given is None for given in embeds),
            "noise augmentation": True,
            UNCONDITIONAL: both,
        }

    @staticmethod
    def _check_source(request: Mapping[str, Any]) -> None:
        """Refuses beside embeddings what would be about touches."""
        for name in ("strength", "sensor", "background", "bridge"):
            if request["touch"] is None and request[name] is not None and request[name] is not False:
                raise InvalidInputError(
                    f"`{name}` is {describe(request[name])}, but `touch_embeds` came, on which it has no effect; leave "
                    "it out, or pass it to `encode_touch`, which makes the embeddings."
                )

    def _check_noise_level(self, noise_level: int | None) -> int:
        """The noise level of the embedding, the checkpoint's default where none came."""
        top = self.image_noising_scheduler.config.num_train_timesteps - 1
        return check_integer("noise_level", self._default("noise_level", noise_level), 0, top)

    def _check_prompts(
        self, request: Mapping[str, Any], batch_size: int, settings: SamplingSettings
    ) -> dict[str, list[str] | Tensor]:
        """The prompts of each branch that runs, or their hidden states, the unconditional one first."""
        prompt = self._check_prompt("prompt", request, batch_size, QUALITY_PROMPT)
        negative = self._check_prompt("negative_prompt", request, batch_size, "", used=settings.guidance.active)
        if not settings.guidance.active:
            return {"prompt": prompt}
        length, negative_length = (
            given.shape[1] if isinstance(given, Tensor) else self.tokenizer.model_max_length
            for given in (prompt, negative)
        )
        if length != negative_length:  # both branches go into one batch
            raise InvalidInputError(
                f"`prompt_embeds` hold {length} tokens and `negative_prompt_embeds` {negative_length}; pass both, of "
                "one length."
            )
        return {"negative_prompt": negative, "prompt": prompt}

    def _check_prompt(
        self, name: str, request: Mapping[str, Any], batch_size: int, default: str, used: bool = True
    ) -> list[str] | Tensor:
        """Prompts as a list of `batch_size`, or the hidden states (1 or `batch_size`, T, C) that came instead."""
        prompt, embeds = request[name], request[f"{name}_embeds"]
        if embeds is not None:
            if prompt is not None:
                raise InvalidInputError(f"Pass either `{name}` or `{name}_embeds`, not both.")
            check_tensor(f"{name}_embeds", embeds, "B", "T", self.unet.config.cross_attention_dim)
            if len(embeds) not in (1, batch_size):
                raise InvalidInputError(
                    f"`{name}_embeds` holds {len(embeds)} prompts for {batch_size} inputs; pass 1 or {batch_size}."
                )
            return embeds
        prompts = check_texts(name, default if prompt is None else prompt)
        if len(prompts) == 1:
            prompts *= batch_size
        if len(prompts) != batch_size:
            raise InvalidInputError(
                f"`{name}` is a list of {len(prompts)} for {batch_size} inputs; pass one, or one each."
            )
        if used and (self._component("text_encoder") is None or self.tokenizer is None):
            raise InvalidInputError(f"`{name}` is needed, but this pipeline has no text encoder; pass `{name}_embeds`.")
        return prompts


def _check_one_came(request: Mapping[str, Any]) -> None:
    """Refuses touches beside their embeddings, and neither of them."""
    if (request["touch"] is None) == (request["touch_embeds"] is None):
        what = "both came" if request["touch"] is not None else "neither came"
        raise InvalidInputError(f"`touch` or `touch_embeds` has to be passed, one of them; {what}.")
