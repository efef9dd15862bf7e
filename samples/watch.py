"""Watches a touch sensor, or a video of one, and makes a picture of every touch; needs PyAV, of the extra `train`.

python samples/watch.py 0 --output outputs/watched    # the first camera, on Linux; Ctrl-C ends it
python samples/watch.py press.mp4

Leave the sensor alone for the first moment: the gel at rest is seen in the first quiet frames.
"""

import argparse
from pathlib import Path

import torch
from PIL import Image

import unitouch_gen
from unitouch_gen.models.videos import contacts, read_video


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("source", help="index of a camera, or a video file")
    parser.add_argument("--output", type=Path, default=Path("outputs/watched"))
    parser.add_argument("--sensor", help="its name; found by its looks if left out")
    parser.add_argument("--bgr", action="store_true", help="frames have blue in the place of red")
    arguments = parser.parse_args()

    if arguments.source.isdecimal():
        frames = read_video("source", f"/dev/video{arguments.source}", form="v4l2")
    else:
        frames = read_video("source", arguments.source)
    pipe = unitouch_gen.tiny("touch-to-image")
    pipe.set_progress_bar_config(disable=True)
    arguments.output.mkdir(parents=True, exist_ok=True)
    count = 0
    try:
        for count, contact in enumerate(contacts(frames, "bgr" if arguments.bgr else "rgb", name="source"), 1):
            output = pipe(contact.frame, sensor=arguments.sensor, generator=torch.Generator().manual_seed(0))
            Image.fromarray(contact.frame).save(arguments.output / f"{count}-touch.png")
            output.images[0].save(arguments.output / f"{count}-picture.png")
            print(f"Touch {count}, frame {contact.index}: {output.report.sensors[0]}; {output.report}")
    except KeyboardInterrupt:
        pass
    print(f"{count} touches; see {arguments.output}")


if __name__ == "__main__":
    main()
