"""`unitouch-gen press`: touch images of height maps."""

import json
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option, echo

from unitouch_gen.cli import options
from unitouch_gen.cli.loading import files_of
from unitouch_gen.cli.options import SEVERAL
from unitouch_gen.cli.pictures import save, unique
from unitouch_gen.errors import InvalidInputError, check_choice
from unitouch_gen.files import replacing

MM_PER_LEVEL = 1e-4  # of depth maps; 65,535 levels reach 6.5 mm, more than the thickness of any gel


def press(
    height: Annotated[list[str], Argument(help=f"Height maps, where bright is high: {SEVERAL}.")],
    output: options.Output,
    mm: Annotated[float, Option(help="Width of each map, mm.")] = 30.0,
    relief_mm: Annotated[float, Option(help="Height from black to white, mm; factor on float TIFF and .npy.")] = 1.0,
    sensor: Annotated[list[str] | None, Option(help="Name of a sensor, digit by default, or all; repeatable.")] = None,
    depth: Annotated[float, Option(help="Depth of the surface beyond first contact, mm.")] = 1.0,
    at: Annotated[list[str] | None, Option(help="Place of a contact: X,Y in mm from the centre; repeatable.")] = None,
    image_size: Annotated[int, Option("--image-size", "--size", help="Side of the images, pixels.")] = 128,
    depth_maps: Annotated[bool, Option("--depth-maps", metavar="", help="Write depth maps, 16-bit PNG, too.")] = False,
    seed: Annotated[int, Option(min=0, max=options.MAX_SEED, help="Seed of the camera's noise.")] = 0,
    overwrite: options.Overwrite = False,
    as_json: options.AsJson = False,
) -> None:
    """Makes touch images of height maps, by any sensor.

    Floats are heights in mm; 8 and 16 bit images run from 0 to `--relief-mm`. Images are named after map, sensor and
    contact. With `--depth-maps`, a depth map is written beside each, with mm per level and per pixel in its metadata.

    Example: unitouch-gen press example:coin --mm 24 --sensor all -o touches/
    """
    files = files_of("height", height, "height")
    places = [place_of(word) for word in at or ["0,0"]]

    from unitouch_gen.world import SENSORS
    from unitouch_gen.world import press as pressed
    from unitouch_gen.world.press import check_relief, height_maps

    names = list(SENSORS) if sensor and "all" in sensor else sensor or ["digit"]
    names = list(dict.fromkeys(check_choice("--sensor", name, SENSORS) for name in names))
    stems = list[str]()
    for file in files:
        for name in names:
            for number in range(1, len(places) + 1):
                stems.append(f"{file.stem}-{name}-{number}" if len(places) > 1 else f"{file.stem}-{name}")
    targets = options.targets_of(output, unique(stems))
    maps = [target.with_name(f"{target.stem}-depth.png") for target in targets] if depth_maps else []
    options.check_output([*targets, *maps], overwrite, inputs=files)

    for file in files:  # checked first, so that the work does not end half done
        height_maps(file, check_relief(relief_mm), name=f"height {file.name}")
    rows: list[dict[str, Any]] = []
    for file in files:
        for name in names:
            contacts = pressed(
                file,
                mm,
                name,
                depth,
                relief_mm=relief_mm,
                at=places,
                image_size=image_size,
                seed=seed,
            )
            for touch, displacement in zip(contacts.touch, contacts.depth, strict=True):
                target = targets[len(rows)]
                save(to_picture(touch), target)
                row: dict[str, Any] = {"picture": str(target), "height": str(file), "sensor": name}
                if depth_maps:
                    depth_map = maps[len(rows)]
                    row["depth_map"] = str(depth_map)
                    save_depth(displacement, depth_map, contacts.field_of_view / image_size)
                row["deepest_mm"] = round(float(displacement.max()), 4)
                rows.append(row)
    if as_json:
        echo(json.dumps({"pictures": rows, "mm_per_level": MM_PER_LEVEL}))
        return
    columns = list(rows[0])
    options.print_table(columns, [[Path(str(row[name])).name for name in columns] for row in rows])
    echo(f"Touches are in {targets[0].resolve().parent}")


def place_of(word: str) -> tuple[float, float]:
    """A place from the text of an option."""
    try:
        x, y = map(float, word.split(","))
    except ValueError as error:
        raise InvalidInputError(f"`--at` is {word!r}; pass X,Y in mm from the centre, such as 5,-3.") from error
    return x, y


def to_picture(touch: Any) -> Any:
    """A touch (3, S, S) in [0, 1] as a PIL image."""
    from PIL import Image

    return Image.fromarray((touch * 255).round().byte().permute(1, 2, 0).numpy())


def save_depth(depth: Any, file: Path, pixel: float) -> None:
    """Writes a depth map (S, S), mm, as PNG of 16 bits with its scale in text entries."""
    import numpy as np
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    scale = PngInfo()
    scale.add_text("mm_per_level", f"{MM_PER_LEVEL:g}")
    scale.add_text("mm_per_pixel", f"{pixel:g}")
    levels = (depth / MM_PER_LEVEL).round().clamp(0, 65535).numpy().astype(np.uint16)
    with replacing("--output", file) as partial:
        Image.fromarray(levels).save(partial, pnginfo=scale)
