"""What is trained for tables alone, and found again in a cache: small touch encoders, by the stage `touch` itself, and
networks that pairs of touches and pictures are fitted by."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from unitouch_gen.evaluation.ablation import ALL, BOTH, ONE, SAMPLING, TOKENS
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.config import UniTouchViTConfig
from unitouch_gen.training import paired, touch
from unitouch_gen.training.data.embedded import encoder_hash
from unitouch_gen.training.data.held import HeldOut
from unitouch_gen.training.recipe import read_recipe
from unitouch_gen.training.stages import Stage, save_modalities
from unitouch_gen.training.trainer import checkpoints_in

SIZES: dict[str, Any] = {
    "hidden_size": 48, "num_hidden_layers": 2, "num_attention_heads": 4, "patch_size": 16, "patch_stride": 16,
    "stem": "residual",
}  # fmt: skip
"""Sizes of encoders that learn something of pictures within minutes on two cores."""

RECIPE = "touch_small"


@dataclass(frozen=True)
class Setting:
    """What one encoder is trained by.

    Attributes:
        one: Whether on the first sensor's data set alone.
        tokens: Of each sensor; 0 is none.
        sigma: Share of a batch from one data set; `None` draws it from all alike.
        touches: Weight of InfoNCE between the same contact under two sensors.
    """

    one: bool = False
    tokens: int = 0
    sigma: float | None = None
    touches: float = 0.0


TOKENS_OF_SENSOR, SIGMA = 5, 0.75
"""The paper's."""

ABLATION = {
    ONE: Setting(one=True),
    ALL: Setting(),
    TOKENS: Setting(tokens=TOKENS_OF_SENSOR),
    SAMPLING: Setting(sigma=SIGMA),
    BOTH: Setting(tokens=TOKENS_OF_SENSOR, sigma=SIGMA),
}

SIGMAS = {f"sigma = {sigma:g}": Setting(tokens=TOKENS_OF_SENSOR, sigma=sigma) for sigma in (0.0, 0.5, SIGMA, 1.0)}

BASELINES = {
    "small": ABLATION[BOTH],
    "vt_cmc_one": ABLATION[ONE],
    "vt_cmc_all": ABLATION[ALL],
    "ssvtp_one": Setting(one=True, touches=1.0),
    "ssvtp_all": Setting(touches=1.0),
}
"""By the names of their features; see `classification.PROBED`."""


def small_joint(joint: UniTouchModel, processor: UniTouchProcessor, cache: Path) -> Path:
    """A folder with the image encoder of a joint space, and the sizes of a small touch encoder."""
    sizes = "-".join(map(str, SIZES.values()))
    folder = cache / f"joint-{encoder_hash(joint, 'image')}-{sizes}"
    if not (folder / "config.json").is_file():
        model = UniTouchModel.from_pretrained(joint.source, modalities=("image",))  # type: ignore[arg-type]
        size, config = processor.image_size, model.config
        config.touch_config = UniTouchViTConfig(
            **SIZES, image_height=size, image_width=size, projection_dim=config.projection_dim
        )
        folder.mkdir(parents=True, exist_ok=True)
        save_modalities(model, ("image",), processor, folder)
    return folder


def trained(joint: Path, setting: Setting, sensors: list[str], seed: int, steps: int, cache: Path) -> UniTouchModel:
    """The touch encoder that a setting leads to, from the cache if it is there; one that was stopped goes on.

    Args:
        joint: See `small_joint`.
        setting: What it is trained by.
        sensors: Of the data sets, by name.
        seed: Of weights and batches.
        steps: Of the optimiser.
        cache: Folder of all that is kept.

    Raises:
        SystemExit: If the training is stopped; what is saved goes on in the next call.
    """
    overrides = [
        f"data.drawn.sensors={json.dumps(sensors[:1] if setting.one else sensors)}",
        f"sensors.tokens={setting.tokens}",
        f"sampler.sigma={json.dumps(setting.sigma)}",
        f"objective.touch={setting.touches}",
        f"trainer.steps={steps}",
        f"trainer.seed={seed}",
    ]
    told = json.dumps([read_recipe(RECIPE, overrides), joint.name], sort_keys=True)
    output = cache / f"encoder-{hashlib.sha256(told.encode()).hexdigest()[:16]}"
    if not (output / "record.json").is_file():
        stage = Stage(
            "touch", recipe=RECIPE, overrides=overrides, output=output, cache=cache, joint=joint,
            resume=bool(checkpoints_in(output)),
        )  # fmt: skip
        torch.manual_seed(seed)
        touch.main(stage)
    return UniTouchModel.from_pretrained(output / "model", modalities=("touch",)).eval()


OF_PAIRS = {"pix2pix": "Pix2Pix, supervised", "visgel": "VisGel, supervised"}
"""Methods of `paired`, and their rows."""


def fitted_to_pairs(known: Sequence[HeldOut], seed: int, steps: int, cache: Path) -> dict[str, paired.PairObjective]:
    """Networks that draw pictures of touches, by row, trained on pairs, each for twice as many steps as an encoder.

    Args:
        known: Contacts by the sensors to learn from.
        seed, steps, cache: See `trained`.

    Raises:
        SystemExit: If the training is stopped; what is saved goes on in the next call.
    """
    touches, images = ([np.asarray(getattr(one.seen, name)) for one in known] for name in ("touch", "image"))
    prints = "-".join(one.seen.fingerprint for one in known)
    return {
        row: paired.fitted(method, touches, images, 2 * steps, cache, prints, seed) for method, row in OF_PAIRS.items()
    }
