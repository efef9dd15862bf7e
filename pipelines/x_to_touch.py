"""`XToTouchPipeline`: the touch of what is seen, read, heard or felt by another sensor (Section 4.6 of the paper)."""

import os
from collections.abc import Mapping, Sequence
from typing import Any, Self

import torch
import torch.nn.functional as F
from diffusers import AutoencoderDC, AutoencoderKL, UNet2DConditionModel, VQModel
from diffusers.schedulers.scheduling_utils import KarrasDiffusionSchedulers
from diffusers.utils import replace_example_docstring
from torch import Tensor

from unitouch_gen.conditioning import match_norm, mix_linear
from unitouch_gen.embedding_bank import EmbeddingBank
from unitouch_gen.errors import InvalidInputError, check_integer
from unitouch_gen.models.images import ImageInput
from unitouch_gen.models.joint import MODALITIES, UniTouchModel
from unitouch_gen.models.processing import UniTouchProcessor
from unitouch_gen.models.sounds import AudioInput
from unitouch_gen.pipelines.base import JointSpacePipeline, SensorNames
from unitouch_gen.pipelines.call import Call, StepEndCallback
from unitouch_gen.pipelines.checks import Generators, check_parts
from unitouch_gen.pipelines.modalities import (
    Bridge,
    Modalities,
    bridge_of,
    check_condition_embeds,
    drawn_sensors,
    plan_of_modalities,
    prepare_modalities,
)
from unitouch_gen.pipelines.pipeline_output import UniTouchPipelineOutput
from unitouch_gen.pipelines.planned import one_call
from unitouch_gen.pipelines.published import Wanted, touch_pipeline
from unitouch_gen.plan import Plan
from unitouch_gen.report import RunReport

EXAMPLE_DOC_STRING = """
    Examples:
        ```py
        >>> import unitouch_gen

        >>> pipe = unitouch_gen.tiny("x-to-touch")
        >>> pipe(text="rough brick", sensor="digit", bridge="nearest").images[0].save("brick.png")
        >>> pipe(image="wall.jpg", num_candidates=4).images[0].save("wall.png")
        ```
"""


