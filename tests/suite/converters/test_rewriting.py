"""The unit table: questions as benchmarks ask them, the rule that matches, the phrase, and its opposite."""

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from probe_kit.errors import SuiteError, UsageError
from probe_kit.suite.converters import ConvertOptions, convert, rewrite
from probe_kit.suite.converters.rewriting import base_of, clean, opposite_of, picture_problem, text_problem
from probe_kit.suite.pictures import look_of

SYMMETRIC, ASYMMETRIC = "picture with a line of symmetry", "picture without a line of symmetry"
TABLE = [
    ("Based on these images, which person is more smiling?", "R1", "more smiling person", "less smiling person"),
    ("Which street is more crowded?", "R1", "more crowded street", "less crowded street"),
    ("Which of the two is more colorful?", "R1", "more colorful picture", "less colorful picture"),
    ("Which image is more cluttered?", "R1", "more cluttered picture", "less cluttered picture"),
    ("Which face is less worried?", "R1", "less worried face", "more worried face"),
    ("Which shirt is more wrinkled in the picture?", "R1", "more wrinkled shirt", "less wrinkled shirt"),
    ("Which wooden table is more scratched?", "R1", "more scratched wooden table", "less scratched wooden table"),
    ("Which tomatoes are more ripe?", "R1", "more ripe tomatoes", "less ripe tomatoes"),
    ("Which building is taller?", "R2", "taller building", "shorter building"),
    ("Which grass is drier?", "R2", "drier grass", "wetter grass"),
    ("Which street is wetter?", "R2", "wetter street", "drier street"),
    ("Which person is happier?", "R2", "happier person", "less happy person"),
    ("Which dog is bigger?", "R2", "bigger dog", "smaller dog"),
    ("Which road is wider?", "R2", "wider road", "narrower road"),
    ("Which bird is larger?", "R2", "larger bird", "smaller bird"),
    ("Which wall is smoother?", "R2", "smoother wall", "rougher wall"),
    ("Which sky is darker?", "R2", "darker sky", "lighter sky"),
    ("Which car is newer?", "R2", "newer car", "older car"),
    ("Which fish is longer in these images?", "R2", "longer fish", "shorter fish"),
    ("Which bag is fuller?", "R2", "fuller bag", "emptier bag"),
    ("Which rope is thinner?", "R2", "thinner rope", "thicker rope"),
    ("Which lake is calmer?", "R2", "calmer lake", "less calm lake"),
    ("Which baby is sadder?", "R2", "sadder baby", "less sad baby"),
    ("Which person looks more surprised?", "R3", "more surprised person", "less surprised person"),
    ("Which man appears more angry?", "R3", "more angry man", "less angry man"),
    ("Which child seems more afraid?", "R3", "more afraid child", "less afraid child"),
    ("Which woman looks happier?", "R3", "happier woman", "less happy woman"),
    ("Which metal appears rustier?", "R3", "rustier metal", "less rusty metal"),
    ("Which person smiles more?", "R4", "more smiling person", "less smiling person"),
    ("Which child laughs more?", "R4", "more laughing child", "less laughing child"),
    ("Which lamp shines more?", "R4", "more shining lamp", "less shining lamp"),
    ("Which dress has more stripes?", "R5", "dress with more stripes", "dress with fewer stripes"),
    ("Which coat has fewer buttons?", "R5", "coat with fewer buttons", "coat with more buttons"),
    ("Which bird has a longer beak?", "R5", "bird with longer beak", "bird with shorter beak"),
    ("Which bird has a darker wing?", "R5", "bird with darker wing", "bird with lighter wing"),
    ("Which fish has more spots?", "R5", "fish with more spots", "fish with fewer spots"),
    ("Which plant has more moss?", "R5", "plant with more moss", "plant with less moss"),
    ("Which person has longer hair?", "R5", "person with longer hair", "person with shorter hair"),
    ("In which image is the water more clear?", "R6", "more clear water", "less clear water"),
    ("In which picture is the floor cleaner?", "R6", "cleaner floor", "dirtier floor"),
    ("In which image does the man look more tired?", "R6", "more tired man", "less tired man"),
    ("In which photo is the fog thicker?", "R6", "thicker fog", "thinner fog"),
    ("In which image are the leaves drier?", "R6", "drier leaves", "wetter leaves"),
    ("Which image has more snow?", "R7", "picture with more snow", "picture with less snow"),
    ("Which picture has more people?", "R7", "picture with more people", "picture with less people"),
    ("Which picture shows fewer cars?", "R7", "picture with fewer cars", "picture with more cars"),
    ("Which picture has six birds?", "R7", "picture with six birds", "picture without six birds"),
    ("Which image contains a bridge?", "R7", "picture with a bridge", "picture without a bridge"),
    ("Which shape has a line of symmetry?", "R7", SYMMETRIC, ASYMMETRIC),
    ("Which shape is a triangle?", "R8", "triangle", None),
    ("Which picture shows a cube?", "R8", "cube", None),
    ("Which solid is an upright cone?", "R8", "upright cone", None),
    ("Which figure is a right triangle?", "R8", "right triangle", None),
    ("Which clock shows half past four?", "R9", "clock showing half past four", None),
    ("Which clock shows 4:30?", "R9", "clock showing 4:30", None),
    ("Which clock says a quarter past six?", "R9", "clock showing a quarter past six", None),
    ("What time is it?", None, "", None),
    ("Is the car red?", None, "", None),
    ("Which is your favorite?", None, "", None),
    ("Which person is her?", None, "", None),
    ("Which sign is other?", None, "", None),
    ("Describe both pictures.", None, "", None),
]  # fmt: skip


