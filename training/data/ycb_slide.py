"""YCB-Slide (Suresh et al., 2022): a DIGIT slides over ten objects, and TACTO's DIGIT over their meshes.

    real/035_power_drill/dataset_0/{frames,webcam_frames}/frame_0000000.jpg
    sim/035_power_drill/00/tactile_images/0.jpg

Objects stand for materials, as in the paper, so recordings are what is kept apart. Poses are in pickles, which are not
read.
"""

from collections.abc import Iterator
from pathlib import Path

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.training.data.records import Frame, Record, found, frame_at, images_in

REAL = ("real/*/dataset_*", "*/dataset_*")  # the second where one half of the data set is alone
SIMULATED = ("sim/*/*/tactile_images", "*/*/tactile_images")
LOOKS_LIKE = (*REAL, *SIMULATED)
APART = "recording"


def read(folder: Path) -> Iterator[Record]:
    """The frames of all recordings."""
    runs = [("digit", run, run / "frames") for run in found(folder, *REAL)]
    runs += [("tacto", images.parent, images) for images in found(folder, *SIMULATED)]
    for sensor, run, place in runs:
        images = images_in(place)
        if not images:
            how = "mkdir frames; ffmpeg -i frames.mp4 -start_number 0 -q:v 2 frames/frame_%07d.jpg"
            raise InvalidInputError(f"{str(place)!r} has no images; where there is a video alone, run: {how}")
        item = run.parent.name
        recording = f"{sensor}/{run.parent.name}/{run.name}"
        labels = {"material": item.lstrip("0123456789_").replace("_", " ")}
        for image in images:
            yield Record(
                f"{recording}/{image.name}",
                Frame(str(image)),
                frame_at(run / "webcam_frames" / image.name),
                sensor=sensor,
                object=item,
                recording=recording,
                labels=labels,
            )
