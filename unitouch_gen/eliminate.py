"""Work that a request does not need, left out of a diffusers UNet exactly: the same prediction, sooner.

For the time of a request, which asks one network many times under the same conditions,

- cross-attention over one condition token is a constant, as the softmax over one key is 1: one vector for each layer
  and row, and neither norm, queries, keys nor softmax;
- keys and values of a longer condition, its projection and the embedding of the class labels are computed once;
- the timestep is embedded once for all rows of a batch;
- both guidance branches have the same latents, so what comes before the first look at the condition is computed for
  one of them, and so is what later layers make of the skips out of there.

Nothing is approximated: predictions differ by the rounding of another order of sums.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import torch
from diffusers import UNet2DConditionModel
from diffusers.models.attention_processor import Attention
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from unitouch_gen.eliminate_layers import Evaluation, StandIn
from unitouch_gen.eliminate_plan import Plan, plan_of
from unitouch_gen.errors import InvalidInputError, InvalidTypeError, describe


@contextmanager
def eliminated(
    unet: nn.Module,
    encoder_hidden_states: Tensor,
    class_labels: Tensor | None = None,
    *,
    halves_share_latents: bool = True,
) -> Iterator["Lean | Whole"]:
    """A UNet for the time of a request, without the work that the request does not need.

    Until the end of the block some layers have another `forward`; after it, however it ends, the UNet is as it was.
    Weights, configuration, attention processors and hooks are not touched, so saving works inside too. Within the block
    the UNet itself, called by anyone, does all of its work; change neither its weights nor its hooks there.

    A layer that is not plain is left alone: one with a processor, a hook or a `forward` of the user's, LoRA, gated or
    adaptive layers. Nothing is left out while gradients are recorded or the UNet is in training mode.

    Args:
        unet: A `UNet2DConditionModel`, compiled or not. Of another network nothing is left out.
        encoder_hidden_states: Condition, (B, T, D): the rows of a guided batch in their order, both halves.
        class_labels: (B,) or (B, D), if the UNet has some.
        halves_share_latents: Whether to look for latents that are the same in both halves of a batch, as they are under
            classifier-free guidance. They are compared in every call, so it is safe to say so of any.

    Yields:
        What to call in place of the UNet; see `Lean`.

    Raises:
        InvalidTypeError: If `encoder_hidden_states` is no tensor.

    Example:
        >>> with eliminated(unet, hidden, labels) as lean:  # doctest: +SKIP
        ...     for timestep in scheduler.timesteps:
        ...         prediction = lean(torch.cat([latents] * 2), timestep)
    """
    network = getattr(unet, "_orig_mod", unet)  # of `torch.compile`
    if not isinstance(network, UNet2DConditionModel):
        yield Whole(unet)
        return
    if not isinstance(encoder_hidden_states, Tensor):
        raise InvalidTypeError(
            f"`encoder_hidden_states` is {describe(encoder_hidden_states)}; it has to be a tensor (B, T, D)."
        )
    evaluation = Evaluation()
    plan = plan_of(network, evaluation)
    lean = Lean(unet, network, plan, evaluation, (encoder_hidden_states, class_labels), halves_share_latents)
    with _standing_in(plan.stand_ins):
        yield lean


class Whole:
    """A network of which nothing is known, called as it is."""

    def __init__(self, network: nn.Module) -> None:
        self.network = network
        self.left_out: list[str] = []

    def __call__(
        self, state: Tensor, timestep: Any, encoder_hidden_states: Tensor, class_labels: Tensor | None = None
    ) -> Tensor:
        """As `Lean`'s."""
        conditions = {"encoder_hidden_states": encoder_hidden_states, "class_labels": class_labels}
        return self.network(state, timestep, **conditions, return_dict=False)[0]


