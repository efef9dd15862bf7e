"""A slow morph between the pictures of two touches, there and back, as a GIF: the picture between the touches.

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
    one, other = pipe.encode_touch(arguments.touches).split(1)
    # Cosine easing: the ends are rests.
    shares = (1 - torch.cos(torch.linspace(0, torch.pi, arguments.frames))) / 2
    embeds = torch.cat([mix_to_norm(torch.stack([one, other]), torch.stack([1 - s, s])) for s in shares])
    # One noise for all frames, of the embedding as of the latents: what changes is the touch.
    generators = [torch.Generator().manual_seed(arguments.seed) for _ in embeds]
    pictures = pipe(touch_embeds=embeds, generator=generators).images
    ends = [(Image.open(file), file.stem.replace("_", " ")) for file in arguments.touches]
    frames = [frame_of(picture, ends, share.item(), arguments.side) for picture, share in zip(pictures, shares)]
    frames += frames[-2:0:-1]
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    frames[0].save(arguments.output, save_all=True, append_images=frames[1:], duration=90, loop=0)
    print(arguments.output)


def frame_of(picture: Image.Image, ends: list[tuple[Image.Image, str]], share: float, side: int) -> Image.Image:
    """The picture between the two touches with their names, each as faint as its share in it is small."""
    small = side // 2
    bar = MARGIN
    names = [written(name, 18, small) for _, name in ends]
    canvas = Image.new("RGB", (2 * (MARGIN + small + GAP) + side, MARGIN + side + bar + MARGIN), PAPER)
    canvas.paste(picture.resize((side, side), Image.Resampling.BICUBIC), (MARGIN + small + GAP, MARGIN))
    places = (MARGIN, canvas.width - MARGIN - small)
    for (touch, _), name, x, weight in zip(ends, names, places, (1 - share, share)):
        shown = Image.new("RGB", (small, small + GAP + name.height), PAPER)
        shown.paste(to_tile(touch, small), (0, 0))
        shown.paste(name, ((small - name.width) // 2, small + GAP))
        faint = Image.blend(Image.new("RGB", shown.size, PAPER), shown, 0.25 + 0.75 * weight)
        canvas.paste(faint, (x, MARGIN + (side - small) // 2))
    # Where between the two the picture is.
    draw = ImageDraw.Draw(canvas)
    left = MARGIN + small + GAP
    y = MARGIN + side + bar
    draw.line((left, y, left + side, y), "lightgrey", 2)
    draw.circle((left + share * side, y), 5, INK)
    # A palette for each frame, and no dithering: its grain would flicker.
    return canvas.quantize(256, kmeans=2, dither=Image.Dither.NONE)


if __name__ == "__main__":
    main()
