"""What the built-in family gave before the package was rebuilt, until a new family takes its place.

`python -m tests.pipelines.test_golden` stores it anew.
"""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

import unitouch_gen

STORED = Path(__file__).with_name("golden.safetensors")

CALL = {"solver": "ddim", "num_inference_steps": 6, "output_type": "latent", "bridge": False}


def latents(seed: int) -> torch.Tensor:
    return torch.randn(1, 8, 16, 16, generator=torch.Generator().manual_seed(seed))


def touch_to_image() -> torch.Tensor:
    pipe = unitouch_gen.tiny("touch-to-image")
    seeded = torch.Generator().manual_seed(0)
    return pipe(unitouch_gen.example("brick"), latents=latents(0), generator=seeded, **CALL).images


def stylization() -> torch.Tensor:
    pipe = unitouch_gen.tiny("stylization")
    photo, touch = unitouch_gen.example("wood", "image"), unitouch_gen.example("gravel")
    seeded = torch.Generator().manual_seed(0)
    return pipe(photo, touch, latents=latents(1), layout=None, generator=seeded, **CALL).images


def text_to_touch() -> torch.Tensor:
    pipe = unitouch_gen.tiny("x-to-touch")
    return pipe(text="rough brick", sensor="digit", latents=latents(2), **CALL).images


def touch_to_touch() -> torch.Tensor:
    pipe = unitouch_gen.tiny("x-to-touch")
    return pipe(touch=unitouch_gen.example("wood"), sensor="gelsight", latents=latents(3), **CALL).images


def embeddings() -> torch.Tensor:
    pipe = unitouch_gen.tiny("x-to-touch")
    inputs = [
        {"touch": unitouch_gen.example("brick")},
        {"image": unitouch_gen.example("wood", "image")},
        {"audio": unitouch_gen.example("metal", "audio")},
        {"text": "rough brick"},
    ]
    return torch.cat([pipe.encode_condition(**one) for one in inputs])


CASES = (touch_to_image, stylization, text_to_touch, touch_to_touch, embeddings)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_the_built_in_family_gives_what_it_gave(case) -> None:
    torch.testing.assert_close(case(), load_file(STORED)[case.__name__], rtol=1e-3, atol=2e-3)


if __name__ == "__main__":
    save_file({case.__name__: case().contiguous() for case in CASES}, STORED)
