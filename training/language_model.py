"""The tiny family's language model: a LLaMA with a tokenizer of its own, from nothing, on the world's texts.

python -m unitouch_gen.training.language_model --output runs/language_model
"""

import json
from collections.abc import Iterable, Sequence

import torch
from pydantic import PositiveInt
from tokenizers import Tokenizer, decoders, models, pre_tokenizers, processors, trainers
from torch import Tensor, nn
from transformers import LlamaConfig, LlamaForCausalLM, PreTrainedTokenizerBase, PreTrainedTokenizerFast

from unitouch_gen.errors import check_integer
from unitouch_gen.training.batches import ArrayDataset, Batch
from unitouch_gen.training.data import DrawnContacts, Rendered, Source
from unitouch_gen.training.recipe import Arguments, Settings, build
from unitouch_gen.training.stages import Recipe, Stage, run
from unitouch_gen.world import World
from unitouch_gen.world.questions import QUESTIONS, answered

PAD, START, END = "<pad>", "<s>", "</s>"
PROMPT = "{question}\n"  # before an answer
IGNORED = -100  # label of tokens without a loss


class TextSettings(Settings):
    """Question-answer pairs of drawn contacts."""

    variants: PositiveInt = 3  # of each contact and topic


class LanguageModelRecipe(Recipe):
    tokenizer: Arguments
    model: Arguments
    texts: TextSettings = TextSettings()


class LanguageModelObjective(nn.Module):
    """Cross-entropy of the next token, of questions and answers alike."""

    def __init__(self, model: LlamaForCausalLM):
        super().__init__()
        self.trained = model

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        ids, _ = one_of(batch)
        labels = ids.masked_fill(ids == self.trained.config.pad_token_id, IGNORED)
        return {"loss": self.trained(input_ids=ids, labels=labels).loss}


def one_of(batch: Batch) -> tuple[Tensor, Tensor]:
    """Token ids and labels (B, T) of one of the pairs (B, V, T) of each contact, drawn at random."""
    ids, labels = batch["input_ids"], batch["labels"]
    rows = torch.arange(len(ids), device=ids.device)
    chosen = torch.randint(ids.shape[1], (len(ids),)).to(ids.device)
    return ids[rows, chosen].long(), labels[rows, chosen].long()


def pairs_of(sources: Sequence[Source], splits: Sequence[Rendered], variants: int) -> list[list[tuple[str, str]]]:
    """Questions and answers of each sample; of a data set's, its caption again and again."""
    pairs = list[list[tuple[str, str]]]()
    for source, split in zip(sources, splits, strict=True):
        if isinstance(source, DrawnContacts):
            draws, measured = World(source.seed).draw(*source.contacts("train")), torch.tensor(split.attributes).mean(1)
            asked = [answered(draws, measured, variant) for variant in range(variants)]
            pairs += [[pair for one in told for pair in one.values()] for told in zip(*asked, strict=True)]
        else:
            wordings = QUESTIONS["caption"] * (2 * variants)
            pairs += [[(question, text) for question in wordings] for text in split.text]
    return pairs


def encoded(tokenizer: PreTrainedTokenizerBase, pairs: Sequence[Sequence[tuple[str, str]]]) -> dict[str, Tensor]:
    """Columns of token ids and of labels, which are those of answers, int16 (N, V, T); padded on the right."""
    flat = [pair for one in pairs for pair in one]
    prompts = tokenizer([PROMPT.replace("{question}", question) for question, _ in flat])["input_ids"]
    answers = tokenizer([answer + END for _, answer in flat], add_special_tokens=False)["input_ids"]
    size = max(len(prompt) + len(answer) for prompt, answer in zip(prompts, answers, strict=True))
    ids = torch.full((len(flat), size), tokenizer.pad_token_id, dtype=torch.int16)
    labels = torch.full_like(ids, IGNORED)
    for row, (prompt, answer) in enumerate(zip(prompts, answers, strict=True)):
        ids[row, : len(prompt) + len(answer)] = torch.tensor(prompt + answer)
        labels[row, len(prompt) : len(prompt) + len(answer)] = torch.tensor(answer)
    return {name: one.view(len(pairs), -1, size) for name, one in (("input_ids", ids), ("labels", labels))}


def train_language_tokenizer(texts: Iterable[str], vocab_size: int) -> PreTrainedTokenizerFast:
    """Byte-pair encoding of texts, whose prompts begin with `<s>`; every byte is in the vocabulary."""
    alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
    check_integer("vocab_size", vocab_size, len(alphabet) + 3, 2**15)
    core = Tokenizer(models.BPE())
    core.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    named = [PAD, START, END, *alphabet]  # the trainer numbers what is not named in no fixed order
    core.train_from_iterator(
        texts, trainers.BpeTrainer(vocab_size=vocab_size, special_tokens=named, show_progress=False)
    )
    trained = json.loads(core.to_str())["model"]
    made = Tokenizer(models.BPE(trained["vocab"], [tuple(merge) for merge in trained["merges"]]))
    made.pre_tokenizer, made.decoder = core.pre_tokenizer, decoders.ByteLevel()
    made.post_processor = processors.TemplateProcessing(single=f"{START} $A", special_tokens=[(START, 1)])
    return PreTrainedTokenizerFast(tokenizer_object=made, pad_token=PAD, bos_token=START, eos_token=END)


def main(stage: Stage) -> None:
    recipe: LanguageModelRecipe = stage.recipe
    build("tokenizer", train_language_tokenizer, recipe.tokenizer, texts=())  # refused before anything is rendered
    splits = stage.splits("text")
    pairs = pairs_of(stage.sources, splits, recipe.texts.variants)
    texts = (f"{question}\n{answer}" for one in pairs for question, answer in one)
    tokenizer = build("tokenizer", train_language_tokenizer, recipe.tokenizer, texts=texts)
    special = {"vocab_size": len(tokenizer), "pad_token_id": 0, "bos_token_id": 1, "eos_token_id": 2}
    model = LlamaForCausalLM(build("model", LlamaConfig, recipe.model, **special))
    stage.fit(LanguageModelObjective(model), ArrayDataset(**encoded(tokenizer, pairs)))
    with stage.saving() as folder:
        model.save_pretrained(folder)
        tokenizer.save_pretrained(folder)


if __name__ == "__main__":
    run("language_model", LanguageModelRecipe, main)
