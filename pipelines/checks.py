"""What every pipeline checks about a call, before any network runs."""

import warnings
from collections.abc import Sequence
from typing import Any

import torch
from diffusers import UNet2DConditionModel
from diffusers.callbacks import MultiPipelineCallbacks, PipelineCallback
from torch import Tensor

from unitouch_gen.embedding_bank import EmbeddingBank
from unitouch_gen.errors import (
    ExchangedInputsWarning,
    InvalidInputError,
    InvalidTypeError,
    UnfamiliarTouchWarning,
    check_choice,
    check_finite,
    check_integer,
    check_number,
    describe,
)
from unitouch_gen.models.joint import UniTouchModel
from unitouch_gen.models.sensors import SensorBank, SensorMatch
from unitouch_gen.schedulers.schedule import PREDICTION_TYPES

OUTPUT_TYPES: tuple[str, ...] = ("pil", "np", "pt", "latent")

Generators = torch.Generator | list[torch.Generator] | None

TIGHTEST = 1e-5
"""Tolerances below this are lost in the rounding of float32."""

MAX_GAIN = 1e6
"""Of guidance and strength; beyond this, float32 cannot hold a guided prediction and its parts at once."""


def check_call(
    *,
    height: Any,
    width: Any,
    multiple: int,
    num_inference_steps: Any,
    max_steps: int,
    guidance_scale: Any,
    eta: Any,
    output_type: Any,
    callback: Any,
    callback_inputs: Any,
    known_callback_inputs: Sequence[str],
) -> None:
    """The numbers of a call.

    Raises:
        InvalidInputError, InvalidTypeError: Naming the argument, what came, and what to do.
    """
    for name, side in (("height", height), ("width", width)):
        check_integer(name, side, multiple, hint=f"It has to be a multiple of {multiple}.")
        if side % multiple:
            lower = side // multiple * multiple
            raise InvalidInputError(
                f"`{name}` is {side}; it has to be a multiple of {multiple}, such as {lower} or {lower + multiple}."
            )
    check_integer("num_inference_steps", num_inference_steps, 1, max_steps)
    check_number("guidance_scale", guidance_scale, 0.0, MAX_GAIN, hint="Guidance is on above 1.")
    check_number("eta", eta, 0.0, 1.0)
    check_choice("output_type", output_type, OUTPUT_TYPES)
    if callback is not None and not callable(callback):
        raise InvalidTypeError(f"`callback_on_step_end` is {describe(callback)}; it has to be a function.")
    if not isinstance(callback_inputs, list | tuple):
        raise InvalidTypeError(
            f"`callback_on_step_end_tensor_inputs` is {describe(callback_inputs)}; it has to be a list of names."
        )
    for name in callback_inputs:
        check_choice("callback_on_step_end_tensor_inputs", name, known_callback_inputs)


def check_tolerance(tolerance: Any, max_evaluations: Any, **fixed: Any) -> None:
    """A tolerance that can be reached, and nothing beside it that fixes the steps.

    Raises:
        InvalidInputError, InvalidTypeError: Naming the argument, what came, and what to do.
    """
    if tolerance is None:
        if max_evaluations is not None:
            raise InvalidInputError(
                f"`max_evaluations` is {describe(max_evaluations)}, but no `tolerance` came, without which it has no "
                "effect; leave it out."
            )
        return
    check_number("tolerance", tolerance, TIGHTEST, 1.0, hint="It is a relative error of the latents in float32.")
    if max_evaluations is not None:
        check_integer("max_evaluations", max_evaluations, 2)
    for name, value in fixed.items():
        if value is not None:
            raise InvalidInputError(
                f"`{name}` is {describe(value)}, but `tolerance` came, which chooses solver and steps; leave one out."
            )


