"""Imitations of the five sources: their layouts and faults, with pictures and sentences of our own."""

import base64
import csv
import json
import struct
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageDraw


def picture(seed: int, size: tuple[int, int] = (160, 140)) -> Image.Image:
    """A picture unlike any of another seed."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (6, 6, 3), dtype=np.uint8)
    return Image.fromarray(coarse).resize(size, Image.Resampling.BICUBIC)


def art(seed: int) -> Image.Image:
    """Line art on a transparent ground, away from its middle."""
    rng = np.random.default_rng(seed)
    image = Image.new("RGBA", (200, 150), (0, 0, 0, 0))
    corners = [(float(x), float(y)) for x, y in rng.uniform((20, 10), (120, 140), (7, 2))]
    ImageDraw.Draw(image).polygon(corners, fill=(*rng.integers(0, 200, 3).tolist(), 255))
    return image


def save(image: Image.Image, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image.save(path)


def write_json(value: Any, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value), encoding="utf-8")


@pytest.fixture
def compbench_root(tmp_path: Path) -> Path:
    """Two sets: FER with twelve pairs, and MIT-States with both types, an empty dict and a backslash."""
    return write_compbench(tmp_path / "compbench")


def write_compbench(root: Path) -> Path:
    """The two sets of `compbench_root` in the folder `root`."""
    fer = []
    for number in range(12):
        names = [f"fer-2013/test/happy/im{number}_{side}.png" for side in "ab"]
        for offset, name in enumerate(names):
            save(picture(2 * number + offset, (48, 48)), root / name)
        question = "Based on these images, which person is more smiling?"
        answer = "Left" if number % 3 else "Right"
        fer.append({"image_1": names[0], "image_2": names[1], "question": question, "answer": answer})
    write_json(fer, root / "Labeled_data" / "fer2013_label" / "fer2013_0_720_rebalanced.json")
    states: list[dict[str, str]] = []
    for number in range(10):
        names = [f"street/wet_{number}_{side}.jpg" for side in "ab"]
        for offset, name in enumerate(names):
            save(picture(100 + 2 * number + offset), root / "transformed_states" / name)
        kind, question = ("State", "Which street is wetter?") if number % 2 else ("Color", "Which sky is darker?")
        states.append(
            {"image_1": names[0], "image_2": names[1], "question": question, "answer": "Left", "type": kind}
        )
    states[3]["image_1"] = states[3]["image_1"].replace("/", "\\")
    states[4]["question"] = "Do you like these?"
    states.insert(5, {})
    write_json(states[:6], root / "Labeled_data" / "st_label" / "State_Transform_merged0_0_1000_test.json")
    write_json(states[6:], root / "Labeled_data" / "st_label" / "State_Transform_merged0_0_1000_val.json")
    return root


def iconqa_problems() -> dict[str, tuple[dict[str, Any], list[str]]]:
    """Problems by pid with their skills; 3 depends on its stem, 4 does so only in words."""
    choose = {"ques_type": "choose_img", "choices": ["choice_0.png", "choice_1.png"], "answer": 1}
    count = {"ques_type": "fill_in_blank"}
    return {
        "1": ({"question": "Which shape is a triangle?", "label": "S1", **choose}, ["geometry"]),
        "2": ({"question": "Which clock shows half past four?", "label": "S2", **choose}, ["time"]),
        "3": ({"question": "Which shape has the same number of sides as this triangle?", **choose}, ["geometry"]),
        "4": ({"question": "Which of these shapes is a square?", **choose}, ["geometry"]),
        "5": ({"question": "Which shape has a line of symmetry?", **choose}, ["geometry"]),
        "6": ({"question": "How many cars are there?", "answer": "5", **count}, ["counting"]),
        "7": ({"question": "How many cars are there?", "answer": "3", **count}, ["counting"]),
        "8": (
            {
                "question": "How many cars are there?",
                "ques_type": "choose_txt",
                "choices": ["1", "12"],
                "answer": 0,
            },
            ["counting"],
        ),
        "9": ({"question": "How many cars are there?", "answer": "2", **count}, ["counting"]),
        "10": ({"question": "Which picture has six birds?", **choose}, ["counting"]),
    }


@pytest.fixture(params=["new", "old"])
def iconqa_root(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """Ten problems, in the newer tree and in the older one without the inner folder."""
    base = tmp_path / "iconqa_data"
    splits: dict[str, list[str]] = {"minichoose_img_train": ["1"], "choose_img_trainval": ["1"]}
    for pid, (problem, _) in iconqa_problems().items():
        kind = problem["ques_type"]
        splits.setdefault(f"{kind}_train", []).append(pid)
        inner = base / "iconqa" if request.param == "new" else base
        folder = inner / "train" / kind / pid
        for number in range(2):
            save(art(10 * int(pid) + number), folder / f"choice_{number}.png")
        save(Image.new("RGB", (90, 90), "white") if pid == "4" else art(10 * int(pid) + 7), folder / "image.png")
    write_json({pid: problem for pid, (problem, _) in iconqa_problems().items()}, base / "problems.json")
    write_json({pid: skills for pid, (_, skills) in iconqa_problems().items()}, base / "pid2skills.json")
    write_json(splits, base / "pid_splits.json")
    return tmp_path


def encoded(image: Image.Image) -> str:
    buffer = BytesIO()
    image.save(buffer, format="JPEG")
    return base64.b64encode(buffer.getvalue()).decode()


@pytest.fixture
def mmbench_root(tmp_path: Path) -> Path:
    """Invented people: seven identity rows, one by reference, a circular copy, and a question about age."""
    columns = ["index", "question", "hint", "A", "B", "C", "D", "answer", "category", "image", "L2-category"]
    rows: list[list[str]] = []
    for number, name in enumerate(["Ada Example", "Bo Sample", "Cy Model", "Di Test", "Ed Case", "Flo Mock"]):
        question = "Who is\nthis person?" if number else "Who is this person?"
        options = [name, "Nobody Known", "", ""]
        rows.append(
            [str(number), question, "", *options, "A", "celebrity_recognition", encoded(picture(number)), "x"]
        )
    rows.append(["6", "Who is this person?", "", "x", "Gus Twin", "", "", "B", "celebrity_recognition", "0", "x"])
    rows.append(["7", "How old is he?", "", "ten", "two", "", "", "A", "celebrity_recognition", "1", "x"])
    circular = [*rows[1]]
    circular[0], circular[9] = "1000001", "1"
    rows.append(circular)
    rows.append(["9", "What is shown?", "", "cat", "dog", "", "", "A", "object_localization", "0", "x"])
    path = tmp_path / "MMBench_DEV_EN.tsv"
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, delimiter="\t").writerows([columns, *rows])
    return tmp_path


@pytest.fixture
def okvqa_root(tmp_path: Path) -> Path:
    """Eight pictures of animals and plants, one answer without agreement, one question about food."""
    names = ["horse", "cow", "sheep", "zebra", "roses", "tulip", "horse", "bear"]
    questions, annotations = [], []
    for number, noun in enumerate(names):
        save(picture(200 + number), tmp_path / "train2014" / f"COCO_train2014_{number:012d}.jpg")
        text = "What type of flower is this?" if number in (4, 5) else "What animal is in the picture?"
        answers = [noun] * 8 + ["thing"] * 2
        if number == 6:
            text = "What does this animal eat?"
        if number == 7:
            answers = [noun] * 4 + ["dog"] * 4 + ["cat"] * 2
        questions.append({"image_id": number, "question_id": 10 * number, "question": text})
        annotations.append(
            {
                "image_id": number,
                "question_id": 10 * number,
                "question_type": "eight",
                "answer_type": "other",
                "answers": [{"answer_id": i, "answer": a[:3], "raw_answer": a} for i, a in enumerate(answers)],
            }
        )
    annotations.append(annotations[0] | {"question_type": "one", "question_id": 999})
    write_json({"questions": questions}, tmp_path / "OpenEnded_mscoco_train2014_questions.json")
    write_json({"annotations": annotations}, tmp_path / "mscoco_train2014_annotations.json")
    return tmp_path


@pytest.fixture
def coco_instances(okvqa_root: Path) -> Path:
    """Boxes for the look-alike: the cow's picture also holds a horse, and the zebra is tiny."""
    names = ["horse", "cow", "sheep", "zebra", "bear"]
    boxes = [(0, 1, 60), (1, 2, 60), (1, 1, 60), (2, 3, 60), (3, 4, 5)]
    value = {
        "categories": [{"id": i + 1, "name": name} for i, name in enumerate(names)],
        "images": [{"id": i, "width": 160, "height": 140} for i in range(8)],
        "annotations": [
            {"image_id": image, "category_id": category, "bbox": [0, 0, side, side]}
            for image, category, side in boxes
        ],
    }
    write_json(value, okvqa_root / "instances" / "instances_train2014.json")
    return okvqa_root / "instances"


