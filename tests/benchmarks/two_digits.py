"""Whether a touch encoder knows a real object again under another DIGIT.

python -m tests.benchmarks.two_digits digit_touchtouch.zip
"""

import argparse
import csv
import io
import zipfile
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from sklearn.metrics import roc_auc_score

from tests.benchmarks.joint_space import JointSpace
from tests.benchmarks.measuring import Figures
from unitouch_gen import weights
from unitouch_gen.evaluation.controls import statistics, untrained_like
from unitouch_gen.models import UniTouchModel

UNITS = ("D20118", "D20140")
AVERAGED = ("touch encoder", "untrained 0")  # over views, of which there are forty


def views(pixels: torch.Tensor, side: float = 0.75) -> list[torch.Tensor]:
    """Touches (N, 3, S, S) as they are and their four corners, each in the eight ways a square can be laid.

    An embedding says where and which way round a contact lies; the mean of these says less of that, and so more of what
    was touched.
    """
    size = pixels.shape[-1]
    part = round(side * size)
    corners = [pixels[..., y : y + part, x : x + part] for y in (0, size - part) for x in (0, size - part)]
    shown = [pixels, *(F.interpolate(corner, size=(size, size), mode="bilinear") for corner in corners)]
    turned = [torch.rot90(one, turn, (-2, -1)) for one in shown for turn in range(4)]
    return [view for one in turned for view in (one, one.flip(-1))]


@torch.no_grad()
def two_digits(joint: JointSpace, archive: Path) -> Figures:
    """Whether an object is known again under another DIGIT: real recordings, of which nothing is trained on.

    Features are standardised within each unit, which takes the unit's own colours away from everyone alike.

    Args:
        joint: With touch; it is not told the sensor and retrieves none.
        archive: `digit_touchtouch.zip`, whose index.csv names file, unit and object of each image.

    Returns:
        By encoder, of touches as they are and of the mean over `views`, the area under the ROC curve of same-object
        pairs against others ("auc", mean over objects, and its standard error "spread"), and the share of images whose
        nearest of the other unit is of the same object ("nearest"). Objects filmed on another day (`hdmi_*`, `usb_*`)
        are left out.
    """
    with zipfile.ZipFile(archive) as box:
        index = list(csv.DictReader(io.TextIOWrapper(box.open("index.csv"))))
        rows = [row for row in index if row["unit"] in UNITS and not row["object"].startswith(("hdmi", "usb"))]
        images = [Image.open(io.BytesIO(box.read(row["file"]))).convert("RGB") for row in rows]
    pixels = joint.processor.touch(images)
    objects = np.array([row["object"] for row in rows])
    first = np.array([row["unit"] == UNITS[0] for row in rows])
    mean = {unit: pixels[torch.from_numpy(first == unit)].mean(dim=0) for unit in (True, False)}
    pairs = zip(pixels, first.tolist(), strict=True)
    changes = [(128.0 * (one - mean[unit])).movedim(0, -1).numpy() for one, unit in pairs]
    models = {"touch encoder": joint.model}
    models |= {f"untrained {seed}": untrained_like(joint.model, seed) for seed in range(3)}
    features = dict[str, np.ndarray]()
    for name, model in models.items():
        found = [F.normalize(encoded(model, view), dim=1) for view in (views(pixels) if name in AVERAGED else [pixels])]
        features[name] = found[0].double().numpy()
        if len(found) > 1:
            features[f"{name}, mean of views"] = torch.stack(found).mean(dim=0).double().numpy()
    plain = [
        statistics(list(view.movedim(1, -1).numpy()))
        for view in views(torch.from_numpy(np.stack(changes)).movedim(-1, 1))
    ]
    for name, values in {"statistics": plain[0], "statistics, mean of views": np.mean(plain, axis=0)}.items():
        features[name] = np.log1p(np.abs(values)) * np.sign(values)
    features["8 x 8 pixels"] = F.adaptive_avg_pool2d(pixels, 8).flatten(1).double().numpy()
    return {name: _known_again(values, objects, first) for name, values in features.items()}


def encoded(model: UniTouchModel, pixels: torch.Tensor) -> torch.Tensor:
    return torch.cat([model.get_touch_features(part) for part in pixels.split(128)])


def _known_again(features: np.ndarray, objects: np.ndarray, first: np.ndarray) -> dict[str, float]:
    for rows in (first, ~first):
        features[rows] = (features[rows] - features[rows].mean(0)) / (features[rows].std(0) + 1e-6)
    features /= np.linalg.norm(features, axis=1, keepdims=True) + 1e-9
    alike = features[first] @ features[~first].T
    same = objects[first][:, None] == objects[~first][None]
    named = objects[first]
    both = sorted(set(named) & set(objects[~first]))
    scores = [roc_auc_score(same[named == one].ravel(), alike[named == one].ravel()) for one in both]
    nearest = [(objects[~first][alike[named == one].argmax(1)] == one).mean() for one in both]
    return {
        "auc": float(np.mean(scores)),
        "spread": float(np.std(scores) / len(scores) ** 0.5),
        "nearest": float(np.mean(nearest)),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.two_digits")
    parser.add_argument("recordings", type=Path, help="digit_touchtouch.zip")
    parser.add_argument("--joint", type=Path, default=weights.JOINT, help="folder of a joint space")
    given = parser.parse_args()
    for name, found in two_digits(JointSpace.from_folder(given.joint), given.recordings).items():
        print(f"{name}: AUC {found['auc']:.3f} +- {found['spread']:.3f}, nearest {100 * found['nearest']:.0f} %")
