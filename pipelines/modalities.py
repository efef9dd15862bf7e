"""What a call of `XToTouchPipeline` is given, planned, checked and ready to be encoded; no network has run yet."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from unitouch_gen.errors import InvalidInputError, InvalidTypeError, check_choice, check_finite, describe, did_you_mean
from unitouch_gen.models.joint import MODALITIES
from unitouch_gen.models.sensors import SensorMatch
from unitouch_gen.pipelines.base import JointSpacePipeline, SensorNames
from unitouch_gen.pipelines.checks import check_weights
from unitouch_gen.plan import Plan, guidance_of

BRIDGES = ("nearest",)
"""How a condition may be moved towards the images the model was trained on; the first is what `True` means."""

ALL = "all"
"""In place of a sensor's name: every sensor there is."""

Bridge = str | bool | None


@dataclass
class Modalities:
    """Inputs of one or several modalities.

    Attributes:
        encoders: What makes features (1 or B, D) of each modality.
        weights: Of each modality that has any, summing to 1.
        batch_size: B.
        matches: Sensor of each touch, if touches came.
    """

    encoders: dict[str, Callable[[], Tensor]]
    weights: dict[str, float]
    batch_size: int
    matches: list[SensorMatch]


def plan_of_modalities(request: Mapping[str, Any]) -> Plan:
    """The plan of a call of `XToTouchPipeline`.

    Raises:
        InvalidInputError: If nothing came.
    """
    modalities = [name for name in MODALITIES if request[name] is not None]
    if request["condition_embeds"] is None:
        check_something_came(modalities)
    bridged = request["bridge"] not in (None, False) and any(name != "image" for name in modalities)
    if isinstance(request["weights"], Mapping):
        modalities = [name for name in modalities if request["weights"].get(name, 1) != 0]
    ranked = request["num_candidates"] != 1  # by the touch encoder, of decoded images
    return Plan(
        modalities=tuple(name for name in MODALITIES if name in modalities or (ranked and name == "touch")),
        known_modalities=MODALITIES,
        embedding_bank=bridged,
        guidance=guidance_of(request["guidance_scale"], request["guidance_interval"]),
        vae=request["output_type"] != "latent" or ranked,
    )


def prepare_modalities(
    pipeline: JointSpacePipeline,
    *,
    image: Any,
    text: Any,
    audio: Any,
    touch: Any,
    weights: Any,
    sampling_rate: int | None,
    source_sensor: Any,
) -> Modalities:
    """Reads and checks whatever came.

    Raises:
        InvalidInputError, InvalidTypeError: If nothing came, it cannot be read, or the modalities' numbers do not fit.
    """
    given = {"image": image, "text": text, "audio": audio, "touch": touch}
    given = {name: value for name, value in given.items() if value is not None}
    check_something_came(given)
    model, processor, device = pipeline.unitouch, pipeline.processor, pipeline._execution_device
    if model is None or processor is None:
        raise InvalidInputError(
            f"`{next(iter(given))}` came, but this pipeline has no `unitouch` and `processor`; pass "
            "`condition_embeds` instead."
        )
    for name, value, modality in (("source_sensor", source_sensor, "touch"), ("sampling_rate", sampling_rate, "audio")):
        if value is not None and modality not in given:
            raise InvalidInputError(f"`{name}` came without `{modality}`, on which it has no effect; leave it out.")
    shares = _shares(weights, given)

    encoders: dict[str, Callable[[], Tensor]] = {}
    sizes: dict[str, int] = {}
    matches: list[SensorMatch] = []
    if "image" in given:
        pictures = processor.images(image)
        encoders["image"], sizes["image"] = lambda: model.get_image_features(pictures.to(device)), len(pictures)
    if "text" in given:
        check_not_blank(text)
        tokens = {name: ids.to(device) for name, ids in processor.text(text).items()}
        encoders["text"], sizes["text"] = lambda: model.get_text_features(**tokens), len(tokens["input_ids"])
    if "audio" in given:
        clips = processor.sounds(audio, sampling_rate, audible=True)
        encoders["audio"], sizes["audio"] = lambda: model.get_audio_features(clips.to(device)), len(clips)
    if "touch" in given:
        if "touch" in shares:
            pixels, matches = pipeline._prepare_touch(touch, source_sensor, None)
        else:  # of no weight: neither sensor nor encoder are asked
            pixels = processor.touch(touch)
        encoders["touch"], sizes["touch"] = lambda: pipeline._touch_features(pixels, matches), len(pixels)
    batch_size = max(sizes.values())
    for name, size in sizes.items():
        if size not in (1, batch_size):
            raise InvalidInputError(
                f"`{name}` holds {size} inputs, where another modality holds {batch_size}; pass one, or one each."
            )
    return Modalities(encoders, shares, batch_size, matches)


def bridge_of(bridge: Bridge) -> str | None:
    """The name of a bridge, or `None` for none.

    Raises:
        InvalidInputError: If there is no such bridge.
    """
    if bridge is None or isinstance(bridge, bool):
        return BRIDGES[0] if bridge else None
    return check_choice("bridge", bridge, BRIDGES, hint="True means the first of them, None or False none.")


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
        check_choice("sensor", name, known, hint=f"{ALL!r} in place of a name draws each of them.") for name in chosen
    ]
    return names * batch_size if len(names) == 1 else names


def check_something_came(given: Collection[str]) -> None:
    """Refuses a call to which nothing came.

    Raises:
        InvalidInputError: If so.
    """
    if not given:
        raise InvalidInputError(
            "Nothing to make a touch of came; pass `image`, `text`, `audio`, `touch` or `condition_embeds`."
        )


def check_condition_embeds(embeds: Any, width: int, others: Mapping[str, Any]) -> int:
    """B of embeddings that came in the place of the modalities.

    Args:
        embeds: (B, 1, D), finite.
        width: D.
        others: Arguments that have no effect beside them, by name; all have to be `None`.

    Raises:
        InvalidInputError, InvalidTypeError: Naming the argument.
    """
    for name, value in others.items():
        if value is not None:
            raise InvalidInputError(
                f"`{name}` is {describe(value)}, but `condition_embeds` came, on which it has no effect; pass one "
                "of them, or mix in `encode_condition`."
            )
    if not isinstance(embeds, Tensor) or not embeds.is_floating_point():
        raise InvalidTypeError(f"`condition_embeds` is {describe(embeds)}; it has to be a tensor (B, 1, {width}).")
    if embeds.ndim != 3 or embeds.shape[1:] != (1, width) or len(embeds) == 0:
        raise InvalidInputError(f"`condition_embeds` is {describe(embeds)}; it has to be (B, 1, {width}).")
    check_finite("condition_embeds", embeds)
    return len(embeds)


def _shares(weights: Any, given: Mapping[str, Any]) -> dict[str, float]:
    """Of each modality that came and weighs anything, summing to 1; all the same where no weights came."""
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


def check_not_blank(text: Any) -> None:
    """Refuses a description that says nothing; what is no string is for the processor to refuse.

    Raises:
        InvalidInputError: Naming the first such.
    """
    for number, item in enumerate(text if isinstance(text, list | tuple) else [text]):
        if isinstance(item, str) and not item.strip():
            where = f"`text[{number}]`" if isinstance(text, list | tuple) else "`text`"
            raise InvalidInputError(f"{where} is blank; describe what is touched, such as 'rough brick'.")
