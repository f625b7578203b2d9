"""The interface of every model family: `Model`, which acts (`Policy`), answers (`AnswerModel`) or both."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from probe_kit.errors import CaptureError, ObservationError, UnknownSiteError, UsageError
from probe_kit.hooks.contract.card import ModelCard, model_html, model_text
from probe_kit.hooks.contract.declared import ALL_EDITS, Interventions
from probe_kit.hooks.contract.feature_statistics import FeatureStatistics
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.sites import Site, Stream, first_of


@dataclass(frozen=True)
class Unembedding:
    """The modules that turn the last residual of a decoder into logits.

    Attributes:
        streams: The streams whose last residual it reads; the positions that choose tokens come last.
        norm: The module that is called first, on the residual.
        head: The module that is called on what `norm` gives.
        softcap: The logits l become softcap · tanh(l / softcap), as in Gemma 2; None leaves them as they are.
    """

    streams: tuple[str, ...]
    norm: nn.Module
    head: nn.Module
    softcap: float | None = None

    @classmethod
    def of_decoder(cls, streams: tuple[str, ...], language_model: Any, norm: nn.Module) -> "Unembedding":
        """Return the `lm_head` of transformers' causal language model, with the soft cap of its configuration.

        Args:
            streams: The streams whose last residual is read; the positions that choose tokens come last.
            language_model: The causal language model, with `lm_head` and `config`.
            norm: The norm in front of the head.
        """
        config = language_model.config
        cap = getattr(getattr(config, "text_config", config), "final_logit_softcapping", None)
        return cls(streams, norm, language_model.lm_head, None if cap is None else float(cap))

    def logits(self, residual: Tensor) -> Tensor:
        """Return the logits (…, V), in the model's dtype, of a residual (…, D) of any layer."""
        with torch.inference_mode():
            return self.capped(self.head(self.norm(residual)))

    def capped(self, logits: Tensor) -> Tensor:
        """Return the logits that leave the model, of those that leave its head."""
        return logits if self.softcap is None else torch.tanh(logits / self.softcap) * self.softcap


@dataclass(frozen=True)
class Rows:
    """One of several equal blocks of a batch: under guidance a module runs 2B rows, and only half are the stream.

    Attributes:
        index: Number of the block, counted from 0.
        blocks: Count of the blocks.
    """

    index: int = 0
    blocks: int = 1

    def of(self, activation: Tensor) -> Tensor:
        """The block as a view: (B, …) of (B * blocks, …).

        Raises:
            CaptureError: If the rows do not divide.
        """
        if self.blocks == 1:
            return activation
        rows, remainder = divmod(activation.shape[0], self.blocks)
        if remainder:
            raise CaptureError(
                f"{activation.shape[0]} rows do not make {self.blocks} equal blocks; correct the tap"
            )
        return activation[self.index * rows : (self.index + 1) * rows]


ALL_ROWS = Rows()
EVERY = slice(None)


@dataclass(frozen=True)
class Tap:
    """An input or output of `module`, called `fires` times per inference, at which a site is read and written.

    The residual stream is read at inputs, not outputs. Some families drive their layers piecewise or add in place,
    and then a layer's output is never seen or seen too late. The first submodule of a block is always called with
    the residual stream itself, so writing into that tensor writes the stream.

    Attributes:
        end: The end of `module` at which it is read: what goes in, or what comes out.
        tokens: The positions of that (B, T, D) tensor which belong to the site, where one call serves two streams.
        rows: The block of the batch which belongs to the site, where one call serves several.
        first: Number of calls of `module` in an inference that come before those of this stream and are passed
            over.
        argument: Name of the keyword that carries the tensor, where the module is not called with it in first
            place.
        view: Brings what passes to (B, T, D) where it has another form. The result must share memory, so that an
            edit of it edits what passes.
        more: Whether an inference may call `module` further times, which belong to no site: where the model itself
            decides how many tokens it puts out.
    """

    module: nn.Module
    fires: int
    end: Literal["input", "output"] = "input"
    tokens: slice = EVERY
    rows: Rows = ALL_ROWS
    first: int = 0
    argument: str | None = None
    view: Callable[[Tensor], Tensor] | None = None
    more: bool = False

    def select(self, passing: Tensor) -> Tensor:
        """The site's own (B, T, D), a view of what passes, or that itself where all of it is the site's."""
        # Rows before tokens: a block of the batch has the same positions as the others.
        activation = self.rows.of(passing if self.view is None else self.view(passing))
        return activation if self.tokens == EVERY else activation[:, self.tokens]

    def write(self, passing: Tensor, new: Tensor) -> None:
        """Put `new` (B, T, D) where `select` reads."""
        self.select(passing).copy_(new)  # in place: the block reads this very tensor


