"""Names and docstrings use the field's words.

A name says what it holds, in the package as in tests, scripts and benchmarks. A docstring of the package begins
with a verb or a noun.
"""

import ast
import re
from collections.abc import Iterator

import pytest

from tests.support.parsed import PACKAGE, nodes, package_trees, parsed

FILLERS = frozenset(
    [
        "found",
        "one",
        "own",
        "place",
        "seen",
        "said",
        "shown",
        "given",
        "there",
        "here",
        "beside",
        "whole",
        "rest",
        "kept",
        "asked",
        "known",
        "wanted",
        "named",
        "told",
        "chosen",
        "meant",
        "taken",
        "made",
        "further",
        "others",
        "another",
        "something",
        "thing",
        "things",
        "it",
        "them",
        "these",
        "those",
        "such",
    ]
)
"""Words that do not describe the value; `episode`, `row`, `site`, `scores` do."""
PRONOUNS = re.compile(
    r"(what|whose|which|as|of|by|with|who|where|how|that|those|these|it|this|so|if|when|from|to|in|for|whether)\b",
    re.IGNORECASE,
)
ROOT = PACKAGE.parent
FOLDERS = ("tests", "scripts", "benchmarks")
FENCE = ROOT / "tests" / "acceptance"
TEXTS = re.compile(r'''""".*?"""|"[^"\n]*"|'[^'\n]*'|#[^\n]*''', re.DOTALL)
WORD = re.compile(rf"\b_*({'|'.join(sorted(FILLERS))})\b")
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def fillers(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Lines and names of assigned variables, parameters, fields and definitions that are fillers."""
    for node in nodes(tree):
        match node:
            case ast.Name(id=name, ctx=ast.Store()) | ast.arg(arg=name) | ast.ExceptHandler(name=str(name)):
                pass
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                pass
            case _:
                continue
        if name.lstrip("_") in FILLERS:
            yield node.lineno, name


def first_words(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Lines and first lines of docstrings that begin with a pronoun, a preposition or a shape.

    The docstring of a function that returns a Boolean may begin with "Whether".
    """
    for node in nodes(tree):
        if not isinstance(node, (ast.Module, ast.ClassDef, *FUNCTIONS)):
            continue
        docstring = (ast.get_docstring(node) or "").strip()
        word = PRONOUNS.match(docstring)
        if docstring.startswith(("(", "[")):
            yield getattr(node, "lineno", 1), docstring.splitlines()[0]
        boolean = isinstance(node, FUNCTIONS) and node.returns is not None and ast.unparse(node.returns) == "bool"
        if word and not (boolean and word.group().lower() == "whether"):
            yield getattr(node, "lineno", 1), docstring.splitlines()[0]


def parameters_in_prose(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Lines and names of parameters and fields that a docstring explains outside of `Args:` or `Attributes:`."""
    for node in nodes(tree):
        if isinstance(node, FUNCTIONS):
            arguments = node.args
            every = [
                *arguments.posonlyargs,
                *arguments.args,
                *arguments.kwonlyargs,
                arguments.vararg,
                arguments.kwarg,
            ]
            names = [argument.arg for argument in every if argument is not None]
        elif isinstance(node, ast.ClassDef):
            names = [
                line.target.id
                for line in node.body
                if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name)
            ]
        else:
            continue
        prose = re.split(r"^(?:Args|Attributes):$", ast.get_docstring(node) or "", maxsplit=1, flags=re.MULTILINE)[
            0
        ]
        for name in names:
            if re.search(rf"(?:^|[.;,] |\band )`?{re.escape(name)}`?: ", prose, re.MULTILINE):
                yield node.lineno, name


IRREGULAR = frozenset(
    [
        "begun",
        "built",
        "chosen",
        "drawn",
        "found",
        "given",
        "grown",
        "held",
        "kept",
        "known",
        "led",
        "lost",
        "made",
        "meant",
        "met",
        "said",
        "seen",
        "sent",
        "shown",
        "sought",
        "taken",
        "told",
        "worn",
        "written",
    ]
)
NOUNS_IN_ED = frozenset({"bed", "embed", "feed", "field", "head", "need", "seed", "speed"})
EXCEPTED = (PACKAGE / "models", PACKAGE / "hooks" / "families")
"""Folders that follow the words of the authors' own code."""


def unclear_functions(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Lines and names of functions that are no verb phrase and name no value: `joined`, `_of_row`.

    Not of properties, class methods and exported functions. A public method may be a participle that returns a
    changed copy of its object, such as `Settings.changed`.
    """

    def visit(parent: ast.AST, in_class: bool) -> Iterator[tuple[int, str]]:
        for node in ast.iter_child_nodes(parent):
            if isinstance(node, FUNCTIONS) and node.name not in PUBLIC_FUNCTIONS:
                decorators = " ".join(ast.unparse(decorator) for decorator in node.decorator_list)
                is_private, word = node.name.startswith("_"), node.name.strip("_")
                is_attribute = "property" in decorators or "classmethod" in decorators
                is_participle = word in IRREGULAR or (
                    re.fullmatch(r"[a-z]{3,}ed", word) and word not in NOUNS_IN_ED
                )
                begins_with_of = not in_class and word.split("_")[0] == "of"
                if not is_attribute and (begins_with_of or (is_participle and (is_private or not in_class))):
                    yield node.lineno, node.name
            yield from visit(node, isinstance(node, ast.ClassDef))

    yield from visit(tree, False)


PUBLIC_FUNCTIONS = frozenset({"scored"})
"""Functions that users import from a package, whose names change with a line of the changelog."""


def test_functions_of_the_package_are_verb_phrases_or_nouns() -> None:
    wrong = [
        f"{file.relative_to(PACKAGE.parent)}:{line}: {name}"
        for file, tree in package_trees().items()
        if not any(file.is_relative_to(folder) for folder in EXCEPTED)
        for line, name in unclear_functions(tree)
    ]
    assert not wrong, "a function is a verb phrase or the noun that it returns\n" + "\n".join(wrong)


@pytest.mark.parametrize(
    ("text", "is_unclear"),
    [
        ("def _joined(): ...", True),
        ("def of_row(): ...", True),
        ("def f():\n    def checked(): ...", True),
        ("class C:\n    def _drawn(self): ...", True),
        ("class C:\n    def changed(self): ...", False),
        ("class C:\n    @property\n    def _stored(self): ...", False),
        ("class C:\n    @classmethod\n    def of_run(cls): ...", False),
        ("def sorted_rows(): ...", False),
        ("def seed(): ...", False),
    ],
)
def test_a_bare_participle_is_found_wherever_a_function_is_defined(text: str, is_unclear: bool) -> None:
    assert bool(list(unclear_functions(ast.parse(text)))) == is_unclear


VAGUE_TESTS = re.compile(r"test_what_(is|was|cannot_be|does_not|it|its|no|nobody|never|means|names|needs|only)_")


def test_names_of_tests_have_a_subject() -> None:
    vague = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in sorted((ROOT / "tests").rglob("test_*.py"))
        if not any(path.is_relative_to(ROOT / "tests" / folder) for folder in NOT_RENAMED)
        for name in re.findall(r"^ *def (test_\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)
        if VAGUE_TESTS.match(name)
    ]
    assert not vague, "say what is refused, stored or shown\n" + "\n".join(vague)


NOT_RENAMED = ("acceptance", "models", "hooks/families")


RULES = {
    "parameters": "a docstring explains parameters under `Args:` and fields under `Attributes:`",
    "names": "a name says what it holds; these are fillers",
    "docstrings": "a docstring begins with a verb or a noun; these begin with a pronoun, a preposition or a shape",
}
CHECKS = {"parameters": parameters_in_prose, "names": fillers, "docstrings": first_words}


@pytest.mark.parametrize("check", CHECKS)
def test_the_package_is_written_in_the_words_of_the_field(check: str) -> None:
    wrong = [
        f"{file.relative_to(PACKAGE.parent)}:{line}: {text}"
        for file, tree in package_trees().items()
        for line, text in CHECKS[check](tree)
    ]
    assert not wrong, f"{RULES[check]}\n" + "\n".join(wrong)


def test_names_of_tests_scripts_and_benchmarks_say_what_they_hold() -> None:
    # The fence stays as it is. Only a file with such a word outside of texts and comments is taken apart.
    paths = {path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")} - set(FENCE.rglob("*.py"))
    suspects = [path for path in sorted(paths) if WORD.search(TEXTS.sub("", path.read_text(encoding="utf-8")))]
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {name}" for path in suspects for line, name in fillers(parsed(path))
    ]
    assert not wrong, f"{RULES['names']}\n" + "\n".join(wrong)


@pytest.mark.parametrize("line", ["found = 1  # one", "f('one', kept := 2)", 'def f(own):\n    """That one."""'])
def test_a_filler_outside_of_texts_and_comments_is_looked_at(line: str) -> None:
    assert WORD.search(TEXTS.sub("", line))
    assert not WORD.search(TEXTS.sub("", '"""One\nfound."""  # one\nsite = "own" + \'kept\''))


@pytest.mark.parametrize(
    "line",
    [
        "found = 1",
        "def f(*, own): ...",
        "for one in x: ...",
        "[seen for seen in x]",
        "class C:\n    kept: int",
        "def _rest(): ...",
        "try: ...\nexcept E as said: ...",
    ],
)
def test_a_filler_is_found_wherever_a_name_is_given(line: str) -> None:
    assert list(fillers(ast.parse(line)))


@pytest.mark.parametrize(
    ("first", "allowed"),
    [
        ("What it is.", False),
        ("Of a run.", False),
        ("The run.", True),
        ("Return it.", True),
        ("(N, D) rows.", False),
    ],
)
def test_a_docstring_begins_with_a_verb_or_a_noun(first: str, allowed: bool) -> None:
    assert list(first_words(ast.parse(f"def f():\n    '{first}'"))) == ([] if allowed else [(1, first)])


def test_whether_is_for_booleans_alone() -> None:
    assert not list(first_words(ast.parse("def f() -> bool:\n    'Whether it is.'")))
    assert list(first_words(ast.parse("def f() -> int:\n    'Whether it is.'")))


@pytest.mark.parametrize(
    "prose", ["Return it.\n\nvalues: (N,).", "Add; values: (N,).", "Add.\n\nunit: m, values: (N,)."]
)
def test_a_parameter_is_found_in_prose(prose: str) -> None:
    function = f'def f(unit, values):\n    """{prose}"""'
    assert (1, "values") in list(parameters_in_prose(ast.parse(function)))


def test_a_parameter_stands_under_args() -> None:
    function = 'def f(values):\n    """Return it.\n\n    Args:\n        values: (N,).\n    """'
    assert not list(parameters_in_prose(ast.parse(function)))


HOMONYMS = frozenset(
    {"Attention", "Block", "Layer", "PictureSettings", "Projector", "VisionConfig", "Cell", "Choice"}
)
"""Names of several classes: parts that networks call so, the cells of a table and of a patch, and two choices."""
SHARED_TYPES = frozenset({"Matrix", "PictureArray", "Progress"})


def test_a_word_is_the_name_of_one_class() -> None:
    homes: dict[str, list[str]] = {}
    for file, tree in package_trees().items():
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes.setdefault(node.name, []).append(str(file.relative_to(PACKAGE)))
    twice = {name: files for name, files in homes.items() if len(files) > 1}
    assert twice.keys() <= HOMONYMS, twice
    assert twice.keys() >= HOMONYMS, f"rename them here too: {sorted(HOMONYMS - twice.keys())}"
    assert len(HOMONYMS) <= 10


def test_types_that_many_files_share_are_declared_in_one() -> None:
    homes = [
        (name.id, str(file.relative_to(PACKAGE)))
        for file, tree in package_trees().items()
        for node in tree.body
        if isinstance(node, ast.Assign)
        for name in node.targets
        if isinstance(name, ast.Name) and name.id in SHARED_TYPES
    ]
    assert sorted(homes) == [(name, "_system/types.py") for name in sorted(SHARED_TYPES)]
