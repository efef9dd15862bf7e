"""`TouchToTextPipeline`: answers about a touch by a language model, Touch-LLM (Section 4.6 of the paper)."""

import copy
import inspect
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import takewhile
from types import NoneType
from typing import Any

import torch
from torch import Tensor
from transformers import PreTrainedModel, PreTrainedTokenizerBase

from unitouch_gen.errors import (
    InvalidInputError,
    check_integer,
    check_kind,
    check_passed,
    check_tensor,
    check_texts,
    check_unused,
    did_you_mean,
    explain_errors,
    one_each,
)
from unitouch_gen.models.images import ImageInput
from unitouch_gen.models.joint import UniTouchModel
from unitouch_gen.models.language import LanguageBridge
from unitouch_gen.models.processing import UniTouchProcessor
from unitouch_gen.pipelines.base import SensorNames, UniTouchPipeline, threads_for
from unitouch_gen.pipelines.output import AnswerReport, TouchToTextPipelineOutput

QUESTION = "{question}"  # where a template has it

_ANSWERING = threading.Lock()  # `generate` draws from torch's global generator, and hooks are seen by all threads


class TouchToTextPipeline(UniTouchPipeline):
    """Touch to text: a language model that answers questions about a touch.

    Args:
        language_bridge: Puts an embedding into the language model; see `LanguageBridge`.
        language_model: Any causal language model of transformers whose attention ends in `o_proj`.
        tokenizer: The language model's; its chat template is used if it has one.
        unitouch, processor: The joint space and its processor. May be `None` if embeddings are passed.
        prompt_template: What the language model was trained to be asked by, with "{question}" in it.
    """

    model_cpu_offload_seq = "unitouch->language_model"
    _optional_components = ["unitouch", "processor"]
    _exclude_from_cpu_offload = ["unitouch", "language_bridge"]
    _task = "image-to-text"
    _example_call = 'pipe(example("brick"), "How does it feel?")'
    _example_end = "print(output.texts[0])"

    def __init__(
        self,
        language_bridge: LanguageBridge,
        language_model: PreTrainedModel,
        tokenizer: PreTrainedTokenizerBase,
        unitouch: UniTouchModel | None = None,
        processor: UniTouchProcessor | None = None,
        prompt_template: str = QUESTION,
    ):
        super().__init__()
        self.register_modules(
            language_bridge=language_bridge,
            language_model=language_model,
            tokenizer=tokenizer,
            unitouch=unitouch,
            processor=processor,
        )
        self._num_weights = language_model.num_parameters()
        if QUESTION not in check_kind("prompt_template", prompt_template, str):
            raise InvalidInputError(f"`prompt_template` is {prompt_template!r}; it has to hold '{QUESTION}'.")
        self.register_to_config(prompt_template=prompt_template)
        language_bridge.check_fits(language_model)
        self._check_widths("`language_bridge`")

    @property
    def embedding_dim(self) -> int:
        """D, width of the embeddings that the language bridge takes."""
        return self.language_bridge.config["embedding_dim"]

    @torch.no_grad()
    def __call__(
        self,
        touch: ImageInput = None,
        question: str | list[str] | None = None,
        max_new_tokens: int | None = None,
        sensor: SensorNames = None,
        background: ImageInput = None,
        image: ImageInput = None,
        touch_embeds: Tensor | None = None,
        generator: torch.Generator | None = None,
        return_dict: bool = True,
        **generate: Any,
    ) -> TouchToTextPipelineOutput | tuple:
        """Answers questions about touches. Other arguments, errors and warnings: see `TouchToImagePipeline.__call__`.

        Args:
            question: One question, or one for each touch; or several about a single touch.
            max_new_tokens: Maximum number of tokens of an answer; default the language model's own, or 128.
            image: Photos in place of `touch`.
            generator: Seeds the sampling of tokens, and torch's global generator stays as it was. Without one, that one
                draws them.
            return_dict: Whether to return an output object rather than the tuple (texts, report).
            generate: Options of the language model's `generate`, such as `do_sample`, `temperature`, `num_beams`,
                `num_return_sequences`, `streamer` or `stopping_criteria`.

        Examples:
            >>> pipe = TouchToTextPipeline.from_pretrained("path/to/touch-llm")  # doctest: +SKIP
            >>> pipe("touch.png", "How does it feel?").texts  # doctest: +SKIP
        """
        # 1. Check inputs, before any network runs
        name, inputs, batch_size = self._read_inputs(touch, image, touch_embeds, sensor=sensor, background=background)
        check_kind("generator", generator, torch.Generator, NoneType)
        prompts = self._tokenize(question, batch_size)
        config, options = self._check_options(prompts, max_new_tokens, generate)
        report = AnswerReport(prompt_tokens=[len(prompt) for prompt in prompts])

        with threads_for(self._num_weights * sum(report.prompt_tokens)):
            # 2. Encode the touch
            with report.stage(name):
                embeds = self._encode(name, inputs, report)

            # 3. Generate token ids, after prompts that are padded on the left
            device = self._execution_device
            pad = config.pad_token_id
            width = max(report.prompt_tokens)
            ids = torch.tensor([[pad] * (width - len(prompt)) + prompt for prompt in prompts], device=device)
            mask = torch.tensor([[0] * (width - size) + [1] * size for size in report.prompt_tokens], device=device)
            rows = embeds.expand(len(prompts), -1).to(device)
            with (
                report.stage("answer"),
                _ANSWERING,
                seeded(generator, device),
                self.language_bridge.attach(self.language_model, rows),
                option_errors(generate),
            ):
                output = self.language_model.generate(ids, attention_mask=mask, generation_config=config, **options)

        # 4. Decode them
        answers = getattr(output, "sequences", output)[:, width:]
        texts = [text.strip() for text in self.tokenizer.batch_decode(answers, skip_special_tokens=True)]
        ends = {pad, *config.eos_token_id}
        report.tokens = [sum(1 for _ in takewhile(lambda one: one not in ends, row)) for row in answers.tolist()]
        self.maybe_free_model_hooks()
        return TouchToTextPipelineOutput(texts, report, embeds) if return_dict else (texts, report)

    @torch.no_grad()
    def encode_touch(self, touch: ImageInput, sensor: SensorNames = None, background: ImageInput = None) -> Tensor:
        """Embeddings (B, D) that the language bridge takes; for arguments and errors see `__call__`."""
        touches = self._read_touches(touch, sensor, background)
        with threads_for(self._num_weights * len(touches.pixels)):
            return self._encode("touch", touches, AnswerReport())

    def _encode(self, name: str, inputs: Any, report: AnswerReport) -> Tensor:
        """Embeddings (B, D) of touches, of photos, or as they were passed."""
        if name == "touch":
            return self._touch_embeds(inputs, report)
        if name == "image":
            return self._match_norm(self.unitouch.get_image_features(inputs), "image")
        return inputs

    def _read_inputs(
        self,
        touch: ImageInput,
        image: ImageInput,
        touch_embeds: Tensor | None,
        *,
        sensor: SensorNames,
        background: ImageInput,
    ) -> tuple[str, Any, int]:
        """Which of the inputs was passed; its touches, pixel values or embeddings; and their number."""
        passed = {"touch": touch, "image": image, "touch_embeds": touch_embeds}
        (name,) = check_passed(passed, only_one=True)
        if name == "touch":
            touches = self._read_touches(touch, sensor, background)
            return name, touches, len(touches.pixels)
        check_unused("without `touch`", sensor=sensor, background=background)
        if name == "image":
            self._require("image", "unitouch", "processor")
            pixel_values = self.processor.images(image)
            return name, pixel_values, len(pixel_values)
        embeds = check_tensor("touch_embeds", touch_embeds, "B", self.embedding_dim)
        return name, embeds, len(embeds)

    def _tokenize(self, question: Any, count: int) -> list[list[int]]:
        """Token ids of a prompt for each of `count` inputs, or of several for a single one."""
        questions = check_texts("question", question, blank=False)
        if count > 1:
            questions = one_each("question", questions, count)
        texts = [self.config["prompt_template"].replace(QUESTION, text) for text in questions]
        chat = getattr(self.tokenizer, "chat_template", None) is not None  # which writes the special tokens itself
        if chat:
            turns = [[{"role": "user", "content": text}] for text in texts]
            texts = self.tokenizer.apply_chat_template(turns, tokenize=False, add_generation_prompt=True)
        return self.tokenizer(texts, add_special_tokens=not chat)["input_ids"]

    def _check_options(
        self, prompts: list[list[int]], max_new_tokens: int | None, options: dict[str, Any]
    ) -> tuple[Any, dict]:
        """The generation config of `generate`, and the options that it does not hold."""
        model = self.language_model
        tokenizer = self.tokenizer
        longest = max(map(len, prompts))
        free = (getattr(model.config.get_text_config(), "max_position_embeddings", None) or 10**9) - longest
        if free < 1:
            raise InvalidInputError(f"`question` has {longest} tokens, too many for the language model; shorten it.")
        config = copy.deepcopy(model.generation_config)
        if max_new_tokens is None:
            max_new_tokens = min(config.max_new_tokens or 128, free)
        config.max_new_tokens = check_integer("max_new_tokens", max_new_tokens, 1, free)
        names = {*vars(config), *inspect.signature(model.generate).parameters}
        names -= {"inputs", "generation_config", "kwargs", "max_length"}  # which are set here
        for name in options.keys() - names:
            raise InvalidInputError(f"`{name}` is no option of a call or of `generate`. {did_you_mean(name, names)}")
        for name in ("num_beams", "num_return_sequences"):
            check_integer(name, options.get(name, 1), 1)
        with option_errors(options):
            others = config.update(**options)
        ends = tokenizer.eos_token_id if config.eos_token_id is None else config.eos_token_id
        config.eos_token_id = ends if isinstance(ends, list) else [ends]
        pads = (config.pad_token_id, tokenizer.pad_token_id, config.eos_token_id[0])
        config.pad_token_id = next(pad for pad in pads if pad is not None)
        return config, others


@contextmanager
def option_errors(options: dict[str, Any]) -> Iterator[None]:
    """Re-raises option errors of `generate`."""
    kinds = (ValueError, TypeError, AttributeError) if options else ()
    with explain_errors("`generate` cannot use its options", "pass others", *kinds):
        yield


@contextmanager
def seeded(generator: torch.Generator | None, device: torch.device) -> Iterator[None]:
    """Seeds torch's global generators by a draw from one, and puts them back."""
    with torch.random.fork_rng([device] if device.type == "cuda" else [], enabled=generator is not None):
        if generator is not None:
            torch.manual_seed(int(torch.randint(2**62, (1,), generator=generator, device=generator.device)))
        yield
