"""Step 9: the proof. Every device answers, a dry run 30 mm above, a touch, the self-check, and six judged presses."""

from __future__ import annotations

import asyncio
import math
import tempfile
from dataclasses import replace
from pathlib import Path

from brushloop.collect.commission.visit import Step, Taught, Visit, rig_of
from brushloop.collect.engine import CollectRequest
from brushloop.collect.engine.engine import Engine
from brushloop.collect.engine.open_or_resume import Opening
from brushloop.collect.errors import NotAccepted
from brushloop.collect.photograph.photographer import FASTER
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.doctor import examine
from brushloop.collect.touch.heights import plane_of
from brushloop.collect.walk import check_protocol
from brushloop.drivers.host import finished
from brushloop.sessions.events import CaptureResult, SelfCheckResult, ZeroTouchResult
from brushloop.sessions.journal import JOURNAL_NAME, replay

HEIGHT = "paper.touch_z_mm"
ABOVE_MM = 30.0
SLOW_MM_S = 45.0
PRESSES = 6
"""Presses that all have to count."""
PRESS_SHARE = 0.6
"""Depth of the judged presses as a share of the deepest."""
DEEPEST_DRY_MM = 24.0
SLOW_CAMERA_MS = 600.0
"""A camera that is later than this makes every photograph slow, and says that something buffers its pictures."""
POLL_S = 0.1
LEAST_SIGMA_MM = 0.01


class ProofStep(Step):
    """Prove the whole rig; it is ready once it has passed."""

    name = "proof"
    title = "Proof"
    minutes = 20

    async def carry_out(self, visit: Visit) -> None:
        """Prove what was taught, and measure height and delay by it. Raises `NotAccepted` and what the run raises."""
        rig = rig_of(visit.notebook, visit.rig_path)
        visit.working("asking every device")
        findings = await examine(rig, visit.clock)
        for finding in findings:
            visit.say(f"{finding.device}: {finding.identity or finding.address}; {finding.notes}")
        if ill := [finding for finding in findings if not finding.well]:
            raise NotAccepted(f"{ill[0].device}: {ill[0].problem}.", ill[0].remedy)
        depth_mm = min(PRESS_SHARE * rig.brush.max_depth_mm, DEEPEST_DRY_MM)
        protocol = f'kind = "grid"\ndepths_mm = [{depth_mm:g}]\ntilts_deg = [0.0]\nrepeats = {PRESSES}\n'
        await visit.may_move(f"Dry run, {ABOVE_MM:g} mm above the sheet")
        with tempfile.TemporaryDirectory(prefix="brushloop-proof-") as dry_folder:
            await self._run(visit, Path(dry_folder), protocol, dry=True)
        visit.say("The dry run made every move of a press without touching anything.")
        await visit.may_move(
            f"Touch the sheet, press three marks and {PRESSES} strokes (needs ink in the well and a blank sheet)"
        )
        folder = tempfile.mkdtemp(prefix=f"{visit.rig_path.stem}.proof-", dir=visit.rig_path.parent)
        session = await self._run(visit, Path(folder), protocol, dry=False)
        visit.say(f"Recorded in {session}.")
        self._keep(visit, rig, session)

    async def _run(self, visit: Visit, folder: Path, protocol: str, *, dry: bool) -> Path:
        """Run the protocol slowly on what was taught; returns the session's folder.

        Raises `ConfigError` before anything is connected if a pose would lie outside the limits.
        """
        protocol_path = folder / "protocol.toml"
        protocol_path.write_text(protocol, encoding="utf-8")
        request = CollectRequest(visit.rig_path, protocol_path, folder / "sessions", armed=True, on_screen=True)
        opening = Opening.load(replace(request, dry_run_mm=ABOVE_MM if dry else None))
        opening = replace(opening, rig=slowly(opening.rig))
        check_protocol(visit.rig_path, protocol_path, opening.rig, opening.protocol)
        engine = Engine(opening, None, visit.clock)
        engine.start()
        try:
            await self._followed(visit, engine)
        finally:
            if not engine.finished:
                engine.stop()
            await finished(asyncio.to_thread(engine.join))
        return Path(engine.snapshot().folder)

    async def _followed(self, visit: Visit, engine: Engine) -> None:
        """Show what the run does and reports, and pass its questions on to the person."""
        shown, doing = 0, ""
        while True:
            over, now = engine.finished, engine.snapshot()
            if lines := now.messages[shown:]:
                visit.say(*lines)
            shown = len(now.messages)
            if over:
                return
            if now.step != doing:
                doing = now.step
                visit.working(f"run: {doing}")
            if (asked := now.prompt) is not None:
                engine.answer(asked.number, str(await visit.ask(asked, back=False)))
            await asyncio.sleep(POLL_S)

    def _keep(self, visit: Visit, rig: RigConfig, session: Path) -> None:
        touch, check, captures = read_proof(session)
        plane = plane_of(touch)
        by_hand_mm = visit.notebook.get(HEIGHT)
        x_mm, y_mm = visit.notebook.get("paper.touch_point_mm")
        z_mm, worst_mm = plane.touch_z_mm(x_mm, y_mm), max(map(abs, touch.residuals_mm), default=0.0)
        sigmas_mm = [sigma_mm for point in touch.points for sigma_mm in point.sigma_mm if sigma_mm is not None]
        sigma_mm = max([*sigmas_mm, LEAST_SIGMA_MM])
        delay_ms, jitter_ms = captures[-1].camera_delay_ms or 0.0, captures[-1].camera_jitter_ms or 0.0
        how = f"touched by {touch.method}, leaning by {plane.slope_deg:.2f} deg"
        residuals = f"residuals up to {worst_mm:.3f} mm (limit: {rig.touch.residual_mm:g} mm)"
        known = f"{z_mm - by_hand_mm:+.2f} mm from the touch by hand; {residuals}"
        again = sum(capture.retake for capture in captures)
        later = "time from when the arm leaves until the picture shows it"
        visit.keep(
            {
                HEIGHT: Taught(z_mm, how, sigma_mm, known),
                "aside.plane": Taught([plane.z0_mm, plane.slope_x, plane.slope_y], how, sigma_mm),
                "camera.latency_ms": Taught(delay_ms, later, known=f"measurements differ by {jitter_ms:.0f} ms"),
            }
        )
        visit.say(
            f"touch height {z_mm:.3f} mm, {known}",
            f"marks off by {math.hypot(*check.offset_mm):.1f} mm (limit: {rig.self_check.offset_mm:g} mm), turned "
            f"{check.turn_deg:+.2f} deg (limit: {rig.self_check.turn_deg:g} deg)",
            f"{PRESSES} presses passed the quality checks, {again} were repeated",
            f"camera delay {delay_ms:.0f} ms (slow above {SLOW_CAMERA_MS:g} ms)",
        )
        if delay_ms > SLOW_CAMERA_MS:
            visit.say("The camera is slow: each photograph waits for it.", FASTER, tone="warning")
        visit.say(
            "Lay a fresh sheet before the first session: this one has the marks of the proof.",
            "Then: brushloop collect --protocol examples/protocol-quick.toml --arm",
            "READY",
        )