@dataclass(frozen=True)
class HeadsTap(Tap):
    """A tap of a tensor with heads, (B, H, T, E), such as keys and values; a site has them as (B, T, H · E)."""

    def select(self, passing: Tensor) -> Tensor:
        """The site's own (B, T, H · E); to write it, use `write`."""
        return self._by_token(passing).flatten(2)

    def write(self, passing: Tensor, new: Tensor) -> None:
        """Put `new` (B, T, H · E) where `select` reads."""
        # `flatten` in `select` copies, because heads lie apart in memory; writing there would change nothing.
        by_token = self._by_token(passing)
        by_token.copy_(new.reshape(by_token.shape))

    def _by_token(self, passing: Tensor) -> Tensor:
        """A view (B, T, H, E) of the site's own part."""
        return self.rows.of(passing).transpose(1, 2)[:, self.tokens]


class Model(ABC):
    """A network whose activations can be captured: what capture, edits, verification and the store need.

    Attributes:
        streams: The streams that an extraction stores, by name.
        further_streams: The streams that are captured by naming their sites only, such as vision towers.
        prompt_kv: The keys and values of the prompt that the acting part reads, block by block, as a stream of the
            quantities `KV`. They are captured and edited by naming their sites, such as `kv.02.values`. The tokens
            are the backbone's. None where a family has none.
        role_names: Per stream, every role its tokens can play.
        absent_inputs: Inputs that it never reads by design: `instruction`, `state`, `picture` or `picture.CAMERA`.
    """

    card: ModelCard
    streams: Mapping[str, Stream]
    further_streams: Mapping[str, Stream] = MappingProxyType({})
    prompt_kv: Stream | None = None
    role_names: Mapping[str, tuple[str, ...]]
    absent_inputs: frozenset[str] = frozenset()

    def __repr__(self) -> str:
        return model_text(type(self).__name__, self.card, self.streams)

    def _repr_html_(self) -> str:
        return model_html(self.card, self.streams)

    @abstractmethod
    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """Return per stored stream the roles of every position of every row, from the model's own packing."""

    @abstractmethod
    def tap(self, site: Site) -> Tap:
        """Return the tap at which `site` is read and written.

        Raises:
            UnknownSiteError: For a site that the model does not have.
        """

    @property
    def unembedding(self) -> Unembedding | None:
        """The modules that turn last residuals into tokens, for a logit lens; None for a model without tokens."""
        return None

    @property
    def word_head(self) -> Unembedding | None:
        """The modules that read a vector of a stream in the words of the vocabulary; None where there are none.

        By default those of the logit lens. A model that puts out no tokens has them where its prompt's decoder
        shares the embedding with its head, as PaliGemma does.
        """
        return self.unembedding

    def token_texts(self) -> tuple[str, ...] | None:
        """Return the text of every token by its id, alone; None if the model cannot say."""
        return None

    def token_ids(self, instructions: Sequence[str]) -> list[tuple[int, ...]] | None:
        """Return per instruction the ids that reach the network as its prompt; None if the model cannot say."""
        del instructions
        return None

    def read_late_files(self) -> None:
        """Read what is otherwise read at the first inference, such as a tokenizer of another repository.

        Its commit then stands in the card.

        Raises:
            CheckpointError: For a file that is not here.
        """
        return

    def sites(self, quantity: str = "residual") -> list[Site]:
        """All sites of one quantity in the stored streams that have it, stream by stream.

        Raises:
            UnknownSiteError: If no stream has the quantity.
        """
        having = [stream for stream in self.streams.values() if quantity in stream.captured]
        if not having:
            raise UnknownSiteError(f"no stream of {self.card.family} has a quantity {quantity!r}")
        return [site for stream in having for site in stream.sites(quantity)]

    def every_stream(self) -> dict[str, Stream]:
        """The streams that are stored, those captured by name only, and `kv`."""
        kv = {} if self.prompt_kv is None else {self.prompt_kv.name: self.prompt_kv}
        return {**self.streams, **self.further_streams, **kv}

    def token_roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """Return `roles`, and those of the tokens of `kv`."""
        roles = self.roles(observations)
        if self.prompt_kv is not None:
            roles[self.prompt_kv.name] = roles[self.tokens_of(self.prompt_kv.name)]
        return roles

    def patch_order(self) -> NDArray[np.int64]:
        """Return which of the picture's tokens, counted from 0, every token of the `vision` stream ends in.

        Returns:
            (V,) of one camera's picture, the same for each camera; −1 for tokens that end in none, such as class
            tokens.

        Raises:
            UnknownSiteError: For a model that does not say.
        """
        raise UnknownSiteError(
            f"{self.card.family} does not say which picture token comes of which patch; ask for all of `image`"
        )

    def tokens_of(self, stream: str) -> str:
        """The stored stream whose tokens a stream has: the backbone for `kv`, else itself."""
        if self.prompt_kv is None or stream != self.prompt_kv.name:
            return stream
        return first_of("backbone", self.streams.values()) or stream

    def stream_of(self, site: Site) -> Stream:
        """The stream `site` lies in.

        Raises:
            UnknownSiteError: If there is none; the message names the streams that there are.
        """
        stream = self.streams.get(site.stream) or self.every_stream().get(site.stream)
        if stream is None or not stream.holds(site):
            available = "; ".join(
                f"{existing.name}: {existing.layers} layers"
                + (f" x {existing.iterations} iterations" if existing.iterations else "")
                + f" of {', '.join(existing.captured)}"
                for existing in self.every_stream().values()
            )
            raise UnknownSiteError(f"{self.card.family} has no site {site}; it has {available}")
        return stream

    def check(self, observations: Sequence[Observation], seeds: Sequence[int] | None = None) -> None:
        """Refuse what the card rules out; adapters call it first.

        Args:
            observations: All rows of one call.
            seeds: One per observation; None for a call without noise.

        Raises:
            ObservationError: For a batch over `card.batch`, an observation without what `card.needs` names, and
                another number of seeds than of observations.
        """
        if seeds is not None and len(seeds) != len(observations):
            raise ObservationError(f"{len(observations)} observations but {len(seeds)} seeds; give each its own")
        limit = self.card.batch
        if limit is not None and len(observations) > limit:
            raise ObservationError(
                f"{len(observations)} observations in one call; {self.card.family} takes at most {limit}: a "
                "larger batch changes its numbers"
            )
        for observation in observations:
            if lacking := observation.lacks(self.card.needs):
                raise ObservationError(
                    f"the observation has no {', '.join(lacking)}, which {self.card.family} reads; choose a scene "
                    "or recording that provides it"
                )


