"""A probability-flow ODE: what solvers are measured on, whether its denoiser is exact or trained.

In the variance-exploding frame x = x_0 + sigma n it is dx/dsigma = (x - D(x, sigma)) / sigma (Karras et al., 2022,
Equation 3), from unit-variance noise taken as the variance-preserving state at the largest noise level.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from unitouch_gen.errors import check_choice
from unitouch_gen.numerics.cache import fingerprint
from unitouch_gen.sampling import Denoiser, Guidance
from unitouch_gen.schedulers.schedule import PREDICTION_TYPES, NoiseSchedule, to_denoised

DataPrediction = Callable[[Tensor, float], Tensor]
"""D: (x (B, C, h, w) float64 on the CPU, its noise level sigma) -> prediction of x_0, alike; guided, if there is."""


@dataclass(frozen=True, eq=False)
class Flow:
    """The ODE of one denoiser from the largest noise level of a schedule.

    Attributes:
        denoise: D.
        schedule: Where the flow starts and the network's knowledge ends.
        identity: Names all that `denoise` depends on, such as `fingerprint(...)` of it: references are kept under it.
        scale: Size of a coordinate of x_0; states are measured against sqrt(sigma^2 + scale^2).
        last_sigma: A noise level far below any structure of the data, for a flow that goes on to sigma = 0; `None`
            where the denoiser knows nothing below the schedule's smallest level.
    """

    denoise: DataPrediction
    schedule: NoiseSchedule
    identity: str
    scale: float = 1.0
    last_sigma: float | None = None

    def start(self, noise: Tensor) -> Tensor:
        """x at the largest noise level, float64 on the CPU: z = `noise` (B, C, h, w), x = z sqrt(1 + sigma^2)."""
        return noise.detach().cpu().double() * math.hypot(1.0, self.schedule.sigma_max)


def network_flow(
    network: Denoiser,
    schedule: NoiseSchedule,
    prediction_type: str,
    guidance: Guidance,
    *,
    identity: str,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Flow:
    """The flow of a trained network.

    Args:
        network: With its conditions bound, as for the sampling loop; called without autograd, at exact timesteps.
        schedule: That it was trained on.
        prediction_type: Of its output: "epsilon", "v_prediction" or "sample".
        guidance: Where active, the network gets a doubled batch, the unconditional half first.
        identity: Of its weights and conditions: `fingerprint(unet, hidden_states, class_labels)`. What else stands here
            is added.
        dtype, device: Of the states that it takes.

    Raises:
        InvalidInputError: If there is no such prediction type.
    """
    check_choice("prediction_type", prediction_type, PREDICTION_TYPES)
    time_dtype = torch.float64 if dtype == torch.float64 else torch.float32

    @torch.no_grad()
    def denoise(x: Tensor, sigma: float) -> Tensor:
        z = x / math.hypot(1.0, sigma)
        state = torch.cat([z] * 2) if guidance.active else z
        timestep = schedule.timestep(sigma).to(device, time_dtype)
        prediction = network(state.to(device, dtype), timestep).cpu().double()
        if guidance.active:
            prediction = guidance.combine(prediction)
        return to_denoised(prediction, z, sigma, prediction_type)

    whole = fingerprint(identity, prediction_type, guidance, dtype)
    return Flow(denoise, schedule, whole)
