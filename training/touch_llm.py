"""Touch-LLM's bridge (Section 4.6 of the paper), on pictures' embeddings: touches are put in zero-shot.

python -m unitouch_gen.training touch_llm --joint runs/image_text/model --llama runs/language_model/model
"""

import shutil

import torch
from transformers import AutoTokenizer, LlamaForCausalLM

from unitouch_gen.training.batches import ArrayDataset
from unitouch_gen.training.language_model import AnswerObjective, AnswerSettings, build_bridge, encoded, pairs_of
from unitouch_gen.training.recipe import Arguments
from unitouch_gen.training.stages import Recipe, Stage


class TouchLLMRecipe(Recipe):
    model: Arguments  # of `LanguageBridge.for_model`
    objective: AnswerSettings


def main(stage: Stage, recipe: TouchLLMRecipe) -> None:
    joint, place = stage.joint_space("image"), stage.folders["llama"]
    llama = LlamaForCausalLM.from_pretrained(place, dtype=torch.float32, use_safetensors=True)
    bridge = build_bridge("model", recipe.model, llama, joint)
    splits = stage.splits("image", "text")
    pairs = encoded(AutoTokenizer.from_pretrained(place), pairs_of(stage.sources, splits))
    dataset = ArrayDataset(image_embeds=stage.image_embeddings(joint, splits), **pairs)
    stage.fit(AnswerObjective(llama, bridge, recipe.objective.noise, frozen=True), dataset)
    with stage.saving() as folder:
        bridge.save_pretrained(folder / "language_bridge")
        shutil.copytree(place, folder / "language_model")