@pytest.mark.parametrize(("question", "rule_id", "phrase", "opposite"), TABLE)
def test_a_question_becomes_a_phrase(
    question: str, rule_id: str | None, phrase: str, opposite: str | None
) -> None:
    wording = rewrite(question)
    if rule_id is None:
        assert wording is None
    else:
        assert wording is not None
        assert (wording.rule_id, wording.phrase, wording.opposite) == (rule_id, phrase, opposite)
        assert wording.article == "the"


def test_the_table_is_long_enough_and_covers_every_rule_without_an_answer_text() -> None:
    assert len(TABLE) >= 60
    assert {rule_id for _, rule_id, _, _ in TABLE if rule_id} == {f"R{number}" for number in range(1, 10)}


@pytest.mark.parametrize(
    "question", ["Who is this person?", "Who is the man in the picture?", "What is the name of her?"]
)
def test_a_name_keeps_its_case_and_gets_no_article(question: str) -> None:
    wording = rewrite(question, "Ada Example", options_are_names=True)
    assert wording is not None
    assert (wording.rule_id, wording.phrase, wording.article) == ("R10", "Ada Example", "none")


@pytest.mark.parametrize(
    ("question", "answer"),
    [
        ("What kind of bird is this?", "a duck"),
        ("What breed of dog is that?", "duck"),
        ("What animal is it?", "the duck"),
    ],
)
def test_a_kind_is_asked_for_by_the_answer_without_article(question: str, answer: str) -> None:
    wording = rewrite(question, answer)
    assert wording is not None
    assert (wording.rule_id, wording.phrase) == ("R11", "picture of duck")


def test_a_long_answer_is_left_to_a_person() -> None:
    assert rewrite("What kind of bird is this?", "some very rare duck") is None


def test_a_question_is_cleaned_of_what_every_question_has() -> None:
    assert clean(" Based on  these images,  Which cat sleeps ?? ") == "which cat sleeps"


@pytest.mark.parametrize(
    ("comparative", "base"),
    [
        ("happier", "happy"),
        ("bigger", "big"),
        ("taller", "tall"),
        ("wider", "wide"),
        ("worse", "bad"),
        ("larger", "large"),
    ],
)
def test_the_base_of_a_comparative(comparative: str, base: str) -> None:
    assert base_of(comparative) == base


def test_opposites_are_reviewed_words_or_less() -> None:
    assert opposite_of("longer") == "shorter"
    assert opposite_of("redder") == "less red"
    assert opposite_of("more", "stripes") == "fewer"
    assert opposite_of("more", "grass") == "less"


@pytest.mark.parametrize("base", ["clean", "green", "calm", "tough", "quiet", "new", "young", "smart", "black"])
def test_a_comparative_that_only_added_er_loses_only_that(base: str) -> None:
    assert base_of(f"{base}er") == base


OPTIONS = ConvertOptions()


