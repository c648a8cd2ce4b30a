"""Pages of the command line, made from its commands: one page for each section of ``mosca --help``."""

import click
from markdown_text import plain, plain_cell

from scenarios.cli.grouped import SECTIONS
from scenarios.cli.main import cli


def pages() -> dict[str, str]:
    """Return the pages (uri -> Markdown); ValueError where a command is on none of them."""
    made = {}
    for title, names in SECTIONS.items():
        text = [f"# Commands: {title.lower()}\n", "The same is shown by `mosca VERB --help`.\n"]
        for verb in names:
            text += _section(cli.commands[verb], click.Context(cli, info_name="mosca"), verb, 2)
        made[f"reference/{_page(title)}"] = "\n".join(text)
    if missing := set(cli.commands) - {name for names in SECTIONS.values() for name in names}:
        raise ValueError(f"scenarios/cli/grouped.py: no section has {', '.join(sorted(missing))}")
    return made


def index() -> str:
    """Return a table of all commands, in the order of the sections, each with its first sentence."""
    rows = ["| command | what it does |", "|---|---|"]
    for title, names in SECTIONS.items():
        rows.append(f"| **{title}** | |")
        for verb in names:
            words = cli.commands[verb].get_short_help_str(200)
            rows.append(f"| [`mosca {verb}`]({_page(title)}#mosca-{verb}) | {words} |")
    return "\n".join(rows)


def _page(title: str) -> str:
    return f"commands/{title.lower().replace(' ', '_')}.md"


def _section(command: click.Command, parent: click.Context, name: str, level: int) -> list[str]:
    """Return heading, words, usage, example and options of a command, then of those below it."""
    context = click.Context(command, info_name=name, parent=parent)
    words, _, example = (command.help or "").replace("\b", "").partition("Example:")
    usage = " ".join([context.command_path, *command.collect_usage_pieces(context)])
    lines = [f"{'#' * level} {context.command_path}\n", f"{_words(words)}\n", f"```text\n{usage}\n```\n"]
    if example:
        shown, _, more = example.partition("\n\n")
        typed = "\n".join(
            line.strip() if line.strip().startswith("mosca ") else f"    {line.strip()}" for line in shown.split("\n")
        )
        lines += [f"Example:\n\n```sh\n{typed.strip()}\n```\n", f"{_words(more)}\n"]
    options = [param for param in command.params if isinstance(param, click.Option)]
    if options:
        lines += ["| option | value | meaning |", "|---|---|---|", *(_row(option, context) for option in options), ""]
    for below, one in getattr(command, "commands", {}).items():
        lines += _section(one, context, below, level + 1)
    return lines


def _row(option: click.Option, context: click.Context) -> str:
    """Return an option's row; what its help shows of default, range and repetition is in the last cell."""
    names = ", ".join(f"`{name}`" for name in (*option.opts, *option.secondary_opts))
    value = "" if option.is_flag or option.count else f"`{option.make_metavar(context)}`"
    record = option.get_help_record(context)
    assert record is not None, option.name
    return f"| {names} | {value} | {plain_cell(record[1])} |"


def _words(text: str) -> str:
    """Return a help's paragraphs as Markdown that shows them as they are."""
    return "\n\n".join(plain(one) for one in text.split("\n\n") if one.strip())
