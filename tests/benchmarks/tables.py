"""The README's tables, and how they get there."""

from tests.benchmarks import Figures
from tests.benchmarks.held_out import CONTACTS
from unitouch_gen.world import COLLECTIONS, MATERIAL_NAMES, SENSORS
from unitouch_gen.world.collections import SPLITS, TRAINING_COLLECTIONS


def percent(share: float) -> str:
    return f"{100 * share:.1f} %"


SENSOR_NAMES = {
    "gelsight": "GelSight",
    "digit": "DIGIT",
    "taxim": "Taxim",
    "tacto": "TACTO",
    "gelslim": "GelSlim",
}
"""As their makers write them."""


def markdown(figures: Figures) -> str:
    """The README's table of figures."""
    joint, pictures = figures["joint"], figures["touch_to_image"]
    spread = 100 * max(pictures["spread"].values())
    rows = [
        (f"material from a picture, zero-shot, mean of {len(joint['image'])} collections",
         percent(joint["image_mean"])),
        (f"material from a sound, zero-shot, mean of {len(joint['audio'])} collections", percent(joint["audio_mean"])),
        (f"material from a touch, zero-shot, the {len(TRAINING_COLLECTIONS)} collections trained on",
         percent(joint["touch_in_domain_mean"])),
        *_by_sensor(joint["touch"]),
        *_other_runs(figures["touch_runs"]),
        ("sensor retrieved right, a sample", percent(joint["sensor_retrieval_mean"])),
        (f"material of pictures generated from touch, by an independent judge ({pictures['seeds']} noise seeds, "
         f"largest spread {spread:.1f} points)", percent(pictures["consistency_mean"])),
        ("... the judge on real pictures (ceiling) and on pictures of shuffled touches (floor)",
         f"{percent(pictures['ceiling_mean'])}, {percent(pictures['floor_mean'])}"),
        ("seconds for one picture after loading", f"{figures['speed']['seconds_per_picture']:.2f}"),
        (f"full samples of the world a second ({len(SENSORS)} sensors)",
         f"{figures['world']['samples_per_second']:.0f}"),
    ]  # fmt: skip
    lines = ["| figure | measured |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)]
    materials, objects = len(MATERIAL_NAMES), SPLITS[figures["split"]][1]
    chance = (
        f"Chance is {percent(1 / materials)}. Held-out split: {materials} materials x {objects} objects x {CONTACTS} "
        "contacts a collection."
    )
    return "\n".join([*lines, "", f"{chance} Timings: {figures['speed']['machine']}."])


def _by_sensor(touch: dict[str, float]) -> list[tuple[str, str]]:
    """Rows of a touch encoder's accuracy: collections trained on, by sensor, and each of the others."""
    known = dict.fromkeys(COLLECTIONS[name].sensor for name in TRAINING_COLLECTIONS)
    rows = []
    for sensor in known:
        scores = [percent(touch[name]) for name in TRAINING_COLLECTIONS if COLLECTIONS[name].sensor == sensor]
        several = f" ({len(scores)} collections)" if len(scores) > 1 else ""
        rows.append((f"... {SENSOR_NAMES[sensor]}{several}", ", ".join(scores)))
    for name, collection in COLLECTIONS.items():
        if not collection.training:
            new = "a collection" if collection.sensor in known else "a sensor"
            rows.append((f"... {SENSOR_NAMES[collection.sensor]}, {new} never trained on", percent(touch[name])))
    return rows


def _other_runs(runs: Figures) -> list[tuple[str, str]]:
    """Rows of other touch encoders: those of the same collections, and those of others."""
    alike = [run for run in runs.values() if set(run["collections"]) == set(TRAINING_COLLECTIONS)]
    rows = []
    if alike:
        steps = ", ".join(sorted({f"{run['steps']:,}" for run in alike}))
        seeds = f"{len(alike)} more training seed{'s' * (len(alike) > 1)} of {steps} steps"
        rows.append(
            (
                f"... the {len(TRAINING_COLLECTIONS)} collections trained on, {seeds}",
                ", ".join(percent(run["in_domain_mean"]) for run in alike),
            )
        )
    for run in runs.values():
        if set(run["collections"]) != set(TRAINING_COLLECTIONS):
            sensors = " and ".join(dict.fromkeys(SENSOR_NAMES[COLLECTIONS[name].sensor] for name in run["collections"]))
            rows.append((f"... {sensors}, by an encoder trained on {sensors} alone", percent(run["in_domain_mean"])))
    return rows


X_TO_TOUCH = (
    ("image", "from a photo"),
    ("caption", "from a caption"),
    ("caption_bridged", "... bridged"),
    ("audio", "from a sound"),
    ("audio_bridged", "... bridged"),
    ("translation", "from the touch of another sensor"),
    ("agreement_raw", "agreement: from a photo and from its caption (paper: 55.3 %)"),
    ("agreement", "... bridged"),
    ("ceiling", "the judge on real touches (ceiling)"),
    ("floor", "... with shuffled labels (floor)"),
)


def x_to_touch_table(figures: Figures) -> str:
    """Material consistency of generated touches, by sensor."""
    measured = figures["x_to_touch"]
    sensors = list(measured["image"])
    lines = [f"| touch | mean | {' | '.join(sensors)} |", "|---|---|" + "---|" * len(sensors)]
    for key, name in X_TO_TOUCH:
        cells = [percent(measured[f"{key}_mean"]), *(percent(measured[key][sensor]) for sensor in sensors)]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    deviation, psnr = measured["deviation_mean"], measured["psnr_mean"]
    seeds = f"{measured['seeds']} noise seed"
    if measured["seeds"] > 1:
        seeds = f"{seeds}s, largest spread {100 * measured['spread']:.1f} points"
    return "\n".join(
        [
            *lines,
            "",
            f"{measured['touches_each']} touches a cell and seed, {seeds}. Pixels of generated touches deviate "
            f"{deviation:.2f} times as much as real ones; the autoencoder restores touches to {psnr:.1f} dB.",
        ]
    )


def stylization_table(figures: Figures) -> str:
    """What a judge of pictures sees in restyled ones, by the weight of the touch."""
    measured = figures["stylization"]
    columns = list(measured["touch"])
    lines = [f"| weight of the touch | {' | '.join(columns)} |", "|---|" + "---|" * len(columns)]
    for key, name in (("photo", "named as the photo's material"), ("touch", "named as the touch's material")):
        lines.append(f"| {name} | {' | '.join(percent(measured[key][column]) for column in columns)} |")
    pictures, seeds, spread = measured["pictures_each"], measured["seeds"], 100 * measured["spread"]
    note = f"{pictures} pictures a cell and seed, {seeds} seeds, largest spread {spread:.1f} points."
    return "\n".join([*lines, "", note])


def surfaces_text(figures: Figures) -> str:
    """What holds on real textures."""
    measured = figures["surfaces"]
    albedo, lit = measured["albedo"], measured["lit"]
    return (
        f"Real textures are another matter: on {measured['surfaces']} scanned surfaces ({measured['touches']} touches) "
        "the touch imagined from the albedo picture and the one rendered from the height map are named alike in "
        f"{percent(albedo['agreement'])} (touches of other surfaces: {percent(albedo['floor'])}), and in "
        f"{percent(lit['agreement'])} ({percent(lit['floor'])}) from a picture in which the relief is lit; touches of "
        f"neighbouring patches agree in {percent(measured['neighbours'])}. "
        "`python -m tests.benchmarks --only surfaces --surfaces FOLDER` measures it on surfaces of your own."
    )


def published_table(figures: Figures) -> str:
    """What the published size takes."""
    measured = figures["published"]
    conversion, encoder = measured["conversion"], measured["touch_encoder"]
    largest = max(conversion["megabytes_of_files"].values()) / 1e3
    parameters = sum(conversion["parameters"].values()) / 1e9
    rows = [
        (
            f"{way} both files, {parameters:.2f} billion parameters",
            f"{seen['seconds']:.0f} s; memory at most {seen['share_of_largest']:.2f} times the larger file "
            f"({largest:.2f} GB)",
        )
        for way, seen in (("converting", conversion["conversion"]), ("reading into memory", conversion["reading"]))
    ]
    errors = {"float32": "", "bfloat16": f"; embeddings err by {percent(encoder['relative_error']['ours_bfloat16'])}"}
    for dtype, error in errors.items():
        times = encoder["times_as_fast"][dtype]
        rows.append(
            (
                f"touches a second in {dtype}, of the touch encoder in `nn.MultiheadAttention` and float32",
                f"{times['ratio']:.2f} times ({times['low']:.2f} to {times['high']:.2f}){error}",
            )
        )
    for dtype, seen in measured["touch_to_image"].items():
        if not seen:  # the system does not say how much memory is held
            continue
        ours, theirs = seen["ours"], seen["diffusers"]
        peaks, steps = seen["share_of_megabytes"], seen["share_of_seconds_a_step"]
        rows += [
            (
                f"768 x 768 from a touch in {dtype} with `low_memory`, peak memory, of diffusers' own pipeline",
                f"{percent(peaks['median'])} (spread {100 * peaks['spread']:.1f} points): "
                f"{ours['megabytes']['median'] / 1e3:.2f} of {theirs['megabytes']['median'] / 1e3:.2f} GB",
            ),
            (
                "... seconds a step, both branches of guidance",
                f"{ours['seconds_a_step']['median']:.1f}, {steps['median']:.2f} times as many (spread "
                f"{steps['spread']:.2f})",
            ),
        ]
    lines = ["| at the published size | measured |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)]
    return "\n".join([*lines, "", f"Random weights; {measured['machine']}."])


def write_between(text: str, mark: str, content: str) -> str:
    """`text` with what stands between two `<!-- mark -->` comments replaced."""
    comment = f"<!-- {mark} -->"
    before, _, after = text.split(comment)
    return f"{before}{comment}\n{content}\n{comment}{after}"
