"""`XToTouchPipeline`: touch images from images, text, audio or another sensor (Section 4.6 of the paper)."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from diffusers import AutoencoderKL, AutoencoderTiny, UNet2DConditionModel, VQModel
from diffusers.schedulers.scheduling_utils import KarrasDiffusionSchedulers
from torch import Tensor

from unitouch_gen.conditioning import EmbeddingBank, SensorBackgrounds, match_norm
from unitouch_gen.errors import (
    InvalidInputError,
    check_choice,
    check_kind,
    check_tensor,
    check_texts,
    check_unused,
    describe,
)
from unitouch_gen.models.images import ImageInput, load_images
from unitouch_gen.models.joint import MODALITIES, UniTouchModel
from unitouch_gen.models.processing import UniTouchProcessor
from unitouch_gen.models.sounds import AudioInput
from unitouch_gen.pipelines.base import (
    Generators,
    SensorNames,
    StepEndCallback,
    Touches,
    UniTouchPipeline,
    check_count,
    check_weights,
    runs_networks,
)
from unitouch_gen.pipelines.output import UniTouchPipelineOutput
from unitouch_gen.sampling import RunReport

ALL = "all"  # in place of a sensor's name: every known sensor
Conditions = dict[str, tuple[float, Any]]  # by modality: weight > 0, and inputs (1 or B)


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
    _hidden_states_name = "condition_embeds"

    def __init__(
        self, unet: UNet2DConditionModel, scheduler: KarrasDiffusionSchedulers,
        vae: AutoencoderKL | AutoencoderTiny | VQModel, unitouch: UniTouchModel | None = None,
        processor: UniTouchProcessor | None = None, embedding_bank: EmbeddingBank | None = None,
        backgrounds: SensorBackgrounds | None = None,
        sensors: list[str] | tuple[str, ...] = (),  # diffusers warns of other annotations
        default_guidance_scale: float = 7.5, default_num_inference_steps: int = 200,
        default_timesteps: list[int] | None = None,
    ):  # fmt: skip
        super().__init__()
        self.register_modules(
            unitouch=unitouch, processor=processor, embedding_bank=embedding_bank, backgrounds=backgrounds, unet=unet,
            scheduler=scheduler, vae=vae,
        )  # fmt: skip
        self.register_to_config(sensors=list(sensors))
        self._finish_init(
            "`unet`", default_guidance_scale=default_guidance_scale,
            default_num_inference_steps=default_num_inference_steps, default_timesteps=default_timesteps,
        )  # fmt: skip
        if unet.config.class_embed_type is not None:
            kind = unet.config.class_embed_type
            raise InvalidInputError(f"`unet` takes class labels of the kind {kind!r}, as unCLIP's.")
        others = int(self.takes_background and bool(sensors))  # the label of unnamed sensors
        labels = unet.config.num_class_embeds or 0
        if labels != len(sensors) + others:
            raise InvalidInputError(f"`sensors` names {len(sensors)}, but `unet` has {labels - others} to be named.")
        if others and (backgrounds is None or backgrounds.config["count"] != len(sensors)):
            raise InvalidInputError("`backgrounds` of each of `sensors` is missing, which `unet` takes.")

    @property
    def embedding_dim(self) -> int:
        """D, width of the embedding that the UNet attends to."""
        return self.unet.config.cross_attention_dim

    @property
    def takes_background(self) -> bool:
        """Whether the UNet takes background latents as input channels; it then draws unnamed sensors, too."""
        return self.unet.config.in_channels != self.unet.config.out_channels

    # Conditions -------------------------------------------------------------------------------------------------------

    @runs_networks
    def encode_condition(
        self, image: ImageInput = None, text: str | list[str] | None = None, audio: AudioInput = None,
        touch: ImageInput = None, *, weights: Mapping[str, float] | None = None, bridge: bool | None = None,
        source_sensor: SensorNames = None,
    ) -> Tensor:  # fmt: skip
        """The condition as the network will see it, one token (B, 1, D); see `__call__` for arguments and errors."""
        bridge = self._check_bridge(bridge)
        given = {"image": image, "text": text, "audio": audio, "touch": touch}
        conditions, _ = self._prepare(given, weights, source_sensor)
        return self._condition(conditions, bridge, RunReport())

    def _condition(self, conditions: Conditions, bridge: bool, report: RunReport, throw: bool = True) -> Tensor:
        """(B, 1, D) of the joint space's norm."""
        mixed: Any = 0.0
        for name, (weight, inputs) in conditions.items():
            if name == "touch":
                embeds = self._touch_embeds(inputs, report, throw)
            else:
                embeds = self._match_norm(getattr(self.unitouch, f"get_{name}_features")(**inputs), name, throw)
            mixed = mixed + weight * (self.embedding_bank.bridge(embeds) if bridge and name != "image" else embeds)
        return match_norm(mixed, self.unitouch.config.embedding_norm)[:, None]

    # One call ---------------------------------------------------------------------------------------------------------

    @runs_networks
    def __call__(
        self,
        image: ImageInput = None, text: str | list[str] | None = None, audio: AudioInput = None,
        touch: ImageInput = None, sensor: SensorNames = None, background: ImageInput = None,
        weights: Mapping[str, float] | None = None, bridge: bool | None = None,
        height: int | None = None, width: int | None = None, num_inference_steps: int | None = None,
        timesteps: Sequence[int] | None = None, guidance_scale: float | None = None,
        num_images_per_prompt: int = 1, source_sensor: SensorNames = None,
        solver: str | None = None, tolerance: float | None = None, max_evaluations: int | None = None, eta: float = 0.0,
        generator: Generators = None, latents: Tensor | None = None, condition_embeds: Tensor | None = None,
        output_type: str = "pil", return_dict: bool = True,
        cross_attention_kwargs: dict[str, Any] | None = None, callback_on_step_end: StepEndCallback | None = None,
        callback_on_step_end_tensor_inputs: Sequence[str] = ("latents",), throw: bool = True,
    ) -> UniTouchPipelineOutput | tuple:  # fmt: skip
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
        given = {"image": image, "text": text, "audio": audio, "touch": touch}
        conditions: Conditions = {}
        if condition_embeds is None:
            bridge = self._check_bridge(bridge)
            conditions, inputs = self._prepare(given, weights, source_sensor)
        else:
            embeds = check_tensor("condition_embeds", condition_embeds, "B", 1, self.embedding_dim)
            given |= {"weights": weights, "source_sensor": source_sensor}
            check_unused("condition_embeds", **given, bridge=bridge or None)
            inputs = len(embeds)
        gels, sensor_labels = self._check_sensor(sensor, background, inputs)
        batch_size = len(sensor_labels)
        settings = self._check_call(
            batch_size, num_images_per_prompt, height, width, num_inference_steps, guidance_scale, solver, tolerance,
            max_evaluations, eta, generator, latents, output_type, cross_attention_kwargs, callback_on_step_end,
            callback_on_step_end_tensor_inputs, throw, timesteps=timesteps,
        )  # fmt: skip

        # 2. Encode the condition
        report = RunReport()
        report.left_out += [f"{name} encoder" for name in MODALITIES if name not in conditions]
        if conditions:
            with report.stage("condition"):
                embeds = self._condition(conditions, bool(bridge), report, throw)
        embeds = embeds.to(settings.device).repeat_interleave(batch_size // inputs, dim=0)
        hidden_states = embeds.repeat_interleave(settings.repeats, dim=0)
        labels = torch.tensor(sensor_labels).repeat_interleave(settings.repeats) if self.config.sensors else None
        extra_channels = None
        if gels:
            latents_of_gels = self._encode_pictures("background", gels, settings)
            extra_channels = latents_of_gels.repeat_interleave(settings.shape[0] // len(gels), dim=0)
        elif self.takes_background:  # those stored with the checkpoint
            stored = self.backgrounds.latents.float()[labels].to(settings.device)
            extra_channels = F.interpolate(stored, settings.shape[-2:], mode="bilinear")
        if settings.guidance.active:  # the unconditional token is zeros
            hidden_states = torch.cat([torch.zeros_like(hidden_states), hidden_states])
            labels = None if labels is None else torch.cat([labels, labels])

        # 3. Denoise, and decode the finite samples
        result = self._denoise(settings, hidden_states, labels, report, extra_channels=extra_channels)
        images = self._images(settings, result, report)
        self.maybe_free_model_hooks()
        return UniTouchPipelineOutput(images=images, report=report, embeds=embeds) if return_dict else (images, report)

    # Checks -----------------------------------------------------------------------------------------------------------

    def _prepare(
        self, given: Mapping[str, Any], weights: Mapping[str, float] | None, source_sensor: SensorNames
    ) -> tuple[Conditions, int]:
        """Reads the given modalities; also returns the number of inputs, B."""
        given = {name: value for name, value in given.items() if value is not None}
        if not given:
            raise InvalidInputError("No input was given; pass `image`, `text`, `audio`, `touch` or `condition_embeds`.")
        self._joint(next(iter(given)))
        if source_sensor is not None and "touch" not in given:
            raise InvalidInputError("`source_sensor` has no effect without `touch`; leave it out.")
        inputs: dict[str, Any] = {}
        if "image" in given:
            inputs["image"] = {"pixel_values": self.processor.images(given["image"])}
        if "text" in given:
            for number, text in enumerate(check_texts("text", given["text"])):
                if not text.strip():
                    raise InvalidInputError(f"`text[{number}]` is blank; describe what is touched, as 'rough brick'.")
            inputs["text"] = dict(self.processor.text(given["text"]))
        if "audio" in given:
            inputs["audio"] = {"input_values": self.processor.sounds(given["audio"], audible=True)}
        if "touch" in given:
            inputs["touch"] = self._prepare_touch(given["touch"], source_sensor, None)
        sizes = [len(one.pixels if isinstance(one, Touches) else next(iter(one.values()))) for one in inputs.values()]
        for name, size in zip(inputs, sizes, strict=True):
            check_count(name, size, max(sizes))
        weights = dict.fromkeys(given, 1.0) if weights is None else weights
        if set(check_kind("weights", weights, Mapping)) != set(given):
            named = ", ".join(map(str, weights))
            raise InvalidInputError(f"`weights` is of {named}, but {', '.join(given)} was given; weigh each of those.")
        shares = check_weights("weights", [weights[name] for name in given])
        return {name: (share, inputs[name]) for name, share in zip(given, shares, strict=True) if share > 0}, max(sizes)

    def _check_sensor(self, sensor: SensorNames, background: ImageInput, inputs: int) -> tuple[list[Tensor], list[int]]:
        """Given images of untouched gels, and the sensor label of each touch image, input by input.

        Labels are indices in `config.sensors`; default 0. With images of gels it is one past the last.
        """
        names, gels = list(self.config.sensors), list[Tensor]()
        if background is not None:
            if not self.takes_background:
                raise InvalidInputError("`background` was given, but this model takes none; leave it out.")
            check_unused("background", sensor=sensor)  # a named sensor has its own
            gels = load_images("background", background)
            labels = [len(names)] * len(gels)
        elif not names and self.takes_background:
            raise InvalidInputError("`background` is missing: this model knows no sensor by name; pass its gel.")
        elif isinstance(sensor, str) and sensor == ALL:
            return [], list(range(max(len(names), 1))) * inputs
        elif not names:
            if sensor is not None:
                raise InvalidInputError(f"`sensor` is {describe(sensor)}, but this model draws one only; leave it out.")
            labels = [0]
        else:
            chosen = sensor if isinstance(sensor, list | tuple) else [names[0] if sensor is None else sensor]
            hint = f"{ALL!r} draws each of them, in place of a name, not together with one."
            labels = [names.index(check_choice("sensor", name, names, hint=hint)) for name in chosen]
        if not labels or (inputs > 1 and len(labels) not in (1, inputs)):
            name = "sensor" if background is None else "background"
            raise InvalidInputError(f"`{name}` holds {len(labels)} for {inputs} inputs; pass one, or one each.")
        return gels, labels * inputs if len(labels) == 1 else labels
