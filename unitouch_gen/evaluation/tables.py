"""Tables 2, 3, 4 and 7 of the paper: figures in [0, 1] of the test split, by row.

Each takes contacts by split, with the features of `embed`. Probes and correlations are fitted to the training split.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from unitouch_gen.evaluation import metrics
from unitouch_gen.evaluation.contacts import EvaluatedContacts, Splits
from unitouch_gen.evaluation.controls import Figures, class_means, others
from unitouch_gen.evaluation.zero_shot import PROMPTS

Embed = Callable[[Sequence[str]], Tensor]  # unit embeddings (N, D) of texts
PROBED = {  # rows of linear probes, by features
    "gel": "untouched gel, probe",
    "statistics": "plain statistics, probe",
    "untrained": "untrained encoder, probe",
    "supervised": "supervised classifier of touches, probe",
    "touch": "touch encoder, probe",
}
ASKED = {"touch": "touch encoder, zero-shot", "image": "picture of the contact, zero-shot"}  # rows, by features
GRASP_PROMPTS = {"dropped": "the object is falling on the ground", "lifted": "the object is lifted in the air"}  # 4.2
TEMPLATES = (
    "this is an image of {}",
    "this is a touch image of {}",
    "this looks like {}",
    "this feels like {}",
    "image of {}",
    "touch of {}",
)
"""The prompts of Table 7."""


def material_table(splits: Splits, embed: Embed) -> Figures:
    """Table 2: accuracy of materials, zero-shot and by linear probes."""
    return _classified(splits, "material", PROMPTS["touch"].format, embed)


def grasp_table(splits: Splits, embed: Embed) -> Figures:
    """Table 3: whether a grasp holds, by a touch before it. Accuracy is balanced, as most hold."""
    return _classified(splits, "grasp", GRASP_PROMPTS.__getitem__, embed, balanced=True)


def prompts_table(splits: Splits, embed: Embed) -> Figures:
    """Table 7: zero-shot accuracy of materials by several templates."""
    test, known = _labelled(splits["test"], "material")
    figures = {"chance": 1 / len(known.unique())}
    for template in TEMPLATES:
        classes = embed([template.format(name) for name in splits["test"].classes["material"]])
        figures[template] = metrics.share_right(_nearest(test["touch"], classes, known), known)
    return figures


def retrieval_table(splits: Splits) -> dict[str, Figures]:
    """Table 4: mean average precision of pictures, sounds and captions of the same object, by row and modality.

    The class mean knows each contact's material alone. CCA and PLSCA are fitted to plain statistics of touches, or the
    touch encoder's embeddings, and the embeddings of the other modality.
    """
    train = splits["train"].features
    test = splits["test"]
    figures = dict[str, Figures]()
    touch = test.features["touch"]
    material = test.material
    for modality in [name for name in ("image", "audio", "text") if name in test.features]:
        gallery = test.features[modality]
        pairs = {"chance (another contact's touch)": (touch[others(len(touch))], gallery)}
        if bool((material >= 0).all()):
            pairs["class mean"] = (class_means(touch, material), gallery)
        for method in metrics.CORRELATED:
            for name, what in (("statistics", "plain statistics"), ("touch", "touch encoder")):
                known = (train[name], train[modality])
                pairs[f"{method} of {what}, supervised"] = metrics.correlated(
                    method, known, test.features[name], gallery
                )
        pairs["touch encoder"] = (touch, gallery)
        for row, (queries, found_in) in pairs.items():
            figures.setdefault(row, {})[modality] = metrics.mean_average_precision(queries, found_in, test.objects)
    return figures


def _classified(
    splits: Splits, label: str, prompt: Callable[[str], str], embed: Embed, *, balanced: bool = False
) -> Figures:
    train, fitted = _labelled(splits["train"], label)
    val, chosen = _labelled(splits["val"], label)
    test, known = _labelled(splits["test"], label)
    classes = embed([prompt(name) for name in splits["test"].classes[label]])
    predicted = {"majority": torch.full_like(known, int(torch.bincount(fitted).argmax()))}
    for name, row in PROBED.items():
        if name in test:
            predicted[row] = metrics.linear_probe(train[name], fitted, val[name], chosen, test[name], balanced=balanced)
    for name, row in ASKED.items():
        if name in test:
            predicted[row] = _nearest(test[name], classes, known)
    shares = {row: metrics.share_right(found, known, balanced=balanced) for row, found in predicted.items()}
    return {"chance": 1 / len(known.unique()), **shares}


def _labelled(contacts: EvaluatedContacts, label: str) -> tuple[dict[str, Tensor], Tensor]:
    """Features of the contacts whose label is known, and the labels."""
    labels = contacts.labels[label]
    rows = labels >= 0
    features = {name: values[rows] for name, values in contacts.features.items()}
    return features, labels[rows]


def _nearest(features: Tensor, classes: Tensor, known: Tensor) -> Tensor:
    """The class (N,) whose text is nearest, among those that occur in the labels `known`."""
    asked = known.unique()
    nearest = metrics.cosines(features, classes[asked]).argmax(dim=1)
    return asked[nearest]