def check_callback(callback: Any, tolerance: Any) -> None:
    """diffusers' callbacks act at a number or a share of the steps, which a tolerance does not fix.

    Raises:
        InvalidInputError: If both came.
    """
    if tolerance is not None and isinstance(callback, PipelineCallback | MultiPipelineCallbacks):
        raise InvalidInputError(
            f"`callback_on_step_end` is {type(callback).__name__}, which counts steps, but `tolerance` came, which "
            "chooses them as it goes; pass `num_inference_steps` in its place, or a function that looks at its "
            "`timestep`."
        )


def check_interval(name: str, interval: Any, last: int) -> tuple[float, float] | None:
    """Shares of the noise levels, as the timesteps from 0 to `last` that they stand for; `None` for all of them.

    Raises:
        InvalidInputError, InvalidTypeError: If it is no pair of rising numbers in [0, 1].
    """
    if interval is None:
        return None
    if not isinstance(interval, list | tuple) or len(interval) != 2:
        raise InvalidTypeError(f"`{name}` is {describe(interval)}; it has to be two numbers, such as (0.2, 0.8).")
    low, high = (check_number(name, end, 0.0, 1.0, hint="0 is no noise, 1 is noise alone.") for end in interval)
    if low >= high:
        raise InvalidInputError(f"`{name}` is ({low:g}, {high:g}); the lower end comes first.")
    return None if (low, high) == (0.0, 1.0) else (low * last, high * last)


def check_has_flow(scheduler: Any) -> None:
    """Steps are chosen along the probability-flow ODE, which a scheduler has to know.

    Raises:
        InvalidInputError: If it does not.
    """
    if not hasattr(scheduler, "alphas_cumprod") or scheduler.config.get("prediction_type") not in PREDICTION_TYPES:
        raise InvalidInputError(
            f"`tolerance` came, but {type(scheduler).__name__} has no noise levels to choose from; leave it out."
        )


def check_one_source(touch: Any, touch_embeds: Any, **only_for_touch: Any) -> None:
    """Either touches or their embeddings, and with embeddings nothing that would be about the touches.

    Raises:
        InvalidInputError: Naming both arguments.
    """
    if (touch is None) == (touch_embeds is None):
        what = "both came" if touch is not None else "neither came"
        raise InvalidInputError(f"`touch` or `touch_embeds` has to be passed, one of them; {what}.")
    for name, value in only_for_touch.items():
        if touch is None and value is not None:
            raise InvalidInputError(
                f"`{name}` is {describe(value)}, but `touch_embeds` came, on which it has no effect; leave it out, or "
                "pass it to `encode_touch`, which makes the embeddings."
            )


def check_embeds(name: str, embeds: Any, width: int) -> Tensor:
    """Embeddings (B, width), floating-point and finite.

    Raises:
        InvalidInputError, InvalidTypeError: Naming the argument.
    """
    if not isinstance(embeds, Tensor):
        raise InvalidTypeError(f"`{name}` is {describe(embeds)}; it has to be a tensor (B, {width}).")
    if embeds.ndim != 2 or embeds.shape[1] != width or len(embeds) == 0:
        raise InvalidInputError(f"`{name}` is {describe(embeds)}; it has to be (B, {width}) with B of at least 1.")
    if not embeds.is_floating_point():
        raise InvalidTypeError(f"`{name}` is {describe(embeds)}; it has to hold floating-point numbers.")
    return check_finite(name, embeds)


def check_weights(name: str, weights: Sequence[Any]) -> list[float]:
    """Weights of a mix, >= 0 and finite, brought to a sum of 1.

    Raises:
        InvalidInputError, InvalidTypeError: If one is negative or no number, or all are 0.
    """
    numbers = [check_number(name, weight, 0.0, MAX_GAIN) for weight in weights]
    total = sum(numbers)
    if total == 0:
        raise InvalidInputError(f"`{name}` sums to 0; at least one weight has to be above 0.")
    return [number / total for number in numbers]