class Lean:
    """A UNet in which work is left out; `eliminated` makes it.

    Attributes:
        left_alone: Where work could have been left out in a plain UNet, in words.
    """

    def __init__(
        self,
        unet: nn.Module,
        network: Any,
        plan: Plan,
        evaluation: Evaluation,
        conditions: tuple[Tensor, Tensor | None],
        halves_share_latents: bool,
    ) -> None:
        self._unet, self._network, self._plan, self._evaluation = unet, network, plan, evaluation
        self._conditions, self._halves_share_latents = conditions, halves_share_latents
        self._hidden, self._labels = _Copy(), _Copy()
        self._left_out: dict[str, None] = {}
        self._noted: set[tuple[Any, ...]] = set()
        self._processors = [(layer, layer.processor) for layer in network.modules() if isinstance(layer, Attention)]
        self._compiled = network is not unet or any(part._compiled_call_impl is not None for part in network.modules())
        self._warm: set[tuple[bool, str]] = set()
        left = plan.other_cross_attentions
        self.left_alone = [f"{left} cross-attentions that are not plain ones"] if left else []

    @property
    def left_out(self) -> list[str]:
        """What the calls so far have left out, in words."""
        return list(self._left_out)

    def __call__(
        self,
        state: Tensor,
        timestep: Tensor | float | int,
        encoder_hidden_states: Tensor | None = None,
        class_labels: Tensor | None = None,
        **others: Any,
    ) -> Tensor:
        """The UNet's prediction, of the shape of `state`.

        Args:
            state: (B, C, h, w).
            timestep: One for all rows, or (B,).
            encoder_hidden_states, class_labels: From this call on, where they are others than before. They have to be
                passed when guidance goes off or on in the middle of a request, and B with it. They are compared by
                value, so they may be passed every time, and changed in place.
            others: More arguments of the UNet. Beside masks, residuals and the like nothing is left out.

        Raises:
            InvalidInputError: If conditions and `state` have different numbers of rows.
        """
        hidden, labels = self._conditions = (
            self._conditions[0] if encoder_hidden_states is None else encoder_hidden_states,
            self._conditions[1] if class_labels is None else class_labels,
        )
        rows = len(state)
        for name, condition, fitting in (
            ("encoder_hidden_states", hidden, (rows,)),
            ("class_labels", labels, (rows, 1)),
        ):
            if condition is not None and len(condition) not in fitting:
                raise InvalidInputError(
                    f"`{name}` is {describe(condition)}, but `state` has {rows} rows; pass the conditions of this call."
                )
        others = {key: value for key, value in others.items() if value is not None}
        if not self._may_leave_out(hidden, others):
            return self._run(state, timestep, hidden, labels, **others)

        known = all([self._hidden.take(hidden), self._labels.take(labels)])
        now = self._evaluation
        now.running, now.single = True, hidden.shape[1] == 1
        now.one_time = not isinstance(timestep, Tensor) or timestep.numel() == 1
        now.shared = self._shared(state, now.one_time)
        try:
            copies = self._hidden.tensor, self._labels.first if self._plan.time else self._labels.tensor
            with self._stance(known, (now.single, now.shared)):
                prediction = self._run(state, timestep, *copies, **others)
            self._note(known, rows, hidden.shape[1])
        finally:
            now.running, now.single, now.one_time, now.shared = False, False, False, "nothing"
        return prediction

    def share_left_out(self, state: Tensor, timestep: Tensor | float | int) -> float:
        """Share of the UNet's floating-point operations that a call leaves out once its conditions are known.

        Makes three evaluations.
        """
        self(state, timestep)
        with FlopCounterMode(display=False) as lean:
            self(state, timestep)
        with FlopCounterMode(display=False) as plain:
            self._network(state, timestep, *self._conditions, return_dict=False)
        return 1.0 - lean.get_total_flops() / plain.get_total_flops()

    def _run(self, state: Tensor, timestep: Any, hidden: Any, labels: Tensor | None, **others: Any) -> Tensor:
        conditions = {"encoder_hidden_states": hidden, "class_labels": labels, **others}
        return self._unet(state, timestep, **conditions, return_dict=False)[0]

    def _may_leave_out(self, hidden: Any, others: dict[str, Any]) -> bool:
        """Whether stand-ins know this kind of call."""
        return (
            not torch.is_grad_enabled()
            and not self._network.training
            and isinstance(hidden, Tensor)
            and hidden.ndim == 3
            and set(others) <= {"added_cond_kwargs"}
            and all(layer.processor is processor for layer, processor in self._processors)
        )

    def _shared(self, state: Tensor, one_time: bool) -> str:
        """The value of `Evaluation.shared`."""
        if not self._halves_share_latents or len(state) % 2 or not torch.equal(*state.chunk(2)):
            return "nothing"
        embeds_alike = one_time and self._labels.halves_alike and self._network.config.addition_embed_type is None
        return "prefix" if embeds_alike else "stem"

    def _stance(self, known: bool, case: tuple[bool, str]) -> AbstractContextManager[Any]:
        """Of a compiled UNet, what is kept is made outside of its graph, which gets it as an input."""
        if not known:
            self._warm.clear()
        if not self._compiled or case in self._warm:
            return nullcontext()
        self._warm.add(case)
        return torch.compiler.set_stance("force_eager")

    def _note(self, known: bool, rows: int, tokens: int) -> None:
        """Adds what the running evaluation leaves out to the list."""
        plan, now = self._plan, self._evaluation
        kind = (known, rows > 1, tokens, now.single, now.one_time, now.shared)
        if kind in self._noted:
            return
        self._noted.add(kind)
        halved, split = plan.halved[now.shared], plan.split[now.shared]
        cases = {
            f"norm, queries, keys and softmax of {plan.cross_attentions} cross-attentions over one token": (
                now.single and plan.cross_attentions
            ),
            f"keys and values of {plan.cross_attentions} cross-attentions over {tokens} tokens after the first step": (
                known and not now.single and plan.cross_attentions
            ),
            "projection of the condition after the first step": known and plan.projection,
            "embedding of class labels after the first step": known and plan.labels,
            "embedding of the timestep for all rows but one": now.one_time and plan.time and rows > 1,
            f"one guidance branch in {halved} layers that do not see the condition": halved,
            f"one guidance branch of the skips in {split} convolutions": split,
        }
        self._left_out.update(dict.fromkeys(words for words, holds in cases.items() if holds))


