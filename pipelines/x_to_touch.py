"""`XToTouchPipeline`: touch images from images, text, audio or another sensor (Section 4.6 of the paper)."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from diffusers import AutoencoderKL, AutoencoderTiny, UNet2DConditionModel, VQModel
from diffusers.schedulers.scheduling_utils import KarrasDiffusionSchedulers
from torch import Tensor

from unitouch_gen.arguments import SamplingArguments
from unitouch_gen.conditioning import EmbeddingBank, SensorBackgrounds, match_norm
from unitouch_gen.errors import (
    InvalidInputError,
    check_choice,
    check_count,
    check_equal,
    check_kind,
    check_not_empty,
    check_passed,
    check_tensor,
    check_unused,
    one_each,
)
from unitouch_gen.models.images import ImageInput, load_images
from unitouch_gen.models.joint import MODALITIES, UniTouchModel
from unitouch_gen.models.processing import UniTouchProcessor
from unitouch_gen.models.sounds import AudioInput
from unitouch_gen.pipelines.base import (
    Generators,
    SensorNames,
    StepEndCallback,
    UniTouchPipeline,
    check_weights,
)
from unitouch_gen.pipelines.output import UniTouchPipelineOutput
from unitouch_gen.sampling import Denoiser, Guidance, RunReport, prepare_steps

ALL = "all"  # in place of a sensor's name: every known sensor
Conditions = dict[str, tuple[float, Any]]  # by modality: weight > 0, and `Touches` or arguments of its encoder


class XToTouchPipeline(UniTouchPipeline):
    """Anything to touch: latent diffusion of touch images, conditioned on one embedding of the joint space.

    Trained on image embeddings only: text, sound and touch are zero-shot.

    Args:
        unet: Attends to one token, the embedding; its class label, if it has any, is the sensor to draw. With twice the
            input channels of a latent, the second half is the sensor's background latent (concatenated as in
            InstructPix2Pix, Brooks et al., 2023), and the last class label is for unnamed sensors.
        scheduler: The pipeline's own solver, used when `solver` is `None`.
        vae: Decodes latents to touch images.
        unitouch: The joint space; only encoders of the given modalities are read. May be `None` if embeddings are
            passed.
        processor: Preprocesses inputs for `unitouch`.
        embedding_bank: Image embeddings of the bridge; `None` for no bridge.
        sensors: Names of the UNet's class labels; empty for a UNet without.
        backgrounds: Background latents of `sensors`; `None` for a UNet without backgrounds or named sensors.
        default_guidance_scale, default_num_inference_steps, default_timesteps: Defaults of a call; here the paper's
            values.
    """

    model_cpu_offload_seq = "unitouch->unet->vae"
    _optional_components = ["unitouch", "processor", "embedding_bank", "backgrounds"]
    _exclude_from_cpu_offload = ["unitouch", "embedding_bank", "backgrounds"]
    _callback_tensor_inputs = ["latents", "condition_embeds"]
    _example_call = 'pipe(image=example("brick", "image"))'

    def __init__(
        self,
        unet: UNet2DConditionModel,
        scheduler: KarrasDiffusionSchedulers,
        vae: AutoencoderKL | AutoencoderTiny | VQModel,
        unitouch: UniTouchModel | None = None,
        processor: UniTouchProcessor | None = None,
        embedding_bank: EmbeddingBank | None = None,
        backgrounds: SensorBackgrounds | None = None,
        sensors: list[str] | tuple[str, ...] = (),  # diffusers warns of other annotations
        default_guidance_scale: float = 7.5,
        default_num_inference_steps: int = 200,
        default_timesteps: list[int] | None = None,
    ):
        super().__init__()
        self.register_modules(
            unitouch=unitouch,
            processor=processor,
            embedding_bank=embedding_bank,
            backgrounds=backgrounds,
            unet=unet,
            scheduler=scheduler,
            vae=vae,
        )
        self.register_to_config(sensors=list(sensors))
        self._finish_init(
            "`unet`",
            default_guidance_scale=default_guidance_scale,
            default_num_inference_steps=default_num_inference_steps,
            default_timesteps=default_timesteps,
        )
        kind = unet.config.class_embed_type
        if kind is not None:
            raise InvalidInputError(f"`unet` has `class_embed_type` {kind!r}; sensors need one without that setting.")
        has_unnamed = self.takes_background and bool(sensors)  # the last label is then for unnamed sensors
        labels = (unet.config.num_class_embeds or 0) - has_unnamed
        if len(sensors) != labels:
            raise InvalidInputError(
                f"`sensors` holds {len(sensors)} names, but `unet` has labels for {labels}; pass one name for each."
            )
        if has_unnamed:
            stored = 0 if backgrounds is None else backgrounds.config["count"]
            check_equal("backgrounds", "length", stored, len(sensors), "one for each of `sensors`")

    @property
    def embedding_dim(self) -> int:
        """D, width of the embedding that the UNet attends to."""
        return self.unet.config.cross_attention_dim

    @property
    def takes_background(self) -> bool:
        """Whether the UNet takes background latents as input channels; it then draws unnamed sensors, too."""
        return self.unet.config.in_channels != self.unet.config.out_channels

    # One call ---------------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def __call__(
        self,
        image: ImageInput = None,
        text: str | list[str] | None = None,
        audio: AudioInput = None,
        touch: ImageInput = None,
        sensor: SensorNames = None,
        background: ImageInput = None,
        weights: Mapping[str, float] | None = None,
        bridge: bool | None = None,
        height: int | None = None,
        width: int | None = None,
        num_inference_steps: int | None = None,
        timesteps: Sequence[int] | None = None,
        guidance_scale: float | None = None,
        num_images_per_prompt: int = 1,
        source_sensor: SensorNames = None,
        solver: str | None = None,
        tolerance: float | None = None,
        max_evaluations: int | None = None,
        eta: float = 0.0,
        generator: Generators = None,
        latents: Tensor | None = None,
        condition_embeds: Tensor | None = None,
        output_type: str = "pil",
        return_dict: bool = True,
        cross_attention_kwargs: dict[str, Any] | None = None,
        callback_on_step_end: StepEndCallback | None = None,
        callback_on_step_end_tensor_inputs: Sequence[str] = ("latents",),
        throw: bool = True,
    ) -> UniTouchPipelineOutput | tuple:
        """Generates touch images.

        The other arguments, the output, errors and warnings are those of `TouchToImagePipeline.__call__`.

        Args:
            image: Photos: paths, PIL images, arrays (H, W, 3), tensors (3, H, W), or a list.
            text: One description or a list; longer ones than the tokenizer's length are cut.
            audio: Sounds: paths (wav, flac, ogg, mp3), pairs (array, rate), or a list. Silence is refused.
            touch: Touch images, which makes it translation from one sensor to another.
            sensor: Sensor to draw: a name in `config.sensors`, one for each input, several for a single input, or "all"
                for every sensor of each input in turn; default: the first.
            background: Image of an unnamed sensor untouched, in place of `sensor`, if `takes_background`: one, one for
                each input, or several for a single input; cropped to the size of the touch images.
            weights: Weights by modality, such as `{"image": 0.7, "text": 0.3}`; default equal. Only ratios count.
            bridge: Move embeddings other than images' to the nearest stored image embeddings (the UNet saw only image
                embeddings). Default: if a bank is present.
            num_inference_steps, guidance_scale: See there (paper: 200 and 7.5).
            num_images_per_prompt: Touch images for each input.
            source_sensor: Sensor that took `touch`: a name, one for each, or `None` to retrieve it.
            generator: One, or one for each touch image.
            latents: Unit-variance noise (B n, C, h, w), n touch images of each input.
            condition_embeds: (B, 1, D) in place of the modalities, used unchanged; see `encode_condition`.
            callback_on_step_end_tensor_inputs: Tensors passed to it: "latents" (B n, C, h, w) in float32,
                "condition_embeds" of both branches, the unconditional one (zeros) first.

        Examples:
            >>> import unitouch_gen

            >>> pipe = unitouch_gen.tiny("x-to-touch")
            >>> pipe(text="rough brick", sensor="digit").images[0].save("brick.png")
            >>> pipe(image="wall.jpg").images[0].save("wall.png")
        """
        # 1. Check inputs, before any network runs
        arguments = self._check_arguments(
            height=height,
            width=width,
            num_inference_steps=num_inference_steps,
            timesteps=timesteps,
            guidance_scale=self.config.default_guidance_scale if guidance_scale is None else guidance_scale,
            num_images_per_prompt=num_images_per_prompt,
            bridge=bridge,
            solver=solver,
            tolerance=tolerance,
            max_evaluations=max_evaluations,
            eta=eta,
            output_type=output_type,
            throw=throw,
        )
        modalities = {"image": image, "text": text, "audio": audio, "touch": touch}
        conditions: Conditions = {}
        if condition_embeds is None:
            conditions, num_inputs = self._read_conditions(modalities, weights, source_sensor)
        else:
            check_tensor("condition_embeds", condition_embeds, "B", 1, self.embedding_dim)
            others = {**modalities, "weights": weights, "source_sensor": source_sensor, "bridge": bridge or None}
            check_unused("with `condition_embeds`", **others)
            num_inputs = len(condition_embeds)
        backgrounds, sensors = self._read_sensors(sensor, background, num_inputs)
        batch_size = len(sensors)
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
        steps, schedule = prepare_steps(self.scheduler, arguments, self._execution_device)
        report = RunReport(left_out=[f"{name} encoder" for name in MODALITIES if name not in conditions])

        images_each = arguments.num_images_per_prompt
        with self._threads(shape, guidance):
            # 2. Encode the condition and the background
            embeds: Any = condition_embeds
            if conditions:
                with report.stage("condition"):
                    embeds = self._encode(conditions, arguments, report)
            embeds = embeds.to(self._execution_device).repeat_interleave(batch_size // num_inputs, dim=0)
            hidden_states = embeds.to(self.unet.dtype).repeat_interleave(images_each, dim=0)
            labels = torch.tensor(sensors, device=self._execution_device).repeat_interleave(images_each)
            concat = self._background_latents(backgrounds, labels, shape) if self.takes_background else None
            if guidance.active:  # the unconditional token is zeros
                hidden_states = torch.cat([torch.zeros_like(hidden_states), hidden_states])
                labels = torch.cat([labels, labels])
            unet_conditions = {
                "encoder_hidden_states": hidden_states,
                "class_labels": labels if self.config.sensors else None,
                "cross_attention_kwargs": cross_attention_kwargs,
            }

            # 3. Denoise
            noise = self.prepare_latents(shape, steps, generator, latents)
            latents = self._denoise(
                Denoiser(self.unet, schedule, unet_conditions, guidance, concat=concat),
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

    # Encoding ---------------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def encode_condition(
        self,
        image: ImageInput = None,
        text: str | list[str] | None = None,
        audio: AudioInput = None,
        touch: ImageInput = None,
        *,
        weights: Mapping[str, float] | None = None,
        bridge: bool | None = None,
        source_sensor: SensorNames = None,
    ) -> Tensor:
        """The condition as the network will see it, one token (B, 1, D); see `__call__` for arguments and errors."""
        arguments = self._check_arguments(bridge=bridge)
        modalities = {"image": image, "text": text, "audio": audio, "touch": touch}
        conditions, num_inputs = self._read_conditions(modalities, weights, source_sensor)
        with self._threads(self._latents_shape(num_inputs, arguments), Guidance(1.0)):
            return self._encode(conditions, arguments, RunReport())

    def _encode(self, conditions: Conditions, arguments: SamplingArguments, report: RunReport) -> Tensor:
        """The mix of conditions, (B, 1, D), at the norm of the joint space's images."""
        model = self.unitouch
        mixed: Any = 0.0
        for modality, (weight, inputs) in conditions.items():
            if modality == "touch":
                embeds = self._touch_embeds(inputs, report, arguments.throw)
            else:
                features = model.get_features(modality, **inputs)
                embeds = self._match_norm(features, modality, arguments.throw)
            if arguments.bridge and modality != "image":
                embeds = self.embedding_bank.bridge(embeds)
            mixed = mixed + weight * embeds
        return match_norm(mixed, model.config.embedding_norm)[:, None]

    def _background_latents(self, backgrounds: list[Tensor], labels: Tensor, shape: Sequence[int]) -> Tensor:
        """Latents (B n, C, h, w) of pictures of untouched sensors, or those stored with the checkpoint."""
        if backgrounds:
            encoded = self._encode_pictures(backgrounds, shape)
            return encoded.repeat_interleave(shape[0] // len(backgrounds), dim=0)
        stored = self.backgrounds.latents.float().to(labels.device)[labels]
        return F.interpolate(stored, shape[-2:], mode="bilinear")

    # Checks -----------------------------------------------------------------------------------------------------------

    def _read_conditions(
        self, modalities: Mapping[str, Any], weights: Mapping[str, float] | None, source_sensor: SensorNames
    ) -> tuple[Conditions, int]:
        """The modalities that were passed, read, with their weights; and the number of inputs."""
        modalities = check_passed(modalities)
        self._require(next(iter(modalities)), "unitouch", "processor")
        if "touch" not in modalities:
            check_unused("without `touch`", source_sensor=source_sensor)
        inputs: dict[str, Any] = {}
        sizes: dict[str, int] = {}
        for name in MODALITIES:
            if name not in modalities:
                continue
            if name == "touch":
                inputs[name] = self._read_touches(modalities[name], source_sensor)
                sizes[name] = len(inputs[name].pixels)
            else:
                inputs[name] = self.processor.inputs(name, modalities[name])
                sizes[name] = len(next(iter(inputs[name].values())))
        num_inputs = max(sizes.values())
        for name, size in sizes.items():
            check_count(name, size, num_inputs)
        weights = dict.fromkeys(modalities, 1.0) if weights is None else weights
        if set(check_kind("weights", weights, Mapping)) != set(modalities):
            named = ", ".join(map(str, weights))
            passed = ", ".join(modalities)
            raise InvalidInputError(f"`weights` has keys {named or 'none'}, not {passed}; pass one weight for each.")
        shares = check_weights("weights", [weights[name] for name in inputs])
        conditions = {name: (share, inputs[name]) for name, share in zip(inputs, shares, strict=True) if share > 0}
        return conditions, num_inputs

    def _read_sensors(
        self, sensor: SensorNames, background: ImageInput, num_inputs: int
    ) -> tuple[list[Tensor], list[int]]:
        """Pictures of untouched sensors that were passed, and the sensor label of each touch image, input by input.

        Labels are indices in `config.sensors`, default 0. Touches with a picture have the label after the last one.
        """
        names = list(self.config.sensors)
        pictures: list[Tensor] = []
        if background is not None:
            if not self.takes_background:
                raise InvalidInputError("`background` cannot be used: this model takes none; leave it out.")
            check_unused("with `background`", sensor=sensor)  # a named sensor has its own
            pictures = load_images("background", background)
            labels = [len(names)] * len(pictures)
        elif not names and self.takes_background:
            raise InvalidInputError("`background` is missing: this model knows no sensor by name; pass its picture.")
        elif isinstance(sensor, str) and sensor == ALL:
            return [], list(range(max(len(names), 1))) * num_inputs
        elif not names:
            check_unused("on a model of one sensor", sensor=sensor)
            labels = [0]
        else:
            chosen = sensor if isinstance(sensor, list | tuple) else [names[0] if sensor is None else sensor]
            hint = f"{ALL!r} draws each of them, in place of a name, not together with one."
            labels = [names.index(check_choice("sensor", name, names, hint=hint)) for name in chosen]
        name = "sensor" if background is None else "background"
        check_not_empty(name, labels)
        return pictures, labels if num_inputs == 1 else one_each(name, labels, num_inputs)