def check_sensor(sensor: Any) -> None:
    """A name, a list of them, or none; whether they fit the touches and the model is for the sensor bank to say.

    Raises:
        InvalidTypeError: If it is something else.
    """
    if not (sensor is None or isinstance(sensor, str | list | tuple)):
        raise InvalidTypeError(f"`sensor` is {describe(sensor)}; it has to be a name or a list of names.")


def warn_of_unfamiliar(bank: SensorBank, matches: Sequence[SensorMatch]) -> None:
    """Warns of touches that are unlike those of the sensors they were matched with; a call goes on with them."""
    names = ["`touch`"] if len(matches) == 1 else [f"`touch[{row}]`" for row in range(len(matches))]
    message = unfamiliar_touches(bank, [match.distance for match in matches], names)
    if message:
        warnings.warn(message, UnfamiliarTouchWarning, stacklevel=2)


EXCHANGED = 0.45
"""A photo is taken for the touch where its distance to a sensor's prototype is below this share of the touch's own.

On the built-in family and objects it was not trained on, that is so of no photo beside a touch of a sensor the model
knows, of 0.6 and 1.5 % beside those of the two it does not know, and where the two were exchanged, of 75 to 85 % with
the sensors it knows and of few with others."""


def warn_of_exchange(model: UniTouchModel, photos: Tensor, touches: Tensor) -> None:
    """Warns where photos are far nearer to a touch sensor's prototype than the touches that came with them.

    Args:
        model: Its sensors' prototypes are what both are compared with.
        photos, touches: Pixel values (B, 3, S, S); their means are compared.
    """
    if not bool(model.sensor_bank.known.any()):
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
            stacklevel=2,
        )


def unfamiliar_touches(bank: SensorBank, distances: Sequence[float | None], names: Sequence[str]) -> str:
    """One line on the touches that are unlike those of the sensors they were matched with; empty if there is none.

    Args:
        bank: Of the model that the touches are for.
        distances: Of each touch to the prototype of its sensor.
        names: What to call each touch.
    """
    rows = bank.unfamiliar(distances)
    if not rows:
        return ""
    shown, more = ", ".join(names[row] for row in rows[:3]), len(rows) - 3
    far = max(distance for distance in distances if distance is not None)
    if more > 0:
        shown = f"{shown} and {more} more"
    return (
        f"{shown}: unlike the touches that this model knows of the sensor ({far:.2f} of full scale from their mean, "
        f"where {bank.reach:g} is far), so expect a guess. Is it a touch image, and the sensor right?"
    )


def check_latents(latents: Any, shape: tuple[int, ...]) -> None:
    """Start noise of exactly the shape that the call needs, finite.

    Raises:
        InvalidInputError, InvalidTypeError: Naming the argument.
    """
    if not isinstance(latents, Tensor):
        raise InvalidTypeError(f"`latents` is {describe(latents)}; it has to be a tensor {shape}.")
    if tuple(latents.shape) != shape:
        raise InvalidInputError(f"`latents` is {describe(latents)}; this call needs {shape}.")
    if not latents.is_floating_point():
        raise InvalidTypeError(f"`latents` is {describe(latents)}; it has to hold floating-point numbers.")
    check_finite("latents", latents)


def check_generators(generator: Any, total: int) -> None:
    """One generator, one for each of `total` pictures, or none.

    Raises:
        InvalidInputError, InvalidTypeError: Naming the argument.
    """
    if generator is None or isinstance(generator, torch.Generator):
        return
    if not isinstance(generator, list) or not all(isinstance(item, torch.Generator) for item in generator):
        raise InvalidTypeError(f"`generator` is {describe(generator)}; pass a torch.Generator or a list of them.")
    if len(generator) != total:
        raise InvalidInputError(
            f"`generator` is a list of {len(generator)} for {total} pictures; pass one, or one for each picture."
        )


