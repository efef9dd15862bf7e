"""Cases on pipelines that are passed in: what they are given, and the networks they run.

Pictures are small and steps few, as what makes a case hard is neither.
"""

import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from unitouch_gen.errors import UnfamiliarTouchWarning
from unitouch_gen.numerics.stability import Case, Ended, ends, largest_error, raises, refused
from unitouch_gen.sampling import ReturnCode
from unitouch_gen.world import World

SUCCESS, NON_FINITE, DIVERGED = ReturnCode.SUCCESS, ReturnCode.NON_FINITE, ReturnCode.DIVERGED
RATE = 16_000
NAN, INF = math.nan, math.inf

Make = Callable[[str, torch.dtype], Any]
"""(name, dtype of the networks) -> pipeline; names are "touch-to-image", "stylization" and "x-to-touch"."""

SIDE = 32

SMALL = {
    "height": SIDE,
    "width": SIDE,
    "num_inference_steps": 2,
    "guidance_scale": 2.0,
    "output_type": "pt",
    "throw": False,
}
"""Of a call, where a case says nothing."""

QUICK: dict[str, Any] = {"height": 16, "width": 16, "guidance_scale": 1.0, "output_type": "latent"}
"""Of a call that is long."""


@cache
def contact() -> Any:
    """One contact of the world, seen and felt."""
    return World().render([5], [200], [0], modalities=("image", "touch"))


def inputs(kind: str) -> dict[str, Any]:
    """What each pipeline is given where a case says nothing."""
    seen, felt = {"image": contact().image}, {"touch": contact().touch["gelsight"]}
    return {"touch-to-image": felt, "stylization": {**seen, **felt}, "x-to-touch": seen}[kind]


