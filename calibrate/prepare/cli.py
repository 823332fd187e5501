"""`brushloop calibrate SESSION` as ever, and `brushloop calibrate preprocess ...` beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from calibrate.cli import calibrate

SESSION = "session"


class SessionOrCommand(TyperGroup):
    """A group whose first argument may be a session's path: whatever is no command's name is one."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the command's name before a path; `./preprocess` names a session of that name."""
        if not args or (args[0] not in self.commands and not args[0].startswith("-")):
            args = [SESSION, *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=SessionOrCommand,
    help="Fit scale and paper plane of a SESSION (`brushloop calibrate SESSION`), or look at what comes before.",
)
app.command(SESSION)(calibrate)


@app.command()
def preprocess(
    capture: Annotated[Path, typer.Argument(help="A session (folder or .mcap), or a photograph.")],
    stroke: Annotated[str, typer.Option(help="Stroke of the session, the first by default.")] = "",
    px_per_mm: Annotated[float | None, typer.Option(help="Scale of a photograph.")] = None,
    before: Annotated[Path | None, typer.Option(help="Photograph of the page before the stroke came.")] = None,
    out: Annotated[Path, typer.Option(help="The picture; the numbers go beside it as .json.")] = Path("stages.png"),
) -> None:
    """Show every stage of one capture as one picture, and write down each number that was fitted on the way."""
    from calibrate.prepare.show import show_photograph, show_stroke

    if capture.suffix.lower() in (".png", ".jpg", ".jpeg"):
        trace = show_photograph(capture, px_per_mm, before, out)
    else:
        trace = show_stroke(capture, stroke, out)
    for name, value in trace.log.items():
        typer.echo(f"{name} {value:.6g}")
    for flag in trace.flags:
        typer.echo(f"flag: {flag}")
    typer.echo(str(out))
