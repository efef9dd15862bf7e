"""Arguments of sampling, with kinds, bounds and defaults, for calls of pipelines, the command line and the page."""

from collections.abc import Sequence
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from unitouch_gen.errors import plain_integer

MAX_SCALE = 1e6  # of guidance, strength and weights: beyond it float32 loses a prediction's smaller parts

Integer = Annotated[int, BeforeValidator(plain_integer)]


class SamplingArguments(BaseModel):
    """Arguments that are the same for all pictures of a call, as `errors.check_fields` makes them of a user's values.

    Pipelines have defaults of their own for some; `None` is the UNet's size, or the usual number of steps.
    """

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)

    # Size and number of pictures
    height: Integer | None = Field(None, ge=1, le=16_384, description="Height of the picture in pixels.")
    width: Integer | None = Field(None, ge=1, le=16_384, description="Width of the picture in pixels.")
    num_images_per_prompt: Integer = Field(1, ge=1, le=100_000, description="Number of pictures for each input.")

    # Steps
    num_inference_steps: Integer | None = Field(None, ge=1, description="Number of solver steps.")
    timesteps: Sequence[Integer] | None = Field(None, description="Descending timesteps, in place of their number.")
    solver: str | None = Field(None, description="Name of a solver, such as ddim or dpm++2m.")
    tolerance: float | None = Field(
        None, ge=1e-5, le=1.0, description="Relative error of the latents, in place of a number of steps."
    )
    max_evaluations: Integer | None = Field(
        None, ge=2, description="Maximum network evaluations; applies only with `tolerance`."
    )
    eta: float = Field(0.0, ge=0.0, le=1.0, description="Share of DDPM's noise that DDIM adds.")
    init_strength: float = Field(1.0, ge=0.0, le=1.0, description="Share of the steps to run from the photo's latents.")

    # Conditioning
    guidance_scale: float = Field(1.0, ge=0.0, le=MAX_SCALE, description="Guidance scale; active above 1.")
    strength: float = Field(1.0, ge=0.0, le=MAX_SCALE, description="Scale of the touch embedding.")
    noise_level: Integer = Field(0, ge=0, description="Noise added to the embedding: more noise, more variety.")
    bridge: bool | None = Field(None, description="Whether to move embeddings towards stored image embeddings.")
    touch_weight: float | None = Field(None, ge=0.0, le=MAX_SCALE, description="Weight of the touch in the mix.")
    image_weight: float | None = Field(None, ge=0.0, le=MAX_SCALE, description="Weight of the photo in the mix.")
    mix: Literal["linear", "paper"] = Field("linear", description="How the embeddings are mixed.")
    layout: Integer | None = Field(
        14, ge=2, description="Cells along the shorter side of the grid that holds the photo's layout."
    )
    keep_colours: bool = Field(False, description="Whether to keep the photo's mean colour, too.")

    # Results
    output_type: Literal["pil", "np", "pt", "latent"] = "pil"
    throw: bool = True


def description(name: str) -> str | None:
    """What a sampling argument is, for helps of options and the page."""
    return SamplingArguments.model_fields[name].description


def bounds(name: str) -> tuple[Any, Any]:
    """Smallest and largest value of a sampling argument; `None` where it has no bound."""
    constraints = SamplingArguments.model_fields[name].metadata
    low = next((one.ge for one in constraints if hasattr(one, "ge")), None)
    high = next((one.le for one in constraints if hasattr(one, "le")), None)
    return low, high
