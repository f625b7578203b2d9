"""The inputs of an observation by name, exchanged or hardly changed one at a time. Imports no torch.

An input is `instruction`, `state`, `picture` for the pictures of all cameras, or `picture.NAME` for one. A name
that no further camera has is that of the first one, whose picture is `Observation.image`.
"""

import unicodedata
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.types import PictureArray
from probe_kit.hooks.contract.observation import Observation
from probe_kit.suite.pictures import through_jpeg

INSTRUCTION, STATE, PICTURE = "instruction", "state", "picture"
STATE_SHARE = 0.01
"""The share of its spread over frames by which a control moves a state."""
FIRST = ""
"""The name of the first camera, among the names of cameras."""


def with_input(clean: Observation, vary: str, donor: Observation) -> Observation:
    """Return the clean observation with one input of another."""
    if vary == INSTRUCTION:
        return replace(clean, instruction=donor.instruction)
    if vary == STATE:
        return replace(clean, state=donor.state)
    return with_pictures(clean, vary, partial(picture_of, donor))


# -- equal values --------------------------------------------------------------------------------------------
# An exchange for a value that differs by no more than the control does is its own control: it would change the
# action as little in a policy that reads every word, and the policy would be called deaf.

BEYOND = 3.0
"""How many times the change by the control an exchange must change pictures and states to be one.

Two lossy copies of one picture are further apart than either is from its JPEG round trip. The blocks of a scene's
picture, encoded again as JPEG of any quality from 50 or as AV1 of CRF 30, lie within three times that.
"""
BLOCK = 8
"""Side of the blocks over which pictures are compared: JPEG's, and noise within a block has no mean."""
GREY_LEVELS = 2.0
"""The least change of a block's mean that counts, of 255: a round trip leaves flat pictures as they are."""
ROUNDING = 1e-5
"""The least change of a number of the state that counts, as a share of the largest number of any state.

It is some hundred units of the last place of float32.
"""


@lru_cache(maxsize=1 << 14)
def normal_form(text: str) -> str:
    """Return a text without what no word hangs on: case, white space, punctuation and the form of its characters.

    Texts of one normal form are one value of an instruction. Marks inside a number, or in front of it, and spaces
    between two numbers stay: 1.5 is not 15, and -5 not 5. Forms are those of Unicode's NFKC.
    """
    plain = "".join(map(_typed_plainly, text))
    folded = unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", plain).casefold())
    visible = "".join(sign for sign in folded if unicodedata.category(sign) not in ("Cf", "Cc") or sign.isspace())
    runs = ["".join(signs) for _, signs in groupby(visible, _is_separator)]
    between = zip(["", *runs], runs, [*runs[1:], ""], strict=False)
    return "".join(
        _kept_of(run, before[-1:], after[:1]) if _is_separator(run[0]) else run for before, run, after in between
    )


def _typed_plainly(sign: str) -> str:
    """Return a character as plain keyboards have it: a dash, or a blank for an accent that stands alone.

    Accents are typed as quotation marks; NFKC would join them to the word before.
    """
    kind = unicodedata.category(sign)
    return "-" if kind == "Pd" or sign == "\N{MINUS SIGN}" else " " if kind == "Sk" else sign


def _is_separator(sign: str) -> bool:
    return sign.isspace() or unicodedata.category(sign).startswith("P")


def _kept_of(run: str, before: str, after: str) -> str:
    """Return what stays of spaces and punctuation, given the characters before and after them."""
    marks = "".join(run.split())
    if before.isdecimal() and after.isdecimal():
        return marks or " "
    # A sign stands apart from the word before it; a hyphen joins it to its number.
    is_sign = marks.endswith("-") and after.isdecimal() and (not before or run[-2:-1].isspace())
    return "-" if is_sign else ""


def values_of_texts(texts: Sequence[str], same_meaning: Sequence[tuple[str, str]] = ()) -> NDArray[np.intp]:
    """Return a number (N,) of the value of every instruction: texts of one `normal_form` have one number.

    Args:
        texts: The instructions.
        same_meaning: Pairs of texts that are one value too, such as an instruction and its other words.
    """
    same: dict[str, str] = {}

    def first_of(form: str) -> str:
        while form in same:
            form = same[form]
        return form

    for pair in same_meaning:
        first, second = (first_of(normal_form(text)) for text in pair)
        if first != second:
            same[second] = first
    forms = [first_of(normal_form(text)) for text in texts]
    numbers = {form: number for number, form in enumerate(dict.fromkeys(forms))}
    return np.array([numbers[form] for form in forms], np.intp)