def check_prompts(
    name: str, prompt: Any, embeds: Any, batch_size: int, default: str, pipeline: Any, used: bool = True
) -> list[str] | None:
    """Prompts as a list of `batch_size`, or `None` where embeddings (1 or `batch_size`, T, C) came in their place.

    Args:
        name: "prompt" or "negative_prompt".
        prompt, embeds: What came; at most one of them.
        batch_size: Number of touches.
        default: The prompt when none came.
        pipeline: Its UNet says the width C, and it encodes the prompts.
        used: Whether the prompts will be encoded; if not, the pipeline needs no text encoder.

    Raises:
        InvalidInputError, InvalidTypeError: Naming the argument.
    """
    if embeds is not None:
        if prompt is not None:
            raise InvalidInputError(f"Pass either `{name}` or `{name}_embeds`, not both.")
        width = pipeline.unet.config.cross_attention_dim
        if not isinstance(embeds, Tensor) or embeds.ndim != 3 or embeds.shape[-1] != width:
            raise InvalidInputError(f"`{name}_embeds` is {describe(embeds)}; it has to be (B, T, {width}).")
        if len(embeds) not in (1, batch_size):
            raise InvalidInputError(
                f"`{name}_embeds` holds {len(embeds)} prompts for {batch_size} inputs; pass 1 or {batch_size}."
            )
        check_finite(f"{name}_embeds", embeds)
        return None
    prompt = default if prompt is None else prompt
    prompts = [prompt] * batch_size if isinstance(prompt, str) else prompt
    if not isinstance(prompts, list | tuple) or not all(isinstance(item, str) for item in prompts):
        raise InvalidTypeError(f"`{name}` is {describe(prompt)}; it has to be a string or a list of strings.")
    if len(prompts) == 1:
        prompts = list(prompts) * batch_size
    if len(prompts) != batch_size:
        raise InvalidInputError(f"`{name}` is a list of {len(prompts)} for {batch_size} inputs; pass one, or one each.")
    if used and (pipeline.text_encoder is None or pipeline.tokenizer is None):
        raise InvalidInputError(f"`{name}` is needed, but this pipeline has no text encoder; pass `{name}_embeds`.")
    return list(prompts)


def check_prompt_lengths(prompt_embeds: Tensor | None, negative_prompt_embeds: Tensor | None, tokenizer: Any) -> None:
    """Guidance puts both branches into one batch, so they need the same number of tokens.

    Raises:
        InvalidInputError: If they differ; prompts that are no embeddings have as many as the tokenizer makes.
    """
    length, negative = (
        tokenizer.model_max_length if embeds is None else embeds.shape[1]
        for embeds in (prompt_embeds, negative_prompt_embeds)
    )
    if length != negative:
        raise InvalidInputError(
            f"`prompt_embeds` hold {length} tokens and `negative_prompt_embeds` {negative}; pass both, of one length."
        )


def check_parts(
    unet: UNet2DConditionModel,
    sensors: Sequence[str],
    unitouch: UniTouchModel | None,
    embedding_bank: EmbeddingBank | None,
) -> None:
    """Refuses parts of an X-to-touch pipeline whose widths or class labels do not fit each other."""
    width, labels = unet.config.cross_attention_dim, unet.config.num_class_embeds or 0
    if unet.config.class_embed_type is not None:
        raise InvalidInputError(
            f"`unet` is conditioned on class labels of the kind {unet.config.class_embed_type!r}, as unCLIP's are; "
            "touch is drawn by networks of numbered classes, one for each sensor, or of none."
        )
    if labels != len(sensors):
        raise InvalidInputError(
            f"`sensors` names {len(sensors)}, but `unet` has {labels} class labels; name each of them."
        )
    for name, found in (
        ("unitouch", unitouch and unitouch.config.projection_dim),
        ("embedding_bank", embedding_bank and embedding_bank.config.embedding_dim),
    ):
        if found is not None and found != width:
            raise InvalidInputError(
                f"`{name}` has embeddings of width {found}, but `unet` attends to width {width}; use parts of one "
                "width."
            )
