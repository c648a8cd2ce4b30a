"""Every command that a page names exists, with its options: each is parsed as the command line would, and not run."""

import re

import click
import pytest
from doc_pages import DOCS, PAGES, ROOT, commands, in_blocks, in_spans

from mosca.errors import InputError
from scenarios.cli.main import cli
from scenarios.cli.options import ScenarioName
from scenarios.spec.catalog import find
from scenarios.spec.scenario import load_scenario

TYPED = (click.Choice, click.IntRange, click.FloatRange)


def complaint(words, whole=True):
    """Return what is wrong with a command line, "" where nothing is; ``whole``: nothing needed may be left out."""
    command, path = cli, click.Context(cli, info_name="mosca")
    try:
        while isinstance(command, click.Group):
            _, words, _ = command.make_parser(path).parse_args(list(words))
            if not words or (words[0].isupper() and not whole):
                return "a command is missing" if whole else ""
            if words[0] not in command.commands:
                return f"no command '{words[0]}'"
            command, words = command.commands[words[0]], words[1:]
            path = click.Context(command, parent=path, info_name=command.name)
        if not whole:
            known = {name for param in command.params for name in (*param.opts, *param.secondary_opts)}
            given = [word.split("=")[0] for word in words if word.startswith("-")]
            return ", ".join(f"no option '{word}'" for word in given if word not in {*known, "--help", "-h"})
        given, left, _ = command.make_parser(path).parse_args(list(words))
        if left:
            return f"'{left[0]}' is one word too many"
        for param in command.params:
            if problem := value_problem(param, given.get(param.name), path):
                return problem
        return scenario_problem(command, given)
    except click.ClickException as error:
        return error.format_message()


def value_problem(param, value, context):
    """Return what is wrong with an argument's or option's value; paths are not looked at."""
    if value is None or value == () or isinstance(value, bool):
        return f"'{param.name}' is missing" if param.required and not value else ""
    for one in value if isinstance(value, (list, tuple)) else (value,):
        if isinstance(param.type, TYPED) and isinstance(one, str) and not one.startswith("$"):
            param.type.convert(one, param, context)
    return ""


def scenario_problem(command, given):
    """Return what is wrong with the name of a built-in scenario and the keys that are changed in it."""
    for param in command.params:
        name = given.get(param.name)
        if isinstance(param.type, ScenarioName) and name and "." not in name and not name.isupper():
            changed = given.get("overrides") or ()
            try:
                load_scenario(find(name), tuple(one for one in changed if one != "KEY=VALUE"))
            except InputError as error:
                return str(error)
    return ""


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_commands_of_the_pages_exist(path):
    text = path.read_text(encoding="utf-8")
    wrong = {f"mosca {' '.join(words)}": complaint(words) for words in in_blocks(text)}
    wrong |= {f"mosca {' '.join(words)}": complaint(words, whole=False) for words in in_spans(text)}
    assert {line: what for line, what in wrong.items() if what} == {}


def helps(command, path=()):
    """Yield the path and the help of a command and of all below it."""
    yield path, command.help or ""
    for name, below in getattr(command, "commands", {}).items():
        yield from helps(below, (*path, name))


@pytest.mark.parametrize(
    ("path", "text"), list(helps(cli)), ids=lambda one: "_".join(one) if type(one) is tuple else ""
)
def test_examples_of_the_helps_exist(path, text):
    # an example ends with its paragraph; a line that begins with another word goes on with the one before
    examples = [re.sub(r"\n\s*(?!\s*mosca )", " ", one.split("\n\n")[0]) for one in text.split("Example:")[1:]]
    lines = [words for one in examples for words in commands(one)]
    assert {" ".join(words): what for words in lines if (what := complaint(words))} == {}
    assert len(lines) >= len(examples)


def test_pages_are_found():
    """The pages that a reader meets first have commands, or the tests above would say nothing."""
    assert len(in_blocks((DOCS / "first_lab.md").read_text())) == 9
    assert ["run", "flight/hover"] in in_blocks((DOCS / "flight.md").read_text())
    assert ["list"] in in_spans((ROOT / "README.md").read_text())


@pytest.mark.parametrize(
    ("line", "what"),
    [
        ("mosca runn actor", "no command 'runn'"),
        ("mosca run actor --sed 3", "No such option"),
        ("mosca run actor --seed", "requires an argument"),
        ("mosca run actr", "no such scenario"),
        ("mosca run actor drone", "one word too many"),
        ("mosca run actor --set cameras.cuont=3", "cuont"),
        ("mosca new lab.toml --subject horse", "is not one of"),
        ("mosca calibrate lab/field --out rig.toml", "missing"),
        ("mosca rig chekc rig.toml", "no command 'chekc'"),
        ("mosca rig", "a command is missing"),
        ("for n in 3 4; do mosca run actor --sed $n; done", "No such option"),
        ("mosca run actor > log.txt && mosca view --wbe RUN", "No such option"),
    ],
)
def test_a_slip_is_found(line, what):
    assert any(what in complaint(words) for words in commands(line))


def test_a_slip_between_words_is_found():
    (words,) = in_spans("Then `mosca run SCENARIO --sorce twin` runs it, and `mosca` alone says nothing.")
    assert complaint(words, whole=False) == "no option '--sorce'"
