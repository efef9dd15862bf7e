"""`UniTouchProcessor`: from paths, pictures, arrays, sounds and strings to model inputs."""

import os
import threading
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from transformers import CLIPTokenizer, FeatureExtractionMixin, PreTrainedConfig, PreTrainedTokenizerBase

from unitouch_gen.errors import InvalidInputError, check_arguments, check_integer, check_kind, check_texts
from unitouch_gen.files import LOADING_OPTIONS, check_saved, local_folder, reading
from unitouch_gen.models.images import ImageInput, centre_rectangle, load_images, normalise_pixels
from unitouch_gen.models.sounds import AudioInput, LogMel, load_sounds
from unitouch_gen.models.videos import VIDEOS, firmest
from unitouch_gen.saving import saved_whole

LENGTHS = (3, 10_000)  # allowed lengths of texts in tokens, with start and end; CLIP's is 77

_TOKENIZING = threading.Lock()  # tokenizers store truncation and padding on themselves, which two threads would set


def tokenize(tokenizer: Any, texts: list[str]) -> Any:
    """`input_ids` and `attention_mask` (B, T), T the tokenizer's full length; longer texts are cut."""
    check_integer("model_max_length", tokenizer.model_max_length, *LENGTHS)
    with _TOKENIZING:
        return tokenizer(texts, padding="max_length", truncation=True, return_tensors="pt")


def read_tokenizer(name: str, folder: Path, kind: Any = CLIPTokenizer) -> Any:
    """A tokenizer of class `kind` from its folder, which the user passed as the argument `name`."""
    with reading(name, folder):
        check_saved(folder, "tokenizer")
        return kind.from_pretrained(folder)


def _still(name: str, touch: Any) -> Any:
    """The frame of firmest contact of a video or an iterator of frames; anything else as it is."""
    is_video = isinstance(touch, str | os.PathLike) and str(touch).lower().endswith(VIDEOS)
    if is_video or isinstance(touch, Iterator):
        return firmest(name, touch)
    return touch


