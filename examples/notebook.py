"""What a notebook does with a session: look at its presses, compare models, and fit the brush.

Run it with the folder of a session: `python examples/notebook.py sessions/2026-11-23-grid-01`. Without one, it collects
nine presses on the loopback rig first, which takes about a minute; nothing of that is a result on paper.
"""

from __future__ import annotations

import sys
from pathlib import Path

import brushloop
from brushloop import Session

FOLDER = Path("notebook-run")
PROTOCOL = 'kind = "grid"\ndepths_mm = [11.0, 15.0, 20.0]\ntilts_deg = [0.0, 5.0, 10.0]\nrepeats = 1\n'


def collected() -> Session:
    """A new session on the loopback rig, calibrated."""
    FOLDER.mkdir(exist_ok=True)
    protocol = FOLDER / "protocol.toml"
    protocol.write_text(PROTOCOL, encoding="utf-8")
    with brushloop.simulate(FOLDER / "rig") as rig:
        folder = brushloop.collect_session(rig.config, protocol, FOLDER / "sessions", sheet=1)
    brushloop.calibrate_session(folder)
    return Session(folder)


def main() -> None:
    """Compare each model with each press, before and after the brush is fitted."""
    session = Session(sys.argv[1]) if len(sys.argv) > 1 else collected()
    print(session.header.session_id, session.header.source)
    fitted = brushloop.fit(session)
    for press in session.presses():
        try:
            ink = press.coverage
        except brushloop.CaptureRefused as refused:
            print(press.name, "not used:", refused)
            continue
        at = press.condition
        published = brushloop.compare(ink, brushloop.predict(at, session.brush).image)
        own = brushloop.compare(ink, brushloop.predict(at, fitted.fit).image)
        print(
            f"{press.name}: H {at.depth_mm:g} mm, reached {press.reached_mm}, CSIM {published.csim:.3f}, {own.csim:.3f}"
        )
    print(fitted.page)


if __name__ == "__main__":
    main()
