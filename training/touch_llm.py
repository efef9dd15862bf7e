"""Touch-LLM (Section 4.6 of the paper): a bridge from image embeddings into a frozen LLaMA, for touches zero-shot.

The stage `language_model` trains the tiny family's LLaMA from random weights on questions about the world. A model so
small, if trained on words alone, hardly attends to a bridge. So it is trained with a bridge, which is discarded.
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
VARIANTS = 3  # wordings of each topic
Pairs = list[tuple[str, str]]  # questions and answers


class AnswerSettings(Settings):
    """Settings of `AnswerObjective`."""

    noise: NonNegativeFloat  # largest norm of the noise on unit embeddings


class TouchLLMRecipe(Recipe):
    model: Arguments = {}  # arguments of the `LlamaConfig` of `language_model`
    bridge: Arguments  # arguments of `LanguageBridge.for_model`
    objective: AnswerSettings


class AnswerObjective(nn.Module):
    """Cross-entropy of the answers' tokens, by a bridge into a language model that is frozen or trained with it.

    Noise of up to the norm `noise` is added to unit embeddings. So a bridge trained on embeddings of pictures works on
    those of touches, which lie beside them (Nukrai et al., 2022, "Text-Only Training for Image Captioning using
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
        count, pairs, _ = batch["input_ids"].shape
        rows = torch.arange(count)
        chosen = torch.randint(pairs, (count,))  # one question and answer of each contact
        ids = batch["input_ids"][rows, chosen].long()
        labels = batch["labels"][rows, chosen].long()
        longest = int((labels != -100).any(dim=0).nonzero().max()) + 1  # only padding follows
        ids = ids[:, :longest]
        labels = labels[:, :longest]
        embeds = F.normalize(batch["image_embeds"].float(), dim=1)
        noise_norm = self.noise * torch.rand_like(embeds[:, :1])
        embeds = embeds + noise_norm * F.normalize(torch.randn_like(embeds), dim=1)
        with self.bridge.attach(self.language_model, embeds):
            return {"loss": self.language_model(input_ids=ids, labels=labels).loss}


def pairs_of(sources: Sequence[Source], splits: Sequence[Contacts]) -> list[Pairs]:
    """Questions and answers of each sample. For a sample of a data set, every answer is its caption."""
    pairs = list[Pairs]()
    for source, split in zip(sources, splits, strict=True):
        if isinstance(source, DrawnContacts):
            draws = source.world().draw(*source.contacts("train"))
            attributes = split.attributes.mean(dim=1)
            variants = [answered(draws, attributes, variant) for variant in range(VARIANTS)]
            for by_variant in zip(*variants, strict=True):
                pairs.append([pair for by_topic in by_variant for pair in by_topic.values()])
        else:
            questions = TOPICS["caption"].questions * len(TOPICS)
            for caption in split.text:
                pairs.append([(question, caption) for question in questions])
    return pairs


def encoded(tokenizer: PreTrainedTokenizerBase, pairs: Sequence[Pairs]) -> dict[str, Tensor]:
    """Columns of token ids and of labels, which are the ids of answers and -100 elsewhere, int16 (N, V, T)."""
    flat = [pair for pairs_of_sample in pairs for pair in pairs_of_sample]
    prompts = [PROMPT.replace("{question}", question) for question, _ in flat]
    answers = [answer for _, answer in flat]
    tokens = tokenizer(prompts, answers, padding=True, return_token_type_ids=True, return_tensors="pt")
    ids = tokens["input_ids"].short()
    labels = ids.masked_fill(tokens["token_type_ids"] == 0, -100)
    columns = {"input_ids": ids, "labels": labels}
    return {name: column.view(len(pairs), -1, ids.shape[1]) for name, column in columns.items()}


def main(stage: Stage, recipe: TouchLLMRecipe) -> None:
    llama = stage.folders.get("llama")  # only `touch_llm` has one
    if llama is not None and recipe.model:
        raise InvalidInputError("`model` is that of `--llama`; leave the section out.")
    tokenizer_folder = llama or TOUCH_TO_TEXT / "language_model"  # the built-in tokenizer knows every byte
    tokenizer = read_tokenizer("llama", tokenizer_folder, AutoTokenizer)
    if llama is not None:
        with reading("llama", llama):
            model = read_network(LlamaForCausalLM, llama, dtype=torch.float32)
    joint = stage.joint_space("image")
    splits = stage.splits("image", "text")
    if llama is None:
        special = {f"{name}_token_id": getattr(tokenizer, f"{name}_token_id") for name in ("pad", "bos", "eos")}
        model = LlamaForCausalLM(build("model", LlamaConfig, recipe.model, vocab_size=len(tokenizer), **special))
    bridge = build(
        "bridge",
        LanguageBridge.for_model,
        recipe.bridge,
        language_model=model,
        embedding_dim=joint.config.projection_dim,
    )
    columns = encoded(tokenizer, pairs_of(stage.sources, splits))
    dataset = ArrayDataset(image_embeds=stage.image_embeddings(joint, splits), **columns)
    stage.fit(AnswerObjective(model, bridge, recipe.objective.noise, frozen=llama is not None), dataset)
    with stage.saving() as folder:
        if llama is not None:
            bridge.save_pretrained(folder / "language_bridge")
            shutil.copytree(llama, folder / "language_model")
        else:
            model.save_pretrained(folder)
            tokenizer.save_pretrained(folder)