def slowly(rig: RigConfig) -> RigConfig:
    """The same rig, with no move faster than 50 mm/s."""
    motion, limits = rig.motion, rig.robot.limits
    slow = {name: min(getattr(motion, name), SLOW_MM_S) for name in ("travel_speed_mm_s", "press_speed_mm_s")}
    capped = limits.model_copy(update={"speed_mm_s": min(limits.speed_mm_s, 50.0)})
    robot = rig.robot.model_copy(update={"limits": capped})
    return rig.model_copy(update={"motion": motion.model_copy(update=slow), "robot": robot})


def read_proof(session: Path) -> tuple[ZeroTouchResult, SelfCheckResult, list[CaptureResult]]:
    """Touch, self-check and captures of the session. Raises `NotAccepted` unless all presses passed the quality checks.

    Captures that failed a check and were repeated on another patch are among them.
    """
    state = replay(session / JOURNAL_NAME)
    captures = state.results(CaptureResult)
    last = [capture for capture in captures if not capture.retake]
    passed = [capture for capture in last if capture.kept and not capture.verdict]
    if len(passed) < PRESSES:
        why = sorted({capture.verdict or "left out" for capture in last if capture not in passed})
        raise NotAccepted(
            f"{len(passed)} of {PRESSES} presses passed the quality checks "
            f"({', '.join(why) or 'the others were not made'}).",
            "Check ink, light and sheet in the pictures above, then run the proof again.",
        )
    return state.results(ZeroTouchResult)[-1], state.results(SelfCheckResult)[-1], captures
