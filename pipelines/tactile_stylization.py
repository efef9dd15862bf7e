"""`TactileStylizationPipeline`: a photo that looks as a touch feels (Section 4.4 of the paper)."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any

import torch
from diffusers.utils import replace_example_docstring
from torch import Tensor

from unitouch_gen.conditioning import apply_strength, mix_linear, mix_spherical, mix_to_norm
from unitouch_gen.errors import (
    ExchangedInputsWarning,
    InvalidInputError,
    check_choice,
    check_integer,
    check_number,
    describe,
)
from unitouch_gen.models.images import ImageInput
from unitouch_gen.models.joint import UniTouchModel
from unitouch_gen.models.out_of_distribution import warn_of_unknown
from unitouch_gen.pipelines.common import (
    MAX_GAIN,
    MOST_IMAGES,
    Generators,
    Plan,
    SensorNames,
    StepEndCallback,
    Touches,
    check_weights,
)
from unitouch_gen.pipelines.output import UniTouchPipelineOutput
from unitouch_gen.pipelines.touch_to_image import TouchToImagePipeline

MIXES = {"linear": mix_to_norm, "slerp": mix_spherical, "paper": mix_linear}
"""How embeddings are mixed, by name."""

Weight = float | Sequence[float]

EXAMPLE_DOC_STRING = """
    Examples:
        ```py
        >>> import unitouch_gen

        >>> pipe = unitouch_gen.tiny("stylization")
        >>> pipe("photo.jpg", unitouch_gen.example("brick")).images[0].save("brick_photo.png")
        >>> pipe("photo.jpg", ["brick.png", "grass.png"], touch_weight=[0.2, 0.1])  # two touches into one picture
        ```
