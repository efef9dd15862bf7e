"""A small CLIP tokenizer, trained on the world's captions with the `tokenizers` library."""

import json
from collections.abc import Iterable

from tokenizers import Tokenizer, models, pre_tokenizers, trainers
from tokenizers.normalizers import Lowercase
from transformers import CLIPTokenizer

from unitouch_gen.conditioning import QUALITY_PROMPT
from unitouch_gen.errors import check_integer
from unitouch_gen.models.processing import LENGTHS

START, END = "<|startoftext|>", "<|endoftext|>"

PROMPTS = (
    QUALITY_PROMPT, "low quality, blurry", "this is an image of a material", "this is a touch image of a material",
    "this looks like it", "this feels like it", "image of", "touch of", "the object is lifted in the air",
    "the object is falling on the ground",
)  # fmt: skip


def train_tokenizer(texts: Iterable[str], vocab_size: int, max_length: int) -> CLIPTokenizer:
    """Byte-pair encoding in CLIP's form, with ids start = n - 2 and end = n - 1, of texts to learn merges from.

    Every byte is in the vocabulary, so any text can be encoded: 514 pieces hold the bytes, within a word and at its
    end, with start and end. Texts are padded or cut to `max_length` tokens.
    """
    alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
    check_integer("vocab_size", vocab_size, 2 * len(alphabet) + 2, 10**6)
    check_integer("max_length", max_length, *LENGTHS)
    core = Tokenizer(models.BPE(end_of_word_suffix="</w>"))
    core.normalizer = Lowercase()
    byte_level = pre_tokenizers.ByteLevel(add_prefix_space=False)
    core.pre_tokenizer = pre_tokenizers.Sequence([pre_tokenizers.Whitespace(), byte_level])
    trainer = trainers.BpeTrainer(
        vocab_size=vocab_size - 2,
        # The trainer numbers what it meets in no fixed order, and breaks ties between merges by number; what is named
        # here has its number before. A resumed run has to find the vocabulary it began with.
        special_tokens=[*alphabet, *(f"{byte}</w>" for byte in alphabet)],
        initial_alphabet=alphabet,
        end_of_word_suffix="</w>",
        show_progress=False,
    )
    core.train_from_iterator([*texts, *PROMPTS], trainer)
    trained = json.loads(core.to_str())["model"]
    pieces = sorted(trained["vocab"], key=trained["vocab"].__getitem__)
    vocab = {piece: index for index, piece in enumerate([*pieces, START, END])}
    merges = [tuple(merge) for merge in trained["merges"]]
    return CLIPTokenizer(vocab=vocab, merges=merges, model_max_length=max_length, pad_token=END)  # type: ignore[arg-type]