class XToTouchPipeline(JointSpacePipeline):
    """Anything to touch: latent diffusion of touch images, conditioned on one embedding of the joint space.

    Trained on image embeddings alone, so what text, sound and touch give is zero-shot.

    Args:
        unet: Attends to one token, the embedding; its class label, if it has any, is the sensor that is drawn.
        scheduler: The pipeline's own solver, used when `solver` is `None`.
        vae: Decodes latents to touch images.
        unitouch: The joint space; of its encoders only those of the modalities that come are read. May be `None` if
            embeddings are passed.
        processor: Prepares what comes for it.
        embedding_bank: Image embeddings for `bridge="nearest"`. May be `None` if that is never asked for.
        sensors: Names of the UNet's class labels; empty for a UNet without.
        default_guidance_scale, default_num_inference_steps: What a call uses where it says nothing. The paper's values;
            a checkpoint may store its own.
        calibration: What error indicators stand for; see `Calibration.find`.
    """

    model_cpu_offload_seq = "unitouch->unet->vae"
    _optional_components = ["unitouch", "processor", "embedding_bank"]
    _exclude_from_cpu_offload = ["unitouch", "embedding_bank"]
    _callback_tensor_inputs = ["latents", "condition_embeds"]
    _hidden_name = "condition_embeds"
    _embeds_name = "condition_embeds"

    def __init__(
        self,
        unet: UNet2DConditionModel,
        scheduler: KarrasDiffusionSchedulers,
        vae: AutoencoderKL | AutoencoderDC | VQModel,
        unitouch: UniTouchModel | None = None,
        processor: UniTouchProcessor | None = None,
        embedding_bank: EmbeddingBank | None = None,
        sensors: Sequence[str] = (),
        default_guidance_scale: float = 7.5,
        default_num_inference_steps: int = 200,
        calibration: Mapping[str, Any] | None = None,
    ):
        super().__init__()
        self.register_modules(
            unitouch=unitouch,
            processor=processor,
            embedding_bank=embedding_bank,
            unet=unet,
            scheduler=scheduler,
            vae=vae,
        )
        self.register_to_config(
            sensors=list(sensors),
            default_guidance_scale=default_guidance_scale,
            default_num_inference_steps=default_num_inference_steps,
            calibration=dict(calibration or {}),
        )
        self._prepare_images()
        check_parts(unet, sensors, unitouch, embedding_bank)

    @property
    def embedding_dim(self) -> int:
        """D of the embedding that the UNet attends to."""
        return self.unet.config.cross_attention_dim

    @classmethod
    def from_published(
        cls,
        ldm: str | os.PathLike,
        unitouch: str | os.PathLike | UniTouchModel,
        *,
        sensors: Sequence[str] = (),
        embedding_norm: float | None = None,
        images: ImageInput = None,
        plan: Plan | None = None,
        low_memory: bool = False,
        dtype: torch.dtype = torch.float32,
        device: str | torch.device | None = None,
        variant: str | None = None,
        offload: str | None = None,
        **hub: Any,
    ) -> Self:
        """Builds on a converted latent diffusion model of touch, and a converted joint space.

        Args:
            ldm: Folder that `unitouch-gen convert ldm` wrote, or repository id of one.
            sensors: Names of the network's class labels, if it has any.
            embedding_norm: Of the image embeddings that the network was trained on; it becomes the joint space's.
                When left out it is the joint space's own, or that of `images` under its image encoder.
            images: Some pictures to measure it on, in place of `embedding_norm`.
            unitouch, plan, low_memory, dtype, device, variant, offload, hub: See `TouchToImagePipeline.from_published`.

        Raises:
            InvalidInputError: If one of them is no such model, or their embeddings differ in width.
        """
        wanted = Wanted(dtype, device, variant, offload, plan, low_memory, hub)
        return touch_pipeline(cls, ldm, unitouch, sensors, embedding_norm, images, wanted)

    # Conditions -------------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def encode_condition(
        self,
        image: ImageInput = None,
        text: str | list[str] | None = None,
        audio: AudioInput = None,
        touch: ImageInput = None,
        *,
        weights: Mapping[str, float] | None = None,
        bridge: Bridge = None,
        sampling_rate: int | None = None,
        source_sensor: SensorNames = None,
    ) -> Tensor:
        """The condition as the network will see it: one token of the joint space's norm, (B, 1, D).

        See `__call__` for the arguments, and for the errors.
        """
        bridge = bridge_of(bridge)
        modalities = self._prepare_modalities(
            image=image, text=text, audio=audio, touch=touch, weights=weights, bridge=bridge,
            sampling_rate=sampling_rate, source_sensor=source_sensor,
        )  # fmt: skip
        return self._condition(modalities, bridge)

    def _prepare_modalities(self, *, weights: Any, bridge: str | None, **given: Any) -> Modalities:
        """What came, ready to be encoded; no network runs."""
        if bridge is not None:
            unlike = [name for name in MODALITIES if name != "image" and given.get(name) is not None]
            if unlike and self.embedding_bank is None:
                raise InvalidInputError(
                    f"`bridge` is {bridge!r}, but this pipeline has no `embedding_bank`; leave it out."
                )
        return prepare_modalities(self, weights=weights, **given)

    def _condition(self, modalities: Modalities, bridge: str | None, throw: bool = True) -> Tensor:
        """(B, 1, D) of the joint space's norm. A modality that weighs nothing is not encoded."""
        rows = []
        for name in modalities.weights:
            embeds = self._matched(modalities.encoders[name](), name, throw)
            if bridge is not None and name != "image":
                embeds = self.embedding_bank.bridge(embeds)
            rows.append(embeds.to(self._execution_device).expand(modalities.batch_size, -1))
        mixed = mix_linear(torch.stack(rows), torch.tensor(list(modalities.weights.values())))
        return match_norm(mixed, self.unitouch.config.embedding_norm)[:, None]

    # One call ---------------------------------------------------------------------------------------------------------

    @classmethod
    def _plan(cls, request: Mapping[str, Any]) -> Plan:
        return plan_of_modalities(request)

    @torch.no_grad()
    @replace_example_docstring(EXAMPLE_DOC_STRING)
    @one_call
    def __call__(
        self,
        image: ImageInput = None,
        text: str | list[str] | None = None,
        audio: AudioInput = None,
        touch: ImageInput = None,
        sensor: SensorNames = None,
        weights: Mapping[str, float] | None = None,
        bridge: Bridge = None,
        height: int | None = None,
        width: int | None = None,
        num_inference_steps: int | None = None,
        guidance_scale: float | None = None,
        guidance_interval: Sequence[float] | None = None,
        num_images_per_prompt: int = 1,
        num_candidates: int = 1,
        sampling_rate: int | None = None,
        source_sensor: SensorNames = None,
        solver: str | None = None,
        tolerance: float | None = None,
        max_evaluations: int | None = None,
        eta: float = 0.0,
        generator: Generators = None,
        latents: Tensor | None = None,
        condition_embeds: Tensor | None = None,
        output_type: str = "pil",
        return_dict: bool = True,
        callback_on_step_end: StepEndCallback | None = None,
        callback_on_step_end_tensor_inputs: Sequence[str] = ("latents",),
        throw: bool = True,
    ) -> UniTouchPipelineOutput | tuple:
        """Generates touch images.

        Args:
            image: Photos: paths, PIL images, arrays (H, W, 3), tensors (3, H, W), or a list.
            text: One description or a list; longer ones than the tokenizer's length are cut.
            audio: Sounds: paths (wav, flac, ogg, mp3), pairs (array, rate), or a list. Silence is refused.
            touch: Touch images, which makes it translation from one sensor to another.
            sensor: Whose image is drawn: a name in `config.sensors`, one for each input, several for a single one, or
                "all" for every sensor of each input in turn; the first when left out.
            weights: Of several modalities, by name, such as `{"image": 0.7, "text": 0.3}`; equal when left out. Only
                their ratios count.
            bridge: "nearest", or `True`, moves conditions that are no pictures towards their nearest stored image
                embeddings, which is what the model was trained on; `None` or `False` takes them as they are.
            height, width: Of the touch images, pixels; multiples of the VAE's scale factor.
            num_inference_steps: Solver steps (paper: 200).
            guidance_scale: s of classifier-free guidance, >= 0 (paper: 7.5); on above 1.
            guidance_interval: Where guidance is on, (low, high) shares of the training timesteps, from 0 (the least
                noise) to 1 (noise alone); everywhere when left out. Outside, the unconditional branch is left out,
                which saves half of an evaluation and is no longer the same picture.
            num_images_per_prompt: Touch images for each input.
            num_candidates: Of each touch image that is returned; the touch encoder chooses the one that is nearest to
                the condition.
            sampling_rate: Of sounds that come as arrays without one, Hz.
            source_sensor: Which sensor took `touch`: a name, one for each, or `None` to retrieve it.
            solver: A name in `unitouch_gen.schedulers.SOLVERS`, or "fitted"; `None` uses the pipeline's own scheduler.
            tolerance: Relative RMS error of the latents, from 1e-5 to 1: chooses the steps as it goes, in place of
                `num_inference_steps` and `solver`.
            max_evaluations: Of the network, at most, to a tolerance; 1,000 when left out.
            eta: Of DDIM, from 0 to 1; other solvers ignore it.
            generator: One, or one for each candidate.
            latents: Unit-variance noise (B n, C, h, w), n counting images and candidates of one input.
            condition_embeds: (B, 1, D) in place of the modalities, taken as they come: see `encode_condition`.
            output_type: "pil", "np", "pt" or "latent".
            return_dict: Whether to return an output object rather than the tuple (images, report).
            callback_on_step_end: Called as `callback(pipe, step, timestep, tensors)` after every evaluation, or to a
                `tolerance` every accepted step.
            callback_on_step_end_tensor_inputs: Which tensors it gets: "latents" (B n, C, h, w) in float32,
                "condition_embeds" of both branches, the unconditional one, zeros, first.
            throw: Raise where a sample breaks. Otherwise the others are returned, and its code is in the report, as
                are, in either case, those of samples that are there, but diverged or interrupted.

        Examples:

        Returns:
            [`UniTouchPipelineOutput`] or `tuple`.

        Raises:
            InvalidInputError, InvalidTypeError: On input that cannot be used, before any network runs.
            NonFiniteError: If an embedding or a sample leaves the range of floating-point numbers and `throw` is set.
            NotConvergedError: If a tolerance is not reached or latents grow to a hundred times a picture's, and `throw`
                is set.

        Warns:
            UnfamiliarTouchWarning: Of touches that are unlike those the model knows of their sensor.
        """
        # 1. Refuse what cannot work, before any network runs
        bridge = bridge_of(bridge)
        given = {"image": image, "text": text, "audio": audio, "touch": touch, "weights": weights, "bridge": bridge,
                 "sampling_rate": sampling_rate, "source_sensor": source_sensor}  # fmt: skip
        plan = self._begin(
            **given,
            condition_embeds=condition_embeds,
            num_candidates=num_candidates,
            guidance_scale=self._default("guidance_scale", guidance_scale),
            guidance_interval=guidance_interval,
            output_type=output_type,
        )
        modalities = None
        if condition_embeds is None:
            modalities = self._prepare_modalities(**given)
            batch_size = modalities.batch_size
        else:
            batch_size = check_condition_embeds(condition_embeds, self.embedding_dim, given)
        names = list(self.config.sensors)
        drawn = drawn_sensors(names, sensor, batch_size)
        labels = torch.tensor([names.index(name) for name in drawn]) if names else None
        inputs, batch_size = batch_size, len(drawn) or batch_size
        candidates = check_integer("num_candidates", num_candidates, 1)
        if candidates > 1 and (self.unitouch is None or self.processor is None):
            raise InvalidInputError(
                f"`num_candidates` is {candidates}, but this pipeline has no `unitouch` and `processor` to choose one; "
                "leave it out."
            )
        call = self._check_call(
            batch_size,
            check_integer("num_images_per_prompt", num_images_per_prompt, 1) * candidates,
            height=height,
            width=width,
            num_inference_steps=num_inference_steps,
            guidance_scale=guidance_scale,
            guidance_interval=guidance_interval,
            solver=solver,
            tolerance=tolerance,
            max_evaluations=max_evaluations,
            eta=eta,
            generator=generator,
            latents=latents,
            output_type=output_type,
            callback=callback_on_step_end,
            callback_inputs=callback_on_step_end_tensor_inputs,
            throw=throw,
        )
        report = call.report(plan, modalities.matches if modalities else ())

        # 2. Condition
        if modalities is not None:
            with report.stage("condition"):
                condition_embeds = self._condition(modalities, bridge, throw)
            self._release(*(name for name in modalities.weights if candidates == 1 or name != "touch"))
        assert condition_embeds is not None
        condition_embeds = condition_embeds.to(self._execution_device).repeat_interleave(batch_size // inputs, dim=0)
        hidden = condition_embeds.repeat_interleave(call.repeats, dim=0)
        if labels is not None:
            labels = labels.repeat_interleave(call.repeats)
        if call.guidance.active:
            hidden = torch.cat([torch.zeros_like(hidden), hidden])
            branches = None if labels is None else torch.cat([labels, labels])
        else:
            branches = labels

        # 3. Denoising
        with report.stage("denoising"):
            latents = self._denoise(call, hidden, branches, report)

        # 4. Touch images, of the samples that ended well; the best candidate of each
        with report.stage("decoding"):
            if candidates == 1:
                images = self._images(call, latents, report)
            else:
                images = self._best(call, latents, condition_embeds, labels, candidates, report)

        self._end(report)
        if not return_dict:
            return images, report
        return UniTouchPipelineOutput(images=images, report=report, embeds=condition_embeds)

    def _best(
        self,
        call: Call,
        latents: Tensor,
        condition: Tensor,
        labels: Tensor | None,
        candidates: int,
        report: RunReport,
    ) -> Any:
        """Of each group of candidates the one whose touch embedding is nearest to the condition."""
        pixels = self._decode(latents, report, call.throw)
        rows = [row for row, code in enumerate(report.codes) if code.finite]
        scores = self._scores(pixels, condition.repeat_interleave(call.repeats, dim=0)[rows, 0], labels, rows)
        best: dict[int, int] = {}
        for index, row in enumerate(rows):
            group = row // candidates
            if group not in best or scores[index] > scores[best[group]]:
                best[group] = index
        chosen = list(best.values())
        report.chosen = [rows[index] for index in chosen]
        report.scores = [scores[index] for index in chosen]
        if call.output_type == "latent":
            return latents[report.chosen]
        return self.image_processor.postprocess(pixels[chosen], output_type=call.output_type)

    def _scores(self, pixels: Tensor, wanted: Tensor, labels: Tensor | None, rows: list[int]) -> list[float]:
        """Cosine of the touch embedding of each image (b, 3, H, W), about [-1, 1], to the embedding wanted (b, D)."""
        if not rows:
            return []
        values = self.processor.touch((pixels / 2 + 0.5).clamp(0.0, 1.0))
        known = self.unitouch.config.sensors
        names = [None if labels is None else self.config.sensors[labels[row]] for row in rows]
        matches = self.unitouch.match_sensors(values, [name if name in known else None for name in names])
        embeds = self._touch_features(values, matches).float()
        return F.cosine_similarity(embeds, wanted.to(embeds), dim=1).tolist()
