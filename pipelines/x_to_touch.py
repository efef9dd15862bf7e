"""`XToTouchPipeline`: the touch of what is seen, read, heard or felt by another sensor (Section 4.6 of the paper)."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import torch
import torch.nn.functional as F
from diffusers import AutoencoderDC, AutoencoderKL, AutoencoderTiny, UNet2DConditionModel, VQModel
from diffusers.schedulers.scheduling_utils import KarrasDiffusionSchedulers
from diffusers.utils import replace_example_docstring
from torch import Tensor

from unitouch_gen.conditioning import EmbeddingBank, SensorBackgrounds, match_norm, mix_linear
from unitouch_gen.errors import (
    InvalidInputError,
    check_choice,
    check_integer,
    check_kind,
    check_tensor,
    check_texts,
    describe,
    did_you_mean,
)
from unitouch_gen.models.images import ImageInput, load_images
from unitouch_gen.models.joint import MODALITIES, UniTouchModel
from unitouch_gen.models.processing import UniTouchProcessor
from unitouch_gen.models.sounds import AudioInput
from unitouch_gen.pipelines.base import (
    MOST_IMAGES,
    CallSettings,
    Generators,
    SensorNames,
    StepEndCallback,
    Touches,
    UniTouchPipeline,
    check_weights,
)
from unitouch_gen.pipelines.output import UniTouchPipelineOutput
from unitouch_gen.pipelines.published import touch_pipeline
from unitouch_gen.sampling import RunReport

ALL = "all"  # in place of a sensor's name: every sensor there is

EXAMPLE_DOC_STRING = """
    Examples:
        ```py
        >>> import unitouch_gen

        >>> pipe = unitouch_gen.tiny("x-to-touch")
        >>> pipe(text="rough brick", sensor="digit").images[0].save("brick.png")
        >>> pipe(image="wall.jpg", num_candidates=4).images[0].save("wall.png")
        ```