class UniTouchProcessor(FeatureExtractionMixin):
    """Prepares the inputs of `UniTouchModel`.

    Args:
        image_size: Side S of pictures and touch images, pixels, from 8 to 8,000 (paper: 224).
        audio: A `LogMel`, or a dictionary of its fields; the paper's when left out.
        tokenizer: For text; may be left out when no text is used.

    Example:
        >>> processor = UniTouchProcessor(image_size=64)
        >>> processor.images(np.zeros((48, 80, 3), dtype=np.uint8)).shape
        torch.Size([1, 3, 64, 64])
    """

    model_input_names = ["pixel_values", "touch_values", "input_values", "input_ids", "attention_mask"]

    def __init__(
        self,
        image_size: int = 224,
        audio: LogMel | dict[str, Any] | None = None,
        tokenizer: CLIPTokenizer | None = None,
        **kwargs: Any,
    ):
        kwargs.pop("auto_map", None)  # belongs to the folder
        super().__init__(**kwargs)
        self.image_size = check_integer("image_size", image_size, 8, 8000)
        check_kind("audio", audio, LogMel, dict, type(None))
        self.audio = audio if isinstance(audio, LogMel) else LogMel(**(audio or {}))
        self.tokenizer = check_kind("tokenizer", tokenizer, PreTrainedTokenizerBase, type(None))

    @classmethod
    def for_config(cls, config: PreTrainedConfig, tokenizer: CLIPTokenizer | None = None) -> "UniTouchProcessor":
        """The processor for the input sizes of a model with this `UniTouchConfig`."""
        audio = {"mel_bins": config.audio_config.image_height, "frames": config.audio_config.image_width}
        return cls(image_size=config.touch_config.image_height, audio=audio, tokenizer=tokenizer)

    def inputs(self, modality: str, values: Any, *, name: str | None = None) -> dict[str, Tensor]:
        """The arguments of the model's `get_<modality>_features`, of inputs as pipelines take them.

        Raises:
            InvalidInputError: If they cannot be read, a text is blank, or a sound silent. The message has `name`, or
                else the modality.
        """
        name = name or modality
        if modality == "text":
            return self.text(check_texts(name, values, blank=False), name=name)
        if modality == "audio":
            return {"input_values": self.sounds(values, name=name, audible=True)}
        read = self.touch if modality == "touch" else self.images
        return {"pixel_values": read(values, name=name)}

    def images(self, images: ImageInput, *, name: str = "image") -> Tensor:
        """Pixel values (B, 3, S, S) for `get_image_features`; see `load_images`."""
        return normalise_pixels(self.raw_images(images, name=name))

    def touch(self, touch: ImageInput, *, name: str = "touch") -> Tensor:
        """Pixel values (B, 3, S, S) for `get_touch_features`; touch images are prepared as pictures are.

        From a video or an iterator of frames, the frame of firmest contact is taken; see `videos.firmest`.
        """
        return normalise_pixels(self.raw_touch(touch, name=name))

    def raw_touch(self, touch: ImageInput, *, name: str = "touch") -> Tensor:
        """Pixels of touches in [0, 1] before normalisation, float32 (B, 3, S, S); see `touch`."""
        if isinstance(touch, list | tuple):
            stills = [_still(f"{name}[{row}]", item) for row, item in enumerate(touch)]
            return self.raw_images(stills, name=name)
        return self.raw_images(_still(name, touch), name=name)

    def raw_images(self, images: ImageInput, *, name: str = "image") -> Tensor:
        """Pixels in [0, 1] before normalisation, float32 (B, 3, S, S): short side resized, centre cropped."""
        side = self.image_size
        return torch.stack([centre_rectangle(image, side, side) for image in load_images(name, images)])

    def sounds(self, sounds: AudioInput, *, name: str = "audio", audible: bool = False) -> Tensor:
        """Log-mel clips (B, clips, 1, mel_bins, frames) for `get_audio_features`; see `load_sounds`.

        With `audible`, silence raises an `InvalidInputError`.
        """
        loaded = load_sounds(name, sounds)
        for number, sound in enumerate(loaded):
            if audible and np.ptp(sound.samples) <= 2.0**-15:  # one bit of 16
                where = name if len(loaded) == 1 else f"{name}[{number}]"
                raise InvalidInputError(f"`{where}` is silent; pass a sound of a contact.")
        return torch.stack([self.audio(sound) for sound in loaded])

    def text(self, text: str | list[str], *, name: str = "text") -> dict[str, Tensor]:
        """`input_ids` and `attention_mask` (B, T) for `get_text_features`; longer texts are cut."""
        texts = check_texts(name, text)
        if self.tokenizer is None:
            raise InvalidInputError(f"`{name}` cannot be read: this processor has no tokenizer; build it with one.")
        encoded = tokenize(self.tokenizer, texts)
        return {"input_ids": encoded.input_ids, "attention_mask": encoded.attention_mask}

    def to_dict(self) -> dict[str, Any]:
        """The content of `preprocessor_config.json`."""
        output = super().to_dict()
        output.pop("tokenizer", None)
        output["processor_class"] = type(self).__name__  # read by AutoProcessor
        output["audio"] = asdict(self.audio)
        return output

    @saved_whole
    def save_pretrained(self, save_directory: str | os.PathLike, **kwargs: Any) -> None:  # type: ignore[override]
        """Writes the settings and the tokenizer, all or none."""
        super().save_pretrained(save_directory, **kwargs)
        if self.tokenizer is not None:
            self.tokenizer.save_pretrained(save_directory)

    @classmethod
    def from_pretrained(  # type: ignore[override]
        cls, pretrained_model_name_or_path: str | os.PathLike, **kwargs: Any
    ) -> "UniTouchProcessor":
        """Reads a processor from a folder or a repository.

        `kwargs` are options of a download, and `image_size` and `audio` in place of the stored ones.
        """
        check_arguments("`from_pretrained`", kwargs, {*LOADING_OPTIONS, "image_size", "audio"})
        name = "pretrained_model_name_or_path"
        settings = {"allow_patterns": ["*.json", "*.txt"], **kwargs}
        folder = local_folder(name, pretrained_model_name_or_path, **settings) / kwargs.pop("subfolder", "")
        with reading(name, folder):
            check_saved(folder, "processor")
            processor = super().from_pretrained(folder, **kwargs)
        if any((folder / file).is_file() for file in ("tokenizer_config.json", "tokenizer.json", "vocab.json")):
            processor.tokenizer = read_tokenizer(name, folder)
        return processor
