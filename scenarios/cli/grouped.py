"""The list of commands in ``mosca --help``, grouped by purpose as in the README."""

import click

SECTIONS: dict[str, tuple[str, ...]] = {
    "Scenarios": ("run", "list", "new", "demo", "suite", "sweep", "report", "view"),
    "Claims": ("claim", "budget", "plan", "accept", "certificate", "benchmark"),
    "Calibration": ("target", "calibrate", "rig", "clinic"),
    "Trajectories": ("reconstruct", "live", "labels", "bodies", "edit", "zones", "tracks"),
    "People and machines": ("skeleton", "motion", "identify", "vibration", "self-orient", "flight"),
    "Lab": ("capture", "station", "twin", "replay"),
    "Files": ("schema",),
}

LONGEST = 120
"""Most characters of a command's description; its first sentence fits."""


class GroupedCommands(click.Group):
    """A group of commands whose help lists them by section; one without a section comes last."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command; for an unknown one the error names the group that has it."""
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            groups = [name for name, one in self.commands.items() if args[0] in getattr(one, "commands", ())]
            if not groups:
                raise
            text = f"{error.message} Did you mean '{groups[0]} {args[0]}'?"
            raise click.UsageError(text, ctx) from None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write a list of commands for each section."""
        listed = {name for names in SECTIONS.values() for name in names}
        others = tuple(name for name in self.list_commands(ctx) if name not in listed)
        width = max(map(len, self.commands), default=0)
        for title, names in {**SECTIONS, "More": others}.items():
            rows = []
            for name in names:
                command = self.get_command(ctx, name)
                if command is not None:
                    rows.append((name.ljust(width), command.get_short_help_str(LONGEST)))
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)