SHAPES: dict[str, Callable[[Any], tuple[int, ...]]] = {
    "touch_embeds": lambda pipe: (1, pipe.embedding_dim),
    "condition_embeds": lambda pipe: (1, 1, pipe.embedding_dim),
    "prompt_embeds": lambda pipe: (1, 77, pipe.unet.config.cross_attention_dim),
    "latents": lambda pipe: (1, pipe.unet.config.in_channels, *[SIDE // pipe.vae_scale_factor] * 2),
}
"""Of tensors that a call may be given, for one small picture."""


@dataclass(frozen=True)
class Noise:
    """In place of a tensor whose shape only a pipeline knows: what becomes of noise of that shape."""

    change: Callable[[Tensor], Any] = lambda noise: noise

    def of(self, name: str, pipe: Any) -> Any:
        """For an argument of a pipeline."""
        return self.change(torch.randn(SHAPES[name](pipe), generator=torch.Generator().manual_seed(1)))


class Trial:
    """Calls of the pipelines, with what a case changes."""

    def __init__(self, make: Make):
        self.make = make

    def call(self, kind: str, dtype: torch.dtype = torch.float32, **arguments: Any) -> Any:
        """The output of one call; arguments that are given take the place of the usual ones."""
        usual: dict[str, Any] = {"generator": torch.Generator().manual_seed(0)}
        if not {"touch_embeds", "condition_embeds", "text", "audio"} & set(arguments):
            usual |= inputs(kind)
        if "tolerance" in arguments:
            usual |= {key: value for key, value in SMALL.items() if key != "num_inference_steps"}
        else:
            usual |= SMALL
        pipe = self.make(kind, dtype)
        given = {
            name: value.of(name, pipe) if isinstance(value, Noise) else value
            for name, value in {**usual, **arguments}.items()
        }
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UnfamiliarTouchWarning)  # they are to be unfamiliar
            return pipe(**given)

    def run(self, kind: str, truth: Callable[[], Tensor] | None = None, **arguments: Any) -> Ended:
        """How one call ended; `truth` is what should come out, (b, ...)."""
        output = self.call(kind, **arguments)
        images = output.images
        if isinstance(images, list):
            images = torch.stack([torch.from_numpy(np.array(image)).float() for image in images] or [torch.empty(0)])
        images = torch.as_tensor(images)
        error = math.nan if truth is None else largest_error(images, truth())
        return Ended(output.report.codes, images, error)

    def ends(self, name: str, kind: str, code: Any = SUCCESS, bound: float = math.inf, **arguments: Any) -> Case:
        """A call has to end with a code."""
        return ends(name, partial(self.run, kind, **arguments), code, bound)

    def refused(self, name: str, kind: str, named: str, **arguments: Any) -> Case:
        """A call has to be refused by the name of an argument."""
        return refused(name, partial(self.call, kind, **arguments), named)


# Numbers of a call ----------------------------------------------------------------------------------------------------

NUMBERS: dict[str, tuple[list[Any], list[Any]]] = {
    "guidance_scale": ([0, 0.5, 1, 1.0001, 7.5], [-5, -1e-9, NAN, INF, -INF, 1e7, "9", True]),
    "num_inference_steps": ([1], [0, -1, 1001, 2.5, "50", True, NAN]),
    "noise_level": ([0, 1, 999], [-1, 1000, 1.5, NAN]),
    "strength": ([0, 1e-30, 1e3, 1e6], [-1, NAN, INF, 1e7]),
    "eta": ([0, 1], [-1, 2, NAN]),
    "height": ([4, 8, 20, 36, 128], [0, -64, 65, 1, 32.5]),
    "num_images_per_prompt": ([3], [0, -1, 1.5]),
    "guidance_interval": ([(0, 1), (0.2, 0.8), (0, 1e-9)], [(0.8, 0.2), (0.5, 0.5), (NAN, 1), (0, 2), 0.5, (0,)]),
    "tolerance": ([1.0, 0.1], [0, -1, 2, 1e-6, NAN, INF, "tight"]),
    "output_type": (["pil", "np", "latent"], ["bogus", "", 3]),
    "solver": (["ddim", "euler", "heun", "dpm++2m", "unipc", "deis"], ["eulr", "", 3]),
}
"""Of touch to image: what has to work, and what has to be refused."""


def number_cases(trial: Trial) -> Iterator[Case]:
    """Every number of a call from end to end, and beyond."""
    kind = "touch-to-image"
    for name, (fine, wrong) in NUMBERS.items():
        for value in fine:
            yield trial.ends(f"{name}={value}", kind, **{name: value})
        for value in wrong:
            yield trial.refused(f"{name}={value!r}", kind, name, **{name: value})
    for scale in (1000, 1e6):
        yield trial.ends(f"guidance_scale={scale}", kind, DIVERGED, guidance_scale=scale)
    yield trial.ends("guidance_scale 30 in 10 steps", kind, guidance_scale=30, num_inference_steps=10)
    beyond = partial(trial.call, kind, guidance_scale=1e6, throw=True)
    yield raises("guidance_scale 1e6, raising", beyond, DIVERGED)
    for scale, code in ((0, SUCCESS), (1000, DIVERGED)):
        yield trial.ends(f"guidance_scale {scale}, x to touch", "x-to-touch", code, guidance_scale=scale)
    thousand: dict[str, Any] = {**QUICK, "num_inference_steps": 1000}
    yield trial.ends("1000 steps, x to touch", "x-to-touch", **thousand)
    for solver in ("euler", "heun"):
        yield trial.refused(f"1 step of {solver}", kind, "num_inference_steps", solver=solver, num_inference_steps=1)
    few: dict[str, Any] = {"tolerance": 1e-4, "max_evaluations": 3}
    yield trial.ends("tolerance within 3 evaluations", kind, ReturnCode.MAX_EVALUATIONS, **few)
    yield raises(
        "tolerance within 3 evaluations, raising",
        partial(trial.call, kind, throw=True, **few),
        ReturnCode.MAX_EVALUATIONS,
    )
    yield trial.refused("tolerance beside steps", kind, "num_inference_steps", tolerance=0.1, num_inference_steps=2)
    yield trial.refused("max_evaluations alone", kind, "max_evaluations", max_evaluations=5)
    for name, fine, wrong in (("init_strength", [0, 1e-9, 1], [-0.1, 1.1, NAN]), ("touch_weight", [0, 1], [-1, NAN])):
        for value in fine:
            yield trial.ends(f"{name}={value}", "stylization", **{name: value})
        for value in wrong:
            yield trial.refused(f"{name}={value}", "stylization", name, **{name: value})
    yield trial.refused("guidance_rescale, which is not there", kind, "guidance_rescale", guidance_rescale=0.7)

    def sets_guidance(value: float) -> Callable[..., dict]:
        def callback(pipe: Any, step: int, timestep: Tensor, tensors: dict) -> dict:
            pipe._guidance_scale = value
            return {}

        return callback

    for value, code in ((0.0, SUCCESS), (-5.0, SUCCESS), (1000.0, SUCCESS), (NAN, NON_FINITE), (INF, NON_FINITE)):
        yield trial.ends(f"guidance {value} from a callback", kind, code, callback_on_step_end=sets_guidance(value))

    def interrupts(pipe: Any, step: int, timestep: Tensor, tensors: dict) -> dict:
        pipe._interrupt = True
        return {}

    for raising in (False, True):
        name = f"an interrupt{', raising' if raising else ''}"
        yield trial.ends(name, kind, ReturnCode.INTERRUPTED, callback_on_step_end=interrupts, throw=raising)
    for value in (NAN, INF):
        yield trial.ends(
            f"latents {value} from a callback",
            kind,
            NON_FINITE,
            callback_on_step_end=lambda pipe, step, timestep, tensors, value=value: {
                "latents": tensors["latents"] * value
            },
        )


# Embeddings and noise -------------------------------------------------------------------------------------------------


def embedding_cases(trial: Trial) -> Iterator[Case]:
    """Embeddings and noise that are no numbers, nothing, or far too large."""
    kinds = {"touch_embeds": "touch-to-image", "condition_embeds": "x-to-touch", "latents": "touch-to-image"}
    for name, kind in kinds.items():
        for what, change, code in (
            ("zero", lambda noise: 0 * noise, SUCCESS),
            ("of size 1e-40", lambda noise: 1e-40 * noise, SUCCESS),
            ("of size 1e3", lambda noise: 1e3 * noise, DIVERGED if name == "latents" else SUCCESS),
            ("of size 1e30", lambda noise: 1e30 * noise, NON_FINITE),
            ("of size 3e38", lambda noise: 3e38 * noise.sign(), NON_FINITE),
            ("in float64", lambda noise: noise.double(), SUCCESS),
            ("in float16", lambda noise: noise.half(), SUCCESS),
        ):
            given: dict[str, Any] = {name: Noise(change)}
            yield trial.ends(f"{name} {what}", kind, code, **given)
        for what, wrong in (
            ("NaN", lambda noise: noise * NAN),
            ("with one NaN", lambda noise: noise.index_fill(-1, torch.tensor([0]), NAN)),
            ("Inf", lambda noise: noise * INF),
            ("without rows", lambda noise: noise[:0]),
            ("of another width", lambda noise: torch.cat([noise, noise], dim=-1)),
            ("of one dimension", lambda noise: noise.flatten()),
            ("of integers", lambda noise: noise.long()),
            ("in a list", lambda noise: noise.tolist()),
        ):
            yield trial.refused(f"{name} {what}", kind, name, **{name: Noise(wrong)})
    for what, wrong in (("NaN", lambda noise: noise * NAN), ("Inf", lambda noise: noise * INF)):
        yield trial.refused(f"prompt_embeds {what}", "touch-to-image", "prompt_embeds", prompt_embeds=Noise(wrong))


# What is felt, seen, heard and read -----------------------------------------------------------------------------------


def touches() -> dict[str, Tensor]:
    """Touch images of nothing, of everything, and of odd sides."""
    board = (torch.arange(64)[:, None] + torch.arange(64)[None]) % 2
    lone = torch.zeros(3, 64, 64)
    lone[:, 30, 30] = 1.0
    noise = torch.rand(3, 800, 800, generator=torch.Generator().manual_seed(0))
    return {
        "black": torch.zeros(3, 64, 64),
        "white": torch.ones(3, 64, 64),
        "constant grey": torch.full((3, 64, 64), 0.5),
        "saturated red": torch.tensor([1.0, 0.0, 0.0]).view(3, 1, 1).expand(3, 64, 64),
        "white as bytes": torch.full((3, 64, 64), 255, dtype=torch.uint8),
        "a chessboard": board.float().expand(3, 64, 64),
        "one white pixel": lone,
        "noise": noise[:, :64, :64],
        "grey of one channel": noise[:1, :64, :64],
        "of 8 x 8": noise[:, :8, :8],
        "of 9 x 13": noise[:, :9, :13],
        "of 37 x 101": noise[:, :37, :101],
        "of 8 x 800": noise[:, :8],
        "of 800 x 8": noise[:, :, :8],
        "of 800 x 800": noise,
    }


def touch_cases(trial: Trial) -> Iterator[Case]:
    """Touch images as they should not be, in every pipeline that takes any."""
    for what, touch in touches().items():
        yield trial.ends(f"a touch {what}", "touch-to-image", touch=touch)
    for what in ("black", "white", "saturated red"):
        yield trial.ends(f"a touch {what}, stylization", "stylization", touch=touches()[what])
        yield trial.ends(f"a touch {what}, x to touch", "x-to-touch", image=None, touch=touches()[what])
    middle = torch.full((3, 64, 64), 0.5)
    for what, value in (
        ("with a NaN", middle.clone().index_fill_(1, torch.tensor([7]), NAN)),
        ("with an Inf", middle * INF),
        ("below 0", middle - 1.0),
        ("above 1", middle * 255.0),
        ("of 7 x 7", middle[:, :7, :7]),
        ("of no pixels", middle[:, :0]),
        ("too long", torch.zeros(3, 8, 808)),
        ("of two channels", middle[:2]),
        ("of whole numbers above 255", (1000 * middle).int()),
        ("in an empty list", []),
        ("that is no image", "a touch"),
    ):
        yield trial.refused(f"a touch {what}", "touch-to-image", "touch", touch=value)
    yield trial.refused("no touch", "touch-to-image", "touch", touch=None)
    yield trial.refused("a sensor that is not there", "touch-to-image", "sensor", sensor="gelsite")


def other_cases(trial: Trial) -> Iterator[Case]:
    """Photos, sounds and words."""
    kind = "x-to-touch"
    for what in ("black", "white", "of 8 x 800"):
        yield trial.ends(f"a photo {what}", kind, image=touches()[what])
        yield trial.ends(f"a photo {what}, stylization", "stylization", image=touches()[what])
    time = np.arange(RATE, dtype=np.float32) / RATE
    tone, click = np.sin(2 * np.pi * 440 * time), np.zeros(RATE, np.float32)
    click[100] = 1.0
    heard: dict[str, Any] = {
        "of one click": (click, RATE),
        "clipped": (np.sign(tone), RATE),
        "of full scale in 16 bits": ((32767 * tone).astype(np.int16), RATE),
        "of amplitude 1e-4": (1e-4 * tone, RATE),
        "of amplitude 1e10": (1e10 * tone, RATE),
        "of 2 samples": (tone[200:202], RATE),
        "at 1 kHz": (tone, 1_000),
        "at 768 kHz": (tone, 768_000),
        "of 60 s": (np.tile(tone, 60), RATE),
        "in stereo": (np.stack([tone, -0.5 * tone]), RATE),
    }
    for what, sound in heard.items():
        yield trial.ends(f"a sound {what}", kind, audio=sound)
    unheard: dict[str, Any] = {
        "of silence": (0 * tone, RATE),
        "of a constant": (0 * tone + 0.3, RATE),
        "of one sample": (tone[:1], RATE),
        "of no samples": (tone[:0], RATE),
        "with a NaN": (np.where(tone > 0.99, np.float32(NAN), tone), RATE),
        "with an Inf": (np.where(tone > 0.99, np.float32(INF), tone), RATE),
        "without a rate": tone,
        "in an empty list": [],
    }
    for what, sound in unheard.items():
        yield trial.refused(f"a sound {what}", kind, "audio", audio=sound)
    for rate in (0, -1, 10**7, 1.5):
        yield trial.refused(f"a sound at {rate} Hz", kind, "audio sampling rate", audio=(tone, rate))
    for what, text in (
        ("of 10 000 words", "brick " * 10_000),
        ("in other signs", "γρασίδι 草 🧱"),
        ("of a letter", "x"),
    ):
        yield trial.ends(f"a text {what}", kind, text=text)
    yield trial.refused("a blank text", kind, "text", text=" \n")
    for value in (NAN, -1.0, 0.0):
        yield trial.refused(f"weights of {value}", kind, "weights", text="brick", weights={"text": value})


def batch_cases(trial: Trial) -> Iterator[Case]:
    """One and many."""
    felt = contact().touch["gelsight"]
    for size in (1, 64):
        each = [torch.Generator().manual_seed(row) for row in range(size)]
        yield trial.ends(
            f"a batch of {size} touches", "touch-to-image", touch=felt.expand(size, -1, -1, -1), generator=each, **QUICK
        )
        yield trial.ends(f"{size} of one input", "x-to-touch", num_images_per_prompt=size, **QUICK)
    yield trial.refused(
        "two generators for three", "touch-to-image", "generator", num_images_per_prompt=3,
        generator=[torch.Generator(), torch.Generator()],
    )  # fmt: skip


def input_suite(trial: Trial) -> dict[str, list[Case]]:
    """All cases on what pipelines are given, by group."""
    return {
        "numbers": list(number_cases(trial)),
        "embeddings": list(embedding_cases(trial)),
        "touches": list(touch_cases(trial)),
        "modalities": list(other_cases(trial)),
        "many": list(batch_cases(trial)),
    }