def noise(width: int, height: int) -> Image.Image:
    pixels = np.random.default_rng(0).integers(0, 256, (height // 20 + 1, width // 20 + 1, 3), dtype=np.uint8)
    return Image.fromarray(pixels).resize((width, height), Image.Resampling.BICUBIC)


@pytest.mark.parametrize(
    ("image", "problem"),
    [
        (noise(120, 100), None),
        (noise(120, 99), "picture too small"),
        (noise(251, 100), "picture too long"),
        (Image.new("RGB", (120, 120), "red"), "picture nearly blank"),
    ],
)
def test_pictures_are_judged_by_size_shape_and_contrast(image: Image.Image, problem: str | None) -> None:
    assert picture_problem(image, OPTIONS) == problem


def test_a_source_of_small_pictures_may_have_its_own_limit() -> None:
    assert picture_problem(noise(48, 48), OPTIONS, least_side=48) is None


def test_fine_detail_is_lost_on_a_tile_and_coarse_detail_is_not() -> None:
    options = ConvertOptions(legible_at=40)
    fine = Image.fromarray(np.random.default_rng(0).integers(0, 256, (400, 400, 3), dtype=np.uint8))
    assert picture_problem(fine, options) == "picture not legible on a tile"
    assert picture_problem(noise(100, 100), options) is None


def test_a_re_encoded_picture_looks_the_same_and_another_colour_does_not() -> None:
    picture = noise(200, 200)
    smaller = picture.resize((150, 150))
    red, green, blue = picture.split()
    assert look_of(picture).same_as(look_of(smaller))
    assert not look_of(picture).same_as(look_of(Image.merge("RGB", (blue, green, red))))


@pytest.mark.parametrize(
    ("instruction", "problem"),
    [
        ("Put the cube on the red shape", None),
        ("Put the cube on the " + "very " * 8 + "red shape", "instruction has too many words"),
        ("Put the cube on the " + "x" * 61, "instruction too long"),
        ("Put the cube. Then stop", "instruction is more than one sentence"),
        ("Put the cube on the red shape.", "instruction ends with a period"),
        ("Put the cube on the café", "instruction is not plain ASCII"),
        ("Put the cube on the left shape", "instruction names a side"),
    ],
)
def test_instructions_are_short_plain_single_sentences(instruction: str, problem: str | None) -> None:
    assert text_problem(instruction, "red shape", OPTIONS) == problem


def test_other_alphabets_are_allowed_on_request() -> None:
    assert text_problem("Put the cube on the café", "café", ConvertOptions(allow_unicode=True)) is None


GOOD = {"instruction": "Put the cube on the calmer sky", "object": "calmer sky", "polarity": "none", "keep": True}


class Service:
    """Answers every request with `reply` and remembers them."""

    def __init__(self) -> None:
        self.reply: object = GOOD
        self.requests: list[dict[str, object]] = []
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                outer.requests.append({"path": self.path, **json.loads(body)})
                content = {"choices": [{"message": {"content": json.dumps(outer.reply)}}]}
                self.send_response(200)
                self.end_headers()
                self.wfile.write(json.dumps(content).encode())

            def log_message(self, *_: object) -> None:
                pass

        self.server = HTTPServer(("127.0.0.1", 0), Handler)
        self.base = f"http://127.0.0.1:{self.server.server_port}/v1"


@pytest.fixture
def service() -> Iterator[Service]:
    running = Service()
    threading.Thread(target=running.server.serve_forever, daemon=True).start()
    yield running
    running.server.shutdown()
    running.server.server_close()


@pytest.mark.slow
def test_a_proposal_waits_for_a_person_unless_models_are_trusted(
    service: Service, compbench_root: Path, tmp_path: Path
) -> None:
    llm = {"llm_base": service.base, "llm_model": "tiny", "llm_cache": str(tmp_path / "cache")}
    source = ("mllm-compbench", compbench_root)
    waiting = convert(*source, tmp_path / "waiting", categories=["attribute"], **llm)
    assert "calmer sky" not in {item.object_phrase for item in waiting.items}
    trusted = convert(*source, tmp_path / "trusted", categories=["attribute"], trust_llm=True, **llm)
    (item,) = [item for item in trusted.items if item.object_phrase == "calmer sky"]
    assert (item.rule_id, item.curation_status) == ("llm", "llm-trusted")
    assert trusted.card["curation"] == ["llm-trusted", "rules-only"]
    assert len(service.requests) == 1, "the second run is answered by the cache"
    assert service.requests[0]["path"] == "/v1/chat/completions"
    assert service.requests[0]["temperature"] == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "reply",
    ["no object", {**GOOD, "keep": False}, {**GOOD, "instruction": "Take the calmer sky"}, {**GOOD, "object": ""}],
)
def test_an_unusable_reply_leaves_the_question_unworded(
    service: Service, compbench_root: Path, tmp_path: Path, reply: object
) -> None:
    service.reply = reply
    llm = {"llm_base": service.base, "llm_model": "tiny", "llm_cache": str(tmp_path / "cache"), "trust_llm": True}
    suite = convert("mllm-compbench", compbench_root, tmp_path / "suite", categories=["attribute"], **llm)
    assert {item.rule_id for item in suite.items} == {"R2"}


def test_a_service_that_does_not_answer_is_an_error(compbench_root: Path, tmp_path: Path) -> None:
    llm = {"llm_base": "http://127.0.0.1:9", "llm_model": "tiny", "llm_cache": str(tmp_path / "cache")}
    with pytest.raises(SuiteError, match="gave no usable reply"):
        convert("mllm-compbench", compbench_root, tmp_path / "suite", categories=["attribute"], **llm)
    assert not (tmp_path / "suite").exists()


def test_half_of_the_settings_are_refused(compbench_root: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="llm_base needs llm_model and llm_cache"):
        convert("mllm-compbench", compbench_root, tmp_path / "suite", llm_base="http://127.0.0.1:9")
