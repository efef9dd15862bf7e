"""What came for each sense, checked and ready to be encoded; no network has run yet."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from unitouch_gen.encoders.model import SENSES
from unitouch_gen.encoders.sensors import SensorMatch
from unitouch_gen.errors import InvalidInputError, InvalidTypeError, describe, did_you_mean
from unitouch_gen.pipelines.base import JointSpacePipeline
from unitouch_gen.pipelines.checks import check_weights


@dataclass
class Senses:
    """Inputs of one or several senses.

    Attributes:
        encoders: What makes features (1 or B, D) of each sense.
        weights: Of each sense that has any, summing to 1.
        batch_size: B.
        matches: Sensor of each touch, if touches came.
    """

    encoders: dict[str, Callable[[], Tensor]]
    weights: dict[str, float]
    batch_size: int
    matches: list[SensorMatch]


def prepare_senses(
    pipeline: JointSpacePipeline,
    *,
    image: Any,
    text: Any,
    audio: Any,
    touch: Any,
    weights: Any,
    sampling_rate: int | None,
    touch_sensor: Any,
) -> Senses:
    """Reads and checks whatever came.

    Raises:
        InvalidInputError, InvalidTypeError: If nothing came, it cannot be read, or the senses' numbers do not fit.
    """
    given = {"image": image, "text": text, "audio": audio, "touch": touch}
    given = {name: value for name, value in given.items() if value is not None}
    if not given:
        raise InvalidInputError(
            "Nothing to make a touch of came; pass `image`, `text`, `audio`, `touch` or `condition_embeds`."
        )
    model, processor, device = pipeline.unitouch, pipeline.processor, pipeline._execution_device
    if model is None or processor is None:
        raise InvalidInputError(
            f"`{next(iter(given))}` came, but this pipeline has no `unitouch` and `processor`; pass "
            "`condition_embeds` instead."
        )
    for name, value, sense in (("touch_sensor", touch_sensor, "touch"), ("sampling_rate", sampling_rate, "audio")):
        if value is not None and sense not in given:
            raise InvalidInputError(f"`{name}` came without `{sense}`, on which it has no effect; leave it out.")
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
        pixels, matches = pipeline._prepare_touch(touch, touch_sensor, None)
        encoders["touch"], sizes["touch"] = lambda: pipeline._touch_features(pixels, matches), len(pixels)
    batch_size = max(sizes.values())
    for name, size in sizes.items():
        if size not in (1, batch_size):
            raise InvalidInputError(
                f"`{name}` holds {size} inputs, where another sense holds {batch_size}; pass one, or one each."
            )
    return Senses(encoders, shares, batch_size, matches)


def _shares(weights: Any, given: Mapping[str, Any]) -> dict[str, float]:
    """Of each sense that came and weighs anything, summing to 1; all the same where no weights came."""
    if weights is None:
        return dict.fromkeys(given, 1.0 / len(given))
    if not isinstance(weights, Mapping):
        raise InvalidTypeError(f"`weights` is {describe(weights)}; it has to be a dictionary of senses and numbers.")
    came = ", ".join(f"`{name}`" for name in given)
    for name in weights:
        if name not in SENSES:
            hint = did_you_mean(name, SENSES)
            raise InvalidInputError(
                f"`weights` names {describe(name)}, which is no sense; {came} came, so weigh "
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
    """Refuses a description that says nothing; what is no string is for the processor to refuse."""
    for number, item in enumerate(text if isinstance(text, list | tuple) else [text]):
        if isinstance(item, str) and not item.strip():
            where = f"`text[{number}]`" if isinstance(text, list | tuple) else "`text`"
            raise InvalidInputError(f"{where} is blank; describe what is touched, such as 'rough brick'.")
