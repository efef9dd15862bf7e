"""`unitouch-gen adapt`: a sensor of one's own."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option, echo

from unitouch_gen.cli.data import BGR, Pattern, layout_of
from unitouch_gen.cli.options import Overwrite, check_output, note, print_table
from unitouch_gen.errors import InvalidInputError


def adapt(
    path: Annotated[Path, Argument(help="Folder of touches; with photos, folders touch and picture.", metavar="DIR")],
    sensor: Annotated[str, Option(help="Name for the sensor.")],
    output: Annotated[Path | None, Option("--output", "-o", help="SENSOR.safetensors if left out.")] = None,
    model: Annotated[Path | None, Option(help="Folder of a joint space; the built-in one if left out.")] = None,
    kind: Annotated[str, Option(help="Layout of the folder, such as touch_and_go; or auto, to see.")] = "auto",
    pattern: Pattern = None, bgr: BGR = False,
    rank: Annotated[int, Option(min=0, max=1000, help="Of the encoder's update; 0 learns tokens alone.")] = 8,
    steps: Annotated[int, Option(min=1, max=10**6, help="Steps of learning.")] = 300,
    seed: Annotated[int, Option(min=0, max=2**32, help="Of what is held out, and of the noise.")] = 0,
    overwrite: Overwrite = False,
) -> None:  # fmt: skip
    """Learns a sensor from a folder of its touches, in minutes; writes a small file for --load-sensor.

    Example: unitouch-gen adapt touches/ --sensor mine
    """
    from unitouch_gen.training.adapt import AdaptConfig, learn

    file = output or Path(f"{sensor}.safetensors")
    if file.suffix != ".safetensors":
        raise InvalidInputError(f"`--output` is {str(file)!r}; name a .safetensors file.")
    check_output([file], overwrite)
    config = AdaptConfig(steps=steps, rank=rank, seed=seed)
    made = learn(path, sensor, model, config, note, kind=kind, bgr=bgr, **layout_of(None, pattern))
    made.save(file)
    before, after, held_out = (made.figures[name] for name in ("before", "after", "held_out"))
    counted = {"view": "another view of a touch is nearest to it", "picture": "its own picture is nearest to it"}
    shares = {name: (before[name], after[name], before["chance"]) for name in counted if name in before}
    rows = [[counted[name], *(f"{share:.0f} %" for share in found)] for name, found in shares.items()]
    print_table([f"of {held_out} touches that were held out", "before", "after", "chance"], rows)
    if held_out < 20:  # of which half, 50 %, is right within 22
        echo(f"These are too few to tell: each of them is {100 / held_out:.0f} % of the figures")
    echo(f"The sensor {sensor!r} is in {file.resolve()}; use it by --load-sensor, or pipe.load_sensor(...)")
