"""What a call may say of its steps; runs in which samples break or diverge; and the report."""

import itertools
import json
import math
import time
from contextlib import suppress
from dataclasses import replace

import diffusers
import pytest
import torch

from unitouch_gen.arguments import SamplingArguments
from unitouch_gen.errors import NonFiniteError, check_fields
from unitouch_gen.numerics.problems import PROBLEMS, STABLE_DIFFUSION, relative_rms
from unitouch_gen.sampling import ReturnCode, RunReport, prepare_steps
from unitouch_gen.schedule import alpha
from unitouch_gen.solvers import DIVERGED_RMS, SOLVERS, sample_adaptive

SUCCESS = ReturnCode.SUCCESS
NON_FINITE = ReturnCode.NON_FINITE
DIVERGED = ReturnCode.DIVERGED
PLAIN = PROBLEMS["conditioning-1e2"]
GUIDED = PROBLEMS["gaussian-guided"]
OWN = PLAIN.scheduler()


def run(network=None, problem=PLAIN, **options):
    """(latents, report) of three samples."""
    return problem.run(problem.noise(3), network=network, **{"solver": "dpm++2m", "num_inference_steps": 8, **options})


def steps_of(scheduler=OWN, **arguments):
    return prepare_steps(scheduler, check_fields(SamplingArguments, arguments))[0]


# What a call may say of its steps -------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.9, 0.5, 0.3])
@pytest.mark.parametrize(
    "how",
    [
        "ddim",
        "unipc",
        diffusers.DDIMScheduler(**STABLE_DIFFUSION),
        diffusers.HeunDiscreteScheduler(),
        diffusers.PNDMScheduler(skip_prk_steps=True, **STABLE_DIFFUSION),
        diffusers.LCMScheduler(),
        diffusers.UniPCMultistepScheduler(use_exponential_sigmas=True, prediction_type="v_prediction"),
        diffusers.EulerDiscreteScheduler(use_karras_sigmas=True),
        diffusers.TCDScheduler(),
    ],
)
def test_a_start_lies_at_its_share_whatever_the_number_of_steps(how, share):
    given = {"scheduler": OWN, "solver": how} if isinstance(how, str) else {"scheduler": how}

    def start(count: int) -> float:
        steps = steps_of(**given, num_inference_steps=count, init_strength=share)
        if isinstance(steps, list):
            assert len(steps) == max(round(share * count), 1) + 1
            return math.log(steps[0])
        assert steps.num_inference_steps == max(round(share * count), 1)
        signal = steps.add_noise(torch.ones(1), torch.zeros(1), steps.timesteps[:1]).item()
        noise = steps.add_noise(torch.zeros(1), torch.ones(1), steps.timesteps[:1]).item()
        return math.log(noise / signal)

    starts = [start(count) for count in (1, 2, 3, 4, 10, 50)]
    assert max(starts) - min(starts) < 1e-3
    if "solver" in given:
        whole = steps_of(**given, num_inference_steps=100)
        assert starts[0] == pytest.approx(math.log(whole[round(100 * (1 - share))]), abs=0.1)


# Samples that break or diverge ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("solver", "value"), [*zip(SOLVERS, itertools.cycle([math.nan, math.inf]))])
def test_a_sample_that_breaks_raises_or_leaves_the_others_as_if_alone(solver, value):
    """Also in multistep solvers, whose memory of the broken sample is not finite for some steps."""

    def breaking():
        calls = []
        network = PLAIN.network(3)

        def predict(z, timestep):
            calls.append(timestep)
            prediction = network(z, timestep)
            prediction[1] = value if len(calls) == 3 else prediction[1]
            return prediction

        return predict

    with pytest.raises(NonFiniteError, match=r"Sample 1 is not finite after step [23]"):
        run(breaking(), solver=solver)
    latents, report = run(breaking(), solver=solver, throw=False)
    assert torch.equal(latents[[0, 2]], run(solver=solver)[0][[0, 2]])
    assert report.failed_at[1] in (1, 2)
    assert report.codes == [SUCCESS, NON_FINITE, SUCCESS]


def test_a_diverged_sample_does_not_hold_steps_to_a_tolerance_up():
    sigmas = steps_of(tolerance=0.05)
    start = PLAIN.noise(3) * math.hypot(1.0, sigmas[0])

    def put(step, x, sigma):
        if step == 2:
            x = x.clone()
            x[0] = 2 * DIVERGED_RMS / alpha(sigma) * x[0].sign()
        return x

    def samples(callback):
        evaluations = []
        denoise = lambda x, sigma: evaluations.append(sigma) or PLAIN.denoise(x, sigma)  # noqa: E731
        return sample_adaptive(denoise, start, sigmas, 0.05, callback)[0], len(evaluations)

    found, evaluations = samples(put)
    whole, alone = samples(lambda step, x, sigma: x)
    assert evaluations <= alone + 2
    assert relative_rms(found, whole)[1:].max() < 0.05


@pytest.mark.parametrize("solver", SOLVERS)
def test_sound_runs_are_a_success_and_too_few_steps_for_a_guidance_diverge(solver):
    assert run(problem=replace(GUIDED, guidance_scale=30.0), solver=solver, num_inference_steps=50)[1].success
    _, report = run(problem=replace(GUIDED, guidance_scale=1000.0), solver=solver, num_inference_steps=6, throw=False)
    assert report.codes[0] in (DIVERGED, NON_FINITE)


# The report -----------------------------------------------------------------------------------------------------------


def test_a_report_adds_up_the_seconds_of_a_stage_also_where_it_fails():
    report = RunReport()
    started = time.perf_counter()
    for _ in range(2):
        with suppress(KeyError), report.stage("touch"):
            time.sleep(0.01)
            raise KeyError
    assert 0.02 <= report.seconds["touch"] <= time.perf_counter() - started


def test_a_report_is_one_line_and_goes_through_json_as_a_copy():
    report = RunReport(
        solver="unipc",
        steps=10,
        evaluations=10,
        seconds={"touch": 0.25, "denoising": 1.5},
        codes=[SUCCESS, NON_FINITE],
        failed_at={1: 3},
        left_out=["VAE"],
        unknown={"touch": ["unlike anything known", None]},
    )
    values = json.loads(json.dumps(report.to_dict()))
    assert values["codes"] == ["success", "non_finite"]
    assert values["failed_at"] == {"1": 3}
    assert values["seconds"] == report.seconds
    report.to_dict()["left_out"].append("x")
    assert report.left_out == ["VAE"]
    assert "\n" not in str(report)
    for part in ("unipc: 10 steps, 10 evaluations, 1.75 s (touch", "success, non_finite; 1 of the inputs unknown"):
        assert part in str(report)
    assert str(RunReport(codes=[SUCCESS])).endswith("0 evaluations, 0.00 s (); all finite")


def test_every_return_code_has_a_message():
    assert all(code.message.endswith(".") for code in ReturnCode)
