"""The tiny family's language model: a LLaMA with a tokenizer of its own, from nothing, on what the world can be asked.

It is so small, and reads so little, that a bridge into one that was trained on words alone hardly moves it. So it is
trained with a bridge from pictures' embeddings, which is left: `touch_llm` trains another, with the model frozen.

python -m unitouch_gen.training.language_model --joint runs/image_text/model --output runs/language_model
"""

import json
from collections.abc import Iterable, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from pydantic import NonNegativeFloat
from tokenizers import Tokenizer, decoders, models, pre_tokenizers, processors, trainers
from torch import Tensor, nn
from transformers import LlamaConfig, LlamaForCausalLM, PreTrainedTokenizerBase, PreTrainedTokenizerFast

from unitouch_gen.errors import check_integer
from unitouch_gen.models import UniTouchModel
from unitouch_gen.models.language import LanguageBridge
from unitouch_gen.training.batches import ArrayDataset, Batch
from unitouch_gen.training.data import DrawnContacts, Rendered, Source
from unitouch_gen.training.recipe import Arguments, Settings, build
from unitouch_gen.training.stages import Recipe, Stage, run
from unitouch_gen.world import World
from unitouch_gen.world.questions import TOPICS, answered

PROMPT = "{question}\n"  # before an answer
VARIANTS = 3  # of the wording of each topic
Pairs = list[tuple[str, str]]


class AnswerSettings(Settings):
    """What `AnswerObjective` does to embeddings."""

    noise: NonNegativeFloat  # greatest length of what is added to unit embeddings


class LanguageModelRecipe(Recipe):
    tokenizer: Arguments
    model: Arguments
    bridge: Arguments  # of `LanguageBridge.for_model`, which is trained beside it and left
    objective: AnswerSettings


class AnswerObjective(nn.Module):
    """Cross-entropy of the answers' tokens of a bridge into a language model, which is frozen or is trained with it.

    Unit embeddings get a random vector of up to the length `noise`, so that a bridge that was trained on pictures'
    takes those of touches, which lie beside them (Nukrai et al., 2022, "Text-Only Training for Image Captioning using
    Noise-Injected CLIP").
    """

    def __init__(self, language_model: LlamaForCausalLM, bridge: LanguageBridge, noise: float, frozen: bool):
        super().__init__()
        self.language_model, self.bridge = language_model.requires_grad_(not frozen), bridge
        self.noise, self.frozen = noise, frozen

    @property
    def trained(self) -> nn.Module:
        return self.bridge if self.frozen else self

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        rows = torch.arange(len(batch["input_ids"]))
        chosen = torch.randint(batch["input_ids"].shape[1], (len(rows),))  # one of the pairs (B, V, T) of each contact
        ids, labels = (batch[name][rows, chosen].long() for name in ("input_ids", "labels"))
        longest = int((labels != -100).any(dim=0).nonzero().max()) + 1  # what is behind it is padding
        ids, labels = ids[:, :longest], labels[:, :longest]
        embeds = F.normalize(batch["image_embeds"].float(), dim=1)
        embeds = embeds + self.noise * torch.rand(len(rows), 1) * F.normalize(torch.randn_like(embeds), dim=1)
        with self.bridge.attach(self.language_model, embeds):
            return {"loss": self.language_model(input_ids=ids, labels=labels).loss}


def pairs_of(sources: Sequence[Source], splits: Sequence[Rendered]) -> list[Pairs]:
    """Questions and answers of each sample; of a data set's, its caption again and again."""
    pairs = list[Pairs]()
    for source, split in zip(sources, splits, strict=True):
        if isinstance(source, DrawnContacts):
            draws = World(source.seed).draw(*source.contacts("train"))
            measured = torch.tensor(split.attributes).mean(dim=1)
            asked = [answered(draws, measured, variant) for variant in range(VARIANTS)]
            pairs += [[pair for one in told for pair in one.values()] for told in zip(*asked, strict=True)]
        else:
            questions = TOPICS["caption"].questions * len(TOPICS)
            pairs += [[(question, caption) for question in questions] for caption in split.text]
    return pairs


