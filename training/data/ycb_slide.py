"""YCB-Slide (Suresh et al., 2022): a DIGIT slides over ten objects, and TACTO's DIGIT over their meshes.

    real/035_power_drill/dataset_0/{frames,webcam_frames}/frame_0000000.jpg
    sim/035_power_drill/00/tactile_images/0.jpg

Objects stand for materials, as in the paper, so splits are kept apart by recordings. Poses are in pickles, which are
not read.
"""

from collections.abc import Iterator
from pathlib import Path

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.training.data.records import Frame, Record, find_paths, frame_at, images_in

REAL = ("real/*/dataset_*", "*/dataset_*")  # the second if a folder holds only this half of the data set
SIMULATED = ("sim/*/*/tactile_images", "*/*/tactile_images")
LOOKS_LIKE = (*REAL, *SIMULATED)
APART = "recording"


def read(folder: Path) -> Iterator[Record]:
    """The frames of all recordings."""
    runs = [("digit", run, run / "frames") for run in find_paths(folder, *REAL)]
    runs += [("tacto", images.parent, images) for images in find_paths(folder, *SIMULATED)]
    for sensor, run, image_folder in runs:
        images = images_in(image_folder)
        if not images:
            how = "mkdir frames; ffmpeg -i frames.mp4 -start_number 0 -q:v 2 frames/frame_%07d.jpg"
            raise InvalidInputError(f"{str(image_folder)!r} has no images; where there is a video alone, run: {how}")
        item = run.parent.name
        recording = f"{sensor}/{item}/{run.name}"
        labels = {"material": item.lstrip("0123456789_").replace("_", " ")}
        for image in images:
            yield Record(
                f"{recording}/{image.name}",
                touch=Frame(str(image)),
                picture=frame_at(run / "webcam_frames" / image.name),
                sensor=sensor,
                object=item,
                recording=recording,
                labels=labels,
            )