class _Copy:
    """A copy of a condition that nobody else can change, so that what is made of it stays true.

    Attributes:
        tensor: The copy.
        first: Its first row if all rows are the same, otherwise all of it.
        halves_alike: Whether the first half of its rows is the same as the second.
    """

    def __init__(self) -> None:
        self.tensor: Tensor | None = None
        self.first: Tensor | None = None
        self.halves_alike = True
        self.setting: tuple[Any, ...] | None = None

    def take(self, tensor: Tensor | None) -> bool:
        """Copies a tensor unless it is the same as before; whether it is."""
        old, setting = self.tensor, None if tensor is None else _setting(tensor)
        same = setting == self.setting and (tensor is None or old is None or torch.equal(tensor, old))
        if not same:
            self.setting = setting
            self.tensor = self.first = None if tensor is None else tensor.clone()
            self.halves_alike = True
            if self.tensor is not None and len(self.tensor) > 1:
                halves = self.tensor.chunk(2)
                self.halves_alike = len(self.tensor) % 2 == 0 and torch.equal(*halves)
                if torch.equal(self.tensor, self.tensor[:1].expand_as(self.tensor)):
                    self.first = self.tensor[:1]
        return same


def _setting(tensor: Tensor) -> tuple[Any, ...]:
    """What else has a say in what layers make of a tensor."""
    kind = tensor.device.type
    return tensor.dtype, tensor.device, torch.is_autocast_enabled(kind), torch.get_autocast_dtype(kind)


@contextmanager
def _standing_in(stand_ins: dict[nn.Module, StandIn]) -> Iterator[None]:
    """Modules with another `forward`, and as they were at the end."""
    before = {module: module.__dict__.get("forward") for module in stand_ins}
    try:
        for module, stand_in in stand_ins.items():
            # A bound method: of it, a compiled graph remembers the class, and so holds for the next request as well.
            module.forward = stand_in.forward  # type: ignore[method-assign]
        yield
    finally:
        for module, forward in before.items():
            if forward is None:
                module.__dict__.pop("forward", None)
            else:
                module.forward = forward  # type: ignore[method-assign]
