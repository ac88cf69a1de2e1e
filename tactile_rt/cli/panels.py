"""The help of the program: commands in panels, an example of each, a welcome screen."""

from typing import Any

from typer.core import TyperGroup

# The panels of the program and of a group, with their commands, the most common first.
PANELS = {
    "tactile-rt": {
        "Try": "demo teach new make",
        "Devices": "list doctor sniff echo hz tare calibrate codecs describe dump array emulate",
        "Record": "record replay convert import label recover",
        "On the robot": "run top config model install-service",
        "Simulate": "view sweep whisk objects hil",
        "Train": "train export eval recipes probe grid bench",
        "Brain": "align",
    },
    "align": {
        "Recordings": "datasets fetch build example",
        "Models": "score board decode report gate",
    },
}
WELCOME = """\
tactile_rt: real-time touch for whisker arrays, tactile skins and force sensors

  tactile-rt demo             watch a model recognise objects; needs no sensor
  tactile-rt list             find the connected sensors and how to read them
  tactile-rt align datasets   find brain recordings to compare models with
                              (the comparison needs the extras align and train)

All commands: tactile-rt --help. One command: tactile-rt COMMAND --help."""
WHOLE = 1000  # characters: no sentence is cut


class PanelGroup(TyperGroup):
    """Command group whose help shows the commands in panels, also in plain text.

    The epilog of a command is an example of one shell line.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        panels = PANELS.get(self.name or "", {})
        place = {name: panel for panel, names in panels.items() for name in names.split()}
        order = [*place, *self.commands]
        self.commands = dict(sorted(self.commands.items(), key=lambda one: order.index(one[0])))
        command: Any
        for name, command in self.commands.items():
            command.rich_help_panel = place.get(name, "Commands")
            if command.epilog:
                start = "Example: " if self.rich_markup_mode else "\b\nExample:\n  "  # not wrapped
                command.epilog = start + command.epilog

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a help section per panel, with the whole first sentence of each command."""
        panels: dict[str, list[tuple[str, str]]] = {}
        wide = max(map(len, self.commands))
        command: Any
        for name, command in self.commands.items():
            row = name.ljust(wide), command.get_short_help_str(WHOLE)
            panels.setdefault(command.rich_help_panel, []).append(row)
        for panel, rows in panels.items():
            with formatter.section(panel):
                formatter.write_dl(rows)
