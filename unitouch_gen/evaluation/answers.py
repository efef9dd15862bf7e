"""Accuracy of answers about touches (Section 4.6 of the paper)."""

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from typing import Any

from torch import Tensor
from torchmetrics.functional.text import rouge_score

from unitouch_gen.evaluation.contacts import Splits
from unitouch_gen.evaluation.controls import Figures, others
from unitouch_gen.evaluation.generated import sample_per_class
from unitouch_gen.evaluation.metrics import cosines
from unitouch_gen.evaluation.zero_shot import PROMPTS
from unitouch_gen.models.features import float_pixels, in_batches
from unitouch_gen.world.questions import TOPICS

Asked = Mapping[str, tuple[str, Sequence[str]]]
"""By topic (see `unitouch_gen.world.questions`), a question about a contact and its true answers."""


def caption_table(pipe: Any, splits: Splits, embed: Callable[[Sequence[str]], Tensor], each: int) -> dict[str, Figures]:
    """Accuracy of answers on `each` contacts of every material of the split "test", by row.

    Touches are answered zero-shot. The same questions are asked of other contacts' touches, and of pictures. Accuracies
    of hardness and grasps are balanced over the true classes; that of grains is over contacts with a grain. ROUGE-L of
    a caption is to the nearest true caption.

    Args:
        pipe: A `TouchToTextPipeline`.
        embed: Returns unit embeddings of texts, for the zero-shot classifier.
    """
    test = splits["test"]
    materials = test.classes.get("material", ())
    rows = sample_per_class(test, each)
    asked_of_test = test.asked()
    asked = [asked_of_test[row] for row in rows.tolist()]
    topics = list(asked[0])
    pixels = float_pixels(test.touch[rows.numpy()])
    sensors = [test.sensors[row] for row in rows.tolist()]
    touch = in_batches(len(rows), lambda part: pipe.encode_touch(pixels[part], sensors[part]))
    embeds = {"touch": touch, "shuffled touches": touch[others(len(touch))]}
    if "image" in test.features:
        embeds["picture"] = test.features["image"][rows]
    most_frequent = most_frequent_answers(splits["train"].asked(), topics)
    answers = {"most frequent answer": {topic: [answer] * len(rows) for topic, answer in most_frequent.items()}}
    for name, values in embeds.items():
        answers[name] = {}
        for topic in topics:
            questions = [by_topic[topic][0] for by_topic in asked]
            answers[name][topic] = answered(pipe, values, questions)
    figures = {name: measured(asked, by_topic, materials) for name, by_topic in answers.items()}
    if "material" in topics:
        classes = embed([PROMPTS["touch"].format(name) for name in materials])
        predicted = cosines(test.features["touch"][rows], classes).argmax(dim=1)
        accuracy = float((predicted == test.material[rows]).double().mean())
        figures["zero-shot classifier"] = {"material": accuracy}
    return figures


def most_frequent_answers(asked: Sequence[Asked], topics: Sequence[str]) -> dict[str, str]:
    """The most frequent true answer of each topic."""
    answers = dict[str, str]()
    for topic in topics:
        counts = Counter(by_topic[topic][1][0] for by_topic in asked)
        answers[topic], _ = counts.most_common(1)[0]
    return answers


def answered(pipe: Any, embeds: Tensor, questions: Sequence[str]) -> list[str]:
    """The likeliest answer to each of N questions about embeddings (N, D)."""
    answers = list[str]()
    for start in range(0, len(questions), 64):
        batch = slice(start, start + 64)
        answers += pipe(touch_embeds=embeds[batch], question=list(questions[batch]), do_sample=False).texts
    return answers


def measured(asked: Sequence[Asked], answers: Mapping[str, Sequence[str]], materials: Sequence[str]) -> Figures:
    """Accuracies of answers by topic, one answer to each of the questions `asked`, and ROUGE-L of captions."""
    figures = Figures()
    for name, topic in TOPICS.items():
        if name not in answers or not topic.figure:
            continue
        words = topic.words or {material: material for material in materials}
        truths = [class_of(by_topic[name][1][0], words) for by_topic in asked]
        predicted = [class_of(text, words) for text in answers[name]]
        figures[topic.figure] = accuracy(truths, predicted, balanced=topic.balanced)
    if "caption" in answers:
        true_captions = [list(by_topic["caption"][1]) for by_topic in asked]
        scores = rouge_score(list(answers["caption"]), true_captions, accumulate="best", rouge_keys="rougeL")
        figures["ROUGE-L"] = float(scores["rougeL_fmeasure"])
    return figures


def accuracy(truths: Sequence[str | None], predicted: Sequence[str | None], *, balanced: bool) -> float:
    """Share of right classes among those with a true one, or its mean over the true classes."""
    right_of: dict[str, list[bool]] = {}
    for truth, prediction in zip(truths, predicted, strict=True):
        if truth:
            right_of.setdefault(truth, []).append(prediction == truth)
    groups = list(right_of.values()) if balanced else [[*chain(*right_of.values())]]
    return sum(sum(right) / len(right) for right in groups) / len(groups)


def class_of(text: str, words: Mapping[str, str]) -> str | None:
    """The class of the first of `words` in a text; `None` if the text has none of them."""
    match = re.search(rf"\b(?:{'|'.join(map(re.escape, words))})\b", text)
    return words[match[0]] if match else None
