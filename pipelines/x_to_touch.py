"""`XToTouchPipeline`: the touch of what is seen, read, heard or felt by another sensor (Section 4.6 of the paper)."""

import os
from collections.abc import Collection, Mapping, Sequence
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
    InvalidTypeError,
    check_choice,
    check_integer,
    check_names,
    check_tensor,
    describe,
    did_you_mean,
)
from unitouch_gen.files import LOADING
from unitouch_gen.models.images import ImageInput, load_images
from unitouch_gen.models.joint import MODALITIES, UniTouchModel
from unitouch_gen.models.out_of_distribution import warn_of_unknown
from unitouch_gen.models.processing import UniTouchProcessor
from unitouch_gen.models.sensors import SensorMatch
from unitouch_gen.models.sounds import AudioInput
from unitouch_gen.pipelines.common import (
    MOST_IMAGES,
    UNCONDITIONAL,
    Generators,
    Plan,
    SamplingSettings,
    SensorNames,
    StepEndCallback,
    UniTouchPipeline,
    check_weights,
    guided,
)
from unitouch_gen.pipelines.output import UniTouchPipelineOutput
from unitouch_gen.pipelines.published import Wanted, touch_pipeline
from unitouch_gen.sampling import RunReport

ALL = "all"
"""In place of a sensor's name: every sensor there is."""

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
    """Inputs of one or several modalities, checked and ready to be encoded.

    Attributes:
        inputs: Of each modality that weighs anything, the arguments of `UniTouchModel.get_..._features`.
        weights: Of these modalities, summing to 1.
        batch_size: B; each modality has one input or B.
        matches: Sensor of each touch, if touches came.
        bridge: Whether those that are no pictures are moved towards pictures.
    """

    inputs: dict[str, dict[str, Any]]
    weights: dict[str, float]
    batch_size: int
    matches: list[SensorMatch]
    bridge: bool


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
    _embeds_name = "condition_embeds"

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
        self._keep_defaults(
            default_guidance_scale=default_guidance_scale, default_num_inference_steps=default_num_inference_steps
        )
        self.register_to_config(sensors=check_names("sensors", sensors))
        self._prepare_images()
        self._check_parts()

    def _check_parts(self) -> None:
        """Refuses parts whose widths or class labels do not fit each other."""
        unet, sensors = self.unet, self.config.sensors
        width, labels = self.embedding_dim, unet.config.num_class_embeds or 0
        if unet.config.class_embed_type is not None:
            raise InvalidInputError(
                f"`unet` is conditioned on class labels of the kind {unet.config.class_embed_type!r}, as unCLIP's are; "
                "touch is drawn by networks of numbered classes, one for each sensor, or of none."
            )
        given, made, stored = unet.config.in_channels, unet.config.out_channels, self.backgrounds
        if given not in (made, 2 * made):
            raise InvalidInputError(
                f"`unet` takes {given} channels and makes {made}; it has to take as many, or twice as many to be shown "
                "what a sensor sees untouched."
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
        self._check_embeddings(f"`unet` attends to width {width}")

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
        plan: Plan | None = None,
        low_memory: bool = False,
        dtype: torch.dtype = torch.float32,
        device: str | torch.device | None = None,
        variant: str | None = None,
        offload: str | None = None,
        **hub: Any,
    ) -> Self:
        """Builds on a latent diffusion model of touch in diffusers' layout, and a converted joint space.

        Args:
            ldm: Folder with `unet`, `vae` and `scheduler` as diffusers saves them, or repository id of one.
            sensors: Names of the network's class labels, if it has any.
            embedding_norm: Of the image embeddings that the network was trained on; it becomes the joint space's.
                When left out it is the joint space's own, or that of `images` under its image encoder.
            images: Some pictures to measure it on, in place of `embedding_norm`.
            unitouch, plan, low_memory, dtype, device, variant, offload, hub: See `TouchToImagePipeline.from_published`.

        Raises:
            InvalidInputError: If one of them is no such model, or their embeddings differ in width.
        """
        wanted = Wanted(dtype, device, variant, offload, plan, low_memory, hub)
        with LOADING:
            return touch_pipeline(cls, ldm, unitouch, sensors, embedding_norm, images, wanted)

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
        unknown: dict[str, list[str | None]] = {}
        embeds = self._condition(self._prepare(locals()), self._execution_device, unknown)
        warn_of_unknown(unknown)
        return embeds

    def _condition(
        self, conditions: Conditions, device: torch.device, unknown: dict[str, list[str | None]], throw: bool = True
    ) -> Tensor:
        """(B, 1, D) of the joint space's norm. A modality that weighs nothing is not encoded."""
        rows = []
        for name, inputs in conditions.inputs.items():
            embeds = self._matched(self._features(name, unknown, **inputs), name, throw)
            embeds = self._towards_pictures(embeds, conditions.bridge and name != "image")
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
            bridge: Whether conditions that are no pictures are moved towards the nearest embeddings of pictures that
                the checkpoint has, as it was trained on such; where it has any, if left out.
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
        # 1. Check everything, before any network runs
        request = dict(locals())  # the arguments as they came, by name
        plan = self._begin(request)
        conditions = None
        if condition_embeds is None:
            conditions = self._prepare(request)
            batch_size = conditions.batch_size
        else:
            batch_size = self._check_condition_embeds(request)
        names = list(self.config.sensors)
        gels = self._check_background(background, sensor, batch_size)
        drawn = [] if gels else drawn_sensors(names, sensor, batch_size)
        inputs, batch_size = batch_size, len(drawn) or max(batch_size, len(gels))
        labels = torch.tensor([names.index(name) for name in drawn] or [len(names)] * batch_size) if names else None
        candidates = check_integer("num_candidates", num_candidates, 1, MOST_IMAGES)
        if candidates > 1 and (self.unitouch is None or self.processor is None):
            raise InvalidInputError(
                f"`num_candidates` is {candidates}, but this pipeline has no `unitouch` and `processor` to choose one; "
                "leave it out."
            )
        repeats = check_integer("num_images_per_prompt", num_images_per_prompt, 1, MOST_IMAGES) * candidates
        settings = self._check_sampling(request, batch_size, repeats)
        report = self._report(settings, plan, conditions.matches if conditions else ())

        # 2. Encode the condition
        if conditions is not None:
            with report.stage("condition"):
                condition_embeds = self._condition(conditions, settings.device, report.unknown, throw)
            self._free(*(name for name in conditions.inputs if candidates == 1 or name != "touch"))
            warn_of_unknown(report.unknown)
        assert condition_embeds is not None
        condition_embeds = condition_embeds.to(settings.device).repeat_interleave(batch_size // inputs, dim=0)
        hidden = condition_embeds.repeat_interleave(repeats, dim=0)
        if labels is not None:
            labels = labels.repeat_interleave(repeats)
        branches = labels
        if settings.guidance.active:
            hidden = torch.cat([torch.zeros_like(hidden), hidden])
            branches = None if labels is None else torch.cat([labels, labels])

        # 3. Denoise
        beside = self._beside(gels, labels, settings) if self.takes_background else None
        with report.stage("denoising"):
            latents = self._denoise(settings, hidden, branches, report, beside=beside)

        # 4. Decode the samples that ended well; of candidates the best of each
        with report.stage("decoding"):
            if candidates == 1:
                images = self._images(settings, latents, report)
            else:
                images = self._best(settings, latents, condition_embeds, labels, candidates, report)

        self.maybe_free_model_hooks()
        if not return_dict:
            return images, report
        return UniTouchPipelineOutput(images=images, report=report, embeds=condition_embeds)

    def _beside(self, gels: list[Tensor], labels: Tensor | None, settings: SamplingSettings) -> Tensor:
        """Latents (B n, C, h, w) of what sensors see untouched: in the pictures that came, or as it is stored."""
        if gels:
            latents = self._encode_pictures("background", gels, settings)
            return latents.expand(settings.shape[0] // settings.repeats, -1, -1, -1).repeat_interleave(
                settings.repeats, dim=0
            )
        latents = self.backgrounds.latents.float()[labels].to(settings.device)
        return F.interpolate(latents, settings.shape[-2:], mode="bilinear")

    def _best(
        self,
        settings: SamplingSettings,
        latents: Tensor,
        condition: Tensor,
        labels: Tensor | None,
        candidates: int,
        report: RunReport,
    ) -> Any:
        """The candidate of each group whose touch embedding is nearest to the condition."""
        pixels = self._decode(latents, report, settings.throw)
        rows = [row for row, code in enumerate(report.codes) if code.finite]
        scores = self._scores(pixels, condition.repeat_interleave(settings.repeats, dim=0)[rows, 0], labels, rows)
        best: dict[int, int] = {}
        for index, row in enumerate(rows):
            group = row // candidates
            if group not in best or scores[index] > scores[best[group]]:
                best[group] = index
        chosen = list(best.values())
        report.chosen = [rows[index] for index in chosen]
        report.scores = [scores[index] for index in chosen]
        if settings.output_type == "latent":
            return latents[report.chosen]
        return self.image_processor.postprocess(pixels[chosen], output_type=settings.output_type)

    def _scores(self, pixels: Tensor, wanted: Tensor, labels: Tensor | None, rows: list[int]) -> list[float]:
        """Cosine of the touch embedding of each image (b, 3, H, W), about [-1, 1], to the embedding wanted (b, D)."""
        if not rows:
            return []
        values = self.processor.touch((pixels / 2 + 0.5).clamp(0.0, 1.0))
        known = self.unitouch.sensors
        own = dict(enumerate(self.config.sensors))
        names = [None if labels is None else own.get(int(labels[row])) for row in rows]
        matches = self.unitouch.match_sensors(values, [name if name in known else None for name in names])
        embeds = self.unitouch.get_touch_features(values, self.unitouch.sensor_ids(matches)).float()
        return F.cosine_similarity(embeds, wanted.to(embeds), dim=1).tolist()

    # Checks -----------------------------------------------------------------------------------------------------------

    @classmethod
    def _plan(cls, request: Mapping[str, Any]) -> Plan:
        modalities = [name for name in MODALITIES if request[name] is not None]
        if request["condition_embeds"] is None:
            _check_something_came(modalities)
        bridged = request["bridge"] is not False and any(name != "image" for name in modalities)
        if isinstance(request["weights"], Mapping):
            modalities = [name for name in modalities if request["weights"].get(name, 1) != 0]
        candidates = check_integer("num_candidates", request["num_candidates"], 1, MOST_IMAGES)
        ranked = candidates > 1  # by the touch encoder, of decoded images
        return Plan(
            {
                **{f"{name} encoder": name in modalities or (ranked and name == "touch") for name in MODALITIES},
                "bank of image embeddings": bridged,
                UNCONDITIONAL: guided(request["guidance_scale"]),
                "VAE": request["output_type"] != "latent" or ranked or request["background"] is not None,
            }
        )

    def _prepare(self, request: Mapping[str, Any]) -> Conditions:
        """Reads and checks whatever came; no network runs."""
        given = {name: request[name] for name in MODALITIES if request[name] is not None}
        bridge = bool(set(given) - {"image"}) and self._check_bridge(request["bridge"])
        _check_something_came(given)
        processor = self.processor
        if self.unitouch is None or processor is None:
            raise InvalidInputError(
                f"`{next(iter(given))}` came, but this pipeline has no `unitouch` and `processor`; pass "
                "`condition_embeds` instead."
            )
        for name, modality in (("source_sensor", "touch"), ("sampling_rate", "audio")):
            if request[name] is not None and modality not in given:
                raise InvalidInputError(f"`{name}` came without `{modality}`, on which it has no effect; leave it out.")
        weights = _shares(request["weights"], given)

        inputs: dict[str, dict[str, Any]] = {}
        matches: list[SensorMatch] = []
        if "image" in given:
            inputs["image"] = {"pixel_values": processor.images(given["image"])}
        if "text" in given:
            check_not_blank(given["text"])
            inputs["text"] = dict(processor.text(given["text"]))
        if "audio" in given:
            inputs["audio"] = {"input_values": processor.sounds(given["audio"], request["sampling_rate"], audible=True)}
        if "touch" in given:
            if "touch" in weights:
                touches = self._prepare_touch(given["touch"], request["source_sensor"], None)
                matches = touches.matches
                inputs["touch"] = {"pixel_values": touches.pixels, "sensor_ids": self.unitouch.sensor_ids(matches)}
            else:  # of no weight: neither sensor nor encoder are asked
                inputs["touch"] = {"pixel_values": processor.touch(given["touch"])}
        sizes = {name: len(next(iter(values.values()))) for name, values in inputs.items()}
        batch_size = max(sizes.values())
        for name, size in sizes.items():
            if size not in (1, batch_size):
                raise InvalidInputError(
                    f"`{name}` holds {size} inputs, where another modality holds {batch_size}; pass one, or one each."
                )
        return Conditions({name: inputs[name] for name in weights}, weights, batch_size, matches, bridge)

    def _check_background(self, background: ImageInput, sensor: SensorNames, batch_size: int) -> list[Tensor]:
        """Pictures of untouched gels, or none where sensors are drawn by their names."""
        names = list(self.config.sensors)
        if background is None:
            if self.takes_background and not names:
                raise InvalidInputError(
                    "`background` is missing: this model knows no sensor by name; pass a picture of the untouched gel "
                    "of the one to draw."
                )
            return []
        if not self.takes_background:
            raise InvalidInputError(
                "`background` came, but the network of this model is shown none, and draws no other sensors than "
                f"{names or 'its one'}; leave it out."
            )
        if sensor is not None:
            raise InvalidInputError(
                f"`sensor` is {describe(sensor)} and `background` came, too, but a sensor with a name has its own; "
                "pass one of them."
            )
        gels = load_images("background", background)
        if batch_size > 1 and len(gels) not in (1, batch_size):
            raise InvalidInputError(
                f"`background` holds {len(gels)} images for {batch_size} inputs; pass one, or one each."
            )
        return gels

    def _check_condition_embeds(self, request: Mapping[str, Any]) -> int:
        """B of embeddings (B, 1, D) that came in the place of the modalities."""
        for name in (*MODALITIES, "weights", "bridge", "sampling_rate", "source_sensor"):
            if request[name] is not None and request[name] is not False:  # a bridge may be off
                raise InvalidInputError(
                    f"`{name}` is {describe(request[name])}, but `condition_embeds` came, on which it has no effect; "
                    "pass one of them, or mix in `encode_condition`."
                )
        return len(check_tensor("condition_embeds", request["condition_embeds"], "B", 1, self.embedding_dim))


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


def _check_something_came(given: Collection[str]) -> None:
    """Refuses a call to which nothing came."""
    if not given:
        raise InvalidInputError(
            "Nothing to make a touch of came; pass `image`, `text`, `audio`, `touch` or `condition_embeds`."
        )


def check_not_blank(text: Any) -> None:
    """Refuses a description that says nothing; what is no string is for the processor to refuse.

    Raises:
        InvalidInputError: Naming the first.
    """
    for number, item in enumerate(text if isinstance(text, list | tuple) else [text]):
        if isinstance(item, str) and not item.strip():
            where = f"`text[{number}]`" if isinstance(text, list | tuple) else "`text`"
            raise InvalidInputError(f"{where} is blank; describe what is touched, such as 'rough brick'.")


def _shares(weights: Any, given: Mapping[str, Any]) -> dict[str, float]:
    """Weights of the modalities that came and weigh anything, summing to 1; all the same where no weights came."""
    if weights is None:
        return dict.fromkeys(given, 1.0 / len(given))
    if not isinstance(weights, Mapping):
        raise InvalidTypeError(
            f"`weights` is {describe(weights)}; it has to be a dictionary of modalities and numbers."
        )
    came = ", ".join(f"`{name}`" for name in given)
    for name in weights:
        if name not in MODALITIES:
            hint = did_you_mean(name, MODALITIES)
            raise InvalidInputError(
                f"`weights` names {describe(name)}, which is no modality; {came} came, so weigh "
                f"{'that' if len(given) == 1 else 'those'} or leave `weights` out.{f' {hint}' if hint else ''}"
            )
        if name not in given:
            raise InvalidInputError(
                f"`weights` names {name!r}, but no `{name}` came, only {came}; pass `{name}`, too, or leave its weight "
                "out."
            )
    for name in given:
        if name not in weights:
            raise InvalidInputError(
                f"`weights` says nothing of `{name}`, which came; give it a weight, or leave `{name}` out."
            )
    shares = check_weights("weights", [weights[name] for name in given])
    return {name: share for name, share in zip(given, shares, strict=True) if share > 0}