"""


@dataclass(frozen=True)
class Conditions:
    """Inputs of one or several modalities, ready to be encoded.

    Attributes:
        inputs: By modality, the arguments of `UniTouchModel.get_..._features`, or the touches.
        weights: By modality, above 0 and summing to 1; others are not encoded.
        batch_size: B; each modality has one input or B.
    """

    inputs: dict[str, Any]
    weights: dict[str, float]
    batch_size: int


class XToTouchPipeline(UniTouchPipeline):
    """Anything to touch: latent diffusion of touch images, conditioned on one embedding of the joint space.

    Trained on image embeddings alone, so what text, sound and touch give is zero-shot.

    Args:
        unet: Attends to one token, the embedding; its class label, if it has any, is the sensor that is drawn. With
            twice the input channels of a latent it is shown what the sensor sees untouched, behind the noise (as
            InstructPix2Pix, Brooks et al., 2023, its picture), and its last label is of sensors without a name.
        scheduler: The pipeline's own solver, used when `solver` is `None`.
        vae: Decodes latents to touch images.
        unitouch: The joint space; of its encoders only those of the modalities that come are read. May be `None` if
            embeddings are passed.
        processor: Prepares what comes for it.
        embedding_bank: Image embeddings that those of other modalities are moved towards; `None` to leave these as they
            are.
        sensors: Names of the UNet's class labels; empty for a UNet without.
        backgrounds: What these see untouched. `None` for a UNet that is shown none, or knows no sensor by name.
        default_guidance_scale, default_num_inference_steps: What a call uses where it says nothing. The paper's values;
            a checkpoint may store its own.
    """

    model_cpu_offload_seq = "unitouch->unet->vae"
    _optional_components = ["unitouch", "processor", "embedding_bank", "backgrounds"]
    _exclude_from_cpu_offload = ["unitouch", "embedding_bank", "backgrounds"]
    _callback_tensor_inputs = ["latents", "condition_embeds"]
    _example_call = 'pipe(image=example("brick", "image"))'
    _hidden_name = "condition_embeds"
    _lora_loadable_modules = ["unet"]

    def __init__(
        self,
        unet: UNet2DConditionModel,
        scheduler: KarrasDiffusionSchedulers,
        vae: AutoencoderKL | AutoencoderTiny | AutoencoderDC | VQModel,
        unitouch: UniTouchModel | None = None,
        processor: UniTouchProcessor | None = None,
        embedding_bank: EmbeddingBank | None = None,
        backgrounds: SensorBackgrounds | None = None,
        sensors: list[str] | tuple[str, ...] = (),  # diffusers warns of kinds that it does not know
        default_guidance_scale: float = 7.5,
        default_num_inference_steps: int = 200,
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
            f"`unet` attends to width {self.embedding_dim}",
            default_guidance_scale=default_guidance_scale,
            default_num_inference_steps=default_num_inference_steps,
        )
        self._check_parts()

    def _check_parts(self) -> None:
        """Raises if class labels, channels and stored backgrounds do not fit each other."""
        unet, sensors, stored = self.unet, self.config.sensors, self.backgrounds
        labels = unet.config.num_class_embeds or 0
        given, made = unet.config.in_channels, unet.config.out_channels
        if given not in (made, 2 * made):
            raise InvalidInputError(
                f"`unet` takes {given} channels and makes {made}; it has to take as many, or twice as many where it is "
                "shown the untouched gel."
            )
        others = int(self.takes_background and bool(sensors))  # the label of sensors without a name
        if labels != len(sensors) + others:
            raise InvalidInputError(
                f"`sensors` names {len(sensors)}, but `unet` has {labels} class labels; name each of them"
                f"{', but the last, which is of all others' if others else ''}."
            )
        wanted = (len(sensors), made) if others else None
        found = (stored.config["count"], stored.config["channels"]) if stored is not None else None
        if found != wanted:
            raise InvalidInputError(
                f"`backgrounds` is {describe(stored)}, of (sensors, channels) {found}, but `sensors` and `unet` are of "
                f"{wanted}; pass those that were stored with `unet`, and none where it is shown none."
            )

    @property
    def embedding_dim(self) -> int:
        """D of the embedding that the UNet attends to."""
        return self.unet.config.cross_attention_dim

    @property
    def takes_background(self) -> bool:
        """Whether the UNet is shown what a sensor sees untouched, so that it draws sensors without a name, too."""
        return self.unet.config.in_channels != self.unet.config.out_channels

    @classmethod
    def from_published(
        cls,
        ldm: str | os.PathLike,
        unitouch: str | os.PathLike | UniTouchModel,
        *,
        sensors: Sequence[str] = (),
        embedding_norm: float | None = None,
        images: ImageInput = None,
        dtype: torch.dtype = torch.float32,
        variant: str | None = None,
        **hub: Any,
    ) -> Self:
        """Builds on a latent diffusion model of touch in diffusers' layout, and a converted joint space.

        Args:
            ldm: Folder with `unet`, `vae` and `scheduler` as diffusers saves them, or repository id of one.
            sensors: Names of the network's class labels, if it has any.
            embedding_norm: Of the image embeddings that the network was trained on; it becomes the joint space's. When
                left out it is the joint space's own, or that of `images` under its image encoder.
            images: Some pictures to measure it on.
            unitouch, dtype, variant, hub: See `TouchToImagePipeline.from_published`.

        Raises:
            InvalidInputError: If one of them is no such model, or their embeddings differ in width.
        """
        return touch_pipeline(cls, ldm, unitouch, sensors, embedding_norm, images, dtype, variant, hub)

    # Conditions -------------------------------------------------------------------------------------------------------

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
        sampling_rate: int | None = None,
        source_sensor: SensorNames = None,
    ) -> Tensor:
        """The condition as the network will see it: one token of the joint space's norm, (B, 1, D).

        See `__call__` for the arguments, and for the errors.
        """
        bridge = self._check_bridge(bridge)
        conditions = self._prepare(image, text, audio, touch, weights, sampling_rate, source_sensor)
        return self._condition(conditions, bridge, self._execution_device, RunReport())

    def _condition(
        self, conditions: Conditions, bridge: bool, device: torch.device, report: RunReport, throw: bool = True
    ) -> Tensor:
        """(B, 1, D) of the joint space's norm."""
        rows = []
        for name in conditions.weights:
            inputs = conditions.inputs[name]
            if isinstance(inputs, Touches):
                features = self._touch_features(inputs, report)
            else:
                features = getattr(self.unitouch, f"get_{name}_features")(**inputs)
            embeds = self._bridged(self._matched(features, name, throw), bridge and name != "image")
            rows.append(embeds.to(device).expand(conditions.batch_size, -1))
        mixed = mix_linear(torch.stack(rows), torch.tensor(list(conditions.weights.values())))
        return match_norm(mixed, self.unitouch.config.embedding_norm)[:, None]

    # One call ---------------------------------------------------------------------------------------------------------

    @torch.no_grad()
    @replace_example_docstring(EXAMPLE_DOC_STRING)
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
        sigmas: Sequence[float] | None = None,
        guidance_scale: float | None = None,
        guidance_interval: Sequence[float] | None = None,
        num_images_per_prompt: int = 1,
        num_candidates: int = 1,
        sampling_rate: int | None = None,
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

        For the arguments that are not named here see `TouchToImagePipeline.__call__`, which takes the same.

        Args:
            image: Photos: paths, PIL images, arrays (H, W, 3), tensors (3, H, W), or a list.
            text: One description or a list; longer ones than the tokenizer's length are cut.
            audio: Sounds: paths (wav, flac, ogg, mp3), pairs (array, rate), or a list. Silence is refused.
            touch: Touch images, which makes it translation from one sensor to another.
            sensor: Whose image is drawn: a name in `config.sensors`, one for each input, several for a single one, or
                "all" for every sensor of each input in turn; the first when left out.
            background: In place of `sensor`, what one without a name sees untouched, of networks that are shown it: one
                picture, one for each input, or several for a single one; cut to the shape of the touch images.
            weights: Of several modalities, by name, such as `{"image": 0.7, "text": 0.3}`; equal when left out. Only
                their ratios count.
            bridge: Whether conditions other than images are moved towards the nearest of the checkpoint's image
                embeddings, as it was trained on images; by default where it has any.
            num_inference_steps, guidance_scale: As there (paper: 200 and 7.5).
            num_images_per_prompt: Touch images for each input.
            num_candidates: Of each touch image that is returned; the touch encoder chooses the one that is nearest to
                the condition.
            sampling_rate: Of sounds that come as arrays without one, Hz.
            source_sensor: Which sensor took `touch`: a name, one for each, or `None` to retrieve it.
            generator: One, or one for each candidate.
            latents: Unit-variance noise (B n, C, h, w), n counting images and candidates of one input.
            condition_embeds: (B, 1, D) in place of the modalities, taken as they come: see `encode_condition`.
            callback_on_step_end_tensor_inputs: Which tensors it gets: "latents" (B n, C, h, w) in float32,
                "condition_embeds" of both branches, the unconditional one, zeros, first.

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
        # 1. Check inputs, before any network runs
        given = {"image": image, "text": text, "audio": audio, "touch": touch}
        conditions = None
        if condition_embeds is None:
            bridge = self._check_bridge(bridge)
            conditions = self._prepare(image, text, audio, touch, weights, sampling_rate, source_sensor)
            inputs = conditions.batch_size
        else:
            others = {"weights": weights, "sampling_rate": sampling_rate, "source_sensor": source_sensor}
            for name, value in {**given, **others}.items():
                if value is not None:
                    raise InvalidInputError(
                        f"`{name}` is {describe(value)}, but `condition_embeds` came, on which it has no effect; pass "
                        "one of them, or mix in `encode_condition`."
                    )
            inputs = len(check_tensor("condition_embeds", condition_embeds, "B", 1, self.embedding_dim))
        names = list(self.config.sensors)
        gels = self._check_background(background, sensor, inputs)
        drawn = [] if gels else drawn_sensors(names, sensor, inputs)
        batch_size = len(drawn) or max(inputs, len(gels))
        labels = torch.tensor([names.index(name) for name in drawn] or [len(names)] * batch_size) if names else None
        candidates = check_integer("num_candidates", num_candidates, 1, MOST_IMAGES)
        if candidates > 1:
            self._joint("num_candidates")
        settings = self._check_call(
            batch_size,
            check_integer("num_images_per_prompt", num_images_per_prompt, 1, MOST_IMAGES) * candidates,
            height=height,
            width=width,
            num_inference_steps=num_inference_steps,
            timesteps=timesteps,
            sigmas=sigmas,
            guidance_scale=guidance_scale,
            guidance_interval=guidance_interval,
            solver=solver,
            tolerance=tolerance,
            max_evaluations=max_evaluations,
            eta=eta,
            generator=generator,
            latents=latents,
            output_type=output_type,
            cross_attention_kwargs=cross_attention_kwargs,
            callback_on_step_end=callback_on_step_end,
            callback_on_step_end_tensor_inputs=callback_on_step_end_tensor_inputs,
            throw=throw,
        )
        report = RunReport()
        encoded = set(conditions.weights if conditions else ()) | ({"touch"} if candidates > 1 else set())
        report.left_out += [f"{name} encoder" for name in MODALITIES if name not in encoded]

        # 2. Encode the condition
        if conditions is not None:
            with report.stage("condition"):
                condition_embeds = self._condition(conditions, bool(bridge), settings.device, report, throw)
        assert condition_embeds is not None
        condition_embeds = condition_embeds.to(settings.device).repeat_interleave(batch_size // inputs, dim=0)
        hidden = condition_embeds.repeat_interleave(settings.repeats, dim=0)
        if labels is not None:
            labels = labels.repeat_interleave(settings.repeats)
        both = labels
        if settings.guidance.active:
            hidden = torch.cat([torch.zeros_like(hidden), hidden])
            both = None if labels is None else torch.cat([labels, labels])

        # 3. Denoise
        shown = self._shown(gels, labels, settings) if self.takes_background else None
        with report.stage("denoising"):
            result = self._denoise(settings, hidden, both, report, shown=shown)

        # 4. Decode the samples that ended well; of candidates the best of each
        with report.stage("decoding"):
            if candidates == 1:
                images = self._images(settings, result, report)
            else:
                images = self._best(settings, result, condition_embeds, labels, candidates, report)
        self.maybe_free_model_hooks()
        if not return_dict:
            return images, report
        return UniTouchPipelineOutput(images=images, report=report, embeds=condition_embeds)

    def _shown(self, gels: list[Tensor], labels: Tensor | None, settings: CallSettings) -> Tensor:
        """Latents (B n, C, h, w) of untouched gels: of the pictures that came, or as the checkpoint stores them."""
        if gels:
            latents = self._encode_pictures("background", gels, settings)
            batch_size = settings.shape[0] // settings.repeats
            return latents.expand(batch_size, -1, -1, -1).repeat_interleave(settings.repeats, dim=0)
        latents = self.backgrounds.latents.float()[labels].to(settings.device)
        return F.interpolate(latents, settings.shape[-2:], mode="bilinear")

    def _best(
        self,
        settings: CallSettings,
        latents: Tensor,
        condition: Tensor,
        labels: Tensor | None,
        candidates: int,
        report: RunReport,
    ) -> Any:
        """The candidate of each group whose touch embedding has the largest cosine to the condition."""
        pixels = self._decode(latents, report, settings.throw)
        rows = [row for row, code in enumerate(report.codes) if code.finite]
        scores = []
        if rows:
            values = self.processor.touch((pixels / 2 + 0.5).clamp(0.0, 1.0))
            own = dict(enumerate(self.config.sensors)) if labels is not None else {}
            drawn = [own.get(int(labels[row])) if labels is not None else None for row in rows]
            matches = self.unitouch.match_sensors(
                values, [name if name in self.unitouch.sensors else None for name in drawn]
            )
            embeds = self.unitouch.get_touch_features(values, self.unitouch.sensor_ids(matches)).float()
            wanted = condition.repeat_interleave(settings.repeats, dim=0)[rows, 0].to(embeds)
            scores = F.cosine_similarity(embeds, wanted, dim=1).tolist()
        best: dict[int, int] = {}
        for index, row in enumerate(rows):
            group = row // candidates
            if group not in best or scores[index] > scores[best[group]]:
                best[group] = index
        report.chosen = [rows[index] for index in best.values()]
        report.scores = [scores[index] for index in best.values()]
        if settings.output_type == "latent":
            return latents[report.chosen]
        return self.image_processor.postprocess(pixels[list(best.values())], output_type=settings.output_type)

    # Checks -----------------------------------------------------------------------------------------------------------

    def _prepare(
        self,
        image: ImageInput,
        text: str | list[str] | None,
        audio: AudioInput,
        touch: ImageInput,
        weights: Mapping[str, float] | None,
        sampling_rate: int | None,
        source_sensor: SensorNames,
    ) -> Conditions:
        """Reads whatever came."""
        given = {"image": image, "text": text, "audio": audio, "touch": touch}
        given = {name: value for name, value in given.items() if value is not None}
        if not given:
            raise InvalidInputError(
                "Nothing to make a touch of came; pass `image`, `text`, `audio`, `touch` or `condition_embeds`."
            )
        self._joint(next(iter(given)))
        if source_sensor is not None and touch is None:
            raise InvalidInputError("`source_sensor` has no effect without `touch`; leave it out.")
        if sampling_rate is not None and audio is None:
            raise InvalidInputError("`sampling_rate` has no effect without `audio`; leave it out.")
        shares, processor = _shares(weights, given), self.processor
        inputs: dict[str, Any] = {}
        if image is not None:
            inputs["image"] = {"pixel_values": processor.images(image)}
        if text is not None:
            for number, item in enumerate(check_texts("text", text)):
                if not item.strip():
                    raise InvalidInputError(f"`text[{number}]` is blank; describe what is touched, as 'rough brick'.")
            inputs["text"] = dict(processor.text(text))
        if audio is not None:
            inputs["audio"] = {"input_values": processor.sounds(audio, sampling_rate, audible=True)}
        if touch is not None:
            inputs["touch"] = self._prepare_touch(touch, source_sensor, None)
        sizes = {
            name: len(values.pixels if isinstance(values, Touches) else next(iter(values.values())))
            for name, values in inputs.items()
        }
        batch_size = max(sizes.values())
        for name, size in sizes.items():
            if size not in (1, batch_size):
                raise InvalidInputError(
                    f"`{name}` holds {size} inputs, where another modality holds {batch_size}; pass one, or one each."
                )
        return Conditions(inputs, shares, batch_size)

    def _check_background(self, background: ImageInput, sensor: SensorNames, batch_size: int) -> list[Tensor]:
        """Pictures of untouched gels, or none where sensors are drawn by their names."""
        names = list(self.config.sensors)
        if background is None:
            if self.takes_background and not names:
                raise InvalidInputError("`background` is missing: this model knows no sensor by name; pass its gel.")
            return []
        if not self.takes_background:
            raise InvalidInputError(
                f"`background` came, but this model draws {names or 'one sensor'} alone; leave it out."
            )
        if sensor is not None:
            raise InvalidInputError(
                f"`sensor` is {describe(sensor)}, and a sensor with a name has its own `background`; pass one of them."
            )
        gels = load_images("background", background)
        if batch_size > 1 and len(gels) not in (1, batch_size):
            raise InvalidInputError(
                f"`background` holds {len(gels)} images for {batch_size} inputs; pass one, or one each."
            )
        return gels


def drawn_sensors(known: Sequence[str], sensor: SensorNames, batch_size: int = 1) -> list[str]:
    """Whose image each touch image of a call is, input by input; several sensors may draw one input.

    The first that is known where none is named, and an empty list where a model draws one sensor only, without a name.

    Args:
        known: Names of the sensors that the model draws.
        sensor: As of `XToTouchPipeline`.
        batch_size: Inputs.

    Raises:
        InvalidInputError: If a name is unknown, or their number does not fit.
    """
    if not known:
        if sensor is not None and sensor != ALL:
            raise InvalidInputError(
                f"`sensor` is {describe(sensor)}, but this model draws one sensor only; leave it out."
            )
        return []
    if isinstance(sensor, str) and sensor == ALL:
        return list(known) * batch_size
    chosen = [known[0] if sensor is None else sensor] if sensor is None or isinstance(sensor, str) else sensor
    if not isinstance(chosen, list | tuple) or not chosen or (batch_size > 1 and len(chosen) not in (1, batch_size)):
        raise InvalidInputError(
            f"`sensor` is {describe(sensor)} for {batch_size} inputs; pass one name, one for each input, or {ALL!r}."
        )
    names = [
        check_choice("sensor", name, known, hint=f"{ALL!r} draws each of them, in place of a name and not beside one.")
        for name in chosen
    ]
    return names * batch_size if len(names) == 1 else names


def _shares(weights: Any, given: Mapping[str, Any]) -> dict[str, float]:
    """Weights above 0 of the modalities that came, summing to 1; equal where no weights came."""
    if weights is None:
        return dict.fromkeys(given, 1.0 / len(given))
    check_kind("weights", weights, Mapping, hint='Such as {"image": 0.7, "text": 0.3}.')
    if set(weights) != set(given):
        wrong = next(iter(set(weights) ^ set(given)))
        raise InvalidInputError(
            f"`weights` is of {', '.join(map(str, weights))}, but {', '.join(f'`{name}`' for name in given)} came; "
            f"weigh each of those. {did_you_mean(wrong, MODALITIES)}".strip()
        )
    shares = check_weights("weights", [weights[name] for name in given])
    return {name: share for name, share in zip(given, shares, strict=True) if share > 0}
