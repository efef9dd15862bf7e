"""A slow morph between the pictures of two touches, there and back, as a GIF.

python samples/touch_morph.py samples/inputs/gelsight_brick.png samples/inputs/digit_wood.png
"""

import argparse
from pathlib import Path

import torch
from PIL import Image

import unitouch_gen
from unitouch_gen.diffusion.conditioning import mix_spherical

INPUTS = Path(__file__).parent / "inputs"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument(
        "touches", type=Path, nargs="*", default=[INPUTS / "gelsight_gravel.png", INPUTS / "taxim_tile.png"]
    )
    parser.add_argument("--output", type=Path, default=Path("outputs/morph.gif"))
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--side", type=int, default=256, help="of the GIF, pixels")
    arguments = parser.parse_args()
    if len(arguments.touches) != 2:
        parser.error("pass two touches")

    pipe = unitouch_gen.tiny("touch-to-image")
    one, other = pipe.encode_touch(arguments.touches).split(1)
    # Cosine easing: the ends are rests.
    shares = (1 - torch.cos(torch.linspace(0, torch.pi, arguments.frames))) / 2
    embeds = torch.cat([mix_spherical(torch.stack([one, other]), torch.stack([1 - s, s])) for s in shares])
    # One noise for all frames, of the embedding as of the latents: what changes is the touch.
    generators = [torch.Generator().manual_seed(arguments.seed) for _ in embeds]
    frames = pipe(touch_embeds=embeds, generator=generators).images
    frames = [frame.resize((arguments.side, arguments.side), Image.Resampling.BICUBIC) for frame in frames]
    frames += frames[-2:0:-1]
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    frames[0].save(arguments.output, save_all=True, append_images=frames[1:], duration=90, loop=0)
    print(arguments.output)


if __name__ == "__main__":
    main()
