"""Touch-LLM's bridge (Section 4.6 of the paper): trained on pictures' embeddings, touches are put in zero-shot.

    python -m unitouch_gen.training.touch_llm --joint runs/image_text/model --llama runs/language_model/model

Projection, blocks, queries and gates alone are trained; the language model and the joint space are frozen.
"""

import shutil

import torch
from torch import Tensor, nn
from transformers import AutoTokenizer, LlamaForCausalLM

from unitouch_gen.models.language import LanguageBridge
from unitouch_gen.training.batches import ArrayDataset, Batch
from unitouch_gen.training.language_model import TextSettings, encoded, one_of, pairs_of
from unitouch_gen.training.recipe import Arguments, build
from unitouch_gen.training.stages import Recipe, Stage, run


class TouchLLMRecipe(Recipe):
    model: Arguments  # of `LanguageBridge.for_model`
    texts: TextSettings = TextSettings()


class TouchLLMObjective(nn.Module):
    """Cross-entropy of the answers' tokens, of a frozen language model that a picture's embedding is attached to."""

    def __init__(self, bridge: LanguageBridge, language_model: LlamaForCausalLM):
        super().__init__()
        self.trained, self.language_model = bridge, language_model.requires_grad_(False).eval()

    def train(self, mode: bool = True) -> "TouchLLMObjective":
        super().train(mode)
        self.language_model.eval()
        return self

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        ids, labels = one_of(batch)
        with self.trained.attach(self.language_model, batch["image_embeds"]):
            return {"loss": self.language_model(input_ids=ids, labels=labels).loss}


def main(stage: Stage) -> None:
    recipe: TouchLLMRecipe = stage.recipe
    joint, place = stage.joint_space("image"), stage.folders["llama"]
    language_model = LlamaForCausalLM.from_pretrained(place, dtype=torch.float32, use_safetensors=True)
    given = {"language_model": language_model, "embedding_dim": joint.config.projection_dim}
    bridge = build("model", LanguageBridge.for_model, recipe.model, **given)
    splits = stage.splits("image", "text")
    pairs = encoded(AutoTokenizer.from_pretrained(place), pairs_of(stage.sources, splits, recipe.texts.variants))
    dataset = ArrayDataset(image_embeds=stage.image_embeddings(joint, splits), **pairs)
    stage.fit(TouchLLMObjective(bridge, language_model), dataset)
    with stage.saving() as folder:
        bridge.save_pretrained(folder / "language_bridge")
        shutil.copytree(place, folder / "language_model")


if __name__ == "__main__":
    run("touch_llm", TouchLLMRecipe, main)
