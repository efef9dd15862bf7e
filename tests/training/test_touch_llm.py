"""Touch-LLM's two stages, two steps each, and what is asked about the world."""

import json
from pathlib import Path

import torch
from safetensors.torch import load_file
from transformers import AutoTokenizer, LlamaForCausalLM

from unitouch_gen.models.language import LanguageBridge
from unitouch_gen.training import language_model, touch_llm
from unitouch_gen.training.stages import run, weights_of
from unitouch_gen.training.trainer import checkpoints_in
from unitouch_gen.world import ATTRIBUTES, MATERIALS, World
from unitouch_gen.world.questions import QUESTIONS, answered

SHORT = ("data.drawn={sensors: [digit], objects: 1, contacts_per_object: 1}", "trainer.batch_size=8",
         "trainer.steps=2", "trainer.warmup=1", "trainer.save_every=1", "trainer.keep_checkpoints=2")  # fmt: skip
TINY = ("tokenizer.vocab_size=300", "model.hidden_size=16", "model.intermediate_size=24", "model.num_hidden_layers=2",
        "data.image_size=32", "data.audio={clip_seconds: 0.2, clips: 1, mel_bins: 16, frames: 24}")  # fmt: skip


def test_the_stages_leave_a_language_model_and_a_bridge_into_it(joint: str, tmp_path: Path) -> None:
    def stage(module, kind, name: str, *words: str, settings: tuple[str, ...]) -> Path:
        overrides = [word for setting in (*SHORT, *settings) for word in ("--set", setting)]
        run(name, kind, module.main, [*words, *overrides, "--output", str(tmp_path / name), "--cache", str(tmp_path)])
        return tmp_path / name

    kind = language_model.LanguageModelRecipe
    llama = stage(language_model, kind, "language_model", settings=TINY) / "model"
    given = ("--joint", joint, "--llama", str(llama))
    made = stage(touch_llm, touch_llm.TouchLLMRecipe, "touch_llm", *given, settings=("model.intermediate_size=24",))
    record = json.loads((made / "record.json").read_text())
    assert record["inputs"] == {"joint": weights_of(Path(joint)), "llama": weights_of(llama)}
    first, last = (load_file(folder / "model.safetensors") for folder in checkpoints_in(made))
    changed = {key.split(".")[0] for key, value in last.items() if not torch.equal(value, first[key])}
    assert changed == {"bridge"}  # the language model is frozen
    bridge = LanguageBridge.from_pretrained(made / "model" / "language_bridge")
    model = LlamaForCausalLM.from_pretrained(made / "model" / "language_model")
    bridge.check_fits(model)
    assert bridge.gates.any() and weights_of(made / "model" / "language_model") == weights_of(llama)
    tokenizer = AutoTokenizer.from_pretrained(llama)
    assert (tokenizer.pad_token_id, tokenizer.eos_token_id) == (0, 2) == (0, model.config.eos_token_id)


def test_labels_are_the_answers_and_their_end(processor) -> None:
    tokenizer = language_model.train_language_tokenizer(["How is it?\nrough."], 280)
    pairs = language_model.encoded(tokenizer, [[("How is it?", "rough."), ("ä?", "é")]])
    for row, (prompt, answer) in enumerate((("How is it?\n", "rough."), ("ä?\n", "é"))):
        ids, labels = pairs["input_ids"][0, row], pairs["labels"][0, row]
        assert tokenizer.decode(labels[labels >= 0].tolist()) == answer + "</s>"
        assert tokenizer.decode(ids.tolist(), skip_special_tokens=True) == prompt + answer


def test_answers_are_true_of_the_world() -> None:
    world = World(3, image_size=64)
    names = torch.cartesian_prod(torch.arange(17), torch.arange(6), torch.arange(1)).T
    scene = world.render(*names, modalities=("attributes", "grasp", "text"))
    draws, attributes = world.draw(*names), scene.attributes["gelsight"]
    for variant in range(2):
        for row, told in enumerate(answered(draws, attributes, variant)):
            spec, measured = MATERIALS[int(names[0][row])], dict(zip(ATTRIBUTES, attributes[row].tolist(), strict=True))
            assert all(question in QUESTIONS[topic] for topic, (question, _) in told.items())
            known = told["material"][1] == f"it is {spec.name}."
            assert known != (measured["cover"] < 0.12) and told["feel"][1].count(spec.feel[0]) == 1
            holds = told["grasp"][1] in ("yes, it would hold.", "no, it would hold.")
            assert holds == bool(scene.grasp[row] > 1)
            assert (told["grasp"][1][:3] == "yes") == (holds != ("slip" in told["grasp"][0]))
            assert (told["grain"][1] == "it has no grain.") != spec.grained
            if variant == 0:
                assert told["caption"][1] == f"{scene.text[row]}."
    flat = attributes[:1].expand(5, -1).clone()
    contacts = [[0.95, 0.0, 0.0], [0.3, -0.5, 0.1], [0.3, 0.5, 0.1], [0.3, 0.1, -0.5], [0.3, 0.0, 0.0]]
    flat[:, [ATTRIBUTES.index(name) for name in ("cover", "place x", "place y")]] = torch.tensor(contacts)
    places = [told["place"][1] for told in answered(world.draw(*(part[:5] for part in names)), flat)]
    assert places == ["all over the view.", "to the left.", "to the right.", "above.", "in the centre."]