def encoded(tokenizer: PreTrainedTokenizerBase, pairs: Sequence[Pairs]) -> dict[str, Tensor]:
    """Columns of token ids, and of labels, which are those of answers, int16 (N, V, T)."""
    questions, answers = zip(*(pair for one in pairs for pair in one), strict=True)
    prompts = [PROMPT.replace("{question}", question) for question in questions]
    tokens = tokenizer(prompts, list(answers), padding=True, return_token_type_ids=True, return_tensors="pt")
    ids = tokens["input_ids"].short()
    columns = {"input_ids": ids, "labels": ids.masked_fill(tokens["token_type_ids"] == 0, -100)}
    return {name: column.view(len(pairs), -1, ids.shape[1]) for name, column in columns.items()}


def train_language_tokenizer(texts: Iterable[str], vocab_size: int) -> PreTrainedTokenizerFast:
    """Byte-pair encoding of texts; every byte is in the vocabulary. Prompts begin with <s>, and answers end in </s>."""
    alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
    check_integer("vocab_size", vocab_size, len(alphabet) + 3, 2**15)
    core, byte_level = Tokenizer(models.BPE()), pre_tokenizers.ByteLevel(add_prefix_space=False)
    core.pre_tokenizer = byte_level
    named = ["<pad>", "<s>", "</s>", *alphabet]  # the trainer numbers what is not named in no fixed order
    trainer = trainers.BpeTrainer(vocab_size=vocab_size, special_tokens=named, show_progress=False)
    core.train_from_iterator(texts, trainer)
    trained = json.loads(core.to_str())["model"]
    made = Tokenizer(models.BPE(trained["vocab"], [tuple(merge) for merge in trained["merges"]]))
    made.pre_tokenizer, made.decoder = byte_level, decoders.ByteLevel()
    made.post_processor = processors.TemplateProcessing(
        single="<s> $A", pair="<s> $A:0 $B:1 </s>:1", special_tokens=[("<s>", 1), ("</s>", 2)]
    )
    return PreTrainedTokenizerFast(tokenizer_object=made, pad_token="<pad>", bos_token="<s>", eos_token="</s>")


def main(stage: Stage) -> None:
    recipe: LanguageModelRecipe = stage.recipe
    build("tokenizer", train_language_tokenizer, recipe.tokenizer, texts=())  # refused before anything is rendered
    joint, splits = stage.joint_space("image"), stage.splits("image", "text")
    pairs = pairs_of(stage.sources, splits)
    texts = (text for one in pairs for pair in one for text in pair)
    tokenizer = build("tokenizer", train_language_tokenizer, recipe.tokenizer, texts=texts)
    special = {"vocab_size": len(tokenizer), "pad_token_id": 0, "bos_token_id": 1, "eos_token_id": 2}
    model = LlamaForCausalLM(build("model", LlamaConfig, recipe.model, **special))
    bridge = build_bridge("bridge", recipe.bridge, model, joint)
    dataset = ArrayDataset(image_embeds=stage.image_embeddings(joint, splits), **encoded(tokenizer, pairs))
    stage.fit(AnswerObjective(model, bridge, recipe.objective.noise, frozen=False), dataset)
    with stage.saving() as folder:
        model.save_pretrained(folder)
        tokenizer.save_pretrained(folder)


def build_bridge(section: str, arguments: Arguments, language_model: LlamaForCausalLM, joint: UniTouchModel) -> Any:
    given = {"language_model": language_model, "embedding_dim": joint.config.projection_dim}
    return build(section, LanguageBridge.for_model, arguments, **given)


if __name__ == "__main__":
    run("language_model", LanguageModelRecipe, main)
