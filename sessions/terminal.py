"""The one way to a terminal: whatever a file, a folder's name or a device says is printed, and never obeyed."""

from __future__ import annotations

import re

import typer

_ACTED_ON = re.compile(
    # Controls of ASCII and of Latin-1 (an escape sequence begins with one), without the tab.
    "[\x00-\x08\x0a-\x1f\x7f-\x9f"
    # What turns the direction of writing, breaks lines or takes no room; halves of characters, from undecodable names.
    "\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ud800-\udfff\U000e0000-\U000e007f]"
)


def plain(text: str, *, keep: str = "") -> str:
    r"""The text with every character that a terminal acts on written out, as `\u001b`: a JSON string keeps its value.

    Line ends are written out as well: a name may not pretend to be the next line. `keep` names what stays as it is.
    """
    if text.isprintable():
        return text
    return _ACTED_ON.sub(lambda found: found[0] if found[0] in keep else _written_out(found[0]), text)


def inert(text: str) -> str:
    """The text without those characters, for a place whose width is laid out already: they take none."""
    return text if text.isprintable() else _ACTED_ON.sub("", text)


def say(*parts: object, err: bool = False) -> None:
    """Print each part: a string as one line, anything else (a table) as rich lays it out, without markup."""
    for part in parts:
        if isinstance(part, str):
            typer.echo(plain(part), err=err)  # noqa: TID251 - the one place
        else:
            from sessions.console import PlainConsole

            PlainConsole(stderr=err).print(part)


def _written_out(char: str) -> str:
    units = char.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[at : at + 2].hex()}" for at in range(0, len(units), 2))
