"""Morphs between the pictures of two touches and back, as a GIF with the picture between the touches.

python samples/touch_morph.py
python samples/touch_morph.py samples/inputs/gelsight_brick.png samples/inputs/digit_wood.png
"""

import argparse
from pathlib import Path

import torch
from PIL import Image, ImageDraw

import unitouch_gen
from drawing import GAP, INK, MARGIN, PAPER, to_tile, written
from unitouch_gen.conditioning import mix_to_norm

INPUTS = Path(__file__).parent / "inputs"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument(
        "touches", type=Path, nargs="*", default=[INPUTS / "gelsight_r15_gravel.png", INPUTS / "gelsight_tile.png"]
    )
    parser.add_argument("--output", type=Path, default=Path("outputs/morph.gif"))
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--side", type=int, default=256, help="of the pictures, pixels")
    arguments = parser.parse_args()
    if len(arguments.touches) != 2:
        parser.error("pass two touches")

    pipe = unitouch_gen.tiny("touch-to-image")
    ends = pipe.encode_touch(arguments.touches)[:, None]  # (2, 1, D)
    shares = (1 - torch.cos(torch.linspace(0, torch.pi, arguments.frames))) / 2  # cosine easing
    embeds = torch.cat([mix_to_norm(ends, torch.stack([1 - share, share])) for share in shares])
    # All frames have the same noise, of the embedding and of the latents, so only the touch changes.
    generators = [torch.Generator().manual_seed(arguments.seed) for _ in embeds]
    pictures = pipe(touch_embeds=embeds, generator=generators).images
    touches = [(Image.open(file), file.stem.replace("_", " ")) for file in arguments.touches]
    frames = [frame_of(picture, touches, share.item(), arguments.side) for picture, share in zip(pictures, shares)]
    frames += frames[-2:0:-1]
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    frames[0].save(arguments.output, save_all=True, append_images=frames[1:], duration=90, loop=0)
    print(arguments.output)


def frame_of(picture: Image.Image, touches: list[tuple[Image.Image, str]], share: float, side: int) -> Image.Image:
    """The picture between the two touches with their names, each faded by its share in the picture."""
    small = side // 2
    left = MARGIN + small + GAP
    bar_y = MARGIN + side + MARGIN
    canvas = Image.new("RGB", (2 * left + side, bar_y + MARGIN), PAPER)
    canvas.paste(picture.resize((side, side), Image.Resampling.BICUBIC), (left, MARGIN))
    places = (MARGIN, canvas.width - MARGIN - small)
    for (touch, text), x, weight in zip(touches, places, (1 - share, share)):
        name = written(text, 18, small)
        panel = Image.new("RGB", (small, small + GAP + name.height), PAPER)
        panel.paste(to_tile(touch, small), (0, 0))
        panel.paste(name, ((small - name.width) // 2, small + GAP))
        faded = Image.blend(Image.new("RGB", panel.size, PAPER), panel, 0.25 + 0.75 * weight)
        canvas.paste(faded, (x, MARGIN + (side - small) // 2))
    # A dot on a line marks the position between the touches.
    draw = ImageDraw.Draw(canvas)
    draw.line((left, bar_y, left + side, bar_y), "lightgrey", 2)
    draw.circle((left + share * side, bar_y), 5, INK)
    # A palette for each frame, without dithering, whose grain would flicker.
    return canvas.quantize(256, kmeans=2, dither=Image.Dither.NONE)


if __name__ == "__main__":
    main()
