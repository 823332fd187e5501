"""Command groups whose first command needs no name: `brushloop validate SESSION` means `validate sessions SESSION`."""

from __future__ import annotations

from typing import Any

from typer.core import TyperGroup


class PathOrCommand(TyperGroup):
    """A group that runs its first command unless its first argument is the name of another one.

    `./diff` is then a path, `diff` the command of that name.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the first command's name before anything that is not a command's name."""
        if not args or (args[0] not in self.commands and args[0] != "--help"):
            args = [next(iter(self.commands)), *args]
        return super().parse_args(ctx, args)
