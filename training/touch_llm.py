"""Touch-LLM (Section 4.6 of the paper): a bridge from pictures' embeddings into a frozen LLaMA, for touches zero-shot.

The stage `language_model` trains the tiny family's LLaMA from nothing, on what the world can be asked. It is so small,
and reads so little, that a bridge into one that was trained on words alone hardly moves it. So it is trained with a
bridge, which is discarded.
"""

import shutil
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from pydantic import NonNegativeFloat
from torch import Tensor, nn
from transformers import AutoTokenizer, LlamaConfig, LlamaForCausalLM, PreTrainedTokenizerBase

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import read_network, reading
from unitouch_gen.models.language import LanguageBridge
from unitouch_gen.models.processing import read_tokenizer
from unitouch_gen.training.batches import ArrayDataset, Batch
from unitouch_gen.training.data import Contacts, DrawnContacts, Source
from unitouch_gen.training.recipe import Arguments, Settings, build
from unitouch_gen.training.stages import Recipe, Stage
from unitouch_gen.weights import TOUCH_TO_TEXT
from unitouch_gen.world.questions import TOPICS, answered

PROMPT = "{question}\n"  # before an answer
VARIANTS = 3  # of the wording of each topic
Pairs = list[tuple[str, str]]


class AnswerSettings(Settings):
    """What `AnswerObjective` does to embeddings."""

    noise: NonNegativeFloat  # greatest length of what is added to unit embeddings


class TouchLLMRecipe(Recipe):
    model: Arguments = {}  # of the LLaMA that `language_model` trains
    bridge: Arguments  # of `LanguageBridge.for_model`
    objective: AnswerSettings


class AnswerObjective(nn.Module):
    """Cross-entropy of the answers' tokens of a bridge into a language model, which is frozen or is trained with it.

    Unit embeddings get a random vector of up to the length `noise`, so that a bridge that was trained on pictures'
    takes those of touches, which lie beside them (Nukrai et al., 2022, "Text-Only Training for Image Captioning using
    Noise-Injected CLIP").
    """

    def __init__(self, language_model: LlamaForCausalLM, bridge: LanguageBridge, noise: float, frozen: bool):
        super().__init__()
        self.language_model = language_model.requires_grad_(not frozen)
        self.bridge = bridge
        self.noise = noise
        self.frozen = frozen

    @property
    def trained(self) -> nn.Module:
        return self.bridge if self.frozen else self

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        rows = torch.arange(len(batch["input_ids"]))
        chosen = torch.randint(batch["input_ids"].shape[1], (len(rows),))  # one of the pairs (B, V, T) of each contact
        ids, labels = (batch[name][rows, chosen].long() for name in ("input_ids", "labels"))
        longest = int((labels != -100).any(dim=0).nonzero().max()) + 1  # what is behind it is padding
        ids = ids[:, :longest]
        labels = labels[:, :longest]
        embeds = F.normalize(batch["image_embeds"].float(), dim=1)
        embeds = embeds + self.noise * torch.rand_like(embeds[:, :1]) * F.normalize(torch.randn_like(embeds), dim=1)
        with self.bridge.attach(self.language_model, embeds):
            return {"loss": self.language_model(input_ids=ids, labels=labels).loss}


def pairs_of(sources: Sequence[Source], splits: Sequence[Contacts]) -> list[Pairs]:
    """Questions and answers of each sample; of a data set's, its caption again and again."""
    pairs = list[Pairs]()
    for source, split in zip(sources, splits, strict=True):
        if isinstance(source, DrawnContacts):
            draws = source.world().draw(*source.contacts("train"))
            measured = split.attributes.mean(dim=1)
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


def main(stage: Stage, recipe: TouchLLMRecipe) -> None:
    llama = stage.folders.get("llama")  # of `touch_llm` alone
    if llama is not None and recipe.model:
        raise InvalidInputError("`model` is that of `--llama`; leave the section out.")
    words = llama or TOUCH_TO_TEXT / "language_model"  # which knows every byte
    tokenizer = read_tokenizer("llama", words, AutoTokenizer)
    if llama is not None:
        with reading("llama", llama):
            model = read_network(LlamaForCausalLM, llama, dtype=torch.float32)
    joint = stage.joint_space("image")
    splits = stage.splits("image", "text")
    if llama is None:
        special = {f"{name}_token_id": getattr(tokenizer, f"{name}_token_id") for name in ("pad", "bos", "eos")}
        model = LlamaForCausalLM(build("model", LlamaConfig, recipe.model, vocab_size=len(tokenizer), **special))
    given = {"language_model": model, "embedding_dim": joint.config.projection_dim}
    bridge = build("bridge", LanguageBridge.for_model, recipe.bridge, **given)
    pairs = encoded(tokenizer, pairs_of(stage.sources, splits))
    dataset = ArrayDataset(image_embeds=stage.image_embeddings(joint, splits), **pairs)
    stage.fit(AnswerObjective(model, bridge, recipe.objective.noise, frozen=llama is not None), dataset)
    with stage.saving() as folder:
        if llama is not None:
            bridge.save_pretrained(folder / "language_bridge")
            shutil.copytree(llama, folder / "language_model")
        else:
            model.save_pretrained(folder)
            tokenizer.save_pretrained(folder)