class Policy(Model):
    """A model that turns observations and an instruction into actions.

    Deterministic for given seeds. Capturing changes no action, bit for bit.

    Attributes:
        interventions: The interventions that it supports; a family says the same before it is loaded.
        draws_noise: Whether noise of the seed enters every inference, as in a flow; None if undeclared.
        flagged: (B,) rows of the last `act` in which the network put out something that is no action. What the row
            then does is the family's choice. None for a family that cannot tell.
    """

    interventions: ClassVar[Interventions] = ALL_EDITS
    draws_noise: ClassVar[bool | None] = None
    flagged: NDArray[np.bool_] | None = None

    def embodiment_mismatch(self) -> str | None:
        """Return why its actions cannot move this arm; None if they can.

        Its activations can be captured nevertheless.
        """
        return None

    def configured_mismatch(self) -> str | None:
        """Return the mismatch as far as the configuration alone shows it: statistics may not be here yet."""
        return None

    def zero_filled_inputs(self) -> tuple[str, ...]:
        """Return inputs that `infer_without_acting` replaces by zeros: the checkpoint expects others there."""
        return ()

    def infer_without_acting(
        self, observations: Sequence[Observation], seeds: Sequence[int]
    ) -> NDArray[np.float32]:
        """Run one inference as `act` makes it, whatever its output means: (B, chunk, any width) float32.

        It serves a policy with an `embodiment_mismatch`, which `act` refuses.
        """
        return self.act(observations, seeds)

    def record_attention(self, note: Callable[[int, int, Tensor], None]) -> AbstractContextManager[None]:
        """A context in which `note` receives the attention of the acting stream; see `hooks.capture_attention`.

        Args:
            note: Called with a block of the backbone, an iteration, and weights (B, H, S, T): of S acting
                positions on the backbone's T tokens. No number of the inference may change.

        Raises:
            UnsupportedInterventionError: For a family that does not declare attention.
        """
        del note
        self.interventions.check("attention", self.card.family)
        raise NotImplementedError(
            f"{type(self).__name__} declares attention and does not implement `record_attention`"
        )

    def differentiable(self, observations: Sequence[Observation], seeds: Sequence[int]) -> Tensor:
        """The actions of `act` with a graph behind them: (B, chunk, 7) in metres and radians, as float32.

        It serves `hooks.gradients_at`. Weights need no gradient, no module is compiled, attention is eager, and
        numbers equal those of `act` to 1e-5 in float32. A number without a slope, such as a gripper that is open
        or closed, has gradient zero.

        Raises:
            UnsupportedInterventionError: For a family that does not declare gradients.
        """
        del observations, seeds
        self.interventions.check("gradients", self.card.family)
        raise NotImplementedError(
            f"{type(self).__name__} declares gradients and does not implement `differentiable`"
        )

    @property
    def state_numbers(self) -> int | None:
        """The count of numbers in a recorded state; None for a policy that takes any, or reads none."""
        return None

    def with_cameras(self, cameras: Sequence[str]) -> "Policy":
        """The same policy, given pictures of these cameras; all but the first from `Observation.cameras`.

        Raises:
            ObservationError: For cameras that it cannot be given together.
        """
        if tuple(cameras) != self.card.cameras[:1]:
            raise ObservationError(
                f"cameras {list(cameras)} given; {self.card.family} is given {list(self.card.cameras[:1])} alone"
            )
        return self

    def laid_out(self, states: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return states (n, 8) of the scene's arm as (n, D), in the order and count that a checkpoint reads."""
        return states

    @property
    def action_names(self) -> tuple[str, ...] | None:
        """The names of the numbers that `predict` gives, in order; None where the checkpoint has none."""
        return None

    @property
    def state_statistics(self) -> FeatureStatistics | None:
        """The statistics of states that the checkpoint was trained on; None where nothing is compared.

        Raises:
            CheckpointError: For a checkpoint that lacks statistics.
        """
        return None

    @property
    def unguarded_state(self) -> str | None:
        """The reason why the states of a source are compared with no statistics; None where they are compared.

        `state_statistics` has them. A family that reads a state has statistics of it, or says here why not; the
        card's notes repeat it.
        """
        if self.state_numbers is None:
            return "no state is read"
        compares = type(self).state_statistics is not Policy.state_statistics
        return None if compares else "the family has no statistics of states"

    @property
    def action_statistics(self) -> FeatureStatistics | None:
        """The statistics of actions that the checkpoint was trained on; None where nothing is compared."""
        return None

    @property
    def predicts_relative(self) -> bool:
        """Whether `predict` gives changes relative to the state, where a data set has the actions themselves."""
        return False

    def predict(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        """Return one chunk of actions per recorded observation, in the checkpoint's own units and width.

        States are taken as recorded. Nothing is claimed about whether the actions fit an arm.

        Returns:
            (B, chunk, D) float32.
        """
        return self.act(observations, seeds)

    @abstractmethod
    def act(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        """Return one chunk of actions per observation.

        All randomness of a row comes from its seed.

        Returns:
            (B, chunk, 7) float32: xyz delta in metres and roll-pitch-yaw delta in radians in the robot base frame,
            gripper 1 = open and 0 = closed. The rate is 5 Hz.

        Raises:
            InstructionError: For an instruction that the policy cannot take in whole.
            ObservationError: For an observation that the policy cannot take in whole.
        """


@dataclass(frozen=True)
class Prompt:
    """A question about an observation.

    Attributes:
        text: The whole question as a person would ask it; the family puts its frame around it.
        options: The beginnings of the admissible answers, such as letters; the logits of their first tokens are
            compared. They stand directly behind the frame, so an option in front begins with `AnswerModel.lead`.
        begun: The beginning of the answer, put behind the frame; it begins with `AnswerModel.lead` too.
        pictured: Whether the picture is shown; False asks in words alone.
    """

    observation: Observation
    text: str
    options: tuple[str, ...] = ()
    begun: str = ""
    pictured: bool = True


@dataclass(frozen=True)
class Reading:
    """The result of one prefill.

    Attributes:
        option_logits: (B, options) float32, one column per option of the questions, in their order.
        option_mass: (B,) float32 share of the next token's probability that lies on the options together.
        state: The state from which `AnswerModel.speak` continues; opaque to all other code.
        option_ids: (B, options) int64 tokens of the options; None if the model does not say them.
    """

    option_logits: NDArray[np.float32]
    option_mass: NDArray[np.float32]
    state: Any = None
    option_ids: NDArray[np.int64] | None = None

    @classmethod
    def of(cls, logits: NDArray[np.float32], options: Sequence[Sequence[int]], state: Any = None) -> "Reading":
        """Return the reading of the logits behind every prompt.

        Args:
            logits: (B, V) of the last position of every row.
            options: Per row, the ids of its options, as many in every row.
            state: The state from which `AnswerModel.speak` continues; None for a model that needs none.

        Raises:
            UsageError: For options of a question that have the same id, or another number than their neighbours.
        """
        if len({len(row) for row in options}) > 1:
            raise UsageError("the questions of one call have different numbers of options; ask them in several")
        for row in options:
            if len(set(row)) < len(row):
                raise UsageError(
                    f"two options begin with the same token (ids {list(row)}): their logits would be one number. "
                    "Name options that differ in their first token, such as letters"
                )
        ids = np.array(options, np.int64).reshape(len(logits), -1)
        option_logits = np.take_along_axis(logits, ids, axis=1)
        # Less the largest logit, so that no exponential overflows; the share stays the same.
        shares = np.exp(logits - logits.max(axis=1, keepdims=True))
        peak = np.exp(option_logits - logits.max(axis=1, keepdims=True))
        return cls(option_logits, peak.sum(axis=1) / shares.sum(axis=1), state, ids)


NEAR_TIE: Mapping[str, float] = MappingProxyType({"float32": 1e-4, "bfloat16": 0.1})
"""The margins per dtype below which another batch or machine may turn a choice round.

Measured on small models, batches against single rows: logits move by 1e-5 in float32, margins by 0.03 in bfloat16.
"""


class AnswerModel(Model):
    """A model that answers questions in text.

    A call of `read` is one inference, as `capture` counts it.

    Attributes:
        whole_prompt: Whether the backbone's stream holds the prompt to its last position, where the answer begins.
            Where it is False, the last position is the stream `answer`.
    """

    whole_prompt: bool = False

    def match_policies(self, matched: bool) -> None:
        """Choose the positions of the backbone's stream, so that a VLM and policies grown from it are compared.

        By default this does nothing: policies too begin their output at the last position of the prompt.

        Args:
            matched: True gives the positions that the stream has in such policies, False those of this model.
        """

    @property
    def lead(self) -> str:
        """The text between the frame and the first word of an answer, such as a space; see `Prompt`."""
        return ""

    @abstractmethod
    def read(self, questions: Sequence[Prompt]) -> Reading:
        """Read all questions, which must have equally many options, in one prefill: every tap fires as promised.

        Questions with and without a picture are not mixed in one call.

        Raises:
            InstructionError: For a question that the model cannot take in whole.
            ObservationError: For an observation that the model cannot take in whole.
            UsageError: For an option that changes the prompt's own tokens, or begins like another one.
        """

    def near_ties(self, reading: Reading) -> NDArray[np.bool_]:
        """Return (B,) whether the two likeliest options are so close that rounding may decide; see `NEAR_TIE`."""
        best = np.sort(reading.option_logits, axis=1)[:, -2:]
        # An unknown dtype counts as the coarser one: too many ties are said rather than too few.
        limit = NEAR_TIE.get(self.card.dtype, NEAR_TIE["bfloat16"])
        return np.asarray(best[:, -1] - best[:, 0] < limit) if best.shape[1] == 2 else np.zeros(len(best), bool)

    @staticmethod
    def shows_pictures(questions: Sequence[Prompt]) -> bool:
        """Whether the questions are asked about their pictures.

        Raises:
            UsageError: If only some are.
        """
        pictured = {question.pictured for question in questions}
        if len(pictured) > 1:
            raise UsageError("some of these questions come with a picture and some without; ask them in two calls")
        return pictured != {False}

    def asked_roles(self, questions: Sequence[Prompt]) -> dict[str, list[Roles]]:
        """The roles of the sequences that `read` makes of these questions, in the form of `roles`.

        A family whose prompt depends on more than a question's text, or that also acts, says so itself.
        """
        return self.roles([replace(question.observation, instruction=question.text) for question in questions])

    @abstractmethod
    def speak(self, reading: Reading, tokens: int) -> list[str]:
        """Return per row at most `tokens` greedy tokens of text, outside of any capture.

        The text is "" where the model ends the answer at once.
        """