"""


@dataclass
class Blend:
    """Photos and touches of one call, checked: what goes into each picture.

    Attributes:
        photos: Pixel values (N, 3, S, S).
        touches: M of them.
        parts: Of each picture's embedding, (weight, "image" or "touch", rows of its input for every picture).
        batch_size: B, number of pictures asked for.
    """

    photos: Tensor
    touches: Touches
    parts: list[tuple[float, str, list[int]]]
    batch_size: int


class TactileStylizationPipeline(TouchToImagePipeline):
    """Restyles photos by touches: the same unCLIP model, on a mix of both embeddings.

    See `TouchToImagePipeline` for the components; `default_strength` is for touches alone and has no say here.
    """

    _embeds_name = None
    _example_call = 'pipe(example("wood", "image"), example("gravel"))'

    @torch.no_grad()
    @replace_example_docstring(EXAMPLE_DOC_STRING)
    def __call__(  # type: ignore[override]
        self,
        image: ImageInput = None,
        touch: ImageInput = None,
        prompt: str | list[str] | None = None,
        touch_weight: Weight = 0.3,
        image_weight: Weight | None = None,
        mix: str = "linear",
        init_strength: float = 0.65,
        height: int | None = None,
        width: int | None = None,
        num_inference_steps: int | None = None,
        timesteps: Sequence[int] | None = None,
        sigmas: Sequence[float] | None = None,
        guidance_scale: float | None = None,
        guidance_interval: Sequence[float] | None = None,
        strength: float = 1.0,
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
        prompt_embeds: Tensor | None = None,
        negative_prompt_embeds: Tensor | None = None,
        output_type: str = "pil",
        return_dict: bool = True,
        cross_attention_kwargs: dict[str, Any] | None = None,
        callback_on_step_end: StepEndCallback | None = None,
        callback_on_step_end_tensor_inputs: Sequence[str] = ("latents",),
        throw: bool = True,
    ) -> UniTouchPipelineOutput | tuple:
        """Restyles photos by touches.

        For the arguments that are not named here see `TouchToImagePipeline.__call__`, which takes the same.

        Args:
            image: One photo or several: paths, PIL images, arrays (H, W, 3), tensors (3, H, W), or a list.
            touch: One touch image or several, likewise. Several photos and touches go in pairs, one of either goes
                with all of the other.
            prompt: What else the picture should be; "high quality" when left out. One, or one for each picture.
            touch_weight, image_weight: Of the embeddings in the mix, brought to a sum of 1 (paper: 0.3 and 0.7). The
                photos' is what the touches leave of 1 when left out. A list weighs several touches, or photos, that are
                all mixed into one picture.
            mix: "linear", sum_i w_i e_i brought back to the norm of the joint space's images, as in X-to-touch;
                "slerp", along the sphere; or "paper", the sum as it is, which is shorter the more its parts differ.
            init_strength: How much of the photo's layout goes: the share of the steps that is made from its own
                latents, from near 0 (the photo) to 1, which starts from noise alone (the paper's). To a `tolerance` it
                is the share of the way in Karras spacing.
            strength: Gain on the mixed embedding, >= 0 (paper: 1).
            bridge: As there, of touches, before they are mixed.
            sensor: Which sensor took the touches: a name, one for each, or `None` to retrieve it.

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
            ExchangedInputsWarning: Where photos look more like touches than the touches do.
        """
        # 1. Check everything, before any network runs
        request = dict(locals())  # the arguments as they came, by name
        plan = self._begin(request)
        strength = check_number("strength", strength, 0.0, MAX_GAIN)
        check_choice("mix", mix, MIXES)
        from_noise = check_number("init_strength", init_strength, 0.0, 1.0) == 1.0
        noise_level, bridge = self._check_noise_level(noise_level), self._check_bridge(bridge)
        blend = self._blend(image, touch, image_weight, touch_weight, sensor, background)
        repeats = check_integer("num_images_per_prompt", num_images_per_prompt, 1, MOST_IMAGES)
        settings = self._check_sampling(request, blend.batch_size, repeats)
        prompts = self._check_prompts(request, blend.batch_size, settings)
        if not from_noise and len(blend.photos) not in (1, blend.batch_size):
            raise InvalidInputError(
                f"`init_strength` is {init_strength:g}, but {len(blend.photos)} photos are mixed into one picture, and "
                "none of them is its layout; pass one photo, or 1 to start from noise."
            )
        report = self._report(settings, plan, blend.touches.matches)

        # 2. Encode photos and touches, and mix their embeddings
        with report.stage("mix"):
            embeds = self._mixed(blend, bridge, mix, strength, report.unknown, throw)
        self._free(*plan.modalities)
        warn_of_unknown(report.unknown)

        # 3. Encode the photo's own latents
        init: dict[str, Any] = {}
        if not from_noise:
            with report.stage("photo latents"):
                latents = self._encode_pictures("image", image, settings)
                latents = latents.expand(blend.batch_size, -1, -1, -1).repeat_interleave(settings.repeats, dim=0)
            init = {"init": latents, "init_strength": init_strength}

        # 4. Generate from the mixed embedding
        return self._generate(settings, embeds, noise_level, prompts, report, return_dict, **init)

    # Conditions -------------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def encode_mix(
        self,
        image: ImageInput,
        touch: ImageInput,
        touch_weight: Weight = 0.3,
        image_weight: Weight | None = None,
        mix: str = "linear",
        strength: float = 1.0,
        sensor: SensorNames = None,
        background: ImageInput = None,
        bridge: bool | None = None,
    ) -> Tensor:
        """Mixed embeddings as the network will see them before noise, (B, D).

        See `__call__` for the arguments, and for the errors.
        """
        strength = check_number("strength", strength, 0.0, MAX_GAIN)
        check_choice("mix", mix, MIXES)
        bridge, unknown = self._check_bridge(bridge), dict[str, list[str | None]]()
        blend = self._blend(image, touch, image_weight, touch_weight, sensor, background)
        embeds = self._mixed(blend, bridge, mix, strength, unknown)
        warn_of_unknown(unknown)
        return embeds

    def _mixed(
        self,
        blend: Blend,
        bridge: bool,
        mix: str,
        strength: float,
        unknown: dict[str, list[str | None]],
        throw: bool = True,
    ) -> Tensor:
        """(B, D); an encoder whose inputs weigh nothing does not run."""
        used = [(weight, modality, rows) for weight, modality, rows in blend.parts if weight > 0]
        modalities = {modality for _, modality, _ in used}
        embeds = {}
        if "touch" in modalities:
            touches = self._matched(self._touch_features(blend.touches, unknown), "touch", throw)
            embeds["touch"] = self._towards_pictures(touches, bridge)
        if "image" in modalities:
            features = self._features("image", unknown, pixel_values=blend.photos)
            embeds["image"] = self._matched(features, "image", throw).to(embeds.get("touch", features).device)
        stacked = torch.stack([embeds[modality][rows] for _, modality, rows in used])
        weights = torch.tensor([weight for weight, _, _ in used], dtype=torch.float64, device=stacked.device)
        return apply_strength(stacked[0] if len(used) == 1 else MIXES[mix](stacked, weights), strength)

    # Checks -----------------------------------------------------------------------------------------------------------

    @classmethod
    def _plan(cls, request: Mapping[str, Any]) -> Plan:
        """The touch encoder is always there, as it has the sensors that touches are matched with."""
        _check_both_came(request["image"], request["touch"])
        image_weight, touch_weight = request["image_weight"], request["touch_weight"]
        if image_weight is None and isinstance(touch_weight, Real | list | tuple):
            shares = [item for item in _listed(touch_weight) if isinstance(item, Real)]
            image_weight = 1.0 - sum(check_number("touch_weight", share, 0.0, MAX_GAIN) for share in shares)
        return Plan(
            {
                "image encoder": not _weighs_nothing(image_weight),
                "touch encoder": True,
                "bank of image embeddings": request["bridge"] is not False and not _weighs_nothing(touch_weight),
                **cls._prompt_parts(request),
                "VAE": request["output_type"] != "latent" or request["init_strength"] != 1,
            }
        )

    def _blend(
        self,
        image: ImageInput,
        touch: ImageInput,
        image_weight: Weight | None,
        touch_weight: Weight,
        sensor: SensorNames,
        background: ImageInput,
    ) -> Blend:
        """What is mixed into each picture; no network runs."""
        _check_both_came(image, touch)
        prepared = self._prepare_touch(touch, sensor, background)
        photos, touches = self.processor.images(image), prepared.pixels
        if background is None:
            warn_of_exchange(self.unitouch, photos, touches)
        touch_weights = _weights("touch_weight", touch_weight, len(touches))
        if image_weight is None:
            rest = 1.0 - sum(touch_weights)
            if rest < 0:
                raise InvalidInputError(
                    f"`touch_weight` sums to {sum(touch_weights):g}, above 1; pass `image_weight`, too."
                )
            image_weight = rest
        image_weights = _weights("image_weight", image_weight, len(photos))
        sizes = [
            len(pixels) if len(weights) == 1 else 1
            for pixels, weights in ((photos, image_weights), (touches, touch_weights))
        ]
        batch_size = max(sizes)
        if min(sizes) not in (1, batch_size):
            raise InvalidInputError(
                f"`image` holds {len(photos)} photos and `touch` {len(touches)} touches; pass one, or one each, or a "
                "list of weights to mix them into one."
            )
        shares = iter(check_weights("touch_weight, image_weight", [*touch_weights, *image_weights]))
        parts = []
        for modality, pixels, weights in (("touch", touches, touch_weights), ("image", photos, image_weights)):
            for number in range(len(weights)):
                own = range(batch_size) if len(weights) == 1 and len(pixels) == batch_size else [number] * batch_size
                parts.append((next(shares), modality, list(own)))
        return Blend(photos, prepared, parts, batch_size)


def _check_both_came(image: Any, touch: Any) -> None:
    for name, value in (("image", image), ("touch", touch)):
        if value is None:
            raise InvalidInputError(
                f"`{name}` is missing; pass a photo as `image` and what it should feel like as `touch`."
            )


def _listed(weight: Any) -> Sequence[Any]:
    return weight if isinstance(weight, list | tuple) else [weight]


def _weighs_nothing(weight: Any) -> bool:
    return all(isinstance(item, Real) and item == 0 for item in _listed(weight))


def _weights(name: str, weight: Any, count: int) -> list[float]:
    """One weight for a batch, or one for each of `count` inputs that are mixed into one picture."""
    if not isinstance(weight, list | tuple):
        return [check_number(name, weight, 0.0, MAX_GAIN)]
    if len(weight) != count:
        raise InvalidInputError(
            f"`{name}` is {describe(weight)} for {count} inputs; pass one number, or one for each input to mix."
        )
    return [check_number(f"{name}[{number}]", item, 0.0, MAX_GAIN) for number, item in enumerate(weight)]


EXCHANGED = 0.45
"""A photo is taken for the touch where its distance to a sensor's prototype is below this share of the touch's own.

On an earlier built-in family and objects it was not trained on, that is so of no photo beside a touch of a sensor the
model knows, of 0.6 and 1.5 % beside those of the two it does not know, and where the two were exchanged, of 75 to 85 %
with the sensors it knows and of few with others."""


def warn_of_exchange(model: UniTouchModel, photos: Tensor, touches: Tensor) -> None:
    """Warns where photos are far nearer to a touch sensor's prototype than the touches that came with them.

    Args:
        model: Its sensors' prototypes are what both are compared with.
        photos, touches: Pixel values (B, 3, S, S); their means are compared.
    """
    _, sensor_bank = model.load("touch")
    if not bool(sensor_bank.known.any()):
        return
    photo, touch = (
        sum(match.distance or 0.0 for match in model.match_sensors(pixels)) / len(pixels)
        for pixels in (photos, touches)
    )
    if photo < EXCHANGED * touch:
        warnings.warn(
            f"`image` looks more like a touch than `touch` does ({photo:.2f} and {touch:.2f} of full scale from the "
            "nearest sensor's mean). Are the two exchanged?",
            ExchangedInputsWarning,
            stacklevel=5,
        )