def glb(texture: Image.Image) -> bytes:
    """A binary glTF that holds nothing but one picture."""
    buffer = BytesIO()
    texture.save(buffer, format="PNG")
    content = buffer.getvalue() + b"\0" * (-len(buffer.getvalue()) % 4)
    scene = {"images": [{"bufferView": 0}], "bufferViews": [{"buffer": 0, "byteLength": len(buffer.getvalue())}]}
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    chunks = (
        struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(content), 0x004E4942) + content
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


@pytest.fixture
def vlthink_root(tmp_path: Path) -> Path:
    """Five traffic signs, whose art is stored transposed, in the repository's layout."""
    folder = tmp_path / "ManiSkill/mani_skill/assets/carrot/more_traffic"
    labels = ["stop give way", "no entry", "no left turn", "danger", "loose chippings"]
    records = {}
    for number, label in enumerate(labels):
        upright = Image.new("RGB", (240, 240), "white")
        draw = ImageDraw.Draw(upright)
        draw.rectangle((40, 40 + 16 * number, 200, 80 + 16 * number), fill="black")  # a bar on top ...
        draw.rectangle((40, 40, 68, 220 - 6 * number), fill=(200, 0, 0))  # ... of a red post at the left
        key = f"{number:03d}_{label.replace(' ', '')}"
        path = folder / "shapes" / key / "textured.glb"
        path.parent.mkdir(parents=True)
        path.write_bytes(glb(upright.transpose(Image.Transpose.TRANSPOSE)))
        records[key] = {"name": f"{label} sign", "sign": label}
    write_json(records, folder / "model_db.json")
    return tmp_path
