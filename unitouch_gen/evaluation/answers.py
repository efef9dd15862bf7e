"""Answers about touches (Section 4.6 of the paper): the share that is right."""

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from typing import Any

from torch import Tensor
from torchmetrics.functional.text import rouge_score

from unitouch_gen.evaluation.contacts import Splits, float_pixels, in_batches
from unitouch_gen.evaluation.controls import Figures, others
from unitouch_gen.evaluation.generated import some
from unitouch_gen.evaluation.metrics import cosines
from unitouch_gen.evaluation.zero_shot import PROMPTS
from unitouch_gen.world.questions import TOPICS

Asked = Mapping[str, tuple[str, Sequence[str]]]
"""By topic, see `unitouch_gen.world.questions`: a question about a contact, and answers that are true."""


def caption_table(pipe: Any, splits: Splits, embed: Callable[[Sequence[str]], Tensor], each: int) -> dict[str, Figures]:
    """Shares of answers that are right, of `each` contacts of every material of the split "test", by row.

    Touches are put in zero-shot; the same is asked of other contacts' touches, and of the pictures. Of hardness and
    grasps accuracy is balanced over what is true; of grains it is of such as there are. ROUGE-L of captions is that to
    the nearest true one.

    Args:
        pipe: A `TouchToTextPipeline`.
        embed: Gives unit embeddings of texts, for the zero-shot classifier.
    """
    test = splits["test"]
    names = test.classes.get("material", ())
    rows = some(test, each)
    truths = test.asked()
    before = splits["train"].asked()
    asked = [truths[row] for row in rows.tolist()]
    usual = {topic: Counter(one[topic][1][0] for one in before) for topic in asked[0]}
    pixels = float_pixels(test.touch[rows.numpy()])
    known = [test.sensors[row] for row in rows.tolist()]
    touch = in_batches(len(rows), lambda part: pipe.encode_touch(pixels[part], known[part]))
    embeds = {"touch": touch, "shuffled touches": touch[others(len(touch))]}
    if "image" in test.features:
        embeds["picture"] = test.features["image"][rows]
    answers = {
        "most frequent answer": {topic: [found.most_common(1)[0][0]] * len(rows) for topic, found in usual.items()}
    }
    for row, values in embeds.items():
        answers[row] = {topic: answered(pipe, values, [one[topic][0] for one in asked]) for topic in asked[0]}
    figures = {row: measured(asked, found, names) for row, found in answers.items()}
    if "material" in asked[0]:
        classes = embed([PROMPTS["touch"].format(name) for name in names])
        found = cosines(test.features["touch"][rows], classes).argmax(dim=1)
        figures["zero-shot classifier"] = {"material": float((found == test.material[rows]).double().mean())}
    return figures


def answered(pipe: Any, embeds: Tensor, questions: Sequence[str]) -> list[str]:
    """The likeliest answers to a question about each of N embeddings (N, D)."""
    found = list[str]()
    for part in [slice(start, start + 64) for start in range(0, len(questions), 64)]:
        found += pipe(touch_embeds=embeds[part], question=list(questions[part]), do_sample=False).texts
    return found


def measured(asked: Sequence[Asked], answers: Mapping[str, Sequence[str]], materials: Sequence[str]) -> Figures:
    """Figures of answers by topic, each to one of the questions that were asked."""
    figures = Figures()
    for name, topic in TOPICS.items():
        if name not in answers or not topic.figure:
            continue
        words = topic.words or {material: material for material in materials}
        truths = [class_of(one[name][1][0], words) for one in asked]
        pairs = list(zip(truths, [class_of(text, words) for text in answers[name]], strict=True))
        right = {true: [true == said for other, said in pairs if other == true] for true, _ in pairs if true}
        groups = list(right.values()) if topic.balanced else [[*chain(*right.values())]]
        figures[topic.figure] = sum(sum(found) / len(found) for found in groups) / len(groups)
    if "caption" in answers:
        true = [list(one["caption"][1]) for one in asked]
        scores = rouge_score(list(answers["caption"]), true, accumulate="best", rouge_keys="rougeL")
        figures["ROUGE-L"] = float(scores["rougeL_fmeasure"])
    return figures


def class_of(text: str, words: Mapping[str, str]) -> str | None:
    """The class that the first of some words in a text stands for; `None` if the text has none of them."""
    found = re.search(rf"\b(?:{'|'.join(map(re.escape, words))})\b", text)
    return words[found[0]] if found else None