def least_step(states: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the change (D,) of every number of a state from which on two states (N, D) are two values."""
    values = np.asarray(states, np.float64)
    if not values.size:
        return np.zeros(values.shape[1:])
    step: NDArray[np.float64] = np.maximum(
        BEYOND * STATE_SHARE * values.std(axis=0), ROUNDING * float(np.abs(values).max())
    )
    return step


@dataclass(eq=False)
class InputComparison:
    """The comparison of frames by their values of one input; of pictures it keeps the means of blocks.

    Instructions differ by their value, see `values_of_texts`. Of pictures some block's mean differs, of states
    some number, by more than the control of the input changes it, see `BEYOND`.

    Attributes:
        observe: A function that returns the observation of a frame by its index.
        vary: The name of the input.
        texts: (N,) values of the instructions.
        step: (D,) the least change of every number of the state, see `least_step`.
    """

    observe: Callable[[int], Observation]
    vary: str
    texts: NDArray[np.intp]
    step: NDArray[np.float64]
    _means: dict[tuple[int, str], NDArray[np.float64]] = field(default_factory=dict, repr=False)
    _least: dict[tuple[int, str], float] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, frames: "Sequence[Frame]", vary: str) -> "InputComparison":
        """Return the comparison of some frames, whose other words mean the same."""
        texts = [frame.instruction for frame in frames]
        same = [(frame.instruction, frame.other_words) for frame in frames if frame.other_words]
        states = np.stack([np.asarray(frame.state, np.float64) for frame in frames])
        return cls(lambda at: frames[at].observation, vary, values_of_texts(texts, same), least_step(states))

    def differ(self, clean: int, other: int) -> bool:
        """Return whether another frame's value would be an exchange for a frame, by the indices of both."""
        if self.vary == INSTRUCTION:
            return bool(self.texts[clean] != self.texts[other])
        first = self.observe(clean)
        if self.vary == STATE:
            changes = np.abs(self.observe(other).state.astype(np.float64) - first.state)
            # Frames of a source without states have none, and their observations zeros.
            return bool((changes > (self.step if self.step.size else 0.0)).any())
        return any(self._picture_differs(clean, other, camera) for camera in _cameras(first, self.vary))

    def values(self, count: int) -> NDArray[np.intp]:
        """Return a number (count,) of each first frame's value; the first frame with a value stands for it."""
        if self.vary == INSTRUCTION:
            return self.texts[:count]
        firsts: list[int] = []
        numbers = np.empty(count, np.intp)
        for at in range(count):
            equal = next((number for number, first in enumerate(firsts) if not self.differ(first, at)), None)
            if equal is None:
                firsts.append(at)
            numbers[at] = len(firsts) - 1 if equal is None else equal
        return numbers

    def _picture_differs(self, clean: int, other: int, camera: str) -> bool:
        first, second = self._means_of(clean, camera), self._means_of(other, camera)
        if first.shape != second.shape:
            return True
        change = float(np.abs(first - second).max(initial=0.0))
        return change > GREY_LEVELS and change > self._least_of(clean, camera)

    def _means_of(self, at: int, camera: str) -> NDArray[np.float64]:
        if (at, camera) not in self._means:
            self._means[at, camera] = block_means(picture_of(self.observe(at), camera))
        return self._means[at, camera]

    def _least_of(self, at: int, camera: str) -> float:
        """Return `BEYOND` times the largest change of a block's mean by the control of a frame's picture."""
        if (at, camera) not in self._least:
            control = block_means(through_jpeg(picture_of(self.observe(at), camera)))
            self._least[at, camera] = BEYOND * float(np.abs(control - self._means_of(at, camera)).max(initial=0.0))
        return self._least[at, camera]


def block_means(picture: PictureArray) -> NDArray[np.float64]:
    """Return the means (h, w, 3) of a picture's blocks, of 8 × 8 pixels each or fewer at its ends."""
    height, width = picture.shape[:2]
    rows, columns = np.arange(0, height, BLOCK), np.arange(0, width, BLOCK)
    sums = np.add.reduceat(np.add.reduceat(picture, rows, axis=0, dtype=np.uint32), columns, axis=1)
    counts = np.outer(np.diff([*rows, height]), np.diff([*columns, width]))
    means: NDArray[np.float64] = sums / counts[..., None]
    return means


def content_of(observation: Observation, vary: str) -> bytes:
    """Return the bytes of one input, which are equal among observations of equal shapes if the input is."""
    if vary == INSTRUCTION:
        return observation.instruction.encode()
    if vary == STATE:
        return observation.state.tobytes()
    return b"".join(picture_of(observation, name).tobytes() for name in _cameras(observation, vary))


def same_input(first: Observation, second: Observation, vary: str) -> bool:
    """Return whether two observations have the same value of one input, number by number."""
    if vary == INSTRUCTION:
        return first.instruction == second.instruction
    if vary == STATE:
        return np.array_equal(first.state, second.state)
    return all(np.array_equal(picture_of(first, name), picture_of(second, name)) for name in _cameras(first, vary))


# -- changes -------------------------------------------------------------------------------------------------


def hardly_changed(clean: Observation, vary: str, spread: NDArray[np.floating]) -> Observation:
    """Return the clean observation after a change of one input that means nothing.

    The instruction gains or loses its period, pictures pass through JPEG, and the state moves by a hundredth of
    its `spread` (D,).
    """
    if vary == INSTRUCTION:
        return replace(clean, instruction=with_other_stop(clean.instruction))
    if vary == STATE:
        moved = clean.state + STATE_SHARE * spread[: clean.state.size]
        return replace(clean, state=moved.astype(np.float32))
    return with_pictures(clean, vary, lambda name: through_jpeg(picture_of(clean, name)))


def with_other_stop(text: str) -> str:
    """Return a text with its period removed, or one added."""
    return text[:-1] if text.endswith(".") else f"{text}."


def blank_of(observations: Sequence[Observation]) -> Observation:
    """Return an observation without content: no words, pictures of the mean color of all, the mean state."""
    first = observations[0]
    states = np.stack([observation.state for observation in observations]).astype(np.float64)
    cameras: Mapping[str, PictureArray] = {
        name: _mean_colour([observation.cameras[name] for observation in observations]) for name in first.cameras
    }
    return replace(
        first,
        image=_mean_colour([observation.image for observation in observations]),
        state=states.mean(axis=0).astype(np.float32),
        instruction="",
        cameras=cameras,
    )


def _mean_colour(pictures: Sequence[PictureArray]) -> PictureArray:
    colour = np.mean([picture.mean(axis=(0, 1)) for picture in pictures], axis=0)
    return np.broadcast_to(np.rint(colour).astype(np.uint8), pictures[0].shape).copy()


def with_pictures(clean: Observation, vary: str, picture: Callable[[str], PictureArray]) -> Observation:
    """Return the observation with other pictures of the cameras that an input names, by the camera's name."""
    pictures = {name: picture(name) for name in _cameras(clean, vary)}
    image = pictures.pop(FIRST, clean.image)
    return replace(clean, image=image, cameras={**clean.cameras, **pictures})


def _cameras(observation: Observation, vary: str) -> tuple[str, ...]:
    camera = vary.partition(".")[2]
    if not camera:
        return FIRST, *observation.cameras
    return (camera,) if camera in observation.cameras else (FIRST,)


def picture_of(observation: Observation, camera: str) -> PictureArray:
    """Return the picture (H, W, 3) of a camera; of the first one for a name that no further camera has."""
    return observation.cameras.get(camera, observation.image)


NEAREST = 8
"""The frames with the nearest states from which a picture's donor is drawn, so that the picture fits the arm."""


@dataclass(frozen=True, eq=False)
class Frame:
    """An observation that a policy gets, alone; its pictures are read when they are needed.

    Attributes:
        group: The unit that is resampled, such as an episode, or a couple of items.
        seed: The seed of the inference.
        instruction: The instruction of the observation.
        state: The state of the observation.
        observe: A function that reads the observation, given the frame.
        other_words: The instruction in other words; empty where the source has none.
        row: The row in a run's episodes; -1 outside a run.
        number: The number of the recorded frame; 0 in an environment.
        item: The item of the row in a run.
        episode: The id of the row in a run.
        category: The category of the row in a run.
        stored: (n, D) actions that the run stores for it, None without any.
    """

    name: str
    group: str
    seed: int
    instruction: str
    state: NDArray[np.floating]
    observe: Callable[["Frame"], Observation] = field(repr=False)
    other_words: str = ""
    row: int = -1
    number: int = 0
    item: str = ""
    episode: str = ""
    category: str = ""
    stored: NDArray[np.float32] | None = None

    @classmethod
    def of(cls, name: str, observation: Observation, group: str, seed: int) -> "Frame":
        """Return the frame of an observation that exists already."""
        state = np.asarray(observation.state, np.float64)
        return cls(name, group, seed, observation.instruction, state, lambda _: observation)

    @property
    def observation(self) -> Observation:
        """The observation, read when it is asked for."""
        return self.observe(self)

    def with_instruction(self, text: str) -> "Frame":
        """Return the frame with another instruction, as a donor."""
        return replace(
            self,
            name=f"{self.name} {text!r}",
            instruction=text,
            observe=lambda _: replace(self.observation, instruction=text),
            other_words="",
        )


GIVE_WORDS = "Give the words of other tasks: --instructions FILE"
"""The remedy for an instruction that does not vary."""


def why_not_varied(instructions: Sequence[str], vary: str) -> str:
    """Return why no frame of another group has another value of an input, and what to do."""
    none = f"no frame of another group has another {vary}"
    if vary != INSTRUCTION:
        beyond = f"{none}, by {BEYOND:g} times what its control changes"
        return f"{beyond}; extract more episodes, or choose another --vary"
    spelt = "; ".join(describe_spellings(instructions))
    return f"{none}{f': {spelt}' if spelt else ''}. {GIVE_WORDS}, or choose another --vary"


def describe_spellings(instructions: Iterable[str]) -> list[str]:
    """Return a sentence, without its stop, for all texts of one `normal_form` that are spelt in several ways."""
    by_form: dict[str, dict[str, None]] = {}
    for text in instructions:
        by_form.setdefault(normal_form(text), {})[text] = None
    return [
        f"{', '.join(map(repr, texts))} are one instruction: case, spaces, punctuation or form alone differ"
        for texts in by_form.values()
        if len(texts) > 1
    ]


def draw_donors(
    frames: Sequence[Frame],
    vary: str,
    rng: np.random.Generator,
    count: int = 1,
    of: Sequence[int] | None = None,
    compared: InputComparison | None = None,
) -> list[tuple[int, int]]:
    """Return pairs (frame, donor) of indices: up to `count` donors per frame.

    A donor is of another group, and has another value of the input, see `InputComparison`. The donor of a picture
    is one of the `NEAREST` frames by state, in spreads of every number, and of all that are equally near. Frames
    without any donor are left out.

    Args:
        frames: The frames, among which donors are drawn too.
        vary: The name of the input.
        rng: The generator of the draws.
        count: The most donors of a frame.
        of: The indices of the frames that get donors; None for all.
        compared: The comparison of these frames, if it was made before.
    """
    groups = np.array([frame.group for frame in frames])
    states = np.stack([np.asarray(frame.state, np.float64) for frame in frames])
    compared = compared or InputComparison.of(frames, vary)
    spread = states.std(axis=0)
    scaled = states / np.where(spread > 0, spread, 1.0)
    pairs = []
    for index in range(len(frames)) if of is None else of:
        is_candidate = groups != groups[index]
        if vary == INSTRUCTION:
            is_candidate &= compared.texts != compared.texts[index]
        elif vary == STATE:
            is_candidate &= (np.abs(states - states[index]) > compared.step).any(axis=1)
        candidates = np.flatnonzero(is_candidate)
        if vary.startswith(PICTURE):
            distances = np.linalg.norm(scaled[candidates] - scaled[index], axis=1)
            ordered = candidates[np.argsort(distances, kind="stable")]
            candidates = _nearest(compared, index, ordered, np.sort(distances))
        drawn = rng.choice(candidates, min(count, len(candidates)), replace=False)
        pairs += [(index, int(donor)) for donor in drawn]
    return pairs


def _nearest(
    compared: InputComparison, index: int, ordered: NDArray[np.intp], distances: NDArray[np.float64]
) -> NDArray[np.intp]:
    """Return the nearest candidates with another picture, in the order of the frames.

    The candidates `ordered` come nearest first, and so do their distances.
    """
    nearest: list[int] = []
    limit = np.inf
    for donor, distance in zip(ordered.tolist(), distances, strict=True):
        # Pictures of recordings are decoded one by one: none is read beyond the limit.
        if len(nearest) >= NEAREST and distance > limit:
            break
        if compared.differ(index, donor):
            nearest.append(donor)
            limit = distance
    return np.sort(np.array(nearest, np.intp))
